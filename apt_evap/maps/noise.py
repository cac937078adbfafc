"""Noise of a map of densities: the number of hits whose counting noise it has."""

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_number
from apt_evap.detection.detector_map import DetectorMap

_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])  # J. Immerkær, Comput. Vis. Image Underst. 64, 300 (1996)
_MEDIAN = 0.4549  # median of the square of a normal number of variance 1
_FEWEST = 50  # bins: the median of their squares has an error of 25 %


def effective_ions(map: DetectorMap) -> float:
    """Number of hits whose counting noise a map of densities has, estimated from the differences of adjacent bins.

    Parameters
    ----------
    map : DetectorMap
        Densities, not smoothed; for counts the estimate can be compared with their number.

    Returns
    -------
    float
        Number of hits inside the mask; infinite for a map without differences.

    Raises
    ------
    ValueError
        If the map is smoothed, or has less than 50 bins with eight neighbours inside the mask.

    Notes
    -----
    The mixed second difference L of 3 x 3 bins is zero for any density a(x) + b(y), such as a straight edge along an
    axis. With counts of variance n it has the variance of their sum, weighted by the squares of its coefficients. The
    density of one hit is the median of L^2 over this sum, divided by the median of the square of a normal number. The
    median disregards lines narrower than three bins, if these are few.
    """
    if check_kind(map, "map", DetectorMap, "a DetectorMap").smoothing:
        raise ValueError(f"map must not be smoothed to estimate its noise, got {map!r}")
    inside = scipy.ndimage.binary_erosion(map.mask, np.ones((3, 3)))
    if np.count_nonzero(inside) < _FEWEST:
        raise ValueError(
            f"map must have at least {_FEWEST} bins with eight neighbours, got {np.count_nonzero(inside)} in {map!r}"
        )
    values = np.where(map.mask, map.values, 0.0)
    difference, variance = (scipy.ndimage.convolve(values, kernel)[inside] for kernel in (_KERNEL, _KERNEL**2))
    known = variance > 0
    if not known.any():
        raise ValueError(f"map must have a density > 0, got {map!r}")
    of_one_hit = float(np.median(difference[known] ** 2 / variance[known])) / _MEDIAN
    return float(values.sum()) / of_one_hit if of_one_hit > 0 else float("inf")


def hits_per_bin(map: DetectorMap, ions: float | None) -> tuple[Floats, bool]:
    """Hits per bin inside the mask, shape (n,), and whether their noise is known."""
    values = np.asarray(map.values[map.mask], float)
    if ions is None:
        if map.is_counts:
            return values, True
        try:
            ions = effective_ions(map)
        except ValueError:  # smoothed or very small
            return values, False
    elif ions != float("inf"):
        ions = check_number(ions, "ions", above=0)
    total = values.sum()
    if ions == float("inf") or not total > 0:
        return values, False
    return values * (ions / total), True
