"""Evaporation voltage of the ions of a run, and the history of a quantity over the ions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_kind
from apt_evap.simulation.run import Run


class SmoothedHistory(NamedTuple):
    """Percentiles of a quantity in successive sections of the ions, each of shape (k,)."""

    ions: np.ndarray
    """Middle of each section, in ions from the first."""
    low: np.ndarray
    """5th percentile, in the unit of the quantity."""
    median: np.ndarray
    """50th percentile, in this unit."""
    high: np.ndarray
    """95th percentile, in this unit."""

    def __repr__(self) -> str:
        return short_repr(self)


def evaporation_fields(run: Run) -> Floats:
    """Evaporation field of the species of each ion of a run [V/nm], shape (n,)."""
    return check_kind(run, "run", Run, "a Run").evaporation_fields


def evaporation_voltages(run: Run) -> Floats:
    """Voltage at which each ion of a run reaches its evaporation field, V F_evap / F [V], shape (n,).

    Charges and fields are proportional to the voltage: an atom that evaporates at the field F is simulated at the
    voltage V. A measurement at a constant rate would apply the result.
    """
    fields = evaporation_fields(run)
    return run.voltage * fields / run.fields


def smoothed_history(values: ArrayLike, points: int = 200) -> SmoothedHistory:
    """Median and 5 and 95 % percentiles of `points` successive sections of nearly equal length, at most one a value."""
    values = check_array(values, "values", ("n",), finite=False)
    points = check_count(points, "points", at_least=1)
    if not len(values):
        raise ValueError("values must contain at least one, got none")
    edges = np.linspace(0, len(values), min(points, len(values)) + 1).astype(int)
    sections = np.split(values, edges[1:-1])
    return SmoothedHistory(
        (edges[:-1] + edges[1:]) / 2, *np.array([np.percentile(part, [5, 50, 95]) for part in sections]).T
    )
