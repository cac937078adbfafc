"""Crystal lattices: unit cells, orientations, and the lattice points inside a shape."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.small_matrices import lengths, matrix_product, products
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_number, short_text
from apt_evap._core.elementary import sine_and_cosine

_HALF = ((0, 0, 0), (0, 1 / 2, 1 / 2), (1 / 2, 0, 1 / 2), (1 / 2, 1 / 2, 0))

BASES = {
    "fcc": _HALF,
    "bcc": ((0, 0, 0), (1 / 2, 1 / 2, 1 / 2)),
    "sc": ((0, 0, 0),),
    "diamond": _HALF + tuple(tuple(x + 1 / 4 for x in site) for site in _HALF),
    "hcp": ((0, 0, 0), (1 / 2, 1 / 2, 0), (1 / 2, 1 / 6, 1 / 2), (0, 2 / 3, 1 / 2)),
}
"""Fractional sites of each structure in its conventional right-angled cell (hcp: a, sqrt(3) a, c)."""

COORDINATION = {"fcc": (12, 6), "bcc": (8, 6), "sc": (6, 12), "diamond": (4, 12), "hcp": (12, 6)}
"""Nearest and second neighbours in the bulk (hcp: its two shells of six, equal at c/a = 1.633, are the nearest)."""

BOND_FACTORS = {"fcc": 1.2, "bcc": 1.077, "sc": 1.2, "diamond": 1.3, "hcp": 1.2}
"""Cutoff distance of nearest neighbours, in nearest neighbour distances: half way to the second shell."""
SECOND_SHELL_FACTORS = {"fcc": 1.57, "bcc": 1.39, "sc": 1.57, "diamond": 1.77, "hcp": 1.52}
"""Cutoff distance of the second shell, in nearest neighbour distances: between the second and the third shell."""

# Percentages: fraction classified as surface atoms, of the atoms with fewer nearest neighbours than in the bulk, and of
# the other atoms down to 4 d_nn; measured on caps of radius 14 d_nn along 4 or 5 axes
SURFACE_FACTORS = {
    "fcc": (2.19, 0.42),  # 88 %, none (12 % miss only one neighbour)
    "bcc": (2.41, 0.49),  # 92 %, none; (2.19, 0.42): 94 %, 0.9 %, which is 2.6 % of the surface
    "sc": (2.19, 0.42),  # 87 %, 0.1 %
    "diamond": (2.19, 0.50),  # 91 %, 0.1 %; (2.19, 0.42): 98 %, 5 %, which is 14 % of the surface
    "hcp": (2.19, 0.42),  # 86 %, 0.01 %
}
"""Neighbourhood radius, and smallest distance of a surface atom from the mean of its neighbourhood [d_nn]."""

_BLOCK = 8  # cells per block edge: few blocks to test, few points outside the shape
_CHUNK = 2**19  # candidate points generated at once, about 50 MB of temporary arrays


def check_structure(structure: str) -> str:
    """Return `structure` if it is known; otherwise a ValueError lists the known ones."""
    return check_choice(structure, "structure", BASES)


def cell_lengths(structure: str, a: float, c: float | None = None) -> Floats:
    """Edges of the conventional right-angled cell [nm], shape (3,).

    The height c of a hexagonal cell is sqrt(8/3) a by default.
    """
    if check_structure(structure) == "hcp":
        height = math.sqrt(8 / 3) * a if c is None else check_number(c, "c", above=0, unit="nm")
        return np.array([a, math.sqrt(3) * a, height])
    return np.array([a, a, a], dtype=np.float64)


def atom_density(structure: str, a: float, c: float | None = None) -> float:
    """Number of atoms per volume of a crystal.

    Parameters
    ----------
    structure : str
        One of fcc, bcc, sc, diamond, hcp.
    a, c : float
        Lattice constants [nm]; c of hcp only.

    Returns
    -------
    float
        Density [1/nm^3].
    """
    a = check_number(a, "a", above=0, unit="nm")
    volume = float(np.prod(cell_lengths(structure, a, c)))
    return len(BASES[structure]) / volume


def nearest_neighbour_distance(structure: str, a: float, c: float | None = None) -> float:
    """Distance between nearest neighbours [nm]."""
    a = check_number(a, "a", above=0, unit="nm")
    if check_structure(structure) == "hcp":
        height = cell_lengths(structure, a, c)[2]
        return float(min(a, math.sqrt(a * a / 3 + height * height / 4)))
    return a * {"fcc": math.sqrt(1 / 2), "bcc": math.sqrt(3) / 2, "sc": 1.0, "diamond": math.sqrt(3) / 4}[structure]


def direction_vectors(structure: str, a: float, c: float | None = None) -> Floats:
    """Basis vectors of the indices of a direction, in units of a, one per row, shape (3, 3).

    The cubic axes, or for hcp a1, a2 (120 degrees apart) and c; parameters as for `cell_lengths`.
    """
    if check_structure(structure) != "hcp":
        return np.eye(3)
    height = cell_lengths(structure, a, c)[2] / a
    return np.array([[1.0, 0.0, 0.0], [-0.5, math.sqrt(3) / 2, 0.0], [0.0, 0.0, height]])


def check_axis(structure: str, axis: Sequence[float]) -> tuple[int | float, ...]:
    """Return a crystal direction, [u v w] or for hcp [u v t w], as a tuple of numbers, or raise an error.

    They are ints without a common factor if all are integers, otherwise the floats unchanged.
    """
    four = structure == "hcp" and np.shape(axis) == (4,)
    try:
        indices = check_array(axis, "axis", (4 if four else 3,), finite=False)
    except ValueError as error:
        more = ", or four such as [2, -1, -1, 0]" if structure == "hcp" else ""
        raise ValueError(f"axis must be three numbers such as [0, 1, 2]{more}, got {short_text(axis)}") from error
    if not np.isfinite(indices).all():
        raise ValueError(f"axis must be finite, got {short_text(axis)}")
    if four:
        u, v, t, w = indices
        # exactly for integers; otherwise to the rounding of a few decimals
        if abs(u + v + t) > (0 if (indices == np.rint(indices)).all() else 1e-6 * np.abs(indices).max()):
            raise ValueError(f"axis must have u + v + t = 0 for a direction [u v t w], got {short_text(axis)}")
        indices = np.array([u - t, v - t, w])
    if not indices.any():
        raise ValueError(f"axis must not be zero, got {short_text(axis)}")
    if np.abs(indices).max() > 1e6 or np.abs(indices).max() < 1e-6:
        raise ValueError(f"axis must have its largest number between 1e-6 and 1e6, got {short_text(axis)}")
    if (indices == np.rint(indices)).all():
        whole = indices.astype(np.int64)
        return tuple((whole // np.gcd.reduce(whole)).tolist())
    return tuple(indices.tolist())


def _perpendicular(structure, indices, vectors):
    """Shortest lattice direction perpendicular to `indices`; among equal ones, the one with the largest indices."""
    u, v, w = indices
    certain = [(u - 2 * v, 2 * u - v, 0)] if structure == "hcp" else [(v, -u, 0), (w, 0, -u), (0, w, -v)]
    small = np.indices((7, 7, 7)).reshape(3, -1).T - 3
    candidates = np.concatenate([small, certain])
    cartesian = matrix_product(candidates, vectors)
    long = lengths(cartesian)
    axis = matrix_product(indices, vectors)
    across = np.abs(products(cartesian, axis)) < 1e-9 * long * lengths(axis)
    candidates, long = candidates[across & (long > 0)], long[across & (long > 0)]
    shortest = candidates[long < long.min() * (1 + 1e-9)]
    return max(map(tuple, shortest.tolist()))


def rotation_to_axis(material: Any, axis: Sequence[int], rotation: float = 0.0) -> Floats:
    """Rotation that brings a crystal direction onto +z.

    If `axis` has integer indices, +x is the shortest lattice direction perpendicular to it: [1 0 0] for [0 1 2]. Among
    equally short ones it is the one with the largest indices, compared in order: [1 0 -1] for [1 1 1]. Other directions
    rarely have a perpendicular lattice direction. Then +x is taken from the edge of the right-angled cell (hcp: a,
    sqrt(3) a, c) that is most nearly perpendicular to `axis` (the first of equal ones): its component perpendicular to
    `axis`. Finally the crystal is rotated about z by `rotation`.

    Parameters
    ----------
    material : Material or str
        A material, or the name of a structure (hcp: with the ideal c/a).
    axis : sequence of float
        Direction [u v w] of any length. For hcp either [u v t w] with u + v + t = 0 (Miller-Bravais), or [u v w] in
        the vectors a1, a2 (120 degrees apart) and c.
    rotation : float
        Angle about +z, counter-clockwise seen from above [degrees].

    Returns
    -------
    ndarray
        Shape (3, 3): `matrix @ crystal vector = vector of the specimen`.

    Raises
    ------
    ValueError
        If the structure is unknown, or the axis is zero or not finite.
    """
    if not isinstance(material, str) and not hasattr(material, "structure"):
        raise ValueError(f"material must be a Material or the name of a structure, got {short_text(material)}")
    structure = check_structure(material if isinstance(material, str) else material.structure)
    a, c = (1.0, None) if isinstance(material, str) else (material.a, material.c)
    angle = math.radians(check_number(rotation, "rotation", unit="degrees"))
    vectors = direction_vectors(structure, a, c)
    indices = np.array(check_axis(structure, axis))
    z = matrix_product(indices, vectors)
    if np.issubdtype(indices.dtype, np.integer):
        x = matrix_product(np.array(_perpendicular(structure, indices, vectors)), vectors)
        z = z / lengths(z)
    else:
        z = z / lengths(z)
        # rounded: directions that differ by their length only have the same x
        edge = int(np.argmin(np.round(np.abs(z), 9)))
        x = np.eye(3)[edge] - z[edge] * z
    x = x / lengths(x)
    y = np.cross(z, x)
    sin, cos = sine_and_cosine(angle)
    return np.array([cos * x - sin * y, sin * x + cos * y, z])


def _to_specimen(coordinates, orientation, origin):
    # summed by hand: a matrix product may round differently for different numbers of points
    x, y, z = coordinates
    return np.stack(
        [row[0] * x + row[1] * y + row[2] * z + shift for row, shift in zip(orientation, origin, strict=True)],
        axis=-1,
    )


class Lattice(NamedTuple):
    """A crystal lattice in the specimen."""

    structure: str
    """One of fcc, bcc, sc, diamond, hcp."""
    a: float
    """Lattice constant [nm]."""
    c: float | None
    """Height of the hexagonal cell [nm]; None for the ideal one, and for cubic lattices."""
    orientation: ArrayLike
    """Rotation from crystal to specimen, shape (3, 3)."""
    origin: ArrayLike
    """Position of the first lattice site [nm], shape (3,)."""


def lattice_sites_in(
    lattice: Lattice,
    signed_distance: Callable[[Floats], Floats],
    bounds: ArrayLike,
    *,
    depth: Callable[[Floats], Floats] | None = None,
    tolerance: float = 0.0,
    block: int = _BLOCK,
    label: Callable[[Floats, Integers, int], NDArray[np.int32]] | None = None,
) -> tuple[Floats, NDArray[np.int32]]:
    """Sites of a lattice inside a shape, or in a shell below its surface, with a label for each of them.

    Space is divided into blocks of cells. The signed distance at the centre of a block excludes most blocks; the points
    of the others are tested. Points are ordered by their cell (first, second, third index), then by the site in the
    cell, for any size of the blocks.

    Parameters
    ----------
    lattice : Lattice
        The lattice.
    signed_distance : callable
        Takes points (n, 3) [nm], returns (n,) [nm], negative inside. The values at two points must not differ by more
        than the distance between the points.
    bounds : array_like
        Lower and upper corner of a box around the shape [nm], shape (2, 3).
    depth : callable, optional
        Takes points (n, 3) [nm], returns (n,) [nm]: the largest distance of a point below the surface. Its values at
        two points must not differ by more than the distance between the points either.
    tolerance : float
        Points at most this far outside count as inside [nm], to include points on the surface in spite of rounding.
    block : int
        Cells per edge of a block.
    label : callable, optional
        Takes points (n, 3) [nm], their cells (3, n) and the number of the site in the cell; returns a label >= 0 for
        each point, or a negative number for a site without an atom: int (n,).

    Returns
    -------
    positions : ndarray, shape (n, 3)
        [nm].
    labels : ndarray of int32, shape (n,)
        Empty without `label`.
    """
    edges = cell_lengths(lattice.structure, lattice.a, lattice.c)
    orientation = check_array(lattice.orientation, "orientation", (3, 3))
    origin = check_array(lattice.origin, "origin", (3,))
    bounds = check_array(bounds, "bounds", (2, 3))
    basis = np.array(BASES[lattice.structure], dtype=np.float64)
    # blocks of cells that cover the bounds: indices of the first one, number, and radius of the sphere around one
    corners = matrix_product(np.array(list(product(*bounds.T))) - origin, orientation) / edges
    first = np.floor((corners.min(axis=0) - 1) / block).astype(np.int64)
    count = np.ceil((corners.max(axis=0) + 1) / block).astype(np.int64) - first
    reach = 0.5 * block * float(lengths(edges)) + tolerance
    cells = np.indices((block,) * 3).reshape(3, -1)

    def inside(points, margin):
        distance = signed_distance(points)
        mask = distance <= margin
        if depth is not None:
            mask &= distance >= -(depth(points) + 2 * margin)
        return mask

    def slab(layer):
        """Points of one layer of blocks; its first cell indices occur in no other layer."""
        rows = np.indices((1, count[1], count[2])).reshape(3, -1)
        rows[0] = layer
        # blocks whose sphere reaches into the body
        low = (rows + first[:, None]) * block
        low = low[:, inside(_to_specimen((low + 0.5 * block) * edges[:, None], orientation, origin), reach)]
        # sites of their cells, in parts that fit into the memory
        for start in range(0, low.shape[1], step):
            cell = (low[:, start : start + step, None] + cells[:, None, :]).reshape(3, -1)
            for site, fraction in enumerate(basis):
                points = _to_specimen((cell + fraction[:, None]) * edges[:, None], orientation, origin)
                mask = inside(points, tolerance)
                points, labels = points[mask], None
                if label is not None:
                    labels = label(points, cell[:, mask], site)
                    mask[mask] = occupied = labels >= 0
                    points, labels = points[occupied], labels[occupied].astype(np.int32)
                # key of a site: its place in the sequence of cells, whatever the blocks are
                i, j, k = cell[:, mask] - (first * block)[:, None]
                yield ((i * count[1] * block + j) * count[2] * block + k) * len(basis) + site, points, labels

    step = max(1, _CHUNK // block**3)
    layers, all_labels = [np.empty((0, 3))], [np.empty(0, np.int32)]
    for layer in range(count[0]):
        pieces = list(slab(layer))
        if pieces:
            order = np.argsort(np.concatenate([keys for keys, _, _ in pieces]))
            layers.append(np.concatenate([points for _, points, _ in pieces])[order])
            if label is not None:
                all_labels.append(np.concatenate([labels for _, _, labels in pieces])[order])  # type: ignore[arg-type]
    return np.ascontiguousarray(np.concatenate(layers)), np.concatenate(all_labels)
