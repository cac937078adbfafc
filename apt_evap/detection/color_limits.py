"""Limits of colour scales, from percentiles; without matplotlib, for pages that do not need it."""

from collections.abc import Sequence

import numpy as np

from apt_evap.detection.detector_map import DetectorMap


def color_limits(map: DetectorMap) -> tuple[float, float]:
    """Robust limits of a colour scale: the 0.5 and 99.5 percentiles of the density inside the detector.

    Returns
    -------
    tuple of float
        Lowest and highest density; 0 and 2 if all are equal.
    """
    low, high = np.percentile(map.density[map.mask], [0.5, 99.5])
    return (float(low), float(high)) if high > low else (0.0, 2.0)


def common_limits(maps: Sequence[DetectorMap]) -> tuple[float, float]:
    """Common limits of a colour scale for several maps: the 0.5 and 99.5 percentiles of all densities.

    The lower limit becomes 0 if it is less than 1/20 of the upper one. They are 0 and 2 if all densities are equal.
    """
    low, high = np.percentile(np.concatenate([map.density[map.mask] for map in maps]), [0.5, 99.5])
    if not high > low:
        return 0.0, 2.0
    return (float(low) if low > high / 20 else 0.0), float(high)
