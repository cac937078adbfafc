"""Registration of a run by an indexing of the measured map, which says where the axis of the run is on it."""

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import LateralVelocity, Perturbation, RollUp
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.index_map import LEAST_IONS, Indexing, index
from apt_evap.maps.indexing.orientation_search import disc_of
from apt_evap.maps.registration.register import Registration, at_bound, register, register_points
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.run import Run
from apt_evap.specimen.symmetry import point_group
from apt_evap.warnings import RegistrationWarning, WorkflowWarning, warn

ENERGY, HEIGHT, SHARPNESS = 0.35, 0.1, 0.4
"""Energy [eV], height of the start [nm] and sharpness of the emission, those of the master patterns."""
ROLLS = 0.1
"""Fraction of the roll-up pattern below which no ion rolls up."""
# bounds of the search: the indexing determines rotation, scale and place better than a search
_ROTATION, _SCALES, _TILT = 5.0, (0.92, 1.08), math.radians(3.0)
_REACH = math.radians(15.0)  # angle from the axis of the run within which both projections are compared


def registration_start(centre: Sequence[float], scale: float) -> dict[str, Any]:
    """Start and bounds of the registration of a run with the settings of a `StartSettings`, for `register`.

    `centre` is the place of the axis on the map [mm], `scale` that of the indexed map [mm/rad].
    """
    x, y = centre
    return _bounded(Registration(0.0, 1.0, (x, y)), scale)


def index_as_run(
    measured: DetectorMap,
    crystal: Orientation | None,
    distance: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Indexing | None:
    """Index a map for the crystal of a run; the flight length of the instrument [mm] bounds the scale.

    None if there is no crystal, there are no patterns of its structure, or the map cannot decide: it has fewer than
    4,000 ions, too few bins, or no scale for this flight length.
    """
    if crystal is None or (measured.is_counts and (measured.ions or 0) < LEAST_IONS):
        return None
    try:
        return index(measured, crystal.material, distance=distance, progress=progress)
    except ValueError:  # no patterns, or a map that is too small, or one of another instrument
        return None


def indexed_start(run: Run, indexing: Indexing) -> dict[str, Any]:
    """Start and bounds of the registration of any run of a crystal on an indexed map, for `register`.

    The crystal of the run is turned into the crystal of the map, of the same structure, by the operation of its point
    group that brings the axis of the run nearest to the centre of the map. The similarity transform follows from the
    places of directions about this axis in both projections. If the operation is improper, the registration is
    mirrored.
    """
    crystal, best = Orientation.known(run.settings["tip"]), indexing.best
    if crystal is None:
        raise ValueError("the run has no crystal with a known orientation")
    seen = image_compression(run).projection
    # from the specimen of the run to that of the map: the nearest one; of equally near ones a rotation
    turns = best.orientation.matrix @ point_group(crystal.material.structure) @ crystal.matrix.T
    proper = np.linalg.det(turns) > 0
    nearest = int(np.argmax(turns[:, 2, 2] + 1e-6 * proper))
    turn, mirror = turns[nearest], not proper[nearest]
    half_angle = disc_of(indexing.map).radius / best.projection.scale
    angle = math.acos(min(turn[2, 2], 1.0))
    if angle > half_angle:
        raise ValueError(
            f"the axis of the run is {math.degrees(angle):.0f} degrees from the centre of the map, outside its field "
            f"of view of {math.degrees(half_angle):.0f} degrees (half angle): the map shows {best}"
        )
    polar, azimuth = np.meshgrid(np.linspace(0.2, 1.0, 5) * _REACH, np.arange(12) * math.pi / 6)
    axis = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    directions = axis.reshape(-1, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RegistrationWarning)  # image compressions differ
        start = register_points(seen.places(directions), best.projection.places(directions @ turn.T), mirror)
    return _bounded(start, best.projection.scale)


def _bounded(start, scale):
    """Start and bounds; `scale` is that of the map [mm/rad]."""
    return {
        "start": start,
        "rotations": (start.rotation - _ROTATION, start.rotation + _ROTATION),
        "scales": tuple(start.scale * factor for factor in _SCALES),
        "tolerance": _TILT * scale,
    }


def emission_of_pattern(rolled: float, height: float = HEIGHT) -> Perturbation:
    """The emission of the master patterns, for the registration of a run on an indexed map.

    Below 0.1 of rolled ions all leave with lateral velocities; `height` is the largest of the start that the run
    permits [nm].
    """
    height = min(height, HEIGHT)
    return RollUp(ENERGY, rolled, SHARPNESS, height) if rolled >= ROLLS else LateralVelocity(ENERGY, height)


def register_near(hits: Hits, measured: DetectorMap, bounds: dict[str, Any]) -> Registration:
    """Registration within bounds; its scale is that of the indexing if the maps do not determine one within them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RegistrationWarning)
        registration = register(hits, measured, **bounds)
    low, high = bounds["scales"]
    if at_bound(registration.scale, (low, high)):
        # poles of a smaller tip are wider, and a smaller scale makes them narrower again
        text = f"the maps do not determine the scale of the registration within {low:.3g} to {high:.3g}: "
        warn(f"{text}that of the indexing is kept", WorkflowWarning)
        return register(hits, measured, **(bounds | {"scales": bounds["start"].scale}))
    for warning in caught:
        warn(str(warning.message), RegistrationWarning)
    return registration
