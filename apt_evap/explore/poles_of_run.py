"""Poles of the specimen of a run on maps, and what the maps show about them, whatever the emission."""

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from apt_evap.detection.projection import Projection
from apt_evap.explore.explorer_maps import ExplorerMaps
from apt_evap.explore.marks import Overlay, overlay
from apt_evap.explore.placement import misplaced
from apt_evap.fit.confirmation import confirmed
from apt_evap.fit.structure import PoleMeasure, RegisteredProjection
from apt_evap.maps.crystallography.directions import poles
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.registration.verdict import Likeness, likeness, symmetric_places
from apt_evap.maps.rings import Ring, ring_statistics
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.run import Run
from apt_evap.specimen.symmetry import pole_symmetry

_FAMILIES = 6  # of poles over the maps
_NEAR = 15.0  # degrees: a pole farther from the axis of the specimen is not that of its apex


class Pole(NamedTuple):
    """Pole near the axis of a specimen."""

    label: str
    """Indices in the math syntax of matplotlib; "axis" for a specimen without a crystal."""
    place: tuple[float, float]
    """Position on the map [mm]."""
    fold: int
    """Rotational symmetry of the poles about it."""


class PolesOfRun:
    """Poles of the specimen of a run, on its maps in the frame of a registration, None for that of the run itself."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._kept: tuple[Any, ...] = (None, None, None, None)  # measured map, registration, measure and structure

    @cached_property
    def _projection(self):
        """Projection from the specimen onto the detector."""
        return image_compression(self._run).projection

    @cached_property
    def _orientation(self):
        return Orientation.known(self._run.settings["tip"])

    @cached_property
    def nearest(self) -> tuple[str, Any, int]:
        """Label, direction in the specimen and symmetry of the pole nearest to the axis."""
        if self._orientation is not None:
            family = poles(self._orientation.material)
            directions = self._orientation.directions(family.normals)
            nearest = int(directions[:, 2].argmax())
            if directions[nearest, 2] > math.cos(math.radians(_NEAR)):
                fold = pole_symmetry(self._orientation.material, family.normals[nearest]).order
                return family.labels[nearest], directions[nearest], fold
        return "axis", np.array([0.0, 0.0, 1.0]), 1

    def pole(self, registration: Registration | None) -> Pole:
        """The pole nearest to the axis, or the axis if there is none within 15 degrees; ValueError with few ions."""
        text, direction, fold = self.nearest
        x, y = self._projection.places(direction[None])[0]
        if registration is not None:
            x, y = registration.points(x, y)
        return Pole(text, (float(x), float(y)), fold)

    def overlay(self, maps: ExplorerMaps, registration: Registration | None) -> Overlay | None:
        """Poles and zone lines of the specimen on the maps, None without a crystal or with too few ions."""
        if self._orientation is None:
            return None
        try:
            projection = self._projection
        except ValueError:  # too few ions
            return None
        if registration is not None:
            projection = RegisteredProjection(projection, registration)
        like = maps.pictures[-1] if maps.whole is None else maps.whole
        drawn = overlay(self._orientation, projection, like, _FAMILIES)
        inside = np.flatnonzero(like.contains(*drawn.places.T))
        return drawn._replace(places=drawn.places[inside], labels=tuple(drawn.labels[k] for k in inside))

    def rings(self, maps: ExplorerMaps, registration: Registration | None) -> tuple[tuple[Ring, ...], ...]:
        """Default rings about the pole, of each map; ValueError for a ring off the map or with too few ions.

        All maps have the same projection, that of the run, centred on the pole and scaled by the registration.
        """
        pole = self.pole(registration)
        scale = 1.0 if registration is None else registration.scale
        projection = Projection(self._projection.scale * scale, pole.place, compression=self._projection.compression)
        return tuple(ring_statistics(counts, projection, fold=pole.fold) for counts in maps.present)

    def likeness(self, maps: ExplorerMaps, registration: Registration) -> Likeness:
        """Whether both maps show the same crystal along the same axis, as `Study.likeness`, and lie on each other."""
        assert maps.simulated is not None and maps.measured is not None
        arguments = maps.simulated, maps.measured, registration
        try:
            projection = self._projection
        except ValueError:  # too few ions
            projection = None
        result = likeness(*arguments, about=symmetric_places(self._orientation, projection))
        if result.verdict == "alike":
            result = confirmed(result, *self.structures(maps, registration))
        if result.verdict == "alike" and (why := misplaced(*arguments)):
            return result._replace(verdict="doubtful", reason=f"{result.reason}, but {why}: check the registration")
        return result

    def structures(self, maps: ExplorerMaps, registration: Registration) -> tuple[Any, Any]:
        """Structure of both maps about a pole, None without one whose rings are on the maps.

        The place of the pole and the structure of the measured map are kept for all emissions.
        """
        measured: Any = maps.measured
        kept = self._kept  # another thread may replace it
        if kept[0] is not measured or kept[1] != registration:
            measure = structure = None
            try:
                measure = PoleMeasure(self._run, registration, measured)
            except ValueError:
                pass
            else:
                structure = measure.structure(measured)
            self._kept = kept = measured, registration, measure, structure
        _, _, measure, structure = kept
        return None if measure is None else measure.structure(maps.simulated), structure
