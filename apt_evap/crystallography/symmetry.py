"""Point group of a crystal, and the parts of it that keep a direction or the axis of a specimen."""

from __future__ import annotations  # help() then shows ArrayLike instead of its ten types

from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array
from apt_evap.specimen.lattice import check_structure

_TOLERANCE = 1e-6  # of the axis: orientations by integers are exact to rounding


def point_group(structure: str) -> Floats:
    """Rotations and reflections that map the lattice of a structure onto itself.

    Parameters
    ----------
    structure : str
        One of fcc, bcc, sc, diamond, hcp.

    Returns
    -------
    ndarray
        Orthogonal matrices in the frame of the crystal: 48 of m-3m, or 24 of 6/mmm for hcp, shape (n, 3, 3). In diamond
        and hcp some of them map the crystal onto itself only with a shift by a part of the cell.
    """
    rotations = "D6" if check_structure(structure) == "hcp" else "O"
    members = scipy.spatial.transform.Rotation.create_group(rotations).as_matrix()
    return np.concatenate([members, -members])  # both groups contain the inversion


def rotational_symmetry(material: Any, direction: ArrayLike) -> int:
    """Order of the rotations about a direction that map the lattice of a crystal onto itself.

    Parameters
    ----------
    material : Material
        The crystal.
    direction : array_like
        In the Cartesian frame of the crystal, of any length, shape (3,).

    Returns
    -------
    int
        1, 2, 3, 4 or 6.
    """
    along = check_array(direction, "direction", (3,))
    group = point_group(material.structure)
    turned = group[np.linalg.det(group) > 0] @ along
    return int(np.count_nonzero(np.linalg.norm(turned - along, axis=1) < _TOLERANCE * np.linalg.norm(along)))


def symmetry_about_axis(material: Any, orientation: ArrayLike) -> Floats:
    """Symmetry of a crystal about the axis of a specimen, in the plane across it.

    Parameters
    ----------
    material : Material
        The crystal.
    orientation : array_like
        ``orientation @ crystal vector = vector of the specimen``, as from `rotation_to_axis`, shape (3, 3).

    Returns
    -------
    ndarray
        Orthogonal matrices for (x, y), shape (n, 2, 2); 6 for fcc [111], and the identity alone for a general axis.
    """
    turn = check_array(orientation, "orientation", (3, 3))
    turned = turn @ point_group(material.structure) @ turn.T
    keeps = np.abs(turned[:, :, 2] - (0.0, 0.0, 1.0)).max(axis=1) < _TOLERANCE
    return turned[keeps][:, :2, :2]
