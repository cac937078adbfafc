"""A batch of emissions, the frame along the surface, and the launches out of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._arrays import check_array, check_number
from apt_evap._types import Booleans, Floats


@dataclass(frozen=True, eq=False, repr=False)
class Emissions:
    """A batch of atoms about to leave.

    Parameters
    ----------
    positions, normals : array_like
        Sites [nm] and outward unit normals, shape (n, 3).
    neighbours : array_like
        Position of the surface nearest neighbour with the highest charge [nm], shape (n, 3); NaN if none.
    charge_states : array_like of int
        Charge of the ion [e], shape (n,).
    masses : array_like
        Mass of the ion [Da], shape (n,).
    ions : array_like of int
        Number of the ion in the sequence of evaporation, shape (n,).
    nearest_neighbour_distance : float
        [nm].

    Raises
    ------
    ValueError
        If shapes disagree, or a value is outside its range.
    """

    positions: np.ndarray
    normals: np.ndarray
    neighbours: np.ndarray
    charge_states: np.ndarray
    masses: np.ndarray
    ions: np.ndarray
    nearest_neighbour_distance: float

    def __post_init__(self):
        positions = check_array(self.positions, "positions", ("n", 3))
        n = len(positions)
        distance = check_number(self.nearest_neighbour_distance, "nearest_neighbour_distance", above=0, unit="nm")
        checked = {
            "positions": positions,
            "normals": check_array(self.normals, "normals", (n, 3)),
            "neighbours": check_array(self.neighbours, "neighbours", (n, 3), finite=False),
            "charge_states": check_array(self.charge_states, "charge_states", (n,), dtype=np.int32),
            "masses": check_array(self.masses, "masses", (n,)),
            "ions": check_array(self.ions, "ions", (n,), dtype=np.int64),
            "nearest_neighbour_distance": distance,
        }
        off = np.abs(np.linalg.norm(checked["normals"], axis=1) - 1)
        if n and off.max() > 1e-6:
            raise ValueError(f"normals must have length 1, got one that is off by {off.max():.2g}")
        for name, least in (("charge_states", 1), ("masses", np.finfo(np.float64).tiny)):
            if n and checked[name].min() < least:
                raise ValueError(f"{name} must be above 0, got {checked[name].min()}")
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        lonely = np.count_nonzero(np.isnan(self.neighbours).any(axis=1))
        return f"<Emissions: {len(self):,} atoms about to leave, {lonely:,} of them without a neighbour to roll onto>"


@dataclass(frozen=True, eq=False, repr=False)
class Launches:
    """How a batch of ions starts.

    Parameters
    ----------
    positions : array_like
        Where [nm], shape (n, 3).
    velocities : array_like
        How fast [nm/ns], shape (n, 3).
    rolled : array_like of bool
        Whether the ion rolled up onto a neighbour first, shape (n,).

    Raises
    ------
    ValueError
        If shapes disagree, or a value is not finite.
    """

    positions: np.ndarray
    velocities: np.ndarray
    rolled: np.ndarray

    def __post_init__(self):
        positions = check_array(self.positions, "positions", ("n", 3))
        n = len(positions)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "velocities", check_array(self.velocities, "velocities", (n, 3)))
        object.__setattr__(self, "rolled", check_array(self.rolled, "rolled", (n,), dtype=bool))

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        return f"<Launches: {len(self):,} ions, {np.count_nonzero(self.rolled):,} of them rolled up>"


def tangent_frame(normals: ArrayLike) -> tuple[Floats, Floats]:
    """Two unit vectors at right angles to each normal and to each other.

    They are x and y carried from the apex (0, 0, 1) to the normal along the great circle: t1 is near x and
    t2 near y on the cap, t1 x t2 = n, and both change smoothly with the normal but for a jump at n_z = -0.9,
    deep in the foot.

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
    """Which ions can roll up, and in which direction.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.

    Returns
    -------
    tuple of ndarray
        Whether there is a neighbour to roll onto, shape (n,), and the components along t1 and t2 of the unit
        vector from the site to the rolled-up position, perpendicular to the normal, each of shape (n,); zero
        if there is no neighbour, or if it lies straight along the normal.
    """
    rolled = np.isfinite(emissions.neighbours).all(axis=1)
    step = np.where(rolled[:, None], emissions.neighbours - emissions.positions, 0.0)
    # the lift d n of the rolled-up position is along the normal and drops out
    along = [np.einsum("ij,ij->i", step, tangent) for tangent in tangent_frame(emissions.normals)]
    length = np.hypot(*along)
    straight = length < 1e-9 * emissions.nearest_neighbour_distance
    scale = np.where(straight, 0.0, 1 / np.where(straight, 1.0, length))
    return rolled, along[0] * scale, along[1] * scale


def launch_tangentially(emissions: Emissions, rolled: Booleans, first: Floats, second: Floats) -> Launches:
    """Launches from velocities along the surface: the one way from `tangential` to `launch`.

    Parameters
    ----------
    emissions : Emissions
        A batch of n.
    rolled : array_like of bool
        Ions that start at p_r = s + d n, one nearest neighbour distance d above their neighbour s; the others
        start at their site. Shape (n,).
    first, second : array_like
        Velocity along t1 and t2 of `tangent_frame` [nm/ns], shape (n,).

    Returns
    -------
    Launches
    """
    frame = tangent_frame(emissions.normals)
    lifted = emissions.neighbours + emissions.nearest_neighbour_distance * emissions.normals
    return Launches(
        positions=np.where(np.asarray(rolled)[:, None], lifted, emissions.positions),
        velocities=np.asarray(first)[:, None] * frame[0] + np.asarray(second)[:, None] * frame[1],
        rolled=rolled,
    )
