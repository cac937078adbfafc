"""Constants of a reconstruction from the crystal: compression from the poles on the map, radius from their planes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import for_json
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_array, check_kind, check_number, short_text
from apt_evap.detection.hits import Hits, MassRanges
from apt_evap.maps.crystallography.directions import plain_label, plane_periods, poles
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.index_map import Indexing, index
from apt_evap.reconstruction.lattice_planes import LatticePlanes, find_planes
from apt_evap.reconstruction.reconstruct import reconstruct
from apt_evap.reconstruction.reconstructed import Reconstruction
from apt_evap.reconstruction.reconstruction_settings import ReconstructionSettings, resolved_settings
from apt_evap.specimen.materials import Material

COMPRESSION_ERROR = 0.035
"""Relative standard error of the compression of a map: RMS 0.036 for seven specimens of the benchmark (0.045 by the
scale in the centre), 0.02 for 55 of one orientation (0.06)."""
NARROW, NARROW_ERROR = 28.0, 0.17
"""Angle of the rim on the surface [degrees] below which it has the second error: in three decided views of 20 degrees
compressions are 1.22 to 1.28 times the right one, in four of 25 degrees 0.97 to 1.06, and rims at 25 to 28 degrees."""

_COMMON = 0.03  # relative error of all spacings: radius times compression is RMS 0.017 off for seven specimens
_OF_POLE = 0.02  # of the spacing at one pole
_FAMILIES = 4  # of planes, those with the largest spacings
_FROM_RIM = math.radians(3.0)  # least distance of a pole from the rim
_CYLINDER = 1.0  # radius about a pole, which moves with the surface [nm]
_WIDEST = 6.0  # angle of planes from their pole [degrees]: at most 3.3 in three specimens
_REACH, _SPACINGS = 0.8, 3  # distance of the ions of a pair along the normal, at least [nm], and in spacings
_FEWEST = 50  # ions at a pole
_FACTORS = 0.5, 2.0  # of the spacing: beyond, planes are others
_AGREE = 3.0  # standard errors
_PASSES = 6
_SETTLED = 0.003  # change of the radius in the last pass


class PoleSpacing(NamedTuple):
    """Lattice planes at a pole, before the last change of the radius."""

    pole: tuple[int, ...]
    """Miller indices."""
    ratio: float
    """Spacing over the true one."""
    error: float
    """Standard error of the ratio."""
    planes: LatticePlanes
    """The planes, with the pole along z."""
    is_used: bool
    """Whether planes were found, and agree with those at most other poles."""


@dataclass(frozen=True, eq=False)
class CrystalConstants:
    """Constants that the crystal of a specimen determines; made by `constants_of_crystal`.

    Parameters
    ----------
    constants : dict
        "compression", "projection", and "radius", "initial_radius" or "field_factor", for `reconstruct`.
    covariance : ndarray, shape (3, 3)
        Relative covariances of compression, radius and efficiency, for `position_covariances`.
    poles : tuple of PoleSpacing
        The poles in view.
    indexing : Indexing or None
        What the map shows; None if the orientation was given.
    """

    constants: dict[str, Any]
    covariance: Floats = field(repr=False)
    poles: tuple[PoleSpacing, ...] = field(repr=False)
    indexing: Indexing | None = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        """Return constants, covariance and the spacings at the poles in plain types.

        Returns
        -------
        dict
        """
        poles = [
            {"pole": one.pole, "ratio": one.ratio, "error": one.error, "is_used": one.is_used} for one in self.poles
        ]
        return {"constants": for_json(self.constants), "covariance": self.covariance.tolist(), "poles": poles}

    def __str__(self) -> str:
        compression, radius, _ = np.sqrt(np.diag(self.covariance))
        name = next(key for key in self.constants if key not in ("compression", "projection"))
        return (
            f"compression {self.constants['compression']:.3f} ± {compression:.1%}, {name.replace('_', ' ')} "
            f"{float(np.median(self.constants[name])):.4g} ± {radius:.1%}, correlation of compression and radius "
            f"{self.covariance[0, 1] / max(compression * radius, 1e-12):.2f}; {_texts(self.poles)}"
        )


def constants_of_crystal(
    hits: Hits,
    settings: ReconstructionSettings | None = None,
    *,
    shape: str = "cap",
    ranges: MassRanges | None = None,
    solutes: Sequence[str] = (),
    labels: ArrayLike | None = None,
    orientation: Orientation | None = None,
    compressions: Sequence[float] = (0.95, 2.2),
    compression_error: float | None = None,
    efficiency_error: float = 0.05,
    **constants: Any,
) -> CrystalConstants:
    r"""Image compression, and radius or field factor, from the poles of a crystal and the spacing of their planes.

    Parameters
    ----------
    hits : Hits
        Ions in the sequence of evaporation.
    settings, **constants
        As for `reconstruct`, with an element. Radius, initial radius or field factor are where to start from, within a
        factor of 1.4. The projection is "compressed".
    shape, ranges, solutes, labels
        As for `reconstruct`: the constants are those for this shape.
    orientation : Orientation, optional
        That of the crystal. Then the compression is that of the settings. By default both are those of `index`.
    compressions : sequence of two float
        Compressions between which the map is searched.
    compression_error, efficiency_error : float
        Relative standard errors of compression and efficiency. That of a compression by the map is 0.035 by default, or
        0.17 if the rim of the view is less than 28 degrees from the axis on the surface; of a given one 0.035.

    Returns
    -------
    CrystalConstants

    Raises
    ------
    ValueError
        If the map shows no orientation, no planes are found at its poles, or their spacings disagree; if the element is
        missing or not that of the orientation, or a number out of range.

    Notes
    -----
    The compression is that of the whole view: the flight length over the scale of `index` at the rim, on a map of the
    angles of flight. At each pole of the four families with the largest spacings, `find_planes` looks at the ions
    within 1 nm of it on the surface at their time. Depths, and the spacings with them, go with
    :math:`1/(\eta R^2 \sin^2\theta_m)`: the radius is multiplied by the root of the mean ratio of the spacings to the
    true ones, without those that are more than 3 standard errors from their median, until it changes by less than
    0.3 %, at most six times, first by the cap; a last change is part of the error. More than half of the poles with
    planes must agree, and two if the map does not decide. That they agree does not test the compression.

    The radius has the errors of the spacings, and follows an error of the compression by :math:`-\theta_m /
    \tan\theta_m` and one of the efficiency by -1/2, so positions are less wrong than by both errors alone.
    """
    for name, right in (("projection", "compressed"), ("lens", None)):
        if constants.get(name, right) != right:
            raise ValueError(f"{name} must be left out: a compression is found, got {short_text(constants[name])}")
    if orientation is not None and settings is None and "compression" not in constants:
        raise ValueError("compression must be given with an orientation, got none: poles agree with a wrong one, too")
    known = resolved_settings(settings, {**constants, "projection": "compressed"})
    element = check_kind(known.element, "element", Material, "a Material, or a str of one")
    if orientation is not None:
        crystal = check_kind(orientation, "orientation", Orientation, "an Orientation").material
        if (crystal.structure, crystal.a, crystal.c) != (element.structure, element.a, element.c):
            raise ValueError(f"orientation must be of {element.name}, the element, got {crystal.name}")
    known_error = 0.0 if compression_error is None else compression_error
    for value, name in ((known_error, "compression_error"), (efficiency_error, "efficiency_error")):
        check_number(value, name, at_least=0, below=0.5)
    indexing, reason = None, "the orientation is given"
    if orientation is None:
        indexing = _index(hits, known, element, compressions)
        reason, candidate = f"{indexing.verdict}: {indexing.reason}", indexing.best
        # the z of a candidate is the centre of the ions: turned until it is the centre of the detector
        turn = _turn(candidate.projection.directions([[0.0, 0.0]])[0])
        orientation = Orientation.from_matrix(element, turn @ candidate.orientation.matrix)
        scale = indexing.best.projection.scale * (1 + indexing.best.rim_change)  # that of the whole view, at the rim
        known = replace(known, compression=known.distance / scale)
    surface: dict[str, Any] = {"shape": shape, "ranges": ranges, "solutes": solutes, "labels": labels}
    mean = math.inf
    for number in range(_PASSES):
        found = reconstruct(hits, known, **(surface if number else {}))
        is_last = (number > 1 and abs(mean) < 2 * _SETTLED) or number == _PASSES - 1
        spacings = _spacings(found, orientation, **({} if is_last else {"scattered": 0}))
        mean, error, used = _mean(spacings, reason)
        known = _with_radius(known, math.exp(mean / 2))
        if is_last:
            break
    spacings = [one._replace(is_used=bool(use)) for one, use in zip(spacings, used, strict=True)]
    enough = 1 if indexing is None or indexing.decided else 2
    if 2 * used.sum() <= sum(one.planes.found for one in spacings) or used.sum() < enough:
        raise ValueError(f"planes must agree at most poles, got {_texts(spacings)}; {reason}")
    rim = float(np.mean(found.geometry.rim_angles(found.hits, found.radii)))
    if compression_error is None:
        is_narrow = indexing is not None and rim < math.radians(NARROW)
        compression_error = NARROW_ERROR if is_narrow else COMPRESSION_ERROR
    causes = np.array([[1, 0, 0], [-rim / math.tan(rim), 1, -0.5], [0, 0, 1]])
    causes *= [compression_error, math.hypot(error, mean, _COMMON) / 2, efficiency_error]  # a mean that did not settle
    name = {"voltage": "field_factor", "shank": "initial_radius"}.get(known.mode, "radius")
    chosen = {key: getattr(known, key) for key in ("compression", "projection", name)}
    return CrystalConstants(chosen, causes @ causes.T, tuple(spacings), indexing)


def _index(hits, known, element, compressions):
    """What the map of the angles of flight shows."""
    least, largest = check_array(compressions, "compressions", (2,))
    if not 0 < least < largest:
        raise ValueError(f"compressions must be two numbers > 0, the smaller one first, got {short_text(compressions)}")
    x, y = (column.astype(np.float64) for column in hits[hits.detected].require("x", "y"))
    across = np.hypot(x, y)
    seen = across <= (known.detector_radius or math.inf)
    flat = known.distance * np.arctan(across / known.distance) / np.maximum(across, 1e-9)
    angles = Hits(x=(flat * x)[seen], y=(flat * y)[seen])
    return index(angles, element, scales=(known.distance / largest, known.distance / least))


def _with_radius(known, factor):
    """Settings with all radii times a factor."""
    if known.mode == "voltage":
        return replace(known, field_factor=known.field_factor / factor)
    name = "initial_radius" if known.mode == "shank" else "radius"
    return replace(known, **{name: getattr(known, name) * factor})


def _spacings(found: Reconstruction, orientation: Orientation, scattered: int = 19) -> list[PoleSpacing]:
    """Planes at the poles in view."""
    places, angles = found.geometry.places(found.hits, found.radii)
    directions = np.column_stack([places, np.cos(angles)])
    widest = math.cos(float(np.mean(found.geometry.rim_angles(found.hits, found.radii))) - _FROM_RIM)
    crystal = poles(orientation.material, _FAMILIES)
    normals, periods = crystal.normals @ orientation.matrix.T, plane_periods(orientation.material, crystal.planes)
    spacings = []
    for number in np.flatnonzero(normals[:, 2] > widest):
        normal, true = normals[number], periods[number]
        near = np.linalg.norm(directions - normal, axis=1) * found.radii < _CYLINDER
        if np.count_nonzero(near) < _FEWEST:
            continue
        turned = found.specimen_positions[near] @ _turn(normal).T
        whole, reach = float(np.abs(turned).max()) * 3, max(_REACH, _SPACINGS * true)
        planes = find_planes(turned, radius=whole, widest=_WIDEST, reach=reach, scattered=scattered)
        ratio, error = planes.spacing / true, planes.spacing_error / true
        spacings.append(PoleSpacing(tuple(crystal.planes[number].tolist()), ratio, error, planes, False))
    return spacings


def _turn(normal):
    """Rotation of a direction to z."""
    x, y, z = normal
    turn = np.array([[0, 0, -x], [0, 0, -y], [x, y, z]])
    turn[:2, :2] = np.eye(2) - np.outer((x, y), (x, y)) / (1 + z)
    return turn


def _mean(spacings: Sequence[PoleSpacing], reason: str) -> tuple[float, float, Booleans]:
    """Mean of the logarithms of the ratios that agree, its error, and which they are; a ValueError without any."""
    ratios, errors = np.array([(one.ratio, one.error) for one in spacings]).reshape(-1, 2).T
    usable = np.array([one.planes.found for one in spacings], bool) & (ratios > _FACTORS[0]) & (ratios < _FACTORS[1])
    if not usable.any():
        got = _texts(spacings) if spacings else f"no pole with {_FEWEST} ions in view"
        raise ValueError(f"hits must have lattice planes at a pole, got {got}; {reason}")
    logs, errors = np.log(np.where(usable, ratios, 1.0)), np.hypot(errors / ratios, _OF_POLE)
    weights = np.where(usable, errors**-2.0, 0.0)
    order = np.argsort(logs)
    middle = logs[order][np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)]
    used = usable & (np.abs(logs - middle) < _AGREE * errors)
    return float(np.average(logs, weights=weights * used)), float((weights * used).sum() ** -0.5), used


def _texts(spacings):
    """Spacings at the poles as text."""
    each = (
        f"{plain_label(one.pole)} {one.ratio:.3f} ± {one.error:.3f}" + ("" if one.is_used else " (not used)")
        if one.planes.found
        else f"{plain_label(one.pole)} none"
        for one in spacings
    )
    return f"spacings of planes over the true ones: {', '.join(each)}"
