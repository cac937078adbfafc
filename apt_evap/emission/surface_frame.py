"""Start position and direction of an ion on the surface: the tangent frame and the roll-ups."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.small_matrices import products
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_array, check_kind
from apt_evap._core.elementary import exponential
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


class RollUps(NamedTuple):
    """Directions of the roll-ups of n atoms, and the shares of their targets."""

    possible: Booleans
    """Whether there is a target to roll onto, shape (n,)."""
    first: Floats
    """Components of the directions along t1 of `tangent_frame`, see `rollup_direction`, shape (n,)."""
    second: Floats
    """Components along t2, shape (n,)."""
    shares: Floats | None
    """Shares of the targets, see `target_shares`, shape (n, 3); None for the strongest ones only."""


def roll_ups(emissions: Emissions, sharpness: float = 0.0) -> RollUps:
    """Roll-ups of a batch, computed once as long as the arguments stay the same.

    The result takes 17 bytes per atom, and 24 more with a sharpness.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.
    sharpness : float
        See `target_shares`.

    Returns
    -------
    RollUps
        Its arrays are read-only.

    Raises
    ------
    ValueError
        If the targets that this needs are not known.
    """
    return emissions.kept(("roll_ups", sharpness), lambda: _roll_ups(emissions, sharpness))


def _roll_ups(emissions, sharpness):
    shares = None if sharpness == 0.0 else target_shares(emissions, sharpness)
    result = RollUps(*rollup_direction(emissions, shares), shares)
    for array in result:
        if array is not None:
            array.flags.writeable = False
    return result


def rollup_direction(emissions: Emissions, shares: Floats | None = None) -> tuple[Booleans, Floats, Floats]:
    """Ions that can roll up, and the direction of their roll-up.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.
    shares : ndarray, shape (n, 3), optional
        Shares of the targets, see `target_shares`; by default the strongest ones only.

    Returns
    -------
    tuple of ndarray
        Whether there is a target to roll onto, shape (n,). Then the components along t1 and t2, each of shape (n,), of
        the unit vector to the rolled-up position, projected perpendicular to the normal; zero without a target, or if
        it lies along the normal.

    Raises
    ------
    ValueError
        If the targets that this needs are not known.
    """
    possible = emissions.can_roll
    step = np.where(possible[:, None], _place(emissions, shares) - emissions.positions, 0.0)
    # the lift d n of the rolled-up position is along the normal and drops out
    along = [products(step, tangent) for tangent in tangent_frame(emissions.normals)]
    length = np.sqrt(along[0] * along[0] + along[1] * along[1])
    straight = length < 1e-9 * emissions.nearest_neighbour_distance
    scale = np.where(straight, 0.0, 1 / np.where(straight, 1.0, length))
    return possible, along[0] * scale, along[1] * scale


def _place(emissions, shares):
    """The target of a roll-up, or the mean of the targets with these shares; shape (n, 3)."""
    if shares is None:
        return emissions.neighbours
    return _mean_targets(emissions, shares[:, None])[:, 0]


def rolled_positions(emissions: Emissions, shares: Floats | None = None) -> Floats:
    """Positions p_r = s + d n [nm], one nearest neighbour distance d above the place s that each ion rolls onto.

    Between two phases, d is the mean of their distances. By default s is the strongest neighbour; with `shares`, (n,
    3), a weighted mean of targets. NaN for an ion without a neighbour.
    """
    return _place(emissions, shares) + _lift(emissions)


def _lift(emissions):
    """Steps d n from a target to the rolled-up position above it [nm], shape (n, 3)."""
    if emissions.rollup_distances is None:
        return emissions.nearest_neighbour_distance * emissions.normals
    return emissions.rollup_distances[:, None] * emissions.normals


def target_shares(emissions: Emissions, sharpness: float) -> Floats:
    r"""Shares of the three strongest surface nearest neighbours in the place onto which an atom rolls.

    Parameters
    ----------
    emissions : Emissions
        A batch of n, with its targets.
    sharpness : float
        :math:`\tau`; 0 for the strongest neighbour only.

    Returns
    -------
    ndarray, shape (n, 3)
        0 for missing neighbours; the first is 1 for an atom without any.

    Notes
    -----
    .. math:: w_j \propto \exp\left(\frac{q_j / q_1 - 1}{\tau}\right)

    with the charges :math:`q_j` of the neighbours in descending order. Where two of them are nearly equal, an atom
    moves onto the bridge or hollow between them.
    """
    check_kind(emissions, "emissions", Emissions, "Emissions")
    n, ratios = len(emissions), emissions.charge_ratios
    shares = np.tile([1.0, 0.0, 0.0], (n, 1))
    if sharpness == 0.0 or n == 0:
        return shares
    if ratios is None:
        raise ValueError("a sharpness > 0 needs the `targets` and `charge_ratios` of the emissions, got none")
    known = np.isfinite(ratios[:, 1:])
    relative = np.where(known, ratios[:, 1:], 0.0) / np.where(ratios[:, :1] > 0, ratios[:, :1], 1.0)
    shares[:, 1:] = np.where(known, exponential((relative - 1.0) / sharpness), 0.0)
    return shares / (shares[:, 0] + shares[:, 1] + shares[:, 2])[:, None]


def _mean_targets(emissions, shares):
    """Weighted means of the targets, shares (n or 1, m, 3) -> (n, m, 3); a missing target is replaced by the first."""
    targets = emissions.targets
    if targets is None:
        raise ValueError(
            "shares of several neighbours need the `targets` and `charge_ratios` of the emissions, got none"
        )
    targets = np.where(np.isfinite(targets), targets, targets[:, :1])
    mean = shares[..., 0, None] * targets[:, None, 0]
    for k in (1, 2):
        mean = mean + shares[..., k, None] * targets[:, None, k]
    return mean


def shared_positions(emissions: Emissions, shares: Floats) -> Floats:
    """Positions one nearest neighbour distance above weighted means of the targets [nm], shape (n, m, 3).

    `shares` of the targets have the shape (n or 1, m, 3). NaN for an ion without a neighbour.
    """
    return _mean_targets(emissions, shares) + _lift(emissions)[:, None]


def along_surface(normals: ArrayLike, first: Floats, second: Floats) -> Floats:
    """Vectors (n, 3) or (n, m, 3) along the surface from their components along t1 and t2 of `tangent_frame`."""
    frame = tangent_frame(normals)
    if np.ndim(first) == 2:
        frame = frame[0][:, None], frame[1][:, None]
    return first[..., None] * frame[0] + second[..., None] * frame[1]


def launch_tangentially(
    emissions: Emissions,
    rolled: Booleans,
    first: Floats,
    second: Floats,
    shares: Floats | None = None,
    heights: Floats | None = None,
) -> Launches:
    """Launches with velocities along the surface.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.
    rolled : array_like of bool
        Whether an ion starts at its rolled-up position, see `rolled_positions`, or at its site, shape (n,).
    first, second : array_like
        Velocity along t1 and t2 of `tangent_frame` [nm/ns], shape (n,).
    shares, heights : ndarray, optional
        As in `TangentialLaunches`.

    Returns
    -------
    Launches
    """
    positions = np.where(np.asarray(rolled)[:, None], rolled_positions(emissions, shares), emissions.positions)
    if heights is not None:
        positions = positions + np.asarray(heights)[:, None] * emissions.normals
    return Launches(
        positions=positions,
        velocities=along_surface(emissions.normals, np.asarray(first), np.asarray(second)),
        rolled=rolled,
    )
