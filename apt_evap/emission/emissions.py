"""A batch of emissions, and the launches of their ions."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np

from apt_evap._common.codec import check_itself
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
        Positions of the three targets of a roll-up, the surface neighbours with the highest charges, in descending
        order [nm], shape (n, 3, 3); NaN if there are fewer. The first one is that of `neighbours`.
    charge_ratios : array_like, optional
        Their charges over that of the atom, shape (n, 3); NaN if there are fewer.
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
    _kept: dict = field(default_factory=dict, init=False)  # key and result of the last call of `kept`

    def __post_init__(self):
        check_itself(self)

    def _check(self):
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
            values["targets"] = check_array(self.targets, "targets", (n, 3, 3), finite=False)
            values["charge_ratios"] = check_array(self.charge_ratios, "charge_ratios", (n, 3), finite=False)
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
        return values

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

    def kept(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Result of a function of these emissions: that of the last call if the key is the same, computed otherwise.

        Parameters
        ----------
        key : hashable
            Name and arguments of the function.
        compute : callable
            Returns the result.
        """
        if key in self._kept:
            return self._kept[key]
        result = compute()
        self._kept.clear()
        self._kept[key] = result
        return result

    @property
    def slowness(self) -> Floats:
        """Time of flight [ns] per reduced time [nm/sqrt(V)], sqrt(m/n) in units of `FLIGHT_TIME`, shape (n,)."""
        return FLIGHT_TIME * np.sqrt(self.masses / self.charge_states)

    def __repr__(self) -> str:
        isolated = np.count_nonzero(np.isnan(self.neighbours).any(axis=1))
        return f"<Emissions: {len(self):,} atoms, {isolated:,} of them without a neighbour to roll onto>"


class TangentialLaunches(NamedTuple):
    """Launches of n ions along the surface."""

    rolled: Booleans
    """Whether each ion rolled up, shape (n,)."""
    first: Floats
    """Velocities along t1 of `tangent_frame` [nm/ns], shape (n,)."""
    second: Floats
    """Velocities along t2, shape (n,)."""
    shares: Floats | None = None
    """Shares of the three targets of the roll-up, shape (n, 3), sum 1; by default the first only."""
    heights: Floats | None = None
    """Heights of the launches above the usual start [nm], shape (n,); by default 0."""

    def __repr__(self) -> str:
        return short_repr(self)


def choose_launches(launches: Sequence[TangentialLaunches], chosen: Integers) -> TangentialLaunches:
    """Launches of n ions: of each ion that of one of several, with the number `chosen`, shape (n,)."""
    n = len(chosen)
    defaults = {"shares": np.tile([1.0, 0.0, 0.0], (n, 1)), "heights": np.zeros(n)}
    columns = {}
    for name in TangentialLaunches._fields:
        columns_of_launches = [getattr(launch, name) for launch in launches]
        if all(column is None for column in columns_of_launches):
            continue
        columns[name] = result = np.array(defaults.get(name, columns_of_launches[0]))
        for k, column in enumerate(columns_of_launches):
            if column is not None:
                rows = chosen == k
                result[rows] = column[rows]
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
        check_itself(self)

    def _check(self):
        positions = check_array(self.positions, "positions", ("n", 3))
        n = len(positions)
        return {
            "positions": positions,
            "velocities": check_array(self.velocities, "velocities", (n, 3)),
            "rolled": check_array(self.rolled, "rolled", (n,), dtype=bool),
        }

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
