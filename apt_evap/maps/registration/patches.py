"""Displacements of patches of a measured map from a simulated one, for the distortion of the instrument."""

from collections.abc import Callable
from typing import Any

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.maps.registration.correlation_search import BROAD, FINE, NARROW, View, correlation

_WIDTH = 1 / 5  # of a patch, in diameters of the field of view: contains a pole or several lines
_REACH = 1 / 3  # largest displacement, in widths of a patch
_LEAST = 0.5  # correlation coefficient of a patch: unrelated patches of 400 pixels reach 0.4
_FEWEST = 6  # patches: a similarity transform has four parameters, each patch two coordinates
_FILLED = 0.7  # fraction of a patch inside both maps


def patch_displacements(
    simulated: View, measured: View, inverse_points: Callable[[Any, Any], Any], scale: float
) -> tuple[Any, Any, Floats]:
    """Places of patches by a registration, their places on the measured map, complex (n,) [mm], and weights.

    A weight is r^2 / (1 - r^2) of the correlation coefficient r.
    """
    pixel, broad = measured.diameter / FINE, BROAD * measured.diameter
    fixed = measured.flatten(NARROW * pixel, broad)
    moving = simulated.flatten(NARROW * pixel / scale, broad / scale)
    half = round(_WIDTH * FINE / 2)
    reach = round(_REACH * _WIDTH * FINE)
    steps = np.arange(-half, half + 1) * pixel
    patch = steps + 1j * steps[:, None]
    shifts = np.arange(-reach, reach + 1) * pixel
    number = int(measured.reach / (half * pixel))
    places = np.arange(-number, number + 1) * half * pixel
    patches = []
    for centre in (measured.centre + places + 1j * places[:, None]).ravel():
        points = centre + patch
        x, y = inverse_points(points.real, points.imag)
        known = np.isfinite(x)
        values, inside = moving.sample(np.where(known, x + 1j * y, 1e9))
        if np.count_nonzero(inside) < _FILLED * inside.size:
            continue
        # correlation of the patch for every shift
        scores = np.full((len(shifts), len(shifts)), -1.0)
        for row, dy in enumerate(shifts):
            for column, dx in enumerate(shifts):
                other, within = fixed.sample(points + complex(dx, dy))
                common = inside & within
                if np.count_nonzero(common) >= _FILLED * inside.size:
                    scores[row, column] = correlation(values[common], other[common])
        row, column = np.unravel_index(scores.argmax(), scores.shape)
        # the largest one, to a fraction of a pixel
        around = scores[row - 1 : row + 2, column - 1 : column + 2]
        if scores[row, column] < _LEAST or around.shape != (3, 3) or around.min() <= -1:
            continue
        move = complex(shifts[column] + pixel * _vertex(around[1]), shifts[row] + pixel * _vertex(around[:, 1]))
        r2 = min(float(scores[row, column]) ** 2, 0.999)
        patches.append((centre, centre + move, r2 / (1 - r2)))
    if len(patches) < _FEWEST:
        raise ValueError(
            f"a distortion needs at least {_FEWEST} patches of both maps with a clear correlation, got {len(patches)}"
        )
    centres, targets, weights = (np.array(column) for column in zip(*patches, strict=True))
    return centres, targets, weights


def _vertex(three):
    """Place of the vertex of a parabola through three equidistant values, in steps from the middle one."""
    curvature = three[0] - 2 * three[1] + three[2]
    return float(np.clip(0.5 * (three[0] - three[2]) / curvature, -0.5, 0.5)) if curvature < 0 else 0.0
