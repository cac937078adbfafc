"""Whether a registered simulated map and a measured one show the same crystal: their symmetry about one point.

The correlation of two registered maps, and their structural similarity, do not answer this: a search over all
rotations, scales and shifts finds some agreement of any two maps with dark and bright places. The symmetry about a pole
does, the axis of the simulated specimen or a pole near it. Each map is compared with itself, rotated about this point.
The correlation as a function of the angle is a curve with maxima at the rotations of the crystal. It does not change if
lines are dark instead of bright, or fainter, and it needs no agreement of the maps in place. Curves of both maps that
agree have the same fold, and lines at the same angles from each other.

Measured, with tips of R = 6 to 7 nm, 12,000 to 15,000 ions, and ions that roll up (all, or half of them with lateral
velocities), on measured maps of nickel, aluminium and tungsten: fcc [111] on nickel 0.76 to 0.80 and on aluminium 0.81
to 0.82, bcc [110] on tungsten 0.88 to 0.92. With the wrong crystal or axis: fcc [111] on tungsten 0.49 to 0.55, bcc
[110] on nickel and aluminium 0.25 to 0.30, fcc [001] on nickel -0.27, and on tungsten, whose bright lines are an X,
0.69. The correlations of the registered maps do not separate these pairs: 0.36 to 0.44 and 0.30 to 0.42. Both limits
were chosen with these numbers, for few maps. Elements with the same crystal structure are not distinguished.

With maps drawn from master patterns and a search without start, agreement alone called two of 18 wrong pairs alike. So
a doubtful registration makes the verdict doubtful (articles/measured_maps).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_kind, check_seed, check_sequence
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.registration.correlation_search import BROAD, FINE, NARROW, View, correlation
from apt_evap.maps.registration.register import Registration

ALIKE, UNLIKE = 0.7, 0.4
"""Agreement of the symmetries above which maps are alike, and below which they are not."""
_ANGLES = np.arange(0.0, 360.0, 3.0)
_NEAR = 15.0  # degrees: at smaller rotations the curve shows the width of the lines
_COMMON = 0.5  # fraction of the points that must stay in the common area at a rotation
_COMPLETE = 0.5  # fraction of the rotations for which this holds
_INNER = 0.04  # radius around the point, in diameters, without azimuthal structure
_PIXELS = FINE // 2  # across the diameter of the common area
_REMEDY = "check the material, the axis and the radius of the tip"


class Likeness(NamedTuple):
    """Whether two registered maps are alike."""

    verdict: str
    """"alike", "doubtful" or "not alike"."""
    symmetry: float
    """Agreement of the symmetries of both maps about a pole, -1 to 1; NaN if not known."""
    halves: float
    """The same for two random halves of the measured counts; NaN for densities."""
    reason: str
    """One sentence."""


def likeness(
    simulated: DetectorMap,
    measured: DetectorMap,
    registration: Registration,
    *,
    about: Sequence[ArrayLike] = ((0.0, 0.0),),
    seed: int = 0,
) -> Likeness:
    """Judge whether two maps show the same crystal along the same axis.

    Parameters
    ----------
    simulated, measured : DetectorMap
        Maps in the measured frame, on the same bins, such as those of a study.
    registration : Registration
        Transform into the measured frame.
    about : sequence of array_like
        Places of poles in the simulated frame [mm], shape (2,) each: the symmetries are compared about the first one
        around which both maps are known. By default the axis of the specimen; without a pole there it has no symmetry.
    seed : int
        Seed of the random halves of the measured counts.

    Returns
    -------
    Likeness

    Raises
    ------
    ValueError
        If the bins differ.
    """
    for name, detector_map in (("simulated", simulated), ("measured", measured)):
        check_kind(detector_map, name, DetectorMap, "a DetectorMap")
    if simulated.values.shape != measured.values.shape:
        raise ValueError(f"simulated must have the bins of the measured map, got {simulated!r} and {measured!r}")
    check_kind(registration, "registration", Registration, "a Registration")
    places = [check_array(place, "about", (2,)) for place in check_sequence(about, "about", "places [mm]")]
    if not places:
        raise ValueError("about must contain at least one place, got none")
    common = simulated.mask & measured.mask
    maps = [replace(detector_map, mask=common) for detector_map in (simulated, measured)]
    for place in places:
        x, y = registration.points(*place)
        centre = complex(float(x), float(y))
        agreement = _agreement(*(_symmetry(detector_map, centre) for detector_map in maps))
        if np.isfinite(agreement):
            break
    halves = float("nan")
    if measured.is_counts:
        half = np.random.default_rng(check_seed(seed)).binomial(measured.counts, 0.5)
        parts = (replace(maps[1], values=part) for part in (half, measured.counts - half))
        halves = _agreement(*(_symmetry(part, centre) for part in parts))
    return _verdict(agreement, halves, registration.doubtful)


def symmetric_places(orientation: Orientation | None, projection: Projection | None) -> list[tuple[float, float]]:
    """Places [mm] of the poles with a rotational symmetry near the axis of a specimen, the highest first.

    The axis alone without an orientation or a projection onto the simulated map, or if there is no such pole.
    """
    if orientation is None or projection is None:
        return [(0.0, 0.0)]
    return [(float(x), float(y)) for x, y in projection.places(orientation.symmetric_poles())] or [(0.0, 0.0)]


def _verdict(agreement, halves, doubtful):
    numbers = f"their symmetries about a pole agree to {agreement:.2f}"
    if np.isnan(agreement):
        reason = "no pole near the axis of the specimen is far enough from the rim of the maps for a verdict"
        return Likeness("doubtful", agreement, halves, reason)
    if halves < ALIKE:
        reason = f"the measurement is too noisy for a verdict: those of two halves of its ions agree to {halves:.2f}"
        return Likeness("doubtful", agreement, halves, f"{numbers}; {reason}")
    if agreement >= ALIKE and doubtful:
        reason = "but the registration is doubtful: give its start, such as that of an indexed map"
        return Likeness("doubtful", agreement, halves, f"{numbers}; {reason}")
    if agreement >= ALIKE:
        return Likeness("alike", agreement, halves, numbers)
    if agreement < UNLIKE:
        return Likeness("not alike", agreement, halves, f"{numbers}: {_REMEDY}")
    return Likeness("doubtful", agreement, halves, f"{numbers}: {ALIKE:g} is needed; {_REMEDY}")


def _symmetry(map: DetectorMap, centre: complex) -> Floats:
    """Correlation of a flattened map with itself for every rotation about a point, NaN if too little is common."""
    curve = np.full(len(_ANGLES), np.nan)
    try:
        view = View(map)
    except ValueError:  # no bin remains without the rim
        return curve
    pixel = view.diameter / _PIXELS
    image = view.flatten(NARROW * pixel, BROAD * view.diameter)
    steps = np.arange(-_PIXELS // 2, _PIXELS // 2 + 1) * pixel
    points = (steps + 1j * steps[:, None]).ravel()
    points = points[(np.abs(points) < 0.5 * view.diameter) & (np.abs(points) > _INNER * view.diameter)]
    values, inside = image.sample(centre + points)
    points, values = points[inside], values[inside]
    if not len(points):
        return curve
    for k, angle in enumerate(_ANGLES):
        rotated, shared = image.sample(centre + points * np.exp(1j * np.radians(angle)))
        if shared.mean() > _COMMON:
            curve[k] = correlation(rotated[shared], values[shared])
    return curve


def _agreement(first, second):
    """Correlation of two curves without their maximum at 0; NaN if too few rotations are known."""
    known = np.isfinite(first) & np.isfinite(second) & (np.abs((_ANGLES + 180) % 360 - 180) > _NEAR)
    if known.mean() < _COMPLETE:
        return float("nan")
    return correlation(first[known], second[known])
