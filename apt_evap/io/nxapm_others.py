"""NXapm files of other programs, such as those of pynxtools-apm and NOMAD.

Columns are at the paths of NXapm. Their units are in the attribute ``units``, and are converted.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from apt_evap._common import nexus
from apt_evap._common.checked_hdf5 import CheckedFile, open_hdf5
from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap.detection.hits import Hits
from apt_evap.io._pulses import are_grouped, first_from_equal, ions_per_pulse, pulses_from_first
from apt_evap.io._records import check_any, check_columns
from apt_evap.warnings import DataWarning, warn

_LENGTHS = {  # [m]
    "m": 1.0,
    "meter": 1.0,
    "metre": 1.0,
    "cm": 1e-2,
    "centimeter": 1e-2,
    "centimetre": 1e-2,
    "mm": 1e-3,
    "millimeter": 1e-3,
    "millimetre": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,  # the micro sign, and the Greek letter
    "μm": 1e-6,
    "micrometer": 1e-6,
    "micrometre": 1e-6,
    "nm": 1e-9,
    "nanometer": 1e-9,
    "nanometre": 1e-9,
    "angstrom": 1e-10,
    "Å": 1e-10,
}
_TIMES = {"s": 1.0, "second": 1.0, "ms": 1e-3, "millisecond": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6}
_TIMES |= {"microsecond": 1e-6, "ns": 1e-9, "nanosecond": 1e-9, "ps": 1e-12, "picosecond": 1e-12}
_VOLTAGES = {"V": 1.0, "volt": 1.0, "kV": 1e3, "kilovolt": 1e3, "mV": 1e-3, "millivolt": 1e-3}
_MASSES = {"Da": 1.0, "dalton": 1.0, "u": 1.0, "amu": 1.0, "unified_atomic_mass_unit": 1.0}


def _in_entry(path):
    return path.removeprefix(f"{nexus.ENTRY}/")


_PULSER = _in_entry(nexus.PULSER)
# path in the entry, values per ion, units and that of `Hits`
_COLUMNS: dict[str, tuple[str, int, dict[str, float], str]] = {
    "positions": (_in_entry(nexus.POSITIONS), 3, _LENGTHS, "nm"),
    "mass_to_charge": (_in_entry(nexus.MASSES), 1, _MASSES, "Da"),
    "time_of_flight": (_in_entry(nexus.TIMES), 1, _TIMES, "ns"),
    "voltage": (f"{_PULSER}/standing_voltage", 1, _VOLTAGES, "V"),
    "pulse_voltage": (f"{_PULSER}/pulse_voltage", 1, _VOLTAGES, "V"),
    "hits": (_in_entry(nexus.HITS), 2, _LENGTHS, "mm"),
    "ion": (_in_entry(nexus.IONS), 1, {}, ""),
    "pulses": ("atom_probe/hit_finding/epos_number_of_pulses", 1, {}, ""),
    "ions_per_pulse": ("atom_probe/hit_finding/epos_ions_per_pulse", 1, {}, ""),
    "multiplicity": (_in_entry(nexus.MULTIPLICITY), 1, {}, ""),
    "pulse_number": (f"{_PULSER}/pulse_number", 1, {}, ""),
}
_ABSENT = ("positions", "mass_to_charge", "time_of_flight", "voltage", "hits")  # zero for all ions: not recorded
_LARGEST = 10  # entries that are looked for: entry, entry0 to entry9


def _entry(file: CheckedFile) -> str | None:
    """Name of the only entry with columns of NXapm; None if there is none."""
    names = [
        name
        for name in ("entry", *(f"entry{number}" for number in range(_LARGEST)))
        if name in file and any(f"{name}/{path}" in file for path, *_ in _COLUMNS.values())
    ]
    if len(names) > 1:
        raise FileError(f"{file.name!r} must have one entry with ions, got {short_text(', '.join(names))}")
    return names[0] if names else None


def is_nxapm(file: CheckedFile) -> bool:
    """Whether an open HDF5 file has columns of NXapm."""
    return _entry(file) is not None


def read_nxapm_of_others(path: AnyPath, *, columns: Sequence[str] | None = None) -> Hits:
    """Read the ions of an NXapm file of another program, such as pynxtools-apm.

    A column of zeros is treated as absent, as in an .epos: positions, masses, times, standing voltages and hits. A
    column whose unit is missing or unknown is an error.

    Returns
    -------
    Hits
        x, y [mm], time_of_flight [ns], voltage, pulse_voltage [V], mass_to_charge [Da], positions [nm], pulses,
        pulse_id, multiplicity and ion, as far as the file has them.
    """
    with open_hdf5(path, "NXapm") as file:
        entry = _entry(file)
        if entry is None:
            raise FileError(f"{file.name!r} has no columns of NXapm, such as entry1/{_COLUMNS['positions'][0]}")
        if f"{entry}/measurement/event2" in file:
            raise FileError(
                f"{file.name!r} must have one event of the measurement, {entry}/measurement/event1, got more"
            )
        return _hits(file, entry, columns)


def _hits(file, entry, columns):
    places = {name: f"{entry}/{place[0]}" for name, place in _COLUMNS.items() if f"{entry}/{place[0]}" in file}
    known = [name for name in places if name not in ("hits", "ions_per_pulse", "pulse_number")]
    known += ["x", "y"] if "hits" in places else []
    known += ["pulse_id"] if {"ions_per_pulse", "pulse_number"} & set(places) else []
    known += ["multiplicity"] if "pulse_id" in known and "multiplicity" not in known else []
    chosen = check_columns(columns, tuple(known), file.name)
    wanted = set(chosen)
    if wanted & {"x", "y"}:
        wanted.add("hits")
    if wanted & {"pulse_id", "multiplicity"}:
        wanted |= {"ions_per_pulse", "pulse_number"}
    table = {name: _column(file, place, name) for name, place in places.items() if name in wanted}
    lengths = {places[name]: len(values) for name, values in table.items()}
    if len(set(lengths.values())) > 1:
        raise FileError(f"{file.name!r}: columns of NXapm must have equal lengths, got {short_text(lengths)}")
    table = {name: values for name, values in table.items() if name not in _ABSENT or values.any()}
    if "hits" in table:
        table["x"], table["y"] = (np.ascontiguousarray(column) for column in table.pop("hits").T)
    _pulses(table, file.name)
    requested = {name: table[name] for name in chosen if name in table}
    check_any(requested, file.name)
    return Hits(**requested, source=file.name)


def _column(file, place, name):
    _, width, factors, unit = _COLUMNS[name]
    values = file.read(place, None, None, compressed=True)
    if width == 1 and values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    expected = (width,) if width > 1 else ()
    if not values.ndim or values.shape[1:] != expected:
        raise ValueError(f"{place} must have shape ({', '.join(['any', *map(str, expected)])}), got {values.shape}")
    if values.dtype.kind not in ("iuf" if factors else "iu"):
        kind = "numbers" if factors else "integers"
        raise FileError(f"{file.name!r}: {place} must contain {kind}, got {values.dtype}")
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    if not factors:
        return values
    stored: Any = file.attribute("units", place)
    text = stored.decode(errors="replace") if isinstance(stored, bytes) else stored
    if not isinstance(text, str) or text not in factors:
        got = "none" if stored is None else short_text(text)
        raise FileError(f"{file.name!r}: the units of {place} must be one of {', '.join(factors)}, got {got}")
    factor = factors[text] / factors[unit]
    if values.dtype.kind == "f" and np.isclose(factor, 1.0, rtol=1e-12):
        return values
    return (values * factor).astype(values.dtype if values.dtype.kind == "f" else float, copy=False)


def _pulses(table, name):
    """Pulses from the ions per pulse of an .epos, or from the numbers of the pulses."""
    numbers, ions = table.pop("pulse_number", None), table.pop("ions_per_pulse", None)
    if numbers is not None and not numbers.any() and ions is not None:
        numbers = None  # the other column has them
    if numbers is not None and len(numbers):
        if are_grouped([numbers], name):
            pulse_id, multiplicity = pulses_from_first(first_from_equal(numbers))
            # numbers that increase are kept
            kept = int(numbers.max()) < 1 << 63 and not (numbers[1:] < numbers[:-1]).any()
            table["pulse_id"] = numbers.astype(np.int64) if kept else pulse_id
            table.setdefault("multiplicity", multiplicity)
    elif ions is not None and len(ions):
        first, problem = ions_per_pulse(ions)
        if first is None:
            warn(f"{name!r}: ions are not grouped in pulses by epos_ions_per_pulse: {problem}", DataWarning)
        else:
            table["pulse_id"], multiplicity = pulses_from_first(first)
            table.setdefault("multiplicity", multiplicity)
