"""Point group of a crystal, and the part of it that keeps the axis of a specimen."""

import math
from itertools import permutations, product
from typing import Any

import numpy as np
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
    if check_structure(structure) != "hcp":
        signs = product((1.0, -1.0), repeat=3)
        return np.array([np.diag(sign)[list(order)] for sign in signs for order in permutations(range(3))])
    members = []
    for turn, across, along in product(range(6), (1.0, -1.0), (1.0, -1.0)):
        cosine, sine = math.cos(turn * math.pi / 3), math.sin(turn * math.pi / 3)
        members.append(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ np.diag([1.0, across, along]))
    return np.array(members)


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
