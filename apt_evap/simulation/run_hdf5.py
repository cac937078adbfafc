"""The HDF5 file of a run: layout, writing and reading.

Groups and fields have the names of NeXus NXapm if it defines one; see `apt_evap.storage.nexus` and docs/formats.rst.
"""

import json
from contextlib import contextmanager
from typing import Any

import numpy as np

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_number, check_seed
from apt_evap.detection.detector import Detector
from apt_evap.emission.perturbations import described, perturbation_of
from apt_evap.evaporation.state import EmitterState
from apt_evap.evaporation.voltage import check_voltage
from apt_evap.flight.response import ResponseSettings
from apt_evap.simulation.columns import (
    ALWAYS,
    OPTIONAL,
    check_sequence_of_ions,
    columns_of,
    flown_columns,
    parts_of,
    response_columns,
    target_columns,
)
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.provenance import provenance_now
from apt_evap.simulation.real_units import RealUnits
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.storage.digested_hdf5 import first_line, open_hdf5, tail_of, write_hdf5
from apt_evap.storage.nexus import ENTRY, IONS, put_field, put_group, put_nxapm, put_text

FORMAT = "apt_evap run 1"
_RUN, _STATE = "run", "state"  # kinds of files

_SIMULATION = f"{ENTRY}/simulation"
_OWN = "NXcollection"
# of tables and of the state
_UNITS = {"field": "V/nm", "fields": "V/nm", "radii": "nm", "apexes": "nm", "charges": "e"}
_STATE_ARRAYS = {
    "sites": (np.int64, (None,)),
    "charges": (np.float64, (None,)),
    "lonely": (np.int64, (None,)),
    "lonely_normals": (np.float64, (None, 3)),
}
_READ_ERRORS = (OSError, KeyError, IndexError, RuntimeError, TypeError, ValueError, AttributeError, OverflowError)


def _place(column):
    """Name of the dataset of a column."""
    path = column.path.removeprefix("emissions/")
    return IONS if path == "ions" else f"{_SIMULATION}/{path}"


# ---- writing -------------------------------------------------------------------------------------------------------


def write_run(path: AnyPath, run: Any) -> None:
    """Write a Run to a file, which is either complete or absent; FileError if it cannot be written."""
    complete = run.ended in (StopReason.COMPLETE, StopReason.EXHAUSTED)
    with write_hdf5(path, _RUN, len(run), run.provenance.get("settings", "") if complete else "") as file:
        put_text(file, "format", FORMAT)
        _write(file, run)


def _put(group, name, values, unit=None):
    *folders, name = name.split("/")
    for folder in folders:
        group = group[folder] if folder in group else put_group(group, folder, _OWN)
    put_field(group, name, values, unit)


def _write(file, run):
    put_text(file, "provenance", json.dumps(run.provenance))
    put_text(file, "settings", json.dumps(run.settings))
    put_text(file, "elements", json.dumps(run.elements))
    put_text(file, "ended", run.ended)
    file.attrs["nearest_neighbour_distance"] = run.emissions.nearest_neighbour_distance
    first, tip = run.hits(run.first_perturbation), run.settings["tip"]
    provenance = {**provenance_now(), **run.provenance}
    put_nxapm(
        file,
        ions=run.emissions.ions,
        hits=np.column_stack([first.x, first.y]),
        times=first.time_of_flight,
        masses=first.mass_to_charge,
        elements=run.elements,
        start_time=provenance["created"],
        version=provenance["version"],
        is_simulation=True,
        radius=tip.get("apex_radius"),
        shank_angle=tip.get("shank_angle"),
    )
    simulation = put_group(file, _SIMULATION, _OWN)
    put_text(simulation, "perturbation", json.dumps(described(run.first_perturbation)))
    every = run.every_column
    for column, values in zip(every, columns_of(run, every).values(), strict=True):
        place = _place(column)
        if place != IONS:
            stored = values.astype(np.int8) if values.dtype == bool else values
            _put(simulation, place.removeprefix(f"{_SIMULATION}/"), stored, column.unit)
    for index, perturbation in enumerate(run.perturbations):
        put_text(simulation[f"flown/{index}"], "perturbation", json.dumps(described(perturbation)))
    for group, table in (("history", run.history), ("cap", run.cap)):
        for name, values in table._asdict().items():
            _put(simulation, f"{group}/{name}", values, _UNITS.get(name))
    if run.units is not None:
        put_text(simulation["real"], "units", json.dumps(to_plain(run.units)))
    if run.state is not None:
        _put_state(put_group(simulation, "state", _OWN), run.state, run.first_event)


def _put_state(group, state, first_event):
    for name, value in vars(state).items():
        if name in _STATE_ARRAYS:
            _put(group, name, value, _UNITS.get(name))
        elif name != "rule_state":
            group.attrs[name] = value
    for name, value in state.rule_state.items():
        group.attrs[name] = value
    group.attrs["first_event"] = first_event


def write_state(path: AnyPath, state: Any, first_event: int) -> None:
    """Write an EmitterState to a separate file, which is either complete or absent."""
    with write_hdf5(path, _STATE, len(state.sites)) as file:
        put_text(file, "format", FORMAT)
        _put_state(file, state, first_event)


# ---- reading -------------------------------------------------------------------------------------------------------


def read_run(path: AnyPath) -> dict[str, Any]:
    """Read the arguments of a Run from a file; FileError if it is missing, damaged or not a run."""
    with _reading(path, _RUN) as file:
        return _read(file)


def read_state(path: AnyPath) -> tuple[EmitterState, int]:
    """Read an EmitterState from a separate file, and the number of atoms evaporated before the first ion of its run."""
    with _reading(path, _STATE) as file:
        return _read_state(file, "")


def count_ions(path: AnyPath) -> int:
    """Number of ions of the run in a file, from its last bytes; FileError if it is not a run."""
    tail = tail_of(path)
    if tail is None or tail.kind != _RUN:
        raise FileError(f"{str(path)!r} is not a run")
    return tail.rows


def is_run(path: AnyPath) -> bool:
    """Whether a file is a run, even if it is damaged."""
    try:
        tail = tail_of(path)
    except FileError:
        return False
    return tail is not None and tail.kind == _RUN


@contextmanager
def _reading(path, kind):
    name = str(check_path(path))
    try:
        with open_hdf5(path) as file:
            if file.tail is None or file.tail.kind != kind:
                found = "another HDF5 file" if file.tail is None else repr(file.tail.kind)
                raise FileError(f"{name!r} is not a {kind}: expected {FORMAT!r}, got {found}")
            found = file.text("format")
            if found != FORMAT:
                raise FileError(f"{name!r} is a {kind} in another format: expected {FORMAT!r}, got {found!r}")
            yield file
    except FileError:
        raise
    except _READ_ERRORS as error:
        raise FileError(f"cannot read {name!r} as a {kind}: {first_line(error)}") from error


def _read(file):
    settings = json.loads(file.text("settings"))
    elements = tuple(json.loads(file.text("elements")))
    response_settings = from_plain(settings["responses"], ResponseSettings, what="responses")
    optional = (*OPTIONAL, *target_columns(response_settings))
    perturbations, columns = [], [*ALWAYS, *(column for column in optional if _place(column) in file)]
    while (group := f"{_SIMULATION}/flown/{len(perturbations)}") in file:
        columns += flown_columns(len(perturbations))
        perturbations.append(_known(json.loads(file.text("perturbation", group))))
    if f"{_SIMULATION}/responses" in file:
        columns += response_columns(response_settings)
    arrays, n = {}, file.tail.rows
    for column in columns:
        stored = np.int8 if column.dtype is np.bool_ else column.dtype
        arrays[column.path] = file.read(_place(column), stored, (n, *column.row)).astype(column.dtype, copy=False)
    _check_index(arrays["species"], "species", len(elements))
    _check_index(arrays["phase"], "phase", len(settings["tip"].get("phases", ())) or 1)
    check_sequence_of_ions(arrays["emissions/ions"], "ions")
    units = None
    if "real/voltages" in arrays:
        steps = np.diff(arrays["real/pulse_ids"])
        if len(steps) and steps.min() < 0:
            raise ValueError(f"pulse_ids must not decrease from ion to ion, got a step of {steps.min()}")
        units = from_plain(json.loads(file.text("units", f"{_SIMULATION}/real")), RealUnits)
    state, first_event = None, 0
    if f"{_SIMULATION}/state" in file:
        state, first_event = _read_state(file, f"{_SIMULATION}/state")
    return parts_of(arrays, float(file.attributes()["nearest_neighbour_distance"])) | {
        "perturbations": tuple(perturbations),
        "seed": check_seed(settings["seed"]),
        "voltage": check_voltage(settings["voltage"]),
        "detector": from_plain(settings["detector"], Detector, what="detector"),
        "response_settings": response_settings,
        "elements": elements,
        "settings": settings,
        "history": History(*_read_table(file, "history", History._fields)),
        "cap": CapHistory(*_read_table(file, "cap", CapHistory._fields)),
        "units": units,
        "state": state,
        "first_event": first_event,
        "ended": file.text("ended"),
        "provenance": dict(json.loads(file.text("provenance"))),
    }


def _check_index(values, name, number):
    if len(values) and not 0 <= values.min() <= values.max() < number:
        raise ValueError(f"{name} must be 0 to {number - 1}, got {values.min()} to {values.max()}")


def _read_table(file, group, names):
    """Columns of a table with the number of ions in the first one."""
    group = f"{_SIMULATION}/{group}"
    ions = file.read(f"{group}/ions", np.int64, (None,))
    return ions, *(file.read(f"{group}/{name}", float, (len(ions),)) for name in names[1:])


def _read_state(file, group):
    before = f"{group}/" if group else ""
    arrays = {name: file.read(before + name, dtype, shape) for name, (dtype, shape) in _STATE_ARRAYS.items()}
    attributes = file.attributes(group)
    # not those of a separate file, or the class of the group, a text of variable length (see `put_text`)
    numbers = {name: attributes[name] for name in attributes if name not in ("format", "digest", "NX_class")}
    own = {name: numbers.pop(name) for name in ("deepened", "tolerance", "opening_angle", "clipped", "unsettled")}
    factor = check_number(float(numbers.pop("voltage_factor", 1.0)), "voltage_factor", above=0)
    first_event = check_count(int(numbers.pop("first_event")), "first_event")
    state = EmitterState(
        **arrays,
        deepened=tuple(int(event) for event in np.ravel(own["deepened"])),
        tolerance=check_number(float(own["tolerance"]), "tolerance", above=0),
        opening_angle=check_number(float(own["opening_angle"]), "opening_angle", at_least=0),
        clipped=check_count(int(own["clipped"]), "clipped"),
        unsettled=check_count(int(own["unsettled"]), "unsettled"),
        rule_state=numbers,
        voltage_factor=factor,
    )
    return state, first_event


def _known(description):
    """The perturbation with this description; for a user-defined one, the description."""
    try:
        return perturbation_of(description)
    except ValueError:
        return description
