"""The columns of a run: every array with one row per ion, its type, and its unit.

A column has a path, such as "site", "emissions/positions" or "flown/0/times"; a group is a part of the run. Selection
of ions, joining of batches, the fingerprint and the file follow from this list. A column of the events with the path
"events/NAME" needs no more than its line here: it is ``run.events["NAME"]``. New columns are in `OPTIONAL`: files of
earlier versions do not have them.
"""

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import Floats
from apt_evap._core import events
from apt_evap.emission.emissions import Emissions
from apt_evap.simulation.flight.response import Responses, ResponseSettings
from apt_evap.simulation.real_units import RealColumns


class Flown(NamedTuple):
    """Results of the flights of one perturbation."""

    directions: Floats
    """Stereographic directions, shape (n, 2)."""
    times: Floats
    """Times of flight [ns], shape (n,)."""

    def __repr__(self) -> str:
        return f"<Flown: directions and times of {len(self.times):,} ions>"


class Clock(NamedTuple):
    """Times and voltages of the events of a run with a temperature; each of shape (n,)."""

    waits: Floats
    """Time before each event [s]; with pulses, time at the top of pulses."""
    voltages: Floats
    """Voltage of the control at each event [V]."""

    def __repr__(self) -> str:
        return f"<Clock: {len(self.waits):,} events>"


class Column(NamedTuple):
    """An array with one row per ion."""

    path: str
    """Name, with the name of its group."""
    dtype: Any
    """Type of the numbers."""
    row: tuple[int, ...] = ()
    """Shape of a row."""
    unit: str | None = None
    """Unit of the numbers."""
    hashed: bool = True
    """Whether the fingerprint contains it."""


_EVENTS = {column.name: column for column in events.COLUMNS}


def _of_events(path, hashed=True):
    """A column that the events fill."""
    column = _EVENTS[path.rpartition("/")[2]]
    return Column(path, column.dtype, column.row, column.unit, hashed)


ALWAYS = (
    Column("emissions/ions", np.int64),
    Column("emissions/positions", np.float64, (3,), "nm"),
    _of_events("emissions/normals"),
    Column("emissions/neighbours", np.float64, (3,), "nm"),
    Column("emissions/targets", np.float64, (3, 3), "nm"),
    Column("emissions/charge_ratios", np.float64, (3,)),
    Column("emissions/charge_states", np.int32, (), "e"),
    Column("emissions/masses", np.float64, (), "Da"),
    _of_events("site"),
    Column("species", np.int32),
    _of_events("charges"),
    _of_events("fields"),
    _of_events("detached", hashed=False),
    Column("phase", np.int8, hashed=False),
)
OPTIONAL = (
    Column("emissions/rollup_distances", np.float64, (), "nm"),  # phases that differ in it
    _of_events("clock/waits"),
    Column("clock/voltages", np.float64, (), "V"),
    Column("responses/not_flown", np.bool_, hashed=False),  # with a field of view
    Column("real/voltages", np.float64, (), "V", hashed=False),
    Column("real/instrument_voltages", np.float64, (), "V", hashed=False),
    Column("real/charges", np.int32, (), "e", hashed=False),
    Column("real/masses", np.float64, (), "Da", hashed=False),
    Column("real/pulse_ids", np.int64, hashed=False),
)


def flown_columns(number: int) -> tuple[Column, ...]:
    """Columns of the flights of the perturbation with this number."""
    group = f"flown/{number}"
    return Column(f"{group}/directions", np.float64, (2,)), Column(f"{group}/times", np.float64, (), "ns")


def response_columns(settings: ResponseSettings) -> list[Column]:
    """Columns of the responses."""
    site, rolled = (len(design.exponents) for design in (settings.site, settings.rolled))
    return [
        Column("responses/site", np.float32, (3, site)),
        Column("responses/rolled", np.float32, (3, rolled)),
        Column("responses/residuals", np.float32, (2,), "mm"),
    ]


def check_sequence_of_ions(ions: NDArray[np.int64], name: str) -> None:
    """Raise ValueError unless the ions of a run are in the sequence of evaporation, each once."""
    wrong = np.flatnonzero(ions[1:] <= ions[:-1])
    if len(wrong):
        before, after = ions[wrong[0]], ions[wrong[0] + 1]
        raise ValueError(
            f"{name} must be in the sequence of evaporation, each once, got ion {after} after ion {before}"
        )


def columns_of(run: Any, every: Iterable[Column]) -> dict[str, np.ndarray]:
    """Arrays of a run by path, for those of these columns that it has."""
    arrays = {}
    for column in every:
        group, _, name = column.path.rpartition("/")
        if group.startswith("flown/"):
            holder = run.flown[int(group.removeprefix("flown/"))]
        else:
            holder = getattr(run, group) if group else run
        if isinstance(holder, Mapping):
            values = holder.get(name)
        else:
            values = None if holder is None else getattr(holder, name)
        if values is not None:
            arrays[column.path] = values
    return arrays


def events_of(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Those columns of the events, by name, that a run keeps under "events"."""
    paths = (column.path for column in (*ALWAYS, *OPTIONAL))
    names = [path.removeprefix("events/") for path in paths if path.startswith("events/")]
    return {name: columns[name] for name in names}


def every_column_of(run: Any) -> list[Column]:
    """The columns that a run has."""
    columns = [*ALWAYS, *OPTIONAL]
    columns += [column for number in range(len(run.flown)) for column in flown_columns(number)]
    columns += response_columns(run.response_settings)
    arrays = columns_of(run, columns)
    return [column for column in columns if column.path in arrays]


def fingerprint_of(run: Any) -> str:
    """Hash of the columns of a run, see `Run.fingerprint`."""
    columns = columns_of(run, (column for column in every_column_of(run) if column.hashed))
    hashed = hashlib.sha256()
    for name in sorted(columns):
        values = np.array(columns[name], order="C")
        if values.dtype.kind == "f":
            values[np.isnan(values)] = np.nan  # NaN has many bits, which depend on the processor
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        hashed.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        hashed.update(values.data)
    return hashed.hexdigest()


def parts_of(arrays: Mapping[str, Any], nearest_neighbour_distance: float) -> dict[str, Any]:
    """Arguments of `Run` from its arrays by path: the reverse of `columns_of`."""
    groups: dict[str, dict[str, Any]] = {}
    for path, values in arrays.items():
        group, _, name = path.rpartition("/")
        groups.setdefault(group, {})[name] = values
    return groups[""] | {
        "emissions": Emissions(**groups["emissions"], nearest_neighbour_distance=nearest_neighbour_distance),
        "events": groups.get("events", {}),
        "flown": tuple(Flown(**arrays) for group, arrays in groups.items() if group.startswith("flown/")),
        "responses": Responses(**groups["responses"]) if "responses" in groups else None,
        "clock": Clock(**groups["clock"]) if "clock" in groups else None,
        "real": RealColumns(**groups["real"]) if "real" in groups else None,
    }
