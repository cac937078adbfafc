"""Whether two maps agree as they lie, or better if one of them is turned or scaled about the axis of the specimen."""

import math
from dataclasses import replace

import numpy as np

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.registration.correlation_search import BROAD, MEDIUM, NARROW, View, correlation
from apt_evap.maps.registration.register import Registration

_ANGLES, _SCALES = np.arange(0.0, 360.0, 3.0), (0.85, 1.0, 1.18)
_COMMON = 0.6  # of the area that must stay common


def misplaced(simulated: DetectorMap, measured: DetectorMap, registration: Registration) -> str:
    """Say how a registered map lies better, about the axis of the specimen; "" if it lies well.

    Notes
    -----
    Compared are the correlations of the flattened maps, as in `register`, for rotations by 3 degrees and three scales.
    A difference counts from two standard errors, which are those of `register`.
    """
    common = simulated.mask & measured.mask
    try:
        views = [View(replace(counts, mask=common)) for counts in (simulated, measured)]
    except ValueError:  # no bin remains without the rim
        return ""
    diameter = views[1].diameter
    pixel = diameter / MEDIUM
    moving, fixed = (view.flatten(NARROW * pixel, BROAD * diameter) for view in views)
    centre = complex(*map(float, registration.points(0.0, 0.0)))
    x, y = (coordinates[common] for coordinates in np.meshgrid(*measured.centres))
    step = max(1, round(pixel / max(measured.bin_size)) ** 2)
    points = (x + 1j * y)[::step]
    values, inside = fixed.sample(points)
    points, values = points[inside], values[inside]

    def score(angle, scale):
        turned = centre + (points - centre) * np.exp(-1j * np.radians(angle)) / scale
        sampled, is_common = moving.sample(turned)
        if is_common.mean() <= _COMMON:
            return -1.0
        return correlation(sampled[is_common], values[is_common]) * math.sqrt(is_common.mean())

    registered = score(0.0, 1.0)
    best, angle, scale = max((score(angle, scale), angle, scale) for angle in _ANGLES for scale in _SCALES)
    patches = len(points) * step * math.prod(measured.bin_size) / (4 * math.pi * (NARROW * pixel) ** 2)
    if best - registered < 2 * math.sqrt(2 / patches) * (1 - best**2):
        return ""
    angle = (angle + 180) % 360 - 180
    better = f"turned by {angle:.0f}° and scaled by {scale:g} they correlate better"
    return f"{better}: {best:.2f} instead of {registered:.2f}"
