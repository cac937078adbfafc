"""Crystal lattices: unit cells, orientations, and the lattice points inside a shape."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.small_matrices import lengths, matrix_product, products
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_choice, check_number, shown
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

COORDINATION = {"fcc": 12, "bcc": 8, "sc": 6, "diamond": 4, "hcp": 12}
"""Nearest neighbours in the bulk (hcp: the two shells of six, which fall together at c/a = 1.633)."""

# Caps of 14 d_nn along 4 or 5 axes: of the atoms with fewer nearest neighbours than in the bulk, and of the
# others down to 4 d_nn, so many are taken for surface atoms
BOND_FACTORS = {"fcc": 1.2, "bcc": 1.077, "sc": 1.2, "diamond": 1.3, "hcp": 1.2}
"""Nearest neighbours are closer than this many nearest neighbour distances: half way to the second shell."""

SURFACE_FACTORS = {
    "fcc": (2.19, 0.42),  # 88 %, none (12 % have lost one neighbour only)
    "bcc": (2.41, 0.49),  # 92 %, none; (2.19, 0.42): 94 %, 0.9 %, which is 2.6 % of the surface
    "sc": (2.19, 0.42),  # 87 %, 0.1 %
    "diamond": (2.19, 0.50),  # 91 %, 0.1 %; (2.19, 0.42): 98 %, 5 %, which is 14 % of the surface
    "hcp": (2.19, 0.42),  # 86 %, 0.01 %
}
"""Neighbourhood radius and least distance of a surface atom from its mean, in nearest neighbour distances."""

_BLOCK = 8  # cells per block edge: a block is cheap to test and its surface layer cheap to waste
_CHUNK = 2**19  # candidate points expanded at once, about 50 MB of temporaries


def check_structure(structure: str) -> str:
    """Return `structure` if it is known, or say which ones are (ValueError)."""
    return check_choice(structure, "structure", BASES)


def cell_lengths(structure: str, a: float, c: float | None = None) -> Floats:
    """Edges of the conventional right-angled cell [nm], shape (3,).

    Parameters
    ----------
    structure : str
        One of fcc, bcc, sc, diamond, hcp.
    a : float
        Lattice constant [nm].
    c : float, optional
        Height of the hexagonal cell [nm]; hcp only, the ideal sqrt(8/3) a if not given.

    Returns
    -------
    ndarray
    """
    if check_structure(structure) == "hcp":
        return np.array([a, math.sqrt(3) * a, c if c is not None else math.sqrt(8 / 3) * a])
    return np.array([a, a, a], dtype=np.float64)


def atom_density(structure: str, a: float, c: float | None = None) -> float:
    """Atoms per volume [1/nm^3]; parameters as for `cell_lengths`."""
    return len(BASES[structure]) / float(np.prod(cell_lengths(structure, a, c)))


def nearest_neighbour_distance(structure: str, a: float, c: float | None = None) -> float:
    """Distance between nearest neighbours [nm]; parameters as for `cell_lengths`."""
    if check_structure(structure) == "hcp":
        height = cell_lengths(structure, a, c)[2]
        return float(min(a, math.sqrt(a * a / 3 + height * height / 4)))
    return a * {"fcc": math.sqrt(1 / 2), "bcc": math.sqrt(3) / 2, "sc": 1.0, "diamond": math.sqrt(3) / 4}[structure]


def direction_vectors(structure: str, a: float, c: float | None = None) -> Floats:
    """Vectors that the indices of a direction multiply, in units of a, one a row, shape (3, 3).

    The cubic axes, or for hcp a1, a2 (120 degrees apart) and c; parameters as for `cell_lengths`.
    """
    if check_structure(structure) != "hcp":
        return np.eye(3)
    height = cell_lengths(structure, a, c)[2] / a
    return np.array([[1.0, 0.0, 0.0], [-0.5, math.sqrt(3) / 2, 0.0], [0.0, 0.0, height]])


def check_axis(structure: str, axis: Sequence[float], name: str = "axis") -> tuple[int | float, ...]:
    """Return a crystal direction as three plain numbers in a tuple, or say what is wrong.

    Parameters
    ----------
    structure : str
        One of fcc, bcc, sc, diamond, hcp.
    axis : sequence of float
        Direction [u v w], or for hcp [u v t w] with u + v + t = 0.
    name : str
        Name of the argument, for the message.

    Returns
    -------
    tuple
        Ints without a common factor if all are whole numbers, else floats as they are given.

    Raises
    ------
    ValueError
        If it is not a direction.
    """
    four = structure == "hcp" and np.shape(axis) == (4,)
    try:
        indices = check_array(axis, name, (4 if four else 3,), finite=False)
    except ValueError as error:
        more = ", or four such as [2, -1, -1, 0]" if structure == "hcp" else ""
        raise ValueError(f"{name} must be three numbers such as [0, 1, 2]{more}, got {shown(axis)}") from error
    if not np.isfinite(indices).all():
        raise ValueError(f"{name} must be finite, got {shown(axis)}")
    if four:
        u, v, t, w = indices
        # of whole numbers exactly; else to the rounding of a few decimals
        if abs(u + v + t) > (0 if (indices == np.rint(indices)).all() else 1e-6 * np.abs(indices).max()):
            raise ValueError(f"{name} must have u + v + t = 0 for a direction [u v t w], got {axis!r}")
        indices = np.array([u - t, v - t, w])
    if not indices.any():
        raise ValueError(f"{name} must be a direction, got {axis!r}")
    if np.abs(indices).max() > 1e6 or np.abs(indices).max() < 1e-6:
        raise ValueError(f"{name} must have its largest number between 1e-6 and 1e6, got {axis!r}")
    if (indices == np.rint(indices)).all():
        whole = indices.astype(np.int64)
        return tuple((whole // np.gcd.reduce(whole)).tolist())
    return tuple(indices.tolist())


def _perpendicular(structure, indices, vectors):
    """Find the shortest lattice direction perpendicular to `indices`; of equals the largest indices."""
    u, v, w = indices
    sure = [(u - 2 * v, 2 * u - v, 0)] if structure == "hcp" else [(v, -u, 0), (w, 0, -u), (0, w, -v)]
    small = np.indices((7, 7, 7)).reshape(3, -1).T - 3
    candidates = np.concatenate([small, sure])
    cartesian = matrix_product(candidates, vectors)
    long = lengths(cartesian)
    axis = matrix_product(indices, vectors)
    across = np.abs(products(cartesian, axis)) < 1e-9 * long * lengths(axis)
    candidates, long = candidates[across & (long > 0)], long[across & (long > 0)]
    shortest = candidates[long < long.min() * (1 + 1e-9)]
    return max(map(tuple, shortest.tolist()))


def rotation_to_axis(material: Any, axis: Sequence[int], rotation: float = 0.0) -> Floats:
    """Rotation that brings a crystal direction onto +z.

    For whole numbers, of the lattice directions perpendicular to `axis` the shortest is put along +x: [1 0 0] for
    [0 1 2]; of several equally short ones the one with the largest indices, compared in turn: [1 0 -1] for [1 1 1].
    A direction of other numbers seldom has one: then +x is the part perpendicular to it of the edge of the
    right-angled cell (hcp: a, sqrt(3) a, c) that is most nearly perpendicular to it, of equals the first. Then
    everything is turned about z by `rotation`.

    Parameters
    ----------
    material : Material or str
        A material, or the name of a structure (hcp then has the ideal c/a).
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
        For an unknown structure, an axis that is not finite or all zeros.
    """
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


def lattice_points_in(
    structure: str,
    a: float,
    c: float | None,
    orientation: ArrayLike,
    origin: ArrayLike,
    signed_distance: Callable[[Floats], Floats],
    bounds: ArrayLike,
    *,
    depth: Callable[[Floats], Floats] | None = None,
    tolerance: float = 0.0,
    block: int = _BLOCK,
) -> Floats:
    """Lattice points inside a shape, or in a shell under its surface.

    Space is cut into blocks of cells; only blocks that the signed distance at their centre does not rule out
    are expanded. The points come in the order of their cell (first, second, third index), then of the site in
    the cell, whatever the size of the blocks.

    Parameters
    ----------
    structure, a, c
        As for `cell_lengths`.
    orientation : array_like
        Rotation from crystal to specimen, shape (3, 3).
    origin : array_like
        Where the lattice has its first site [nm], shape (3,).
    signed_distance : callable
        Takes points (n, 3) [nm], returns (n,) [nm]: negative inside, and never changing faster than the
        distance between the points.
    bounds : array_like
        Lower and upper corner of a box around the shape [nm], shape (2, 3).
    depth : callable, optional
        Takes points (n, 3) [nm], returns (n,) [nm]: only points at most this far below the surface. It must not
        change faster than the distance between the points either.
    tolerance : float
        Points at most this far outside count as inside [nm]: points that lie on the surface but for rounding.
    block : int
        Cells per edge of a block.

    Returns
    -------
    ndarray
        Positions [nm], shape (n, 3).
    """
    edges = cell_lengths(structure, a, c)
    orientation = check_array(orientation, "orientation", (3, 3))
    origin = check_array(origin, "origin", (3,))
    bounds = check_array(bounds, "bounds", (2, 3))
    basis = np.array(BASES[structure], dtype=np.float64)
    corners = np.array([[x, y, z] for x in bounds[:, 0] for y in bounds[:, 1] for z in bounds[:, 2]])
    corners = matrix_product(corners - origin, orientation) / edges
    first = np.floor((corners.min(axis=0) - 1) / block).astype(np.int64)
    count = np.ceil((corners.max(axis=0) + 1) / block).astype(np.int64) - first
    reach = 0.5 * block * float(lengths(edges)) + tolerance
    cells = np.indices((block,) * 3).reshape(3, -1)

    def inside(points, margin):
        distance = signed_distance(points)
        kept = distance <= margin
        if depth is not None:
            kept &= distance >= -(depth(points) + 2 * margin)
        return kept

    def slab(layer):
        """Points of one layer of blocks, whose first cell indices no other layer has."""
        rows = np.indices((1, count[1], count[2])).reshape(3, -1)
        rows[0] = layer
        low = (rows + first[:, None]) * block
        low = low[:, inside(_to_specimen((low + 0.5 * block) * edges[:, None], orientation, origin), reach)]
        for start in range(0, low.shape[1], step):
            cell = (low[:, start : start + step, None] + cells[:, None, :]).reshape(3, -1)
            for site, fraction in enumerate(basis):
                points = _to_specimen((cell + fraction[:, None]) * edges[:, None], orientation, origin)
                kept = inside(points, tolerance)
                i, j, k = cell[:, kept] - (first * block)[:, None]
                yield ((i * count[1] * block + j) * count[2] * block + k) * len(basis) + site, points[kept]

    step = max(1, _CHUNK // block**3)
    layers = []
    for layer in range(count[0]):
        pieces = list(slab(layer))
        if pieces:
            order = np.argsort(np.concatenate([keys for keys, _ in pieces]))
            layers.append(np.concatenate([points for _, points in pieces])[order])
    return np.ascontiguousarray(np.concatenate(layers)) if layers else np.empty((0, 3))
