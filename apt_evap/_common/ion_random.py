"""Random numbers keyed by seed and ion number: independent of the batches and of the number of threads."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.counter_random import GAMMA, mix, open_interval
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_seed
from apt_evap._core.elementary import normal_quantile


class IonRandom:
    """Random numbers of a batch of ions, with a separate stream for each ion.

    Number `j` of an ion depends only on (seed, ion, j). Each call continues with new columns. Every column is computed
    once, also for the copies by `from_start`.

    Parameters
    ----------
    seed : int
        Seed, from 0 to 2^64 - 1.
    ions : array_like of int
        Number of each ion in the sequence of evaporation, shape (n,).

    Raises
    ------
    ValueError
        If the seed or an ion number is not an integer, or outside its range.

    Notes
    -----
    Each ion has its own SplitMix64 generator (Steele, Lea and Flood, OOPSLA 2014). Its seed is output number `ion` of a
    generator that is seeded with a hash of `seed`.
    """

    def __init__(self, seed: int, ions: ArrayLike) -> None:
        self.seed = check_seed(seed)
        ions = check_array(ions, "ions", ("n",), dtype=np.int64).view(np.uint64)
        start = mix(np.array([self.seed], dtype=np.uint64) + GAMMA)
        self._state = mix(start + (ions + np.uint64(1)) * GAMMA)
        self._column = 0
        self._columns: dict[int, Floats] = {}  # by their index, each of shape (n,)

    def __repr__(self) -> str:
        return f"IonRandom(seed={self.seed}, {len(self._state)} ions)"

    @property
    def n_used(self) -> int:
        """Number of columns that were returned so far."""
        return self._column

    def from_start(self) -> IonRandom:
        """Return the same random numbers from the first column on."""
        other = copy(self)  # with the same columns
        other._column = 0
        return other

    def uniform(self, columns: int = 1) -> Floats:
        """Return the next uniform numbers in (0, 1), shape (n, columns)."""
        first = self._column
        self._column += check_count(columns, "columns", at_least=1)
        return np.stack([self._uniform(column) for column in range(first, self._column)], axis=1)

    def _uniform(self, column):
        if column not in self._columns:
            step = np.array([column + 1], dtype=np.uint64) * GAMMA
            self._columns[column] = open_interval(mix(self._state + step))
        return self._columns[column]

    def normal(self, columns: int = 1) -> Floats:
        """Return the next normal numbers of mean 0 and variance 1, shape (n, columns)."""
        return normal_quantile(self.uniform(columns))
