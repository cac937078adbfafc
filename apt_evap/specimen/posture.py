"""How a specimen from positions stands: upright, upside down, on its side or leaning; the sphere of its apex."""

import numpy as np
import scipy

from apt_evap._common.sphere import fit_sphere
from apt_evap._common.types import Floats
from apt_evap.warnings import SpecimenWarning, warn

_LEAST = 200  # atoms: fewer have no shape
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


def warn_if_odd(positions: Floats) -> None:
    """Warn if a specimen stands upside down, lies on its side or leans; its axis should be +z, with the apex on top.

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
    """Depth of atoms below the apex sphere along z [nm], shape (n,); NaN for atoms beside the sphere."""
    with np.errstate(invalid="ignore"):
        above = np.sqrt(radius**2 - np.sum((positions[:, :2] - centre[:2]) ** 2, axis=1))
    return centre[2] + above - positions[:, 2]
