"""The HDF5 file of a run: layout, writing and reading.

Groups and fields have the names of NeXus NXapm if it defines one; see `apt_evap._common.nexus` and docs/formats.rst.
"""

import json
from typing import Any

import numpy as np

from apt_evap._common.checked_hdf5 import label_of, open_hdf5, put_field, put_text, write_hdf5
from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError
from apt_evap._common.nexus import ENTRY, IONS, put_group, put_nxapm
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_number, check_seed
from apt_evap.detection.detector import Detector
from apt_evap.emission.perturbations import described, perturbation_of
from apt_evap.evaporation.state import EmitterState
from apt_evap.evaporation.voltage import check_voltage
from apt_evap.simulation.columns import (
    ALWAYS,
    OPTIONAL,
    check_sequence_of_ions,
    columns_of,
    flown_columns,
    parts_of,
    response_columns,
)
from apt_evap.simulation.flight.response import ResponseSettings
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.provenance import provenance_now
from apt_evap.simulation.real_units import RealUnits
from apt_evap.simulation.stop_reason import StopReason

_RUN = "run"  # kind of file

_SIMULATION = f"{ENTRY}/simulation"
_OWN = "NXcollection"
# of tables and of the state
_UNITS = {"field": "V/nm", "fields": "V/nm", "radii": "nm", "apexes": "nm", "charges": "e"}
_STATE_ARRAYS = {
    "sites": (np.int64, (None,)),
    "charges": (np.float64, (None,)),
    "isolated": (np.int64, (None,)),
    "isolated_normals": (np.float64, (None, 3)),
}


def _place(column):
    """Name of the dataset of a column."""
    path = column.path.removeprefix("emissions/")
    return IONS if path == "ions" else f"{_SIMULATION}/{path}"


# ---- writing -------------------------------------------------------------------------------------------------------


def write_run(path: AnyPath, run: Any) -> None:
    """Write a Run to a file, which is either complete or absent; FileError if it cannot be written."""
    complete = run.ended in (StopReason.COMPLETE, StopReason.EXHAUSTED)
    with write_hdf5(path, _RUN, len(run), run.provenance.get("settings", "") if complete else "") as file:
        _write(file, run)


def _put(group, name, values, unit=None, compress=False):
    *folders, name = name.split("/")
    for folder in folders:
        group = group[folder] if folder in group else put_group(group, folder, _OWN)
    put_field(group, name, values, unit, compress=compress)


def _write(file, run):
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
    for name in ("settings", "elements", "provenance"):
        put_text(simulation, name, json.dumps(getattr(run, name)))
    put_text(simulation, "ended", run.ended)
    put_text(simulation, "perturbation", json.dumps(described(run.first_perturbation)))
    every = run.every_column
    for column, values in zip(every, columns_of(run, every).values(), strict=True):
        place = _place(column)
        if place != IONS:
            stored = values.astype(np.int8) if values.dtype == bool else values
            _put(simulation, place.removeprefix(f"{_SIMULATION}/"), stored, column.unit, compress=True)
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
    for name in _STATE_ARRAYS:
        _put(group, name, getattr(state, name), _UNITS.get(name))
    numbers = {name: value for name, value in vars(state).items() if name not in _STATE_ARRAYS}
    numbers["first_event"] = first_event
    put_text(group, "numbers", json.dumps(numbers, default=lambda value: np.asarray(value).tolist()))


# ---- reading -------------------------------------------------------------------------------------------------------


def read_run(path: AnyPath) -> dict[str, Any]:
    """Read the arguments of a Run from a file; FileError if it is missing, damaged or not a run."""
    with open_hdf5(path, "a run") as file:
        label = _check_label(file.label, file.name)
        return _read(file, label.rows)


def _check_label(label, name):
    """The label of a run; FileError if it is another one."""
    if label is not None and label.kind.startswith(f"{_RUN} of format"):
        raise FileError(f"{name!r} is a {label.kind}, which this version cannot read: repeat the run")
    if label is None or label.kind != _RUN:
        raise FileError(f"{name!r} is not a run{f', but {label.kind!r}' if label else ''}")
    return label


def count_ions(path: AnyPath) -> int:
    """Number of ions of the run in a file, without reading them; FileError if it is not a run."""
    return _check_label(label_of(path), str(path)).rows


def is_run(path: AnyPath) -> bool:
    """Whether a file is a run, even if its columns are damaged."""
    try:
        label = label_of(path)
    except FileError:
        return False
    return label is not None and label.kind.split(" of ")[0] == _RUN


def _read(file, n):
    settings = file.json(f"{_SIMULATION}/settings")
    elements = tuple(file.json(f"{_SIMULATION}/elements"))
    response_settings = from_plain(settings["responses"], ResponseSettings, what="responses")
    perturbations, columns = [], [*ALWAYS, *(column for column in OPTIONAL if _place(column) in file)]
    while (group := f"{_SIMULATION}/flown/{len(perturbations)}") in file:
        columns += flown_columns(len(perturbations))
        perturbations.append(_known(file.json(f"{group}/perturbation")))
    if f"{_SIMULATION}/responses" in file:
        columns += response_columns(response_settings)
    arrays = {}
    for column in columns:
        stored = np.int8 if column.dtype is np.bool_ else column.dtype
        values = file.read(_place(column), stored, (n, *column.row), compressed=True)
        arrays[column.path] = values.astype(column.dtype, copy=False)
    _check_index(arrays["species"], "species", len(elements))
    _check_index(arrays["phase"], "phase", len(settings["tip"].get("phases", ())) or 1)
    check_sequence_of_ions(arrays["emissions/ions"], "ions")
    units = None
    if "real/voltages" in arrays:
        steps = np.diff(arrays["real/pulse_ids"])
        if len(steps) and steps.min() < 0:
            raise ValueError(f"pulse_ids must not decrease from ion to ion, got a step of {steps.min()}")
        units = from_plain(file.json(f"{_SIMULATION}/real/units"), RealUnits)
    state, first_event = None, 0
    if f"{_SIMULATION}/state" in file:
        state, first_event = _read_state(file)
    return parts_of(arrays, float(file.attribute("nearest_neighbour_distance"))) | {
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
        "ended": file.text(f"{_SIMULATION}/ended"),
        "provenance": dict(file.json(f"{_SIMULATION}/provenance")),
    }


def _check_index(values, name, number):
    if len(values) and not 0 <= values.min() <= values.max() < number:
        raise ValueError(f"{name} must be 0 to {number - 1}, got {values.min()} to {values.max()}")


def _read_table(file, group, names):
    """Columns of a table with the number of ions in the first one."""
    group = f"{_SIMULATION}/{group}"
    ions = file.read(f"{group}/ions", np.int64, (None,))
    return ions, *(file.read(f"{group}/{name}", float, (len(ions),)) for name in names[1:])


def _read_state(file):
    group = f"{_SIMULATION}/state"
    arrays = {name: file.read(f"{group}/{name}", dtype, shape) for name, (dtype, shape) in _STATE_ARRAYS.items()}
    numbers = file.json(f"{group}/numbers")
    state = EmitterState(
        **arrays,
        extensions=tuple(int(event) for event in numbers["extensions"]),
        tolerance=check_number(numbers["tolerance"], "tolerance", above=0),
        opening_angle=check_number(numbers["opening_angle"], "opening_angle", at_least=0),
        clipped=check_count(numbers["clipped"], "clipped"),
        unsettled=check_count(numbers["unsettled"], "unsettled"),
        rule_state={name: np.array(value)[()] for name, value in numbers["rule_state"].items()},
        voltage_factor=check_number(numbers["voltage_factor"], "voltage_factor", above=0),
    )
    return state, check_count(numbers["first_event"], "first_event")


def _known(description):
    """The perturbation with this description; for a user-defined one, the description."""
    try:
        return perturbation_of(description)
    except ValueError:
        return description
