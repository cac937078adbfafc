"""A batch of emissions, and the launches of their ions."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np

from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_number
from apt_evap.units import FLIGHT_TIME

T = TypeVar("T")

COLUMNS = ("positions", "normals", "neighbours", "charge_states", "masses", "ions")
OPTIONAL_COLUMNS = ("targets", "charge_ratios", "rollup_distances")


@dataclass(frozen=True, eq=False, repr=False)
class Emissions:
    """A batch of atoms at the moment of their evaporation.

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
        [nm], of the matrix.
    targets : array_like, optional
        Positions of the three targets of each roll-up, in falling order of their charges [nm], shape (n, rolls, 3, 3);
        NaN if there are fewer. The targets of the first roll-up are the surface nearest neighbours, the strongest one
        that of `neighbours`. Those of a second one are the surface neighbours of the strongest neighbour that are
        neither the atom nor neighbours of it.
    charge_ratios : array_like, optional
        Their charges over that of the atom, shape (n, rolls, 3); NaN if there are fewer.
    rollup_distances : array_like, optional
        Distance of each rolled-up ion from its neighbour [nm], shape (n,); by default `nearest_neighbour_distance`.

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
    targets: Any = None
    charge_ratios: Any = None
    rollup_distances: np.ndarray | None = None
    _kept: Any = field(default=None, init=False)  # key and result of the last call of `kept`

    def __post_init__(self):
        positions = check_array(self.positions, "positions", ("n", 3))
        n = len(positions)
        distance = check_number(self.nearest_neighbour_distance, "nearest_neighbour_distance", above=0, unit="nm")
        values = {
            "positions": positions,
            "normals": check_array(self.normals, "normals", (n, 3)),
            "neighbours": check_array(self.neighbours, "neighbours", (n, 3), finite=False),
            "charge_states": check_array(self.charge_states, "charge_states", (n,), dtype=np.int32),
            "masses": check_array(self.masses, "masses", (n,)),
            "ions": check_array(self.ions, "ions", (n,), dtype=np.int64),
            "nearest_neighbour_distance": distance,
        }
        if (self.targets is None) != (self.charge_ratios is None):
            raise ValueError("targets and charge_ratios must be given together, got one of them")
        if self.targets is not None:
            targets = check_array(self.targets, "targets", (n, "rolls", 3, 3), finite=False)
            if targets.shape[1] not in (1, 2):
                raise ValueError(f"targets must be those of 1 or 2 roll-ups, got {targets.shape[1]}")
            ratios = check_array(self.charge_ratios, "charge_ratios", (n, targets.shape[1], 3), finite=False)
            values |= {"targets": targets, "charge_ratios": ratios}
        if self.rollup_distances is not None:
            values["rollup_distances"] = check_array(self.rollup_distances, "rollup_distances", (n,))
        deviation = np.abs(np.linalg.norm(values["normals"], axis=1) - 1)
        if n and deviation.max() > 1e-6:
            raise ValueError(f"normals must have length 1, got one that deviates by {deviation.max():.2g}")
        for name, least in (
            ("charge_states", 1),
            ("masses", np.finfo(np.float64).tiny),
            ("rollup_distances", np.finfo(np.float64).tiny),
        ):
            if n and name in values and values[name].min() < least:
                raise ValueError(f"{name} must be > 0, got {values[name].min()}")
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, selection: Any) -> "Emissions":
        """Return selected atoms as `Emissions`; takes a slice, a mask or indices."""
        columns = {name: getattr(self, name)[selection] for name in self.columns}
        return Emissions(**columns, nearest_neighbour_distance=self.nearest_neighbour_distance)

    @classmethod
    def join(cls, parts: "Sequence[Emissions]") -> "Emissions":
        """Join batches in their order."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in parts[0].columns}
        return cls(**columns, nearest_neighbour_distance=parts[0].nearest_neighbour_distance)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the arrays with one row per atom."""
        return COLUMNS + tuple(name for name in OPTIONAL_COLUMNS if getattr(self, name) is not None)

    @property
    def can_roll(self) -> Booleans:
        """Whether each atom has a neighbour to roll onto, bool (n,)."""
        return np.isfinite(self.neighbours).all(axis=1)

    @property
    def can_roll_twice(self) -> Booleans:
        """Whether each atom has a target of a second roll-up, bool (n,); ValueError if these are not known."""
        return np.isfinite(self.strongest_targets(1)).all(axis=1)

    def targets_of(self, roll: int) -> Floats:
        """Targets of the first roll-up (0) or the second one (1) [nm], shape (n, 3, 3); ValueError if not known."""
        if self.targets is not None and roll < self.targets.shape[1]:
            return self.targets[:, roll]
        if roll:
            raise ValueError(
                "a second roll-up needs its targets, which this run does not have: run with "
                "response_settings=ResponseSettings(rolls=2) or ResponseSettings.wide(rolls=2)"
            )
        raise ValueError(
            "shares of several neighbours need the targets of the roll-up, which this run does not have: run with "
            "response_settings=ResponseSettings.wide()"
        )

    def strongest_targets(self, roll: int) -> np.ndarray:
        """The strongest of `targets_of` each atom [nm], shape (n, 3); NaN if there is none."""
        return self.targets_of(roll)[:, 0] if roll else self.neighbours

    def kept(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Result of a function of these emissions: that of the last call if the key is the same, computed otherwise.

        Parameters
        ----------
        key : hashable
            Name and arguments of the function.
        compute : callable
            Returns the result.
        """
        if self._kept is None or self._kept[0] != key:
            object.__setattr__(self, "_kept", (key, compute()))
        return self._kept[1]

    @property
    def slowness(self) -> Floats:
        """Time of flight [ns] per reduced time [nm/sqrt(V)], sqrt(m/n) in units of `FLIGHT_TIME`, shape (n,)."""
        return FLIGHT_TIME * np.sqrt(self.masses / self.charge_states)

    def __repr__(self) -> str:
        lonely = np.count_nonzero(np.isnan(self.neighbours).any(axis=1))
        return f"<Emissions: {len(self):,} atoms, {lonely:,} of them without a neighbour to roll onto>"


class TangentialLaunches(NamedTuple):
    """Launches of n ions along the surface."""

    rolled: Booleans
    """Whether each ion rolled up, shape (n,)."""
    first: Floats
    """Velocities along t1 of `tangent_frame` [nm/ns], shape (n,)."""
    second: Floats
    """Velocities along t2, shape (n,)."""
    shares: Floats | None = None
    """Shares of the three targets of each roll-up, shape (n, rolls, 3), sum 1; by default the first only."""
    heights: Floats | None = None
    """Heights of the launches above the usual start [nm], shape (n,); by default 0."""
    twice: Booleans | None = None
    """Whether each ion rolled up twice, shape (n,), a part of `rolled`; by default none did."""

    def __repr__(self) -> str:
        return short_repr(self)


def choose_launches(launches: Sequence[TangentialLaunches], chosen: Integers) -> TangentialLaunches:
    """Launches of n ions, each from one of several.

    Parameters
    ----------
    launches : sequence of TangentialLaunches
        Each of all n ions.
    chosen : ndarray of int, shape (n,)
        Which one of them each ion has.

    Returns
    -------
    TangentialLaunches
        Shares, heights and second roll-ups are left at their default if all have it.
    """
    n = len(chosen)
    rolls = max(
        2 if each.twice is not None else 1 if each.shares is None else each.shares.shape[1] for each in launches
    )
    strongest = np.zeros((n, rolls, 3))
    strongest[..., 0] = 1.0
    defaults = {"shares": strongest, "heights": np.zeros(n), "twice": np.zeros(n, bool)}
    columns = {}
    for name in TangentialLaunches._fields:
        given = [getattr(each, name) for each in launches]
        if all(column is None for column in given):
            continue
        columns[name] = result = np.array(defaults.get(name, given[0]))
        for k, column in enumerate(given):
            if column is not None:
                rows = chosen == k
                (result[:, : column.shape[1]] if name == "shares" else result)[rows] = column[rows]
    return TangentialLaunches(**columns)


@dataclass(frozen=True, eq=False, repr=False)
class Launches:
    """Start positions and velocities of a batch of ions.

    Parameters
    ----------
    positions : array_like
        Start positions [nm], shape (n, 3).
    velocities : array_like
        Start velocities [nm/ns], shape (n, 3).
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


def check_launches(perturbation: Any, launches: Any, n: int) -> Launches:
    """Return the launches of a perturbation; ValueError unless they are `Launches` of n ions."""
    if not isinstance(launches, Launches):
        raise ValueError(f"launch of {perturbation!r:.80} must return Launches, got {launches!r:.80}")
    if len(launches) != n:
        raise ValueError(f"{perturbation!r} must launch {n} ions, one per emission, got {len(launches)}")
    return launches
