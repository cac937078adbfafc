"""Marks that would decide between orientations: poles of large spacing that only one of them has at a place."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.directions import members_of_families, plain_label, poles
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.marked_poles import POLE_ERROR

_FAMILIES = 6  # of poles that are named
_APART = 3.0  # standard errors of a marked pole: nearer poles of another orientation could be the same spot


class _Spot(NamedTuple):
    place: np.ndarray
    family: str


def deciding_marks(map: DetectorMap, candidates: Sequence[tuple[Orientation, Projection]]) -> tuple[str, ...]:
    """Name for each orientation the pole that distinguishes it best from the others.

    Returns
    -------
    tuple of str
        Sentences; of an orientation that has no such pole there is none.
    """
    if len(candidates) < 2:
        return ()
    spots = [_spots(map, *candidate) for candidate in candidates]
    sentences = []
    for number, poles_here in enumerate(spots):
        scale = candidates[number][1].scale
        for spot in poles_here:  # those of the largest spacing first
            others = [other for k, rival in enumerate(spots) if k != number for other in rival]
            alike = [
                other
                for other in others
                if other.family == spot.family
                and np.hypot(*(other.place - spot.place)) < _APART * np.radians(POLE_ERROR) * scale
            ]
            if not alike:
                x, y = (round(float(value)) for value in spot.place)
                sentences.append(f"if the spot at ({x}, {y}) mm is {{{spot.family}}}: candidate {number + 1}")
                break
    return tuple(sentences)


def _spots(map, orientation, projection):
    """Poles of an orientation inside a map, those of the largest spacing first."""
    known = poles(orientation.material, _FAMILIES)
    places = projection.places(orientation.directions(known.normals))
    inside = map.contains(*places.T)
    return [
        _Spot(places[member], plain_label(known.planes[members[0]]))
        for members in members_of_families(known)
        for member in members
        if inside[member]
    ]
