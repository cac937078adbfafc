"""Marks of a user on a map: poles and zone lines, named or only pointed at, and how an orientation explains them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_sequence, short_text
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.directions import ZONES, plain_label, poles, zones
from apt_evap.specimen.materials import Material

POLE_ERROR, LINE_ERROR, LINE_OFFSET = 1.5, 3.0, 2.5
"""Standard errors of a marked pole, of the direction of a marked line, and of its distance from the zone [degrees].

Lines need not go through their pole: the arms of the lines of a tungsten map are parallel, and up to 2 degrees from
their zone on either side."""
_FAMILIES = 8  # of poles that a mark without a name may be
_FARTHEST = 5.0  # standard errors: beyond, a mark counts as explained by something else
_LARGEST_INDEX = 9  # of a pole or a zone that a map can show
_BESIDE = 0.1  # radii of the field of view: a mark may be this far outside
_CONTRADICTORY = 3.0  # standard errors of the angle between two poles, and of the root mean square of all marks
_MORE = ((1, 1, 2),)  # zones of lines that cubic maps show beside those of `ZONES`


class Mark(NamedTuple):
    """A pole or a line on a map, and what it may be."""

    places: np.ndarray
    """x and y [mm]: of a pole, shape (1, 2); of a line, of its two ends, shape (2, 2)."""
    targets: np.ndarray
    """Unit vectors in the crystal, normals of planes or zone axes, shape (n, 3)."""
    penalties: np.ndarray
    """Twice the number of families that are more likely for a mark without a name, shape (n,)."""
    is_line: bool
    """Whether it is a line."""
    text: str
    """Name for messages: places and indices."""

    def signed(self, directions: Floats, target: int) -> Floats:
        """Deviations from one target in standard errors, shape (3,) or (2,), for the directions of the places."""
        if not self.is_line:
            axis = self.targets[target] * np.sign(self.targets[target] @ directions[0])
            return np.degrees(np.cross(axis, directions[0])) / POLE_ERROR
        return self._of_line(directions, self.targets[[target]])[0]

    def _of_line(self, directions, targets):
        middle = directions.sum(axis=0)
        middle /= np.linalg.norm(middle)
        along = directions[1] - directions[0]
        along -= middle * (along @ middle)
        along /= np.linalg.norm(along)
        sines = np.stack([targets @ middle, targets @ along], axis=1)
        return np.degrees(np.arcsin(np.clip(sines, -1, 1))) / (LINE_OFFSET, LINE_ERROR)

    def residuals(self, directions: Floats) -> Floats:
        """Deviations from all targets in standard errors, shape (n, 1) or (n, 2), at most `_FARTHEST`.

        `directions` are those of the places in the frame of the crystal.
        """
        if self.is_line:
            return np.clip(self._of_line(directions, self.targets), -_FARTHEST, _FARTHEST)
        sine = np.linalg.norm(np.cross(self.targets, directions[0]), axis=1)
        return np.minimum(np.degrees(np.arcsin(np.minimum(sine, 1)))[:, None] / POLE_ERROR, _FARTHEST)

    def misfit(self, directions: Floats) -> tuple[float, int]:
        """Smallest sum of squared deviations and penalty, and its target."""
        misfits = (self.residuals(directions) ** 2).sum(axis=1) + self.penalties
        best = int(misfits.argmin())
        return float(misfits[best]), best

    def nearest(self, directions: Floats) -> int | None:
        """Number of the target that the mark may be, None if all are farther away than `_FARTHEST`."""
        target = self.misfit(directions)[1]
        return target if np.abs(self.residuals(directions)[target]).max() < _FARTHEST else None

    def deviation(self, directions: Floats) -> float:
        """Distance from the target that the mark may be [standard errors]."""
        return float(np.linalg.norm(self.signed(directions, self.misfit(directions)[1])))


def marks_of(material: Material, marked_poles: Sequence[Any], marked_lines: Sequence[Any]) -> tuple[Mark, ...]:
    """Check the marks of a user [mm].

    Poles are (x, y) or (x, y, indices), lines (x, y, x, y) of their ends or (x, y, x, y, indices of the zone axis).
    """
    marks = []
    known = poles(material, _FAMILIES)
    spacings = np.unique(-known.spacings.round(9))
    for pole in check_sequence(marked_poles, "poles", "positions"):
        place, indices = _split(pole, 2, "poles", "(x, y) or (x, y, indices)")
        if indices is None:
            targets, penalties = known.normals, 2.0 * np.searchsorted(spacings, -known.spacings.round(9))
        else:
            targets = _family(material, indices, "poles")
            penalties = np.zeros(len(targets))
        marks.append(Mark(place.reshape(1, 2), targets, penalties, False, _text_of("pole", place, indices)))
    cubic = material.structure != "hcp"
    families = ZONES[material.structure] + (_MORE if cubic else ())
    for line in check_sequence(marked_lines, "lines", "pairs of ends"):
        ends, indices = _split(line, 4, "lines", "(x, y, x, y) or (x, y, x, y, indices)")
        if np.ptp(ends.reshape(2, 2), axis=0).max() == 0:
            raise ValueError(f"the ends of a line must differ, got {short_text(line)}")
        axes = zones(material, families if indices is None else [indices])
        text = _text_of("line", ends, indices)
        marks.append(Mark(ends.reshape(2, 2), axes.directions, 2.0 * axes.families, True, text))
    return tuple(marks)


def _split(mark, n, name, expected):
    """Numbers, and indices or None, of one mark."""
    try:
        mark = tuple(mark)
        indices = mark[n] if len(mark) == n + 1 else None
        if len(mark) not in (n, n + 1):
            raise TypeError
    except TypeError:
        raise ValueError(f"{name} must be {expected}, got {short_text(mark)}") from None
    if indices is not None:
        indices = check_sequence(indices, f"indices of {name}", "integers")
        for index in indices:
            if not (isinstance(index, Integral) and abs(index) <= _LARGEST_INDEX):
                bounds = f"integers from {-_LARGEST_INDEX} to {_LARGEST_INDEX}"
                raise ValueError(f"indices of {name} must be {bounds}, got {short_text(indices)}")
    return check_array(mark[:n], name, (n,)), indices


def _text_of(kind, numbers, indices):
    called = "" if indices is None else f" called {plain_label(indices)}"
    return f"the {kind} ({', '.join(f'{number:g}' for number in numbers)}){called}"


def check_places(marks: Sequence[Mark], map: DetectorMap, radius: float) -> None:
    """Refuse marks outside a map (ValueError); `radius` is that of its field of view [mm]."""
    x, y = map.centres
    rows, columns = np.nonzero(map.mask)
    for mark in marks:
        for place in mark.places:
            if np.hypot(x[columns] - place[0], y[rows] - place[1]).min() > _BESIDE * radius:
                left, right, lower, upper = map.extent
                field = f"{left:.4g} to {right:.4g} mm by {lower:.4g} to {upper:.4g} mm"
                name = "lines" if mark.is_line else "poles"
                raise ValueError(f"{name} must be in the field of view of the map ({field}), got {mark.text}")


def contradictory_pair(marks: Sequence[Mark], centre: Sequence[float], scales: tuple[float, float]) -> str:
    """Two marked poles whose angle differs from those of their planes at any scale [mm/rad]; "" if there are none."""
    places = [mark for mark in marks if not mark.is_line]
    for first, second in combinations(places, 2):
        angles = []
        for scale in scales:
            (one,), (other,) = (Projection(scale, tuple(centre)).directions(mark.places) for mark in (first, second))
            angles.append(math.degrees(math.acos(np.clip(one @ other, -1, 1))))
        low, high = sorted(angles)
        margin = _CONTRADICTORY * math.sqrt(2) * POLE_ERROR
        expected = np.degrees(np.arccos(np.clip(first.targets @ second.targets.T, -1, 1)))
        if not ((low - margin < expected) & (expected < high + margin)).any():
            apart = f"{low:.0f} to {high:.0f} degrees apart, as no such planes are"
            return f"the marks contradict each other: {first.text} and {second.text} are {apart}"
    return ""


def contradictory_marks(marks: Sequence[Mark], deviations: Floats) -> str:
    """Marks that an orientation does not explain, by their deviations in standard errors; "" if it explains them."""
    if not len(deviations):
        return ""
    if deviations.max() < _FARTHEST and math.sqrt((deviations**2).mean()) < _CONTRADICTORY:
        return ""
    off = [mark.text for mark, deviation in zip(marks, deviations, strict=True) if deviation > _CONTRADICTORY]
    return f"the marks contradict each other or the map: the first candidate does not explain {' and '.join(off)}"


def _family(material, indices, name):
    """Normals of all members of a family of planes."""
    from apt_evap.maps.crystallography.directions import plane_normals
    from apt_evap.specimen.symmetry import point_group

    (normal,) = plane_normals(material, [indices], name)
    members = point_group(material.structure) @ normal
    return members[np.unique(members.round(6), axis=0, return_index=True)[1]]


def rotations_misfit(marks: Sequence[Mark], directions: Sequence[Floats], turn: Floats, angles: Floats) -> Floats:
    """Sum of the misfits of all marks for an axis and all rotations about it, shape (m,).

    `directions` are those of the places of each mark in the frame of the specimen, `turn` takes the axis of the crystal
    to z, and `angles` are the rotations [rad], shape (m,).
    """
    total = np.zeros(len(angles))
    cosine, sine = np.cos(angles), np.sin(angles)
    for mark, places in zip(marks, directions, strict=True):
        # targets in the specimen before the rotation; the marks are turned back
        targets = mark.targets @ turn.T
        turned = np.stack(
            [
                places[:, :1] * cosine + places[:, 1:2] * sine,
                places[:, 1:2] * cosine - places[:, :1] * sine,
                np.broadcast_to(places[:, 2:], (len(places), len(angles))),
            ],
            axis=-1,
        )  # (places, m, 3)
        if mark.is_line:
            middle = turned.sum(axis=0)
            middle /= np.linalg.norm(middle, axis=1, keepdims=True)
            along = turned[1] - turned[0]
            along -= middle * (along * middle).sum(axis=1, keepdims=True)
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            squares = (np.arcsin(np.clip(middle @ targets.T, -1, 1)) / math.radians(LINE_OFFSET)) ** 2
            squares = np.minimum(squares, _FARTHEST**2)
            direction = (np.arcsin(np.clip(along @ targets.T, -1, 1)) / math.radians(LINE_ERROR)) ** 2
            squares += np.minimum(direction, _FARTHEST**2)
        else:
            cosines = np.clip(np.abs(turned[0] @ targets.T), 0, 1)
            squares = np.minimum((np.arccos(cosines) / math.radians(POLE_ERROR)) ** 2, _FARTHEST**2)
        total += (squares + mark.penalties).min(axis=1)
    return total
