"""Poles and zone lines that a user marks on a map, and the orientations that fit them."""

import math
import re
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.fit.structure import RegisteredProjection
from apt_evap.maps.crystallography.directions import members_of_families, poles, zones
from apt_evap.maps.crystallography.orientation import FittedOrientation, Orientation, fit_orientation
from apt_evap.specimen.materials import as_material

FAMILIES = 10
"""Families of poles that can be marked, of the largest spacings."""
_MOST = 6  # candidates
_LEAST, _LARGEST = math.radians(12.0), math.radians(45.0)  # half angles of the field of view of instruments
_SAME = math.radians(0.5)  # angles between poles that are equal for the eye
_DIGITS = 1  # of an RMS [mm] by which candidates are ordered
_AZIMUTHS = np.radians(np.arange(0.0, 361.0, 2.0))


class Overlay(NamedTuple):
    """Poles and zone lines of an orientation within the field of view of a map."""

    places: Floats
    """Positions of the poles [mm], shape (n, 2)."""
    labels: tuple[str, ...]
    """Indices of the poles, with a bar over a negative one."""
    lines: tuple[Floats, ...]
    """Points of each zone line [mm], shape (m, 2), NaN outside the map."""


@dataclass
class Marks:
    """What a user has marked on a map of a crystal.

    Parameters
    ----------
    poles : list
        Pairs of the index of a family, in the order of `families`, and a position (x, y) [mm].
    lines : list
        Zone lines through the first pole: pairs of the index of the family of another pole on the line, and positions
        on the line [mm].
    """

    material: Any
    poles: list[tuple[int, tuple[float, float]]] = field(default_factory=list)
    lines: list[tuple[int, list[tuple[float, float]]]] = field(default_factory=list)

    def __post_init__(self):
        self.material = as_material(self.material)
        crystal = poles(self.material, FAMILIES)
        self._members = members_of_families(crystal)
        self.families = tuple(plain(crystal.labels[members[0]]) for members in self._members)
        self.planes = tuple(tuple(crystal.planes[members[0]].tolist()) for members in self._members)
        self._crystal = crystal

    def fits(
        self, *, scale: float | None = None, centre: tuple[float, float] = (0.0, 0.0), mirror: bool = False
    ) -> list[FittedOrientation]:
        """Orientations that fit the marks, the best first.

        A user knows the family of a pole, not the member. The first pole is the first member. For the second pole, or
        for the first zone line if there is one pole, all different members are tried. The others are then those next
        to their marks.
        """
        if len(self.poles) < 2 and (not self.poles or not self.lines or scale is None):
            raise ValueError("mark two poles, or one pole and a zone line through it with a scale")
        options: dict[str, Any] = {"scale": scale, "centre": centre, "mirror": mirror}
        places = np.array([place for _, place in self.poles])
        if len(np.unique(np.concatenate([places, *self._points()]), axis=0)) < 2:
            raise ValueError("places of the marks must be different")
        fits: list[FittedOrientation] = []
        starts = sorted(self._starts(places, Projection(scale or 1.0, centre, mirror), scale is None))
        for *_, members, lines in starts[:_MOST]:
            pairs = [
                (self._crystal.planes[member], points) for member, points in zip(lines, self._points(), strict=True)
            ]
            fit = fit_orientation(self.material, self._crystal.planes[list(members)], places, lines=pairs, **options)
            if not any(_equal(fit, other, self._crystal) for other in fits):
                fits.append(fit)
        reach = float(np.linalg.norm(np.concatenate([places, *self._points()]) - centre, axis=1).max())

        def order(fit):
            angle = reach / fit.projection.scale
            return round(fit.rms, _DIGITS), not _LEAST <= angle <= _LARGEST, abs(math.log(angle / _LARGEST)), fit.rms

        return sorted(fits, key=order)[:_MOST]

    def _points(self):
        return [np.array(points) for _, points in self.lines]

    def _starts(self, places, projection, free):
        """Misfit [mm], distance from the usual field of view, members of the poles and of the lines.

        One for each different member of the second mark. The misfit is rounded: members that fit equally well are not
        to be ordered by rounding errors.
        """
        normals = self._crystal.normals
        first = self._members[self.poles[0][0]][0]
        of_pole = len(places) > 1
        simple = len(places) == 2 and not self.lines  # only the angle between both matters
        angles: list[float] = []
        for member in self._members[self.poles[1][0] if of_pole else self.lines[0][0]]:
            angle = math.acos(np.clip(normals[first] @ normals[member], -1, 1))
            if not _SAME < angle < math.pi - _SAME or (simple and any(abs(angle - other) < _SAME for other in angles)):
                continue
            angles.append(angle)
            scales = [projection.scale]
            if free:  # distances per angle are smaller off the centre, in most directions
                scale = float(np.linalg.norm(places[1] - places[0])) / angle
                scales = [factor * scale for factor in (0.9, 1.0, 1.1, 1.2)]
            tried = [self._matched(first, member, places, replace(projection, scale=scale)) for scale in scales]
            misfit, members, lines = min(tried)
            misfit = 0.0 if simple and free else round(misfit, _DIGITS)  # two poles fit exactly by some scale
            unusual = abs(math.log(np.linalg.norm(places, axis=1).max() / scales[1] / _LARGEST)) if free else 0.0
            yield misfit, unusual, members, lines

    def _matched(self, first, member, places, projection):
        """Members next to the marks, if the first two marks are these members."""
        normals, directions = self._crystal.normals, projection.directions(places)
        second = directions[1] if len(places) > 1 else projection.directions(self._points()[0])[-1]
        # the plane through both marks gives the rotation about the first one
        rotated = normals @ _frame(normals[first], normals[member]) @ _frame(directions[0], second).T
        members = [first]
        members += [
            self._members[family][int((rotated[self._members[family]] @ direction).argmax())]
            for (family, _), direction in zip(self.poles[1:], directions[1:], strict=True)
        ]
        squares = [_square(rotated[k], direction) for k, direction in zip(members, directions, strict=True)]
        lines = []
        for (family, _), points in zip(self.lines, self._points(), strict=True):
            across = np.cross(rotated[first], rotated[self._members[family]])
            length = np.linalg.norm(across, axis=1)
            sine = np.abs(across @ projection.directions(points).T).max(axis=1)
            sine = np.divide(sine, length, out=np.full(len(length), np.inf), where=length > 1e-6)
            lines.append(self._members[family][int(sine.argmin())])
            squares.append(float(sine.min() ** 2))
        return projection.scale * math.sqrt(np.mean(squares)), tuple(members), tuple(lines)


def overlay(
    orientation: Orientation,
    projection: Projection | RegisteredProjection,
    like: DetectorMap,
    families: int = FAMILIES,
) -> Overlay:
    """Poles and zone lines of an orientation within the field of view of a map."""
    crystal = poles(orientation.material, families)

    def places_of(directions):
        places = projection.places(directions)
        places[~like.contains(*places.T)] = np.nan
        return places

    places = places_of(orientation.directions(crystal.normals))
    inside = np.flatnonzero(np.isfinite(places[:, 0]))
    lines = []
    for axis in orientation.directions(zones(orientation.material).directions):
        first, second = np.linalg.svd(axis[None])[2][1:]
        line = places_of(np.cos(_AZIMUTHS)[:, None] * first + np.sin(_AZIMUTHS)[:, None] * second)
        if np.isfinite(line).any():
            lines.append(line)
    return Overlay(places[inside], tuple(plain(crystal.labels[k]) for k in inside), tuple(lines))


def plain(label: str) -> str:
    """Label of a pole without the math syntax of matplotlib, with bars over negative indices."""
    label = re.sub(r"\\bar\{(\d+)\}", lambda match: "".join(f"{digit}\u0305" for digit in match[1]), label)
    return label.replace("$", "").replace(r"\,", " ")


def _frame(first, second):
    """Orthonormal vectors, as columns: the first one, and a normal of the plane of both."""
    normal = np.cross(first, second)
    length = np.linalg.norm(normal)
    if length < 1e-9:
        raise ValueError("the first two marks must be at different places")
    normal = normal / length
    return np.column_stack([first, normal, np.cross(first, normal)])


def _square(first, second):
    """Squared angle between unit vectors."""
    return max(0.0, 2.0 - 2.0 * float(first @ second))


def _equal(first, second, crystal):
    """Whether two fits put the same families at the same directions, and have the same scale."""
    if abs(math.log(first.projection.scale / second.projection.scale)) > 1e-3:
        return False
    normals = [fit.orientation.directions(crystal.normals) for fit in (first, second)]
    for family in members_of_families(crystal)[:3]:
        cosines = normals[0][family] @ normals[1][family].T
        if cosines.max(axis=1).min() < math.cos(_SAME):
            return False
    return True
