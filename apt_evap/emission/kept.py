"""Emissions that keep what is computed from them, for many perturbations of one run."""

from __future__ import annotations  # help() then shows ArrayLike instead of its ten types

import copy
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import wraps
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.ion_random import IonRandom


class KeptRandom(IonRandom):
    """Random numbers that are computed once: every `rewound` copy returns the same arrays, which are read-only."""

    def __init__(self, seed: int, ions: ArrayLike) -> None:
        super().__init__(seed, ions)
        self._kept: dict[tuple[int, int], Floats] = {}

    def rewound(self) -> KeptRandom:
        """Return the same random numbers from the first column on."""
        other = copy.copy(self)  # with the same arrays
        other._column = 0
        return other

    def uniform(self, columns: int = 1) -> Floats:
        """Return the next uniform numbers in (0, 1), shape (n, columns)."""
        key = self._column, columns
        if key not in self._kept:
            numbers = super().uniform(columns)
            numbers.flags.writeable = False
            self._kept[key] = numbers
        else:
            self._column += columns
        return self._kept[key]


class KeptEmissions(Emissions):
    """Emissions that keep their random numbers, and the last result of each function decorated with `kept`.

    All results have the same bits as those of `Emissions`. Memory: 40 bytes per ion for the built-in perturbations.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "_results", {})

    @classmethod
    def of(cls, emissions: Emissions) -> KeptEmissions:
        """Return the same batch, with shared arrays."""
        return cls(**{each.name: getattr(emissions, each.name) for each in fields(emissions)})

    def random(self, seed: int) -> IonRandom:
        """Random numbers of these ions, computed once."""
        kept_random: KeptRandom | None = self._results.get("random")  # type: ignore[attr-defined]
        if kept_random is None or kept_random.seed != seed:
            kept_random = self._results["random"] = KeptRandom(seed, self.ions)  # type: ignore[attr-defined]
        return kept_random.rewound()

    def result_of(self, function: Callable[..., Any], arguments: tuple[Any, ...], options: Mapping[str, Any]) -> Any:
        """Result of a function of these emissions; that of the last call if its other arguments are the same."""
        results: dict[Any, Any] = self._results  # type: ignore[attr-defined]
        key = arguments[1:], options
        if function not in results or not _same(results[function][0], key):
            results[function] = key, function(*arguments, **options)
        return results[function][1]


def _same(first: Any, second: Any) -> bool:
    """Whether two keys are equal; arrays are compared by identity."""
    (ones, options), (others, other_options) = first, second
    pairs = zip(ones, others, strict=False)
    return (
        len(ones) == len(others)
        and all(one is other or (not isinstance(one, np.ndarray) and one == other) for one, other in pairs)
        and options == other_options
    )


Function = TypeVar("Function", bound=Callable[..., Any])


def kept(function: Function) -> Function:
    """Decorate a function of emissions that returns arrays: `KeptEmissions` keep its last result, read-only."""

    def read_only(*arguments, **options):
        results = function(*arguments, **options)
        for array in (results,) if isinstance(results, np.ndarray) else results:
            array.flags.writeable = False
        return results

    @wraps(function)
    def wrapper(emissions: Emissions, *arguments: Any, **options: Any) -> Any:
        if isinstance(emissions, KeptEmissions):
            return emissions.result_of(read_only, (emissions, *arguments), options)
        return function(emissions, *arguments, **options)

    return wrapper  # type: ignore[return-value]
