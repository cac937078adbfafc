"""How a specimen from positions stands: upright, upside down or on its side; the sphere of its apex."""

import warnings

import numpy as np
import scipy

from apt_evap._common.sphere import fit_sphere
from apt_evap._common.types import Floats
from apt_evap.warnings import SpecimenWarning

_LEAST = 200  # atoms: fewer have no shape
_END = 0.1  # fraction of the height at either end whose widths are compared
_WIDER = 1.25  # ratio of these widths: that of a straight wire with ends cut along a lattice plane is below 1.1
_LONGER = 1.25  # ratio of the length of a lying needle to its height and to its width
_CAP = np.radians(45.0)  # atoms within this angle of the axis define the sphere of the apex


def warn_if_odd(positions: Floats) -> None:
    """Warn if a specimen stands upside down or lies on its side; its axis should be +z, with the apex on top.

    Parameters
    ----------
    positions : ndarray
        Atoms [nm], shape (n, 3).

    Warns
    -----
    SpecimenWarning
        Names what was seen.
    """
    if len(positions) < _LEAST:
        return
    x, y, z = np.ptp(positions, axis=0)
    length, width = max(x, y), min(x, y)
    if length > _LONGER * max(z, width):
        axis = "x" if x > y else "y"
        warnings.warn(
            f"the specimen lies on its side: it is {length:.3g} nm long in {axis}, and {z:.3g} nm high in z; its axis "
            "must be +z, with the apex on top",
            SpecimenWarning,
            stacklevel=3,
        )
        return
    top, bottom = _widths(positions)
    if top > _WIDER * bottom:
        warnings.warn(
            f"the specimen stands upside down: its top is {2 * top:.3g} nm wide, and its bottom {2 * bottom:.3g} nm; "
            "its apex must be on top, at the largest z",
            SpecimenWarning,
            stacklevel=3,
        )


def _widths(positions):
    """Radius of the atoms in the uppermost and in the lowest part [nm]."""
    heights = positions[:, 2]
    low, high = heights.min(), heights.max()
    ends = heights >= high - _END * (high - low), heights <= low + _END * (high - low)
    centre = np.median(positions[:, :2], axis=0)
    return tuple(float(np.percentile(np.linalg.norm(positions[end, :2] - centre, axis=1), 95)) for end in ends)


def apex_sphere(positions: Floats) -> tuple[Floats, float] | None:
    """Sphere through the corners of the convex hull within 45 degrees of the axis.

    Parameters
    ----------
    positions : ndarray
        Atoms [nm], shape (n, 3).

    Returns
    -------
    centre : ndarray, shape (3,)
        Centre of the sphere [nm].
    radius : float
        Its radius [nm], to the places of the atoms. None instead of both if fewer than 10 atoms define it.
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
    """Depth of atoms below the apex sphere along z [nm], shape (n,); NaN beyond 45 degrees of the axis."""
    lateral = np.linalg.norm(positions[:, :2] - centre[:2], axis=1)
    with np.errstate(invalid="ignore"):
        depth = centre[2] + np.sqrt(radius**2 - lateral**2) - positions[:, 2]
    return np.where(lateral < radius * np.sin(_CAP), depth, np.nan)
