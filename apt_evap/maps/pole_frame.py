"""Bins of a map in the frame of a pole: angle from the pole, azimuth, hits and solid angle."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_kind
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.noise import hits_per_bin


class Directions(Protocol):
    """Interface of a projection: `Projection` has it."""

    def directions(self, places: ArrayLike) -> Floats:
        """Directions in the specimen at places on the detector [mm]: unit vectors of shape (n, 3) for (n, 2)."""
        ...


class PoleFrame(NamedTuple):
    """Bins inside the mask of a map, all of shape (n,) or (n, 3)."""

    directions: np.ndarray
    """Unit vectors in the frame of the projection."""
    angle: np.ndarray
    """Angle from the pole [degrees]."""
    azimuth: np.ndarray
    """Azimuth about the pole [turns], 0 to 1."""
    hits: np.ndarray
    """Hits per bin, or densities if the noise is not known."""
    solid: np.ndarray
    """Solid angle [sr]."""
    noise_known: bool
    """Whether `hits` have Poisson noise."""


def unit_vector(direction: ArrayLike, name: str = "pole") -> Floats:
    """Unit vector of a direction, shape (3,); ValueError for a zero vector."""
    vector = check_array(direction, name, (3,))
    if not np.linalg.norm(vector) > 0:
        raise ValueError(f"{name} must not be zero, got (0, 0, 0)")
    return vector / np.linalg.norm(vector)


def axes_about(pole: Floats) -> Floats:
    """Two unit vectors perpendicular to a pole, shape (2, 3): azimuth 0 towards the axis that is farthest from it."""
    first = np.eye(3)[np.abs(pole).argmin()]
    first = first - pole * (first @ pole)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(pole, first)])


def pole_frame(map: DetectorMap, projection: Directions, pole: ArrayLike, ions: float | None) -> PoleFrame:
    """Bins of a map of counts or densities in the frame of a pole, a direction in the frame of the projection."""
    check_kind(map, "map", DetectorMap, "a DetectorMap")
    check_kind(projection, "projection", "directions", "a Projection")
    pole = unit_vector(pole)
    x, y = (grid[map.mask] for grid in np.meshgrid(*map.centres))
    width, height = map.bin_size
    places = np.column_stack([x, y])
    directions = projection.directions(places)
    # solid angle of a bin, from the directions of its neighbours
    across, along = (
        projection.directions(places + half) - projection.directions(places - half)
        for half in (np.array([0.5 * width, 0.0]), np.array([0.0, 0.5 * height]))
    )
    first, second = axes_about(pole)
    hits, known = hits_per_bin(map, ions)
    return PoleFrame(
        directions=directions,
        angle=np.degrees(np.arccos(np.clip(directions @ pole, -1.0, 1.0))),
        azimuth=np.arctan2(directions @ second, directions @ first) / (2 * np.pi) % 1.0,
        hits=hits,
        solid=np.linalg.norm(np.cross(across, along), axis=1),
        noise_known=known,
    )
