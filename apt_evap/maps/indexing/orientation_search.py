"""Field of view of a map, its polar pictures without slow changes, and orientations that a search steps through.

Pictures are polar: rings about the centre of the field of view. All rotations about the axis are then one Fourier
transform along the azimuth (`joint_search`). Slow changes across the map are removed: first the mean density of every
ring, as many instruments have a strong change along the radius, then polynomials of degree four.
"""

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.detection.binning import field_of_view
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.noise import effective_ions
from apt_evap.specimen.symmetry import point_group

RINGS, AZIMUTHS = 20, 96
"""Points of a polar picture."""
SMOOTHED = 1.5
"""Standard deviation of the Gaussian that smooths the patterns [degrees], about the distance to the nearest axis."""
DEGREE = 4
"""Degree of the polynomials that are removed from maps and patterns."""
_NARROW = 1 / 40  # radii of the field of view: smoothing of the measured map
_RIM = 0.04  # radii of the field of view: its rim, where the density rises
_HITS = 40  # in the area of a Gaussian, 4 pi sigma^2, for a noise of 16 %
_DARK = 0.3  # of the median density: a rim and corners that are darker are not used
_LINE = 0.1  # radii of the field of view: dark lines up to twice as wide do not divide it
_HOT, _HOT_ERRORS = 5, 10  # medians of the neighbours, and standard errors, above which a bin is hot
BRIGHTEST = 2.5
"""Mean densities: brighter points of map and pattern are set to this."""
_RING = 0.03  # radii of the field of view: width of a ring
_TRIMMED = 0.1  # part of the darkest and of the brightest bins of a ring that its mean does not contain
_FEWEST_OF_RING = 8  # bins
_BETWEEN_RINGS = 1.5  # rings: smoothing of their means
_MOST_HITS = 1e7  # of densities without noise
_LARGEST_RATIO = 6.0  # of a bin to the mean of its ring: hot bins of densities


class UnusableMap(ValueError):
    """A map without a field of view that could show an orientation."""


class Disc(NamedTuple):
    """The largest circle inside the field of view of a map."""

    map: DetectorMap
    """The map, with the field of view as its mask."""
    centre: tuple[float, float]
    """Centre of the circle [mm]."""
    radius: float
    """Radius [mm]."""
    hits: float | None = None
    """Number of hits whose noise the map has, if it is not that of its values."""


class Start(NamedTuple):
    """An orientation that the search found."""

    matrix: np.ndarray
    """Rotation from crystal to specimen, shape (3, 3), with z along the centre of the disc."""
    scale: float
    """[mm/rad]."""
    score: float
    """Of the search: a correlation of the flattened pictures, or an evidence."""


def disc_of(map: DetectorMap) -> Disc:
    """Find the field of view of a map, without its rim and corners of low density, and the largest circle inside it."""
    if not map.values[map.mask].sum() > 0:
        raise UnusableMap(f"the map must have hits, got {map!r}")
    values = map.values if map.is_counts else map.values * (20 / map.values[map.mask].mean())
    mask = map.mask & field_of_view(np.where(map.mask, values, 0))
    map = _without_hot_bins(map)
    width, height = map.bin_size
    size = np.sqrt(np.count_nonzero(mask) * width * height / np.pi)
    # as many hits in a smoothed point as in `field_of_view`
    hits = max(float(values[mask].sum()), 1.0)
    smoothed = map.smoothed(max(_RIM, np.sqrt(_HITS / (4 * hits))) * size).values
    # dark poles are inside, and so are dark lines that end at the rim
    mask &= scipy.ndimage.binary_fill_holes(_closed(smoothed > _DARK * np.median(smoothed[mask]), map.bin_size, size))
    mask = _distance(mask, map.bin_size) > _RIM * size
    labels, n = scipy.ndimage.label(mask)
    if not n:
        raise UnusableMap(f"the map must have a field of view of more than a rim, got {map!r}")
    mask = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    distance = _distance(mask, map.bin_size)
    # the middle of all bins that are about as far from the rim, as in a rectangle
    row, column = np.argwhere(distance > distance.max() - 1.5 * max(width, height)).mean(axis=0)
    x, y = map.centres
    centre = (float(np.interp(column, np.arange(len(x)), x)), float(np.interp(row, np.arange(len(y)), y)))
    return Disc(replace(map, mask=mask), centre, float(distance.max()))


def _closed(mask, bin_size, size):
    """A mask with the dark lines between its parts filled: closed by a circle."""
    radius = _LINE * size
    far = int(np.ceil(radius / min(bin_size))) + 1
    # farther than a radius from all that is within a radius of the mask, beyond the edges of the map, too
    near = scipy.ndimage.distance_transform_edt(~np.pad(mask, far), sampling=bin_size[::-1]) <= radius
    closed = scipy.ndimage.distance_transform_edt(near, sampling=bin_size[::-1]) > radius
    return mask | closed[far:-far, far:-far]


def _without_hot_bins(map):
    """The map with the counts of every hot bin of a detector replaced by the median of its neighbours."""
    if not map.is_counts:
        return map
    neighbours = np.ones((5, 5), bool)
    neighbours[2, 2] = False
    median = scipy.ndimage.median_filter(map.values, footprint=neighbours, mode="nearest")
    hot = map.mask & (map.values > _HOT * median + _HOT_ERRORS * np.sqrt(median + 1))
    if not hot.any():
        return map
    values = np.where(hot, median, map.values)
    return replace(map, values=values, ions=int(values[map.mask].sum()), detected=None)


def _distance(mask, bin_size):
    """Distance of each bin from the rim of a mask [mm]."""
    return scipy.ndimage.distance_transform_edt(np.pad(mask, 1), sampling=bin_size[::-1])[1:-1, 1:-1]


def flattened_by_rings(disc: Disc) -> Disc:
    """Divide a map by the trimmed mean of every ring about the centre of its disc: no changes along the radius remain.

    The mask and the disc stay those of the map itself, as the rim of a flattened map is as bright as its middle.
    """
    map = disc.map
    try:
        hits = float(map.values[map.mask].sum()) if map.is_counts else effective_ions(map)
    except ValueError as error:  # few bins
        raise UnusableMap(str(error)) from error
    x, y = np.meshgrid(*map.centres)
    rings = np.hypot(x - disc.centre[0], y - disc.centre[1]) / (_RING * disc.radius)
    smooth, area = (scipy.ndimage.gaussian_filter(values, 1.0) for values in (_masked(map), map.mask.astype(float)))
    values, number = (smooth / np.maximum(area, 1e-3))[map.mask], rings[map.mask].astype(int)
    means = np.full(number.max() + 1, np.nan)
    for ring in range(len(means)):
        inside = np.sort(values[number == ring])
        if len(inside) >= _FEWEST_OF_RING:
            trimmed = int(_TRIMMED * len(inside))
            means[ring] = inside[trimmed : len(inside) - trimmed].mean()
    known = np.flatnonzero(np.isfinite(means))
    if not len(known):
        return disc
    profile = np.interp(rings, known + 0.5, scipy.ndimage.gaussian_filter(means[known], _BETWEEN_RINGS))
    ratio = np.clip(_masked(map) / np.maximum(profile, 1e-3 * profile.max()), 0, _LARGEST_RATIO)
    flat = DetectorMap.from_array(np.where(map.mask, ratio, np.nan), map.x_edges, map.y_edges, map.mask)
    return disc._replace(map=flat, hits=min(hits, _MOST_HITS))


def _masked(map):
    return np.where(map.mask, map.values, 0.0)


def polar_grid(rings: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Radii, shape (rings,), as fractions of the rim, and azimuths [rad]."""
    return (np.arange(rings) + 0.5) / rings, np.arange(azimuths) * (2 * np.pi / azimuths)


def slow_changes(radii: Floats, azimuths: Floats) -> tuple[Floats, Floats]:
    """Orthonormal polynomials on the disc, with the areas of the points as weights, (n, k), and these weights (n,)."""
    r, phi = (values.ravel() for values in np.meshgrid(radii, azimuths, indexing="ij"))
    x, y = r * np.cos(phi), r * np.sin(phi)
    terms = np.column_stack([x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])
    weights = r / r.sum()
    return np.linalg.qr(terms * np.sqrt(weights)[:, None])[0], weights


@lru_cache(maxsize=1)
def slow_of_pictures() -> tuple[Floats, Floats]:
    """`slow_changes` of the points of a polar picture, read-only."""
    slow, weights = slow_changes(*polar_grid(RINGS, AZIMUTHS))
    slow.flags.writeable = weights.flags.writeable = False
    return slow, weights


def flattened(disc: Disc, sigma: float) -> Floats:
    """Polar picture of a map, smoothed by `sigma` [mm], without its slow changes, times the root of the areas.

    Shape (RINGS, AZIMUTHS).
    """
    radii, azimuths = polar_grid(RINGS, AZIMUTHS)
    slow, weights = slow_of_pictures()
    smoothed = disc.map.smoothed(max(sigma, _NARROW * disc.radius))
    values = np.where(smoothed.mask, smoothed.values, np.nan)
    r, phi = np.meshgrid(radii * disc.radius, azimuths, indexing="ij")
    x, y = smoothed.centres
    width, height = smoothed.bin_size
    index = np.stack(
        [(disc.centre[1] + r * np.sin(phi) - y[0]) / height, (disc.centre[0] + r * np.cos(phi) - x[0]) / width]
    )
    picture = scipy.ndimage.map_coordinates(np.nan_to_num(values), index, order=1, mode="nearest").ravel()
    root = np.sqrt(weights)
    # relative to the slow changes, then without them
    background = slow @ (slow.T @ (picture * root)) / root
    relative = np.clip(picture / np.maximum(background, 0.05 * background.max()), 0, BRIGHTEST) * root
    return (relative - slow @ (slow.T @ relative)).reshape(RINGS, AZIMUTHS)


def axes_of(structure: str, step: float) -> Floats:
    """Directions about `step` degrees apart, one of each set that the point group makes equal, shape (n, 3)."""
    group = point_group(structure)
    n = int(np.ceil(4 * np.pi / np.radians(step) ** 2))
    k = np.arange(n) + 0.5  # a spiral of equal areas
    z, phi = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    points = np.column_stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z])
    # of all equal directions the one closest to a general direction
    general = np.array([0.36, 0.12, 0.93])
    return points[(points @ (general @ group).T <= (points @ general)[:, None] + 1e-12).all(axis=1)]


def about_axis(axis: Floats) -> Floats:
    """A rotation that takes an axis of the crystal to z, shape (3, 3)."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


def distinct_starts(
    scored: list[tuple[float, float, Floats, bool, float]],
    proper: Floats,
    n_max: int,
    axis_step: float,
    scale_step: float,
) -> list[Start]:
    """The best results of a search that are more than two steps from a better one.

    Steps are those of the axes [degrees] and of the logarithm of the scale. A result is its score, scale [mm/rad], turn
    of the axis, whether mirrored, and azimuth [rad]. `proper` are the rotations of the point group, shape (n, 3, 3).
    """
    scored.sort(key=lambda entry: -entry[0])
    starts: list[Start] = []
    for score, scale, turn, mirror, angle in scored:
        matrix = oriented(turn, mirror, angle)
        if not any(
            abs(math.log(scale / other.scale)) < 2.5 * scale_step
            and misorientation(matrix, other.matrix, proper) < 2 * axis_step
            for other in starts
        ):
            starts.append(Start(matrix, float(scale), float(score)))
            if len(starts) == n_max:
                break
    return starts


def oriented(turn: Floats, mirror: bool, angle: float) -> Floats:
    """Rotation from crystal to specimen of a result of the search."""
    cosine, sine = np.cos(angle), np.sin(angle)
    about = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    # the mirror image of a crystal with inversion is the crystal turned by 180 degrees about the normal of the mirror
    return about @ (np.diag([1.0, -1.0, 1.0]) @ -turn if mirror else turn)


def misorientation(first: Floats, second: Floats, rotations: Floats) -> float:
    """Smallest angle between two orientations of a crystal with these rotations as its symmetry [degrees]."""
    turn = first.T @ second
    trace = np.einsum("ij,nji->n", turn, rotations).max()
    return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))))
