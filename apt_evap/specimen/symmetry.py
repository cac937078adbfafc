"""Point group of a crystal, and the parts of it that keep a direction or the axis of a specimen."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_kind
from apt_evap.specimen.lattice import check_structure
from apt_evap.specimen.materials import Material

_ANY = np.array([1.0, 0.3, 0.1])  # in no mirror plane; azimuths begin towards [100] where they can
_TOLERANCE = 1e-6  # of the axis: orientations by integers are exact to rounding


def point_group(structure: str) -> Floats:
    """Rotations and reflections that map the lattice of a structure onto itself.

    Returns
    -------
    ndarray
        Orthogonal matrices in the frame of the crystal: 48 of m-3m, or 24 of 6/mmm for hcp, shape (n, 3, 3). In diamond
        and hcp some of them map the crystal onto itself only with a shift by a part of the cell.
    """
    rotations = "D6" if check_structure(structure) == "hcp" else "O"
    members = scipy.spatial.transform.Rotation.create_group(rotations).as_matrix()
    return np.concatenate([members, -members])  # both groups contain the inversion


class PoleSymmetry(NamedTuple):
    """Symmetry of a lattice about a direction; result of `pole_symmetry`."""

    name: str
    """"6mm", "4mm", "3m", "2mm", "m" or "1"."""
    order: int
    """Order of the rotations about the direction: 1, 2, 3, 4 or 6."""
    toward: np.ndarray
    """Unit vector perpendicular to the direction, in a mirror plane if there is one, in the frame of the crystal."""


def pole_symmetry(material: Any, direction: ArrayLike) -> PoleSymmetry:
    """Symmetry of the lattice of a crystal about a direction.

    Parameters
    ----------
    material : Material
        The crystal.
    direction : array_like
        In the Cartesian frame of the crystal, of any length, shape (3,).

    Examples
    --------
    >>> from apt_evap.specimen.symmetry import pole_symmetry
    >>> for direction in ((0, 0, 1), (1, 1, 1), (0, 1, 1), (1, 1, 3), (1, 2, 3)):
    ...     print(pole_symmetry(ae.material("Ni"), direction).name)
    4mm
    3m
    2mm
    m
    1
    """
    check_kind(material, "material", Material, "a Material")
    along = check_array(direction, "direction", (3,))
    length = np.linalg.norm(along)
    if not length > 0:
        raise ValueError("direction must not be zero, got (0, 0, 0)")
    group = point_group(material.structure)
    # one of the symmetric directions stands for all: a rule for it gives them symmetric results
    to_first = group[np.argmax(group @ (along / length) @ _ANY[::-1])]
    pole = to_first @ along / length
    keeps = group[np.linalg.norm(group @ pole - pole, axis=1) < _TOLERANCE]
    rotations = np.linalg.det(keeps) > 0
    order = int(np.count_nonzero(rotations))
    mirrored = bool((~rotations).any())
    if mirrored:
        # the normal of a mirror plane is its eigenvector of -1
        normals = [np.linalg.eigh(mirror)[1][:, 0] for mirror in keeps[~rotations]]
        inside = [sign * np.cross(normal, pole) for normal in normals for sign in (1, -1)]
    else:
        inside = [np.cross(pole, np.eye(3)[np.abs(pole).argmin()])]
    toward = max(inside, key=lambda direction: float(direction @ _ANY))
    name = (f"{order}mm" if order % 2 == 0 else f"{order}m" if order > 1 else "m") if mirrored else str(order)
    return PoleSymmetry(name, order, to_first.T @ toward / np.linalg.norm(toward))


def symmetry_about_axis(material: Any, orientation: ArrayLike) -> Floats:
    """Symmetry of a crystal about the axis of a specimen: orthogonal matrices (n, 2, 2) in the plane across it.

    ``orientation @ crystal vector = vector of the specimen``, as from `rotation_to_axis`. There are 6 for fcc [111],
    and the identity alone for a general axis.
    """
    check_kind(material, "material", Material, "a Material")
    turn = check_array(orientation, "orientation", (3, 3))
    turned = turn @ point_group(material.structure) @ turn.T
    keeps = np.abs(turned[:, :, 2] - (0.0, 0.0, 1.0)).max(axis=1) < _TOLERANCE
    return turned[keeps][:, :2, :2]
