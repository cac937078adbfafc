"""How the crystal of a specimen is oriented, and how that follows from poles seen on a map."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_number, check_sequence, check_switch, shown
from apt_evap.crystallography.poles import plane_normals
from apt_evap.detection.projection import Projection
from apt_evap.specimen import lattice
from apt_evap.specimen.materials import Material, as_material

_SAME = math.radians(0.1)  # directions closer than this count as one


@dataclass(frozen=True)
class Orientation:
    """Orientation of a crystal in the frame of the specimen, as `Tip` takes it.

    Parameters
    ----------
    material : Material or str
        The crystal; a str is looked up by `material`.
    axis : sequence of float
        Crystal direction along +z, see `lattice.rotation_to_axis`.
    rotation : float
        Rotation of the crystal about z [degrees].

    Raises
    ------
    ValueError
        If there is no such material or direction.
    """

    material: Material
    axis: tuple = (0, 0, 1)
    rotation: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "material", as_material(self.material))
        object.__setattr__(self, "axis", lattice.check_axis(self.material.structure, self.axis))
        object.__setattr__(self, "rotation", check_number(self.rotation, "rotation", unit="degrees"))

    @cached_property
    def matrix(self) -> Floats:
        """Rotation from crystal to specimen, shape (3, 3): `matrix @ crystal vector = vector of the specimen`."""
        return lattice.rotation_to_axis(self.material, self.axis, self.rotation)

    @classmethod
    def from_matrix(cls, material: Any, matrix: ArrayLike) -> "Orientation":
        """Make the orientation that has a rotation matrix.

        Parameters
        ----------
        material : Material or str
            The crystal.
        matrix : array_like
            Rotation from crystal to specimen, shape (3, 3).

        Returns
        -------
        Orientation
            Its `matrix` is the given one but for rounding.

        Raises
        ------
        ValueError
            If the matrix is no rotation.
        """
        matrix = check_array(matrix, "matrix", (3, 3))
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6 or np.linalg.det(matrix) < 0:
            raise ValueError(
                f"matrix must be a rotation: orthogonal to 1e-6, with a determinant of +1, got {shown(matrix)}"
            )
        host = cls(material).material
        vectors = lattice.direction_vectors(host.structure, host.a, host.c)
        axis = tuple((matrix[2] @ np.linalg.inv(vectors)).tolist())
        turned = matrix @ lattice.rotation_to_axis(host, axis).T
        angle = math.atan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
        return cls(host, axis, math.degrees(angle))

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> "Orientation":
        """Make the orientation of a tip from its settings: `Tip.settings`, or ``Run.settings["tip"]``.

        Raises
        ------
        ValueError
            If they are not those of one crystal: the tip was made from positions.
        """
        if "axis" not in settings:
            raise ValueError(f"settings must hold the axis of a crystal, got {', '.join(settings)}")
        return cls(Material(**settings["material"]), tuple(settings["axis"]), settings["rotation"])

    def directions(self, crystal_directions: ArrayLike) -> Floats:
        """Turn vectors in the frame of the crystal into the frame of the specimen, both of shape (n, 3)."""
        return check_array(crystal_directions, "crystal_directions", ("n", 3)) @ self.matrix.T


@dataclass(frozen=True, eq=False)
class FittedOrientation:
    """Orientation of a specimen that was found from poles on a map.

    Parameters
    ----------
    orientation : Orientation
        Its axis and rotation can be given to `Tip`.
    projection : Projection
        The projection, with the scale that was fitted or given.
    residuals : ndarray
        How far each pole is from where it should be [mm], shape (n,).
    rms : float
        Root of the mean square of the angles by which poles and points on lines are off, times the scale [mm].
    angle_error, scale_error : float
        Standard errors of the orientation [degrees] and the scale [mm/rad], from the residuals; NaN if there are
        no more places than unknowns, or if the scale was given.
    mirrored_rms : float
        The rms of the best fit of the other handedness [mm].
    """

    orientation: Orientation
    projection: Projection
    residuals: np.ndarray
    rms: float
    angle_error: float
    scale_error: float
    mirrored_rms: float


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
    """Find the orientation of a specimen from poles at known places of a map.

    Two poles, or a pole and a zone line through it with a scale, are enough; of more the sum of the squares of the
    angles between where they are and where they should be is least.

    Parameters
    ----------
    material : Material or str
        The crystal.
    planes : array_like of int
        Miller indices of the poles, shape (n, 3), for hcp also (n, 4).
    places : array_like
        Where they are [mm], shape (n, 2).
    lines : sequence
        Zone lines from the first pole towards others that may lie outside of the map: the Miller indices of such a
        pole, and points on the line [mm], shape (m, 2).
    scale : float, optional
        Distance on the detector for an angle on the specimen [mm/rad]; fitted if not given.
    centre : tuple of float
        Where the axis of the specimen meets the detector [mm].
    mirror : bool or None
        Whether the map is a mirror image; None takes what fits better.

    Returns
    -------
    FittedOrientation

    Raises
    ------
    ValueError
        If the poles do not fix an orientation, or without a scale that.

    Notes
    -----
    The projection is the azimuthal equidistant one. The start is the rotation that aligns the directions best
    (Kabsch's method). All lattices here have mirror planes: for every indexing of a map there is one of its mirror
    image that fits as well, with other members of the same families. Only given indices tell the handedness.
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
        raise ValueError("scale must be given [mm/rad]: one pole with zone lines does not fix it")
    if len(places) > 1 and np.ptp(places, axis=0).max() == 0:
        raise ValueError(f"places must be different for different poles, got {places[0]} for all")
    fits = [_fit(normals, places, lines, projection, scale is None, mirrored) for mirrored in (False, True)]
    # exact data fit either way but for rounding
    chosen = bool(fits[1][2] < 0.999 * fits[0][2] - 1e-9) if mirror is None else bool(mirror)
    matrix, projection, rms, errors = fits[chosen]
    residuals = np.linalg.norm(projection.places(normals @ matrix.T) - places, axis=1)
    angle_error, scale_error = errors
    return FittedOrientation(
        orientation=Orientation.from_matrix(host, matrix),
        projection=projection,
        residuals=residuals,
        rms=rms,
        angle_error=angle_error,
        scale_error=scale_error,
        mirrored_rms=fits[not chosen][2],
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
        raise ValueError(f"the plane of a line must be another one than that of the first pole, got {plane!r}")
    zone /= np.linalg.norm(zone)
    return zone, np.cross(zone, first), check_array(points, "points of a line", ("m", 2))


def _fit(normals, places, lines, projection, free, mirror):
    """Rotation matrix, projection, rms [mm] and standard errors of the least squares fit of one handedness."""
    tries = []
    for scale in _scales(normals, places, projection) if free else [projection.scale]:
        start = Projection(scale, projection.centre, mirror)
        rotation = _aligned(normals, places, lines, start)

        def misfit(unknowns, rotation=rotation, scale=scale):
            turned = (scipy.spatial.transform.Rotation.from_rotvec(unknowns[:3]) * rotation).as_matrix()
            trial = Projection(scale * math.exp(unknowns[3]) if free else scale, projection.centre, mirror)
            # on the sphere, times the scale: finite for any rotation
            measured, expected = trial.directions(places), normals @ turned.T
            parts = [_offsets(measured, expected).ravel()]
            parts += [np.arcsin(trial.directions(points) @ (turned @ zone)) for zone, _, points in lines]
            return trial.scale * np.concatenate(parts)

        fit = scipy.optimize.least_squares(
            misfit, np.zeros(4 if free else 3), x_scale=0.1, xtol=1e-12, ftol=1e-12, gtol=1e-12
        )
        fitted_scale = scale * math.exp(fit.x[3]) if free else scale
        tries.append((fit.cost, fitted_scale, rotation, fit))
    reach = np.linalg.norm(places - projection.centre, axis=1).max()
    tries = [each for each in tries if reach <= Projection(each[1]).rim] or tries
    # two poles may fit exactly in two ways: of equals the one with the smaller angles
    least = min(each[0] for each in tries)
    _, scale, rotation, fit = max(
        (each for each in tries if each[0] <= 1.001 * least + 1e-12), key=lambda each: each[1]
    )
    matrix = (scipy.spatial.transform.Rotation.from_rotvec(fit.x[:3]) * rotation).as_matrix()
    surplus = len(fit.fun) - len(fit.x) - len(places)  # of the three offsets of a pole two are independent
    errors = [math.nan, math.nan]
    if surplus > 0:
        covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * (2 * fit.cost / surplus)
        errors[0] = math.degrees(math.sqrt(np.trace(covariance[:3, :3])))
        errors[1] = float(scale * math.sqrt(covariance[3, 3])) if free else math.nan
    rms = math.sqrt(2 * fit.cost / (len(fit.fun) - 2 * len(places)))
    return matrix, Projection(scale, projection.centre, mirror), rms, errors


def _offsets(first, second):
    """Rotation vectors from unit vectors to others, as long as the angle between them, shape (n, 3)."""
    across = np.cross(first, second)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("ij,ij->i", first, second))
    return across * np.divide(angle, sine, out=np.ones_like(sine), where=sine > 0)[:, None]


def _scales(normals, places, projection):
    """Scales to start from [mm/rad]: the median over all pairs of poles of distance over angle, and some around."""
    first, second = np.triu_indices(len(normals), 1)
    angles = np.linalg.norm(_offsets(normals[first], normals[second]), axis=1)
    apart = angles > _SAME
    ratio = np.median(np.linalg.norm(places[first] - places[second], axis=1)[apart] / angles[apart])
    least = np.linalg.norm(places - projection.centre, axis=1).max() / Projection(1.0).rim
    return [max(ratio * factor, least) for factor in (0.7, 1.0, 1.4, 2.5)]


def _aligned(normals, places, lines, projection):
    """The rotation that brings poles and lines nearest to where they are seen."""
    specimen, crystal = [projection.directions(places)], [normals]
    for _, tangent, points in lines:
        there = projection.directions(points)
        angle = np.arctan2(np.linalg.norm(np.cross(there, specimen[0][0]), axis=1), there @ specimen[0][0])
        specimen.append(there)
        crystal.append(np.cos(angle)[:, None] * normals[0] + np.sin(angle)[:, None] * tangent)
    specimen, crystal = np.concatenate(specimen), np.concatenate(crystal)
    return scipy.spatial.transform.Rotation.align_vectors(specimen, crystal)[0]
