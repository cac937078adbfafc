"""Poles and zone axes of a crystal: the lattice planes visible on a map, their directions and labels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import permutations, product
from math import gcd
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_kind, check_sequence, short_text
from apt_evap.specimen import lattice
from apt_evap.specimen.materials import Material, as_material

_LARGEST = 9  # largest index in the search: includes the 50 families of largest spacing of all lattices
_MAX_FAMILIES = 50

ZONES = {
    "fcc": ((1, 1, 0), (1, 0, 0)),
    "bcc": ((1, 0, 0), (1, 1, 1), (1, 1, 0)),
    "sc": ((1, 0, 0), (1, 1, 0)),
    "diamond": ((1, 1, 0), (1, 0, 0)),
    "hcp": ((1, 1, -2, 0), (1, 0, -1, 0), (0, 0, 0, 1)),
}
"""Families of zone axes with the most poles of large spacing, in three indices (hcp: four)."""


class Poles(NamedTuple):
    """Poles of a crystal, family by family."""

    planes: np.ndarray
    """Miller indices, int64 of shape (n, 3), for hcp Miller-Bravais indices of shape (n, 4)."""
    normals: np.ndarray
    """Unit normals in the frame of the crystal, shape (n, 3)."""
    spacings: np.ndarray
    """Distance between neighbouring atomic planes [nm], shape (n,)."""
    labels: tuple
    """Labels of the poles in the math syntax of matplotlib, with bars over negative indices."""

    def __repr__(self) -> str:
        return short_repr(self)


class Zones(NamedTuple):
    """Zone axes of a crystal, one of each pair of opposite directions."""

    axes: np.ndarray
    """Indices, int64 of shape (n, 3), for hcp of shape (n, 4)."""
    directions: np.ndarray
    """Unit vectors in the frame of the crystal, shape (n, 3)."""
    families: np.ndarray
    """Index of the family of each axis, shape (n,)."""

    def __repr__(self) -> str:
        return short_repr(self)


def poles(material: Any, families: int = 8) -> Poles:
    """Poles of a crystal: the families of lattice planes with the largest spacing.

    Higher steps between terraces give a larger facet and a darker pole on a map. So the families are ordered by their
    spacing: 111, 002, 022, 113, 133, 024, ... for fcc.

    Parameters
    ----------
    material : Material or str or Orientation or FittedOrientation
        The crystal; of an orientation its material. A str is looked up by `material`.
    families : int
        Number of families, from 1 to 50.

    Returns
    -------
    Poles
        Every member of each family. Indices count all atomic planes: 002 for fcc, whose planes are a/2 apart.

    Raises
    ------
    ValueError
        If `families` is not an integer from 1 to 50.
    """
    material = _crystal(material)
    families = check_count(families, "families", at_least=1)
    if families > _MAX_FAMILIES:
        raise ValueError(f"families must be <= {_MAX_FAMILIES}, got {families}")
    four = material.structure == "hcp"
    candidates = []
    for h, k, last in product(range(_LARGEST + 1), repeat=3):
        if gcd(h, k, last) != 1 or h > k or (not four and k > last):
            continue
        plane = np.array([h, k, -h - k, last] if four else [h, k, last])
        multiple, spacing = _stacking(material, plane)
        # rounded: families of equal spacing are ordered by their indices
        candidates.append(
            (-round(spacing / material.a, 9), int(np.abs(plane).sum()), tuple((multiple * plane).tolist()))
        )
    candidates.sort()
    members = [
        (member, -spacing * material.a) for spacing, _, plane in candidates[:families] for member in _members(plane)
    ]
    planes = np.array([member for member, _ in members])
    return Poles(
        planes,
        plane_normals(material, planes),
        np.array([spacing for _, spacing in members]),
        tuple(label(plane) for plane in planes),
    )


def zones(material: Any, families: Sequence[Any] | None = None) -> Zones:
    """Zone axes of a crystal; the zone line is the great circle perpendicular to the axis, which contains its poles.

    Parameters
    ----------
    material : Material or str or Orientation or FittedOrientation
        As for `poles`.
    families : sequence, optional
        One member of each family, [u v w] or for hcp [u v t w]; by default those of `ZONES`.

    Returns
    -------
    Zones

    Raises
    ------
    ValueError
        If an axis is not a lattice direction.
    """
    material = _crystal(material)
    families = ZONES[material.structure] if families is None else check_sequence(families, "families", "zone axes")
    if not families:
        raise ValueError("families must contain at least one zone axis, got none")
    width = 4 if material.structure == "hcp" else 3
    axes, numbers = [], []
    for number, axis in enumerate(families):
        axis = check_array(axis, "a zone axis", (width,), dtype=np.int64)
        direction_normals(material, axis[None])  # validates the axis
        for member in _members(tuple(axis.tolist())):
            if tuple(-index for index in member) not in axes:
                axes.append(member)
                numbers.append(number)
    axes = np.array(axes)
    return Zones(axes, direction_normals(material, axes), np.array(numbers))


def _crystal(thing):
    """The material of an orientation, of a fitted one, or itself."""
    thing = getattr(thing, "orientation", thing)
    return as_material(getattr(thing, "material", thing))


def plane_normals(material: Material, planes: ArrayLike, name: str = "planes") -> Floats:
    """Unit normals (n, 3) of lattice planes (h k l), for hcp also (h k i l), in the frame of the crystal."""
    planes = _three(material, planes, name, lambda h, k, _, last: (h, k, last))
    normals = planes @ _reciprocal(material)
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def plane_periods(material: Material, planes: ArrayLike) -> Floats:
    """Distances after which the atomic planes of lattice planes repeat [nm], shape (n,), as for `plane_normals`."""
    planes = _three(material, planes, "planes", lambda h, k, _, last: (h, k, last))
    return 1 / np.linalg.norm(planes @ _reciprocal(material), axis=1)  # type: ignore[no-any-return]


def direction_normals(material: Material, directions: ArrayLike) -> Floats:
    """Unit vectors (n, 3) along directions [u v w], for hcp also [u v t w], in the frame of the crystal."""
    directions = _three(material, directions, "directions", lambda u, v, t, w: (u - t, v - t, w))
    vectors = directions @ lattice.direction_vectors(material.structure, material.a, material.c)
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def label(indices: Iterable[int]) -> str:
    """Label of a pole or an axis in the math syntax of matplotlib, with bars over negative indices (str)."""
    space = r"\," if max(abs(int(index)) for index in indices) > 9 else ""
    return "$" + space.join(rf"\bar{{{-index}}}" if index < 0 else str(index) for index in map(int, indices)) + "$"


def plain_label(indices: Iterable[int]) -> str:
    """Label of a pole or an axis in plain text: "011", or "1 -1 0" with a negative index (str)."""
    texts = [str(int(index)) for index in indices]
    return ("" if all(len(text) == 1 for text in texts) else " ").join(texts)


def members_of_families(crystal: Poles) -> list[list[int]]:
    """Members of each family of poles, by their numbers: all have its spacing, and the same indices in any order."""
    keys = [(round(spacing, 9), tuple(sorted(map(abs, plane)))) for spacing, plane in zip(
        crystal.spacings.tolist(), crystal.planes.tolist(), strict=True)]  # fmt: skip
    return [[k for k, key in enumerate(keys) if key == family] for family in dict.fromkeys(keys)]


def _three(material, indices, name, from_four):
    """Convert rows of three or, for hcp, four indices to three."""
    check_kind(material, "material", Material, "a Material")
    four = material.structure == "hcp" and np.ndim(indices) == 2 and np.shape(indices)[1] == 4
    indices = check_array(indices, name, ("n", 4 if four else 3), dtype=np.int64)
    if four:
        wrong = indices[:, :3].sum(axis=1) != 0
        if wrong.any():
            raise ValueError(f"{name} must have first three indices with a sum of 0, got {indices[wrong][0]}")
        indices = np.column_stack(from_four(*indices.T))
    if not indices.any(axis=1).all():
        raise ValueError(f"{name} must not have indices that are all zero, got {short_text(indices.tolist())}")
    return indices


def _reciprocal(material):
    """Reciprocal lattice vectors without 2 pi, one per row [1/nm]."""
    return np.linalg.inv(material.a * lattice.direction_vectors(material.structure, material.a, material.c)).T


def _members(indices):
    """All symmetry-equivalent indices, of three (m-3m) or four (6/mmm)."""
    if len(indices) == 3:
        signs = product((1, -1), repeat=3)
        members = {
            tuple(int(s * i) for s, i in zip(sign, p, strict=True)) for sign in signs for p in permutations(indices)
        }
    else:
        *first, last = indices
        members = {
            (*(sign * int(index) for index in p), other * int(last))
            for p in permutations(first)
            for sign in (1, -1)
            for other in (1, -1)
        }
    return sorted(members, reverse=True)


def _stacking(material, plane):
    """Number of equidistant layers per period of a plane with coprime indices (1 if uneven), and largest gap [nm]."""
    reciprocal = plane[[0, 1, -1]] @ _reciprocal(material)
    sites = np.array(lattice.BASES[material.structure])
    heights = sites * lattice.cell_lengths(material.structure, material.a, material.c) @ reciprocal
    heights = np.unique(np.round(heights % 1, 6) % 1)  # in periods; 6 digits separate all layers of these cells
    gaps = np.diff(np.append(heights, heights[0] + 1))
    even = np.ptp(gaps) < 1e-5
    return len(gaps) if even else 1, float(gaps.max() / np.linalg.norm(reciprocal))
