"""Orientation of the crystal of a specimen, and its fit to poles on a map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import checked, number, settings
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_sequence, check_switch, short_text
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.directions import plane_normals, poles
from apt_evap.specimen import lattice
from apt_evap.specimen.materials import as_material
from apt_evap.specimen.symmetry import point_group, pole_symmetry

_ROUNDING = 1e-9  # sines below this come from rounding
_SAME = math.radians(0.1)  # directions closer than this count as one


class OrientedPole(NamedTuple):
    """A pole of an oriented crystal, in the frame of the specimen."""

    direction: np.ndarray
    """Unit vector, shape (3,)."""
    symmetry: str
    """Symmetry of the lattice about it, such as "2mm"."""
    toward: np.ndarray
    """Unit vector perpendicular to it, in a mirror plane if there is one, shape (3,)."""


@settings
class Orientation:
    """Orientation of a crystal in the frame of the specimen, as for `Tip`.

    Examples
    --------
    >>> orientation = ae.Orientation("Ni", axis=(1, 1, 1), rotation=20.0)
    >>> (direction,) = orientation.directions([[0, 0, 1]])
    >>> print(f"[001] is {np.degrees(np.arccos(direction[2])):.2f} degrees from the axis")
    [001] is 54.74 degrees from the axis
    """

    material: Any = checked("The crystal; a str is looked up by `material`.", "Material or str", as_material)
    axis: tuple = checked(
        "Crystal direction along +z, see `specimen.rotation_to_axis`.",
        "sequence of float",
        lambda axis, name: axis,  # checked with the structure
        default=(0, 0, 1),
    )
    rotation: float = number("Rotation of the crystal about z.", default=0.0, unit="degrees")

    def _check(self):
        return {"axis": lattice.check_axis(self.material.structure, self.axis)}

    @cached_property
    def matrix(self) -> Floats:
        """Rotation from crystal to specimen, shape (3, 3): `matrix @ crystal vector = vector of the specimen`."""
        return lattice.rotation_to_axis(self.material, self.axis, self.rotation)

    @classmethod
    def from_matrix(cls, material: Any, matrix: ArrayLike) -> Orientation:
        """Make an orientation from its rotation matrix.

        Parameters
        ----------
        material : Material or str
            The crystal.
        matrix : array_like
            Rotation from crystal to specimen, shape (3, 3).

        Returns
        -------
        Orientation
            Its `matrix` equals the input, apart from rounding.

        Raises
        ------
        ValueError
            If the matrix is not a rotation.
        """
        matrix = check_array(matrix, "matrix", (3, 3))
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6 or np.linalg.det(matrix) < 0:
            raise ValueError(
                f"matrix must be a rotation (orthogonal to 1e-6, with a determinant of +1), got {short_text(matrix)}"
            )
        host = cls(material).material
        vectors = lattice.direction_vectors(host.structure, host.a, host.c)
        axis = tuple((matrix[2] @ np.linalg.inv(vectors)).tolist())
        about_z = matrix @ lattice.rotation_to_axis(host, axis).T
        angle = math.atan2(about_z[1, 0] - about_z[0, 1], about_z[0, 0] + about_z[1, 1])
        return cls(host, axis, math.degrees(angle))

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Orientation:
        """Make the orientation of a tip from its settings: `Tip.settings`, or ``Run.settings["tip"]``.

        With several phases it is that of the matrix.

        Raises
        ------
        ValueError
            If the tip was made from positions: its settings have no orientation.
        """
        if "axis" not in settings:
            raise ValueError(f"settings must contain the axis of a crystal, got {', '.join(settings)}")
        if "phases" not in settings:
            return cls(settings["material"], tuple(settings["axis"]), settings["rotation"])
        matrix = settings["phases"][0]
        axis, rotation = (settings[name] if matrix[name] is None else matrix[name] for name in ("axis", "rotation"))
        return cls(matrix["material"], tuple(axis), rotation)

    @classmethod
    def known(cls, settings: Mapping[str, Any]) -> Orientation | None:
        """Make the orientation as `from_settings`; None for a tip made from positions."""
        return cls.from_settings(settings) if "axis" in settings else None

    def euler(self) -> tuple[float, float, float]:
        """Euler angles of Bunge: rotations about z, x and z that take the frame of the specimen to that of the crystal.

        `matrix` takes the components of a vector from crystal to specimen, and the orientation matrix g of Bunge, of
        MTEX and of orix is its transpose; the angles are the same.

        Returns
        -------
        tuple of float
            phi1 and phi2 from 0 to 360 and Phi from 0 to 180 [degrees]: `matrix` is Rz(phi1) Rx(Phi) Rz(phi2). With a
            Phi of 0 or 180, phi2 is 0.
        """
        matrix = self.matrix
        sine = math.hypot(matrix[2, 0], matrix[2, 1])
        if sine > _ROUNDING:
            first, last = math.atan2(matrix[0, 2], -matrix[1, 2]), math.atan2(matrix[2, 0], matrix[2, 1])
        else:
            first, last = math.atan2(matrix[1, 0], matrix[0, 0]), 0.0
        tilt = math.degrees(math.atan2(sine, matrix[2, 2]))
        return math.degrees(first) % 360.0 % 360.0, tilt, math.degrees(last) % 360.0 % 360.0

    def to_orix(self) -> Any:
        """Make an orientation of orix, with the symmetry of the lattice.

        Returns
        -------
        orix.quaternion.Orientation
            Its matrix is the transpose of `matrix`: orix takes vectors from specimen to crystal.

        Raises
        ------
        ImportError
            If orix is not installed.
        """
        quaternion = optional_import("orix.quaternion", "to_orix")
        groups = optional_import("orix.quaternion.symmetry", "to_orix")
        symmetry = groups.D6h if self.material.structure == "hcp" else groups.Oh
        return quaternion.Orientation.from_matrix(self.matrix.T, symmetry=symmetry)

    def directions(self, crystal_directions: ArrayLike) -> Floats:
        """Rotate vectors from the frame of the crystal to the frame of the specimen, both of shape (n, 3)."""
        return check_array(crystal_directions, "crystal_directions", ("n", 3)) @ self.matrix.T

    def nearest_pole(self, plane: Sequence[int]) -> OrientedPole:
        """Pole of a family of planes that is nearest to the axis of the specimen.

        Parameters
        ----------
        plane : sequence of int
            Miller indices of one plane of the family, four for hcp.

        Returns
        -------
        OrientedPole
            In the frame of the specimen: the arguments of `maps.folded`.
        """
        normal = plane_normals(self.material, np.atleast_2d(np.asarray(plane)))[0]
        members = point_group(self.material.structure) @ normal
        nearest = members[np.argmax(np.round(self.directions(members)[:, 2], 9))]
        symmetry = pole_symmetry(self.material, nearest)
        direction, toward = self.directions([nearest, symmetry.toward])
        return OrientedPole(direction, symmetry.name, toward)

    def symmetric_poles(self, within: float = 25.0) -> Floats:
        """Directions of the poles with a rotational symmetry near the axis, the highest symmetry first.

        Parameters
        ----------
        within : float
            Largest angle from the axis [degrees].

        Returns
        -------
        ndarray
            Unit vectors in the frame of the specimen, shape (n, 3); n may be 0.
        """
        normals = poles(self.material).normals
        normals = normals[self.directions(normals)[:, 2] > math.cos(math.radians(within))]
        directions = self.directions(normals)
        orders = np.array([pole_symmetry(self.material, normal).order for normal in normals], int)
        order = np.lexsort((-directions[:, 2], -orders))
        return directions[order[orders[order] > 1]]


@dataclass(frozen=True, eq=False)
class FittedOrientation:
    """Result of `fit_orientation`.

    Parameters
    ----------
    orientation : Orientation
        The orientation; use its axis and rotation for `Tip`.
    projection : Projection
        The projection, with the fitted or given scale.
    residuals : ndarray
        Distance of each pole from its fitted position [mm], shape (n,).
    rms : float
        Root mean square angular deviation of poles and points on lines, times the scale [mm].
    angle_error, scale_error : float
        Standard errors of the orientation [degrees] and the scale [mm/rad], from the residuals; NaN if there are no
        more positions than unknowns, or if the scale was given.
    mirrored_rms : float
        `rms` of the best fit with the other handedness [mm].
    """

    orientation: Orientation
    projection: Projection
    residuals: np.ndarray
    rms: float
    angle_error: float
    scale_error: float
    mirrored_rms: float

    def __repr__(self) -> str:
        return short_repr(self)


def fit_orientation(
    material: Any,
    planes: ArrayLike,
    places: ArrayLike,
    *,
    lines: Sequence[Any] = (),
    scale: float | None = None,
    centre: tuple[float, ...] = (0.0, 0.0),
    mirror: bool | None = False,
) -> FittedOrientation:
    """Find the orientation of a specimen from the positions of poles on a map.

    Two poles, or a pole and a zone line through it with a known scale, are enough. With more of them, the fit minimises
    the sum of the squared angular deviations.

    Parameters
    ----------
    material : Material or str
        The crystal.
    planes : array_like of int
        Miller indices of the poles, shape (n, 3), for hcp also (n, 4).
    places : array_like
        Their positions [mm], shape (n, 2).
    lines : sequence
        Zone lines from the first pole to another one, which may be outside the map: pairs of the Miller indices of that
        pole, and points on the line [mm], shape (m, 2).
    scale : float, optional
        Distance on the detector per angle in the specimen [mm/rad]; fitted by default.
    centre : tuple of float
        Position of the specimen axis on the detector [mm].
    mirror : bool or None
        Whether the map is a mirror image; None selects the better fit.

    Returns
    -------
    FittedOrientation

    Raises
    ------
    ValueError
        If the poles do not determine the orientation, or the scale if it is not given.

    Notes
    -----
    The projection is the azimuthal equidistant one. The start is the rotation that aligns the directions best
    (Kabsch's method). All lattices here have mirror planes: every indexing of a map has an equally good indexing of the
    mirror image, with other members of the same families. Only known indices determine the handedness.
    """
    if mirror is not None:
        check_switch(mirror, "mirror")
    host = as_material(material)
    normals = plane_normals(host, planes)
    places = check_array(places, "places", (len(normals), 2))
    projection = Projection(1.0 if scale is None else scale, centre)
    lines = check_sequence(lines, "lines", "pairs of Miller indices and points")
    lines = [_line(host, normals[0], line) for line in lines]
    sine = np.linalg.norm(np.cross(normals[0], normals), axis=1).max()
    if sine < _SAME and not lines:
        raise ValueError("an orientation needs two poles in different directions, or a pole and a zone line")
    if scale is None and sine < _SAME:
        raise ValueError("scale [mm/rad] must be given: one pole with zone lines does not determine it")
    if len(places) > 1 and np.ptp(places, axis=0).max() == 0:
        raise ValueError(f"places of the poles must be different, got {places[0]} for all")
    fits = [_fit(normals, places, lines, projection, scale is None, mirrored) for mirrored in (False, True)]
    # exact data fit both ways, apart from rounding
    mirrored = bool(fits[1][2] < 0.999 * fits[0][2] - 1e-9) if mirror is None else bool(mirror)
    matrix, projection, rms, errors = fits[mirrored]
    residuals = np.linalg.norm(projection.places(normals @ matrix.T) - places, axis=1)
    angle_error, scale_error = errors
    return FittedOrientation(
        orientation=Orientation.from_matrix(host, matrix),
        projection=projection,
        residuals=residuals,
        rms=rms,
        angle_error=angle_error,
        scale_error=scale_error,
        mirrored_rms=fits[not mirrored][2],
    )


def _line(host, first, line):
    """Normal of the zone, tangent at the first pole, and points of one line."""
    try:
        plane, points = line
    except (TypeError, ValueError):
        raise ValueError(f"lines must be pairs of Miller indices and points, got {line!r:.80}") from None
    other = plane_normals(host, [plane], "the plane of a line")[0]
    zone = np.cross(first, other)
    if np.linalg.norm(zone) < _SAME:
        raise ValueError(f"the plane of a line must differ from that of the first pole, got {short_text(plane)}")
    zone /= np.linalg.norm(zone)
    return zone, np.cross(zone, first), check_array(points, "points of a line", ("m", 2))


def _fit(normals, places, lines, projection, free, mirror):
    """Rotation matrix, projection, rms [mm] and standard errors of the least squares fit of one handedness."""
    candidates = []
    for scale in _scales(normals, places, projection) if free else [projection.scale]:
        start = Projection(scale, projection.centre, mirror)
        rotation = _aligned(normals, places, lines, start)

        def deviations(unknowns, rotation=rotation, scale=scale):
            matrix = (scipy.spatial.transform.Rotation.from_rotvec(unknowns[:3]) * rotation).as_matrix()
            trial = Projection(scale * math.exp(unknowns[3]) if free else scale, projection.centre, mirror)
            # angles on the sphere, times the scale: finite for any rotation
            measured, expected = trial.directions(places), normals @ matrix.T
            parts = [_offsets(measured, expected).ravel()]
            parts += [np.arcsin(trial.directions(points) @ (matrix @ zone)) for zone, _, points in lines]
            return trial.scale * np.concatenate(parts)

        fit = scipy.optimize.least_squares(
            deviations, np.zeros(4 if free else 3), x_scale=0.1, xtol=1e-12, ftol=1e-12, gtol=1e-12
        )
        fitted_scale = scale * math.exp(fit.x[3]) if free else scale
        candidates.append((fit.cost, fitted_scale, rotation, fit))
    reach = np.linalg.norm(places - projection.centre, axis=1).max()
    candidates = [fitted for fitted in candidates if reach <= Projection(fitted[1]).rim] or candidates
    # two poles may fit exactly in two ways: the one with the smaller angles is selected
    least = min(cost for cost, *_ in candidates)
    _, scale, rotation, fit = max(
        (fitted for fitted in candidates if fitted[0] <= 1.001 * least + 1e-12), key=lambda fitted: fitted[1]
    )
    matrix = (scipy.spatial.transform.Rotation.from_rotvec(fit.x[:3]) * rotation).as_matrix()
    surplus = len(fit.fun) - len(fit.x) - len(places)  # two of the three offsets of a pole are independent
    errors = [math.nan, math.nan]
    if surplus > 0:
        covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * (2 * fit.cost / surplus)
        errors[0] = math.degrees(math.sqrt(np.trace(covariance[:3, :3])))
        errors[1] = float(scale * math.sqrt(covariance[3, 3])) if free else math.nan
    rms = math.sqrt(2 * fit.cost / (len(fit.fun) - 2 * len(places)))
    return matrix, Projection(scale, projection.centre, mirror), rms, errors


def _offsets(first, second):
    """Rotation vectors between pairs of unit vectors; their length is the angle, shape (n, 3)."""
    across = np.cross(first, second)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("ij,ij->i", first, second))
    return across * np.divide(angle, sine, out=np.ones_like(sine), where=sine > 0)[:, None]


def _scales(normals, places, projection):
    """Start values of the scale [mm/rad]: multiples of the median ratio of distance to angle of all pairs of poles."""
    first, second = np.triu_indices(len(normals), 1)
    angles = np.linalg.norm(_offsets(normals[first], normals[second]), axis=1)
    apart = angles > _SAME
    ratio = np.median(np.linalg.norm(places[first] - places[second], axis=1)[apart] / angles[apart])
    least = np.linalg.norm(places - projection.centre, axis=1).max() / Projection(1.0).rim
    return [max(ratio * factor, least) for factor in (0.7, 1.0, 1.4, 2.5)]


def _aligned(normals, places, lines, projection):
    """Rotation that aligns poles and lines best with their positions."""
    specimen, crystal = [projection.directions(places)], [normals]
    for _, tangent, points in lines:
        line = projection.directions(points)
        angle = np.arctan2(np.linalg.norm(np.cross(line, specimen[0][0]), axis=1), line @ specimen[0][0])
        specimen.append(line)
        crystal.append(np.cos(angle)[:, None] * normals[0] + np.sin(angle)[:, None] * tangent)
    specimen, crystal = np.concatenate(specimen), np.concatenate(crystal)
    return scipy.spatial.transform.Rotation.align_vectors(specimen, crystal)[0]
