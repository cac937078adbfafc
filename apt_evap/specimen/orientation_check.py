"""Checks of a specimen from positions: direction of its axis, distance of its atoms, number of bodies; its apex."""

from collections.abc import Sequence
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from apt_evap._common.sphere import fit_sphere
from apt_evap._common.types import Floats
from apt_evap.warnings import SpecimenWarning, warn

_LEAST = 200  # atoms: fewer have no shape
_CROWD = 50  # atoms: fewer have no typical distance
_CLOSE, _FAR = 0.6, 1.6  # measured distance over that of the material; oxides and carbides: 0.65 to 0.9
_AS_CLOSE = 1.15  # a unit fits if the distance then agrees with that of the material within this factor
_UNITS = {"nm": 1.0, "Angstrom": 0.1, "Bohr radii": 0.052917721, "pm": 1e-3, "um": 1e3, "m": 1e9}  # [nm]
_BOND = 1.5  # [d_nn]: atoms closer than this touch; second neighbours in bcc are at 1.15, in fcc at 1.41
_SLAB = 1 << 19  # atoms whose pairs are in memory at the same time
_END = 0.1  # fraction of the height at either end whose widths are compared
_WIDER = 1.25  # ratio of these widths: that of a straight wire with ends cut along a lattice plane is below 1.1
_LONGER = 1.44  # ratio of the standard deviations along both longest axes: a cylinder 1.25 times as long as wide
_LEANING = 10.0  # angle to z [degrees]: the axis of an upright needle is within 2 degrees
_CAP = np.radians(45.0)  # atoms within this angle of the axis define the sphere of the apex


def pointing(positions: Floats) -> Floats:
    """Direction from the wide to the narrow end of a specimen, a unit vector of shape (3,).

    It is along the longest principal axis of the atoms [nm], shape (n, 3), or along z if none is clearly the longest.
    If both ends are about equally wide, it is the direction with the larger z.
    """
    values, vectors = np.linalg.eigh(np.cov(positions.T))
    axis = vectors[:, 2] if values[2] > _LONGER**2 * values[1] else np.array([0.0, 0.0, 1.0])
    axis = axis if axis[2] > 0 or (axis[2] == 0 and axis.sum() > 0) else -axis
    first, last = _widths(positions, axis)
    return -axis if last > _WIDER * first else axis


def warn_of_direction(positions: Floats) -> None:
    """Warn if a specimen stands upside down, lies on its side or leans; its axis should be +z, with the apex on top."""
    if len(positions) < _LEAST:
        return
    axis = pointing(positions)
    angle = float(np.degrees(np.arccos(np.clip(axis[2], -1.0, 1.0))))
    if angle < _LEANING:
        return
    if angle < 45.0:
        seen = "leans"
    elif angle <= 135.0:
        seen = f"lies on its side, along {'xyz'[np.argmax(np.abs(axis))]}"
    else:
        seen = "stands upside down"
    warn(
        f"the specimen {seen}: its narrow end points along ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}), "
        f"{angle:.0f} degrees from z; its axis must be +z, with the apex on top, at the largest z",
        SpecimenWarning,
    )


def warn_of_shape(positions: Floats) -> None:
    """Warn of the direction of a specimen, and of several bodies, for atoms [nm] whose materials are not known."""
    if len(positions) >= _CROWD:
        distances = scipy.spatial.cKDTree(positions).query(positions[:: len(positions) // _CROWD], k=2)[0][:, 1]
        warn_of_bodies(positions, float(np.median(distances)))
    warn_of_direction(positions)


def check_spacing(distance: float, expected: Sequence[float], names: Sequence[str], n: int) -> None:
    """Refuse positions in a wrong unit, and warn of other distances between atoms that no crystal of them has.

    Positions in another unit would be simulated at a wrong voltage, without any other sign. `distance` is the median
    from an atom to its nearest neighbour, `expected` that of each species [nm]. Below 50 atoms, nothing is checked.
    """
    low, high = min(expected), max(expected)
    if n < _CROWD or _CLOSE * low <= distance <= _FAR * high:
        return
    species = ", ".join(f"{name} {length:.3g}" for name, length in dict(zip(names, expected, strict=True)).items())
    problem = f"neighbouring atoms are {distance:.3g} nm apart, in crystals of their species {species} nm"
    for supposed, read in product(_UNITS, ("nm", "Angstrom", "Bohr radii")):
        corrected = distance * _UNITS[supposed] / _UNITS[read]
        if supposed != read and low / _AS_CLOSE <= corrected <= _AS_CLOSE * high:
            raise ValueError(
                f"positions were read in a wrong unit: {problem}, as if {supposed} had been taken for {read}"
            )
    warn(
        f"{problem}: wrong unit (reduced units of LAMMPS?), wrong material or not a solid; voltages and fields are "
        "only right for the distances of the material",
        SpecimenWarning,
    )


def warn_of_bodies(positions: Floats, distance: float) -> None:
    """Warn if a specimen is in several pieces, such as a needle that was cut by the borders of a periodic box.

    Atoms within 1.5 times the distance of nearest neighbours belong to one body.
    """
    if len(positions) < _CROWD:
        return
    sizes = np.sort(np.bincount(bodies(positions, _BOND * distance)))[::-1]
    if len(sizes) > 1:
        largest = ", ".join(f"{size:,}" for size in sizes[:4]) + (", ..." if len(sizes) > 4 else "")
        warn(
            f"the specimen is not one body but {len(sizes):,} that do not touch, of {largest} atoms: was it cut by the "
            "borders of a periodic box, or are atoms around it?",
            SpecimenWarning,
        )


def bodies(positions: Floats, reach: float) -> NDArray[np.int32]:
    """Number of the connected body of each atom, int32 (n,); atoms closer than `reach` [nm] are connected."""
    order = np.argsort(positions[:, 2], kind="stable")
    heights = positions[order, 2]
    labels = np.full(len(positions), -1)
    links, count = [], 0
    for start in range(0, len(positions), _SLAB):  # slabs that overlap by `reach`
        last = heights[min(start + _SLAB, len(positions)) - 1]
        slab = order[start : np.searchsorted(heights, last + reach, side="right")]
        tree = scipy.spatial.cKDTree(positions[slab], balanced_tree=False, compact_nodes=False)  # only used once
        pairs = tree.query_pairs(reach, output_type="ndarray")
        parts, part = _connected(pairs, len(slab))
        part = part + count
        known = labels[slab] >= 0
        links.append(np.column_stack([labels[slab][known], part[known]]))
        labels[slab[~known]] = part[~known]
        count += parts
    return _connected(np.concatenate(links), count)[1][labels]


def _connected(pairs, n):
    """Number of connected components, and the component of each of n nodes."""
    graph = scipy.sparse.coo_array((np.ones(len(pairs), bool), pairs.T), (n, n)).tocsr()
    return scipy.sparse.csgraph.connected_components(graph, connection="weak")  # undirected ones take twice the time


def _widths(positions, axis):
    """Radius of the atoms in the first and in the last tenth of the length along an axis [nm]."""
    heights = positions @ axis
    low, high = heights.min(), heights.max()
    lateral = positions - heights[:, None] * axis
    centre = np.median(lateral, axis=0)
    ends = heights <= low + _END * (high - low), heights >= high - _END * (high - low)
    return tuple(float(np.percentile(np.linalg.norm(lateral[end] - centre, axis=1), 95)) for end in ends)


def upright(positions: Floats) -> Floats:
    """Positions turned about their mean such that their narrow end points along +z, shape (n, 3) [nm]."""
    x, y, z = pointing(positions)
    if z > np.cos(np.radians(_LEANING)):
        return positions
    turn = scipy.spatial.transform.Rotation.align_vectors([[0.0, 0.0, 1.0]], [[x, y, z]])[0]
    return turn.apply(positions - positions.mean(axis=0))


def apex_sphere(positions: Floats) -> tuple[Floats, float] | None:
    """Centre (3,) and radius [nm] of the sphere through the corners of the convex hull within 45 degrees of the axis.

    None instead of both if fewer than 10 atoms define it.
    """
    try:
        surface = positions[scipy.spatial.ConvexHull(positions).vertices]
    except (scipy.spatial.QhullError, ValueError):  # atoms in a plane, or too few
        return None
    span = np.ptp(positions, axis=0)
    radius = 0.5 * float(min(span[0], span[1], 2 * span[2]))
    centre = np.array([*np.median(positions[:, :2], axis=0), positions[:, 2].max() - radius])
    for _ in range(5):  # the atoms of the cap depend on the centre
        away = surface - centre
        cap = surface[away[:, 2] > np.cos(_CAP) * np.linalg.norm(away, axis=1)]
        if len(cap) < 10:
            return None
        centre, radius = fit_sphere(cap)
    return centre, radius


def depths(positions: Floats, centre: Floats, radius: float) -> Floats:
    """Depth of atoms below the apex sphere along z [nm], shape (n,); NaN for atoms beside the sphere."""
    with np.errstate(invalid="ignore"):
        above = np.sqrt(radius**2 - np.sum((positions[:, :2] - centre[:2]) ** 2, axis=1))
    return centre[2] + above - positions[:, 2]
