"""Start position and direction of an ion on the surface: the tangent frame, the roll-up, the launch."""

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.small_matrices import products
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_array
from apt_evap.emission.emissions import Emissions, Launches


def tangent_frame(normals: ArrayLike) -> tuple[Floats, Floats]:
    """Two unit vectors perpendicular to each normal and to each other.

    They are x and y, rotated from the apex (0, 0, 1) to the normal along the great circle: on the cap t1 is close to x
    and t2 to y, and t1 x t2 = n. Both change smoothly with the normal, except for a jump at n_z = -0.9, far below the
    cap.

    Parameters
    ----------
    normals : array_like
        Unit vectors, shape (n, 3).

    Returns
    -------
    tuple of ndarray
        t1 and t2, each of shape (n, 3).

    Notes
    -----
    Duff et al., J. Computer Graphics Techniques 6 (1), 1 (2017), with the seam moved from n_z = 0 to -0.9.
    """
    x, y, z = check_array(normals, "normals", ("n", 3)).T
    sign = np.where(z < -0.9, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return first, np.stack([b, sign + y * y * a, -y], axis=1)


def rollup_direction(emissions: Emissions) -> tuple[Booleans, Floats, Floats]:
    """Ions that can roll up, and the direction of their roll-up.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.

    Returns
    -------
    tuple of ndarray
        Whether there is a neighbour to roll onto, shape (n,). Then the components along t1 and t2, each of shape (n,),
        of the unit vector from the site to the rolled-up position, projected perpendicular to the normal; zero if there
        is no neighbour, or if it lies along the normal.
    """
    rolled = np.isfinite(emissions.neighbours).all(axis=1)
    step = np.where(rolled[:, None], emissions.neighbours - emissions.positions, 0.0)
    # the lift d n of the rolled-up position is along the normal and drops out
    along = [products(step, tangent) for tangent in tangent_frame(emissions.normals)]
    length = np.sqrt(along[0] * along[0] + along[1] * along[1])
    straight = length < 1e-9 * emissions.nearest_neighbour_distance
    scale = np.where(straight, 0.0, 1 / np.where(straight, 1.0, length))
    return rolled, along[0] * scale, along[1] * scale


def rolled_positions(emissions: Emissions) -> Floats:
    """Positions p_r = s + d n, one nearest neighbour distance d above the neighbour s that each ion rolls onto.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.

    Returns
    -------
    ndarray, shape (n, 3)
        Positions [nm]; NaN for an ion without a neighbour.
    """
    return emissions.neighbours + emissions.nearest_neighbour_distance * emissions.normals


def along_surface(normals: ArrayLike, first: Floats, second: Floats) -> Floats:
    """Vectors along the surface from their components in the tangent frame.

    Parameters
    ----------
    normals : array_like, shape (n, 3)
        Outward unit normals.
    first, second : ndarray, shape (n,) or (n, m)
        Components along t1 and t2 of `tangent_frame`, of one or of m vectors at each normal.

    Returns
    -------
    ndarray, shape (n, 3) or (n, m, 3)
    """
    frame = tangent_frame(normals)
    if np.ndim(first) == 2:
        frame = frame[0][:, None], frame[1][:, None]
    return first[..., None] * frame[0] + second[..., None] * frame[1]


def launch_tangentially(emissions: Emissions, rolled: Booleans, first: Floats, second: Floats) -> Launches:
    """Launches with velocities along the surface.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.
    rolled : array_like of bool
        Whether an ion starts at its rolled-up position, see `rolled_positions`, or at its site, shape (n,).
    first, second : array_like
        Velocity along t1 and t2 of `tangent_frame` [nm/ns], shape (n,).

    Returns
    -------
    Launches
    """
    return Launches(
        positions=np.where(np.asarray(rolled)[:, None], rolled_positions(emissions), emissions.positions),
        velocities=along_surface(emissions.normals, np.asarray(first), np.asarray(second)),
        rolled=rolled,
    )
