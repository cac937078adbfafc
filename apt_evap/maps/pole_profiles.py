"""Profiles about a pole in degrees of crystal angle: density against the angle from it, and across its zone lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.validation import check_array, check_count, check_number
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.pole_frame import Directions, pole_frame, unit_vector
from apt_evap.maps.profiles import Profile

RADII = (0.0, 1.0, 2.0, 3.0, 6.0)
"""Edges of the radial density [degrees]."""
_INNER = 16.0  # degrees: the radial density is relative to the mean within this angle


def pole_profile(
    map: DetectorMap,
    projection: Directions,
    pole: ArrayLike = (0.0, 0.0, 1.0),
    radii: Sequence[float] = RADII,
    *,
    ions: float | None = None,
) -> Profile:
    """Density against the angle from a pole, relative to the mean within 16 degrees: how dark and how wide the pole is.

    Parameters
    ----------
    map, projection, pole, ions
        As for `ring_statistics`.
    radii : sequence of float
        Edges of the rings [degrees], increasing.

    Returns
    -------
    Profile
        `position` is the centre of each ring [degrees]; density and error are NaN for a ring without a bin.

    Raises
    ------
    ValueError
        If the radii do not increase, or the map has no hits within 16 degrees of the pole.
    """
    edges = check_array(radii, "radii", ("n",))
    if len(edges) < 2 or not (np.diff(edges) > 0).all() or edges[0] < 0:
        raise ValueError(f"radii must be at least two increasing numbers >= 0 [degrees], got {edges.tolist()}")
    frame = pole_frame(map, projection, pole, ions)
    near = frame.angle < _INNER
    if not frame.hits[near].any():
        raise ValueError(f"{map!r} has no hits within {_INNER:g} degrees of the pole")
    mean = frame.hits[near].sum() / frame.solid[near].sum()
    hits, areas = (np.histogram(frame.angle, edges, weights=values)[0] for values in (frame.hits, frame.solid))
    return _profile((edges[1:] + edges[:-1]) / 2, hits, areas, mean, frame.noise_known)


def pole_line_profile(
    map: DetectorMap,
    projection: Directions,
    pole: ArrayLike,
    toward: ArrayLike,
    *,
    inner: float = 5.0,
    outer: float = 14.0,
    width: float = 12.0,
    bins: int = 24,
    ions: float | None = None,
) -> Profile:
    """Density across the zone lines from a pole towards other directions, averaged along and over these lines.

    `fit_zone_line` gives the width and the height of the line. With an indexed map, the directions are those of other
    poles: ``orientation.directions(plane_normals)``.

    Parameters
    ----------
    map, projection, pole, ions
        As for `ring_statistics`.
    toward : array_like
        Directions in the frame of the projection to which the lines lead, shape (3,) or (n, 3). Symmetric lines are
        averaged.
    inner, outer : float
        First and last angle from the pole [degrees].
    width : float
        Width of the profile [degrees], centred on the line.
    bins : int
        Number of strips of equal width along the line, which should be wider than the bins of the map.

    Returns
    -------
    Profile
        `position` is the angle from the great circle through the pole and the other direction [degrees], positive to
        the left of the line as seen along it from outside the specimen. The density is relative to its mean.

    Raises
    ------
    ValueError
        If a direction is that of the pole, a range is empty, or there are no hits.
    """
    start = unit_vector(pole)
    directions = check_array(toward, "toward", ("n", 3) if np.ndim(toward) == 2 else (3,)).reshape(-1, 3)
    inner = check_number(inner, "inner", at_least=0, unit="degrees")
    outer = check_number(outer, "outer", above=inner, at_most=90, unit="degrees")
    width = check_number(width, "width", above=0, at_most=90, unit="degrees")
    bins = check_count(bins, "bins", at_least=1, at_most=MAX_BINS)
    frame = pole_frame(map, projection, start, ions)
    edges = width * (np.arange(bins + 1) / bins - 0.5)
    hits, areas = np.zeros(bins), np.zeros(bins)
    for direction in directions:
        along = unit_vector(direction, "toward")
        along = along - start * (along @ start)
        if np.linalg.norm(along) < 1e-6:  # rounding of a direction
            raise ValueError(f"toward must be another direction than the pole, got {direction.tolist()}")
        along /= np.linalg.norm(along)
        left = np.cross(start, along)
        distance = np.degrees(np.arctan2(frame.directions @ along, frame.directions @ start))
        across = np.degrees(np.arcsin(np.clip(frame.directions @ left, -1.0, 1.0)))
        inside = (distance >= inner) & (distance < outer)
        hits += np.histogram(across[inside], edges, weights=frame.hits[inside])[0]
        areas += np.histogram(across[inside], edges, weights=frame.solid[inside])[0]
    if not hits.any():
        raise ValueError(
            f"{map!r} has no hits within {width:g} degrees of the lines, {inner:g} to {outer:g} degrees out"
        )
    return _profile((edges[1:] + edges[:-1]) / 2, hits, areas, hits.sum() / areas.sum(), frame.noise_known)


def _profile(position, hits, areas, mean, noise_known):
    """Profile from hits and solid angles; an empty bin gets the error of one hit."""
    scale = np.where(areas > 0, areas, np.nan) * mean
    error = np.sqrt(np.maximum(hits, 1.0)) / scale if noise_known else np.full(len(position), np.nan)
    return Profile(position, hits / scale, error, "degrees")
