"""Ions that hit the detector in one pulse: their numbers, and the correlation of their masses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_number

_MOST_PAIRS = 20_000_000  # of a file: memory
_QUANTILE = 0.999  # of m/n, the largest of a histogram by default
_MARGIN = 1.1


@dataclass(frozen=True, eq=False, repr=False)
class Correlation:
    """Pairs of ions of one pulse; made by `Hits.correlation`.

    Parameters
    ----------
    first, second : ndarray
        m/n of each pair [Da], the smaller one first, shape (pairs,). A pulse of n ions has n (n - 1) / 2 pairs.
    pulses : ndarray
        Number of pulses with 1, 2, ... ions, shape (most ions,).
    """

    first: Floats
    second: Floats
    pulses: Integers

    def __len__(self) -> int:
        return len(self.first)

    def __repr__(self) -> str:
        return f"<Correlation: {len(self):,} pairs, {self.multiple_part:.1%} of the ions in pulses with others>"

    def __str__(self) -> str:
        rows = [f"{n} ions: {number:,} pulses" for n, number in enumerate(self.pulses.tolist(), 1) if number]
        return "\n".join([f"{self.multiple_part:.1%} of the ions are in pulses with others", *rows])

    @property
    def multiple_part(self) -> float:
        """Part of the ions in pulses with two or more ions."""
        ions = self.pulses * np.arange(1, len(self.pulses) + 1)
        return float(ions[1:].sum() / max(int(ions.sum()), 1))

    def histogram(self, bins: int = 400, limits: Any = None) -> tuple[Integers, Floats]:
        """Number of pairs by both m/n, each pair at both places, so that the histogram is symmetric.

        Parameters
        ----------
        bins : int
            Number of bins along each axis.
        limits : tuple of float, optional
            Lowest and highest m/n [Da]; by default from 0 to the largest that is frequent.

        Returns
        -------
        counts : ndarray of int64, shape (bins, bins)
        edges : ndarray, shape (bins + 1,)
            m/n at the edges of the bins [Da].

        Raises
        ------
        ValueError
            If bins or limits are invalid.
        """
        bins = check_count(bins, "bins", at_least=1, at_most=8192)
        if limits is None:
            largest = float(np.quantile(self.second, _QUANTILE)) if len(self) else 100.0
            limits = 0.0, _MARGIN * largest
        low, high = check_array(limits, "limits", (2,)).tolist()
        if not low < high:
            raise ValueError(f"limits must be low < high [Da], got {low:g} to {high:g}")
        edges = np.linspace(low, high, bins + 1)
        counts = np.histogram2d(self.first, self.second, (edges, edges))[0].astype(np.int64)
        return counts + counts.T, edges


def correlate(mass: Floats, pulse: Integers) -> Correlation:
    """Pairs of ions of one pulse, from m/n [Da] and number of the pulse of each ion; ValueError for too many pairs."""
    order = np.argsort(pulse, kind="stable")
    mass, pulse = np.asarray(mass, np.float64)[order], pulse[order]
    _, number = np.unique(pulse, return_counts=True)
    pairs = int((number * (number - 1) // 2).sum())
    if pairs > _MOST_PAIRS:
        raise ValueError(f"ions must have at most {_MOST_PAIRS:,} pairs, got {pairs:,}: select fewer")
    first, second = [np.zeros(0)], [np.zeros(0)]
    for step in range(1, int(number.max(initial=1))):
        rows = np.flatnonzero(pulse[step:] == pulse[:-step])
        first.append(np.minimum(mass[rows], mass[rows + step]))
        second.append(np.maximum(mass[rows], mass[rows + step]))
    return Correlation(np.concatenate(first), np.concatenate(second), np.bincount(number)[1:].astype(np.int64))


def dissociation_line(parent: float, first: float, second: float, number: int = 50) -> tuple[Floats, Floats]:
    """Apparent m/n of two fragments of an ion that breaks on its way, from its start to the end of the acceleration.

    m' = m / (1 - (1 - m / M) v) with the part v of the voltage where the ion of m/n M breaks (Saxey, Ultramicroscopy
    111, 473 (2011)).

    Parameters
    ----------
    parent : float
        m/n of the ion [Da].
    first, second : float
        m/n of its fragments [Da].
    number : int
        Number of points.

    Returns
    -------
    first, second : ndarray
        Apparent m/n [Da], shape (number,): from the m/n of the fragments to that of the ion.

    Raises
    ------
    ValueError
        If a value is not above zero.
    """
    parent, first, second = (
        check_number(value, name, above=0, unit="Da")
        for value, name in ((parent, "parent"), (first, "first"), (second, "second"))
    )
    part = np.linspace(0, 1, check_count(number, "number", at_least=2))
    line = [mass / (1 - part * (1 - mass / parent)) for mass in (first, second)]
    return line[0], line[1]
