"""Quantiles of many numbers, without a copy of all."""

import math
from collections.abc import Callable, Iterable

import numpy as np

from apt_evap._common.types import Floats

_BINS = 1 << 16


def quantile(parts: Callable[[], Iterable[Floats]], low: float, high: float, share: float) -> float:
    """Quantile as `numpy.quantile` of the numbers in all parts, which are between two bounds.

    `parts` is called twice: the numbers are counted in bins, and those of the bins about the quantile are ordered.
    """
    scale = (_BINS - 1) / (high - low) if high > low else 0.0

    def bins(part):
        return ((part - low) * scale).astype(np.int64)

    counts = np.zeros(_BINS + 1, np.int64)
    for part in parts():
        counts += np.bincount(bins(part), minlength=len(counts))
    ends = np.cumsum(counts)
    place = share * (int(ends[-1]) - 1)
    below = math.floor(place)
    first, last = np.searchsorted(ends, [below, min(below + 1, int(ends[-1]) - 1)], side="right")
    near = np.sort(np.concatenate([part[(at >= first) & (at <= last)] for part in parts() for at in [bins(part)]]))
    at = below - int(ends[first] - counts[first])
    return float(np.quantile(near[at : at + 2], place - below))
