"""The HDF5 file of a run: layout, writing and reading, also of the undamaged ions in a damaged file.

Groups and fields have the names of NeXus NXapm if it defines one; see `apt_evap.simulation.nexus` and docs/formats.rst.
"""

import json
import warnings
from contextlib import contextmanager, suppress
from typing import Any

import h5py
import numpy as np

from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_number, check_seed
from apt_evap._common.warnings import DataWarning
from apt_evap._common.wording import argument
from apt_evap.detection.detector import Detector
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.perturbations import from_dict, to_dict
from apt_evap.evaporation.state import EmitterState
from apt_evap.evaporation.voltage import check_voltage
from apt_evap.flight.response import Responses, ResponseSettings
from apt_evap.simulation.checked_hdf5 import (
    CheckedFile,
    DamagedRows,
    first_line,
    has_checksums,
    open_checked,
    write_checked,
)
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.nexus import ATOM_PROBE, ENTRY, IONS, put_field, put_group, put_nxapm, put_text
from apt_evap.simulation.old_settings import upgraded
from apt_evap.simulation.provenance import provenance_now
from apt_evap.simulation.real_units import RealColumns, RealUnits

FORMAT = "apt_evap run 3"
_KIND = "apt_evap run "
_READABLE = ("apt_evap run 2", FORMAT)  # 2: evaporation_id in another group, and not a complete NXapm file
ROWS = 4096  # rows of a dataset with a common checksum: any damage to them loses these ions

_SIMULATION = f"{ENTRY}/simulation"
_OWN = "NXcollection"
_EMISSIONS = ("positions", "normals", "neighbours", "charge_states", "masses")
_COLUMNS = ("site", "species", "charges", "fields")
_DETACHED = "detached", (f"{_SIMULATION}/detached", np.int8, ())  # not in files of earlier versions
_PHASE = "phase", (f"{_SIMULATION}/phase", np.int8, ())  # only with several phases
_ROLLUP = "rollup_distances", (f"{_SIMULATION}/rollup_distances", np.float64, ())  # only if the phases differ in it
_UNITS = {
    "rollup_distances": "nm",
    "positions": "nm",
    "neighbours": "nm",
    "targets": "nm",
    "second_targets": "nm",
    "charge_states": "e",
    "masses": "Da",
    "charges": "e",
    "fields": "V/nm",
    "times": "ns",
    "residuals": "mm",
    "field": "V/nm",
    "radii": "nm",
    "waits": "s",
    "voltages": "V",
}
_OLD_IONS = f"{ATOM_PROBE}/evaporation_id"
_KINDS = {  # datasets with one row per ion, besides the ions: name, type, shape of a row
    "positions": (f"{_SIMULATION}/positions", np.float64, (3,)),
    "normals": (f"{_SIMULATION}/normals", np.float64, (3,)),
    "neighbours": (f"{_SIMULATION}/neighbours", np.float64, (3,)),
    "charge_states": (f"{_SIMULATION}/charge_states", np.int32, ()),
    "masses": (f"{_SIMULATION}/masses", np.float64, ()),
    "site": (f"{_SIMULATION}/site", np.int64, ()),
    "species": (f"{_SIMULATION}/species", np.int32, ()),
    "charges": (f"{_SIMULATION}/charges", np.float64, ()),
    "fields": (f"{_SIMULATION}/fields", np.float64, ()),
}
# only with wide responses, and with those for two roll-ups
_TARGETS = {
    f"{before}{name}": (f"{_SIMULATION}/{before}{name}", np.float64, shape)
    for before in ("", "second_")
    for name, shape in (("targets", (3, 3)), ("charge_ratios", (3,)))
}
_RESPONSES = ("site", "rolled", "twice")  # polynomials in the order of the designs
# not in all files: datasets with one row per ion of `Run.clock` and `Run.real`
_CLOCK = {name: (f"{_SIMULATION}/clock/{name}", np.float64, ()) for name in ("waits", "voltages")}
_REAL = {
    name: (f"{_SIMULATION}/real/{name}", kind, ())
    for name, kind in (
        ("voltages", np.float64),
        ("charges", np.int32),
        ("masses", np.float64),
        ("pulse_ids", np.int64),
    )
}
_STATE_ARRAYS = {
    "sites": (np.int64, (None,)),
    "charges": (np.float64, (None,)),
    "lonely": (np.int64, (None,)),
    "lonely_normals": (np.float64, (None, 3)),
}
_HISTORY = {"flagged": "marked"}  # columns with other names in files
_READ_ERRORS = (OSError, KeyError, IndexError, RuntimeError, TypeError, ValueError, AttributeError, OverflowError)


def plain(settings: Any) -> Any:
    """Settings in the plain types of JSON, as read from a file."""
    return json.loads(json.dumps(settings, default=_plain))


def _plain(value):
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"a setting must be a plain number, text or list, got {value!r}")


def described(perturbation: Any) -> dict[str, Any]:
    """Description of a perturbation in a file, dict."""
    return perturbation if isinstance(perturbation, dict) else to_dict(perturbation)


# ---- writing -------------------------------------------------------------------------------------------------------


def write_run(path: AnyPath, run: Any) -> None:
    """Write a Run to a file, which is either complete or absent; FileError if it cannot be written."""
    with write_checked(path, ROWS) as file:
        put_text(file, "format", FORMAT)
        _write(file, run)


def _put(group, name, values):
    *folders, name = name.split("/")
    for folder in folders:
        group = group[folder] if folder in group else put_group(group, folder, _OWN)
    put_field(group, name, values, _UNITS.get(name))


def _write(file, run):
    put_text(file, "provenance", json.dumps(run.provenance))
    put_text(file, "settings", json.dumps(run.settings, default=_plain))
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
    for name in run.emissions.columns:
        if name != "ions":
            _put(simulation, name, getattr(run.emissions, name))
    for name in _COLUMNS:
        _put(simulation, name, getattr(run, name))
    _put(simulation, "detached", run.detached.astype(np.int8))
    if len(run.phase_names) > 1:
        _put(simulation, "phase", run.phase)
    for index, (perturbation, flown) in enumerate(zip(run.perturbations, run.flown, strict=True)):
        _put(simulation, f"flown/{index}/directions", flown.directions)
        _put(simulation, f"flown/{index}/times", flown.times)
        put_text(simulation[f"flown/{index}"], "perturbation", json.dumps(described(perturbation)))
    if run.responses is not None:
        for name, values in run.responses.columns.items():
            _put(simulation, f"responses/{name}", values)
    for name, values in run.history._asdict().items():
        _put(simulation, f"history/{_HISTORY.get(name, name)}", values)
    for name, values in run.cap._asdict().items():
        _put(simulation, f"cap/{name}", values)
    for group, columns in (("clock", run.clock), ("real", run.real)):
        if columns is not None:
            for name, values in columns._asdict().items():
                _put(simulation, f"{group}/{name}", values)
    if run.units is not None:
        put_text(simulation["real"], "units", json.dumps(run.units.to_dict(), default=_plain))
    if run.state is not None:
        _put_state(put_group(simulation, "state", _OWN), run.state, run.first_event)


def _put_state(group, state, first_event):
    for name, value in vars(state).items():
        if name in _STATE_ARRAYS:
            _put(group, name, value)
        elif name != "rule_state":
            group.attrs[name] = value
    for name, value in state.rule_state.items():
        group.attrs[name] = value
    group.attrs["first_event"] = first_event


def write_state(path: AnyPath, state: Any, first_event: int) -> None:
    """Write an EmitterState to a separate file, which is either complete or absent."""
    with write_checked(path, ROWS) as file:
        put_text(file, "format", FORMAT)
        _put_state(file, state, first_event)


# ---- reading -------------------------------------------------------------------------------------------------------


def read_run(path: AnyPath, partial: bool = False) -> dict[str, Any]:
    """Read the arguments of a Run from a file; FileError if it is missing, damaged or not a run."""
    hint = "" if partial else f"; {argument('partial', True)} reads the undamaged ions"
    with _reading(path, hint, partial=partial) as file:
        return _read(file, partial)


def read_state(path: AnyPath) -> tuple[EmitterState, int]:
    """Read an EmitterState from a separate file, and the number of atoms evaporated before the first ion of its run."""
    with _reading(path) as file:
        return _read_state(file, "")


def count_ions(path: AnyPath) -> int:
    """Number of ions of the run in a file; FileError as `read_run`."""
    with _reading(path, with_data=False) as file:
        return len(file.dataset(_ions_of(file), np.int64, (None,)))


def is_run(path: AnyPath) -> bool:
    """Whether a file is a run, even if it is damaged or in another version of the format."""
    with suppress(OSError, RuntimeError, ValueError, KeyError):
        if has_checksums(path):
            try:
                with open_checked(path, with_data=False) as file:
                    return "format" in file.attributes() and file.text("format").startswith(_KIND)
            except FileError:
                return True
        with h5py.File(path, "r", locking=False) as file:
            return CheckedFile(file, 0, None).text("format").startswith(_KIND)
    return False


@contextmanager
def _reading(path, hint="", with_data=True, partial=False):
    name = str(check_path(path))
    try:
        with open_checked(path, with_data=with_data, partial=partial) as file:
            kind = file.text("format") if "format" in file.attributes() else "another file"
            if not kind.startswith(_KIND):
                raise FileError(f"{name!r} is not a run: expected {FORMAT!r}, got {kind!r}")
            if kind not in _READABLE:
                readable = " and ".join(map(repr, _READABLE))
                raise FileError(f"{name!r} is a run in another format, {kind!r}; this version reads {readable}")
            yield file
    except DamagedRows as error:
        raise FileError(f"{error}{hint}") from error
    except FileError:
        raise
    except _READ_ERRORS as error:
        raise FileError(f"cannot read {name!r} as a run: {first_line(error)}{hint}") from error


def _read(file, partial):
    settings = upgraded(json.loads(file.text("settings")))
    elements = tuple(json.loads(file.text("elements")))
    response_settings = ResponseSettings.from_dict(settings["responses"])
    perturbations, kinds = [], {"ions": (_ions_of(file), np.int64, ()), **_KINDS}
    while (group := f"{_SIMULATION}/flown/{len(perturbations)}") in file:
        kinds[f"{len(perturbations)} directions"] = f"{group}/directions", np.float64, (2,)
        kinds[f"{len(perturbations)} times"] = f"{group}/times", np.float64, ()
        perturbations.append(_known(json.loads(file.text("perturbation", group))))
    group, responses = f"{_SIMULATION}/responses", {}
    if group in file:
        designs = response_settings.designs
        shapes = {name: (3, len(each.exponents)) for name, each in zip(_RESPONSES, designs, strict=False)}
        for name, shape in {**shapes, "residuals": (len(designs),)}.items():
            kinds[f"responses {name}"] = responses[name] = f"{group}/{name}", np.float32, shape
    targets = {name: kind for name, kind in _TARGETS.items() if kind[0] in file}
    kinds |= targets
    kinds |= {name: kind for name, kind in (_DETACHED, _PHASE, _ROLLUP) if kind[0] in file}
    optional = {"clock": _CLOCK, "real": _REAL}
    optional = {group: names for group, names in optional.items() if f"{_SIMULATION}/{group}" in file}
    for group, names in optional.items():
        kinds |= {f"{group} {name}": kind for name, kind in names.items()}
    columns, lost = _columns(file, kinds, partial)
    if len(columns["ions"]) and not 0 <= columns["species"].min() <= columns["species"].max() < len(elements):
        raise ValueError(f"species must be 0 to {len(elements) - 1}, as there are {len(elements)} elements")
    n_phases = len(settings["tip"].get("phases", ())) or 1
    phase = columns.get("phase", np.zeros(1, np.int8))
    if len(phase) and not 0 <= phase.min() <= phase.max() < n_phases:
        raise ValueError(f"phase must be 0 to {n_phases - 1}, as there are {n_phases} phases")
    groups = {group: [columns[f"{group} {name}"] for name in names] for group, names in optional.items()}
    units = None
    if "real" in groups:
        units = RealUnits.from_dict(json.loads(file.text("units", f"{_SIMULATION}/real")))
    history, cap, state, first_event = History.empty(), CapHistory.empty(), None, 0
    try:
        history = History(*_read_table(file, "history", History._fields))
        if f"{_SIMULATION}/cap" in file:
            cap = CapHistory(*_read_table(file, "cap", CapHistory._fields))
        if f"{_SIMULATION}/state" in file and not lost:
            state, first_event = _read_state(file, f"{_SIMULATION}/state")
    except _READ_ERRORS:
        if not partial:
            raise
    return {
        "emissions": Emissions(
            **{name: columns[name] for name in ("ions", *_EMISSIONS, *targets)},
            nearest_neighbour_distance=float(file.attributes()["nearest_neighbour_distance"]),
            rollup_distances=columns.get("rollup_distances"),
        ),
        **{name: columns[name] for name in _COLUMNS},
        "detached": columns["detached"].astype(bool) if "detached" in columns else None,
        "phase": columns.get("phase"),
        "perturbations": tuple(perturbations),
        "flown": tuple((columns[f"{k} directions"], columns[f"{k} times"]) for k in range(len(perturbations))),
        "responses": Responses(**{name: columns[f"responses {name}"] for name in responses}) if responses else None,
        "seed": check_seed(settings["seed"]),
        "voltage": check_voltage(settings["voltage"]),
        "detector": Detector(**settings["detector"]),
        "response_settings": response_settings,
        "elements": elements,
        "settings": settings,
        "history": history,
        "cap": cap,
        "clock": groups.get("clock"),
        "units": units,
        "real": RealColumns(*groups["real"]) if "real" in groups else None,
        "state": state,
        "first_event": first_event,
        "ended": f"damaged: {lost:,} ions are lost" if lost else file.text("ended"),
        "provenance": dict(json.loads(file.text("provenance"))),
    }


def _ions_of(file):
    """Name of the dataset of the ions, which depends on the version of the format."""
    return _OLD_IONS if file.text("format") == _READABLE[0] else IONS


def _columns(file, kinds, partial):
    """Columns by name; for a damaged file, only the ions whose rows are undamaged in all columns."""
    n = len(file.dataset(kinds["ions"][0], np.int64, (None,)))
    datasets = {name: file.dataset(path, dtype, (n, *shape)) for name, (path, dtype, shape) in kinds.items()}
    blocks, lost = [], 0
    step = ROWS if partial else max(n, 1)
    for begin in range(0, n, step):
        end = min(begin + step, n)
        try:
            blocks.append([file.rows(dataset, begin, end) for dataset in datasets.values()])
        except _READ_ERRORS:
            if not partial:
                raise
            lost += end - begin
    if lost or file.is_damaged:
        warnings.warn(f"{file.name!r} is damaged: {lost:,} of {n:,} ions are lost", DataWarning, stacklevel=5)
    if len(blocks) == 1:
        return dict(zip(datasets, blocks[0], strict=True)), lost
    empty = [dataset[:0] for dataset in datasets.values()]
    joined = [np.concatenate(parts) for parts in zip(empty, *blocks, strict=True)]
    return dict(zip(datasets, joined, strict=True)), lost


def _read_table(file, group, names):
    """Columns of a table with the number of ions in the first one."""
    group = f"{_SIMULATION}/{group}"
    ions = file.read(f"{group}/ions", np.int64, (None,))
    return ions, *(file.read(f"{group}/{_HISTORY.get(name, name)}", float, (len(ions),)) for name in names[1:])


def _read_state(file, group):
    before = f"{group}/" if group else ""
    arrays = {name: file.read(before + name, dtype, shape) for name, (dtype, shape) in _STATE_ARRAYS.items()}
    attributes = file.attributes(group)
    # not those of a separate file, or the class of the group, a text of variable length (see `put_text`)
    numbers = {name: attributes[name] for name in attributes if name not in ("format", "checksums", "NX_class")}
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
    """The perturbation with this description of `to_dict`; for a user-defined one, the description."""
    try:
        return from_dict(description)
    except ValueError:
        return description
