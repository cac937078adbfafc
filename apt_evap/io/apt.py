"""The .apt exchange format of CAMECA: a header, then sections with one column each, little-endian.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), and the layout of files of IVAS and AP Suite.
All sections with one fixed record per ion are read; the others are named in a warning.
"""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from apt_evap._common.files import FileError, TruncatedFile, open_for_reading
from apt_evap._common.types import AnyPath
from apt_evap.detection.hits import Hits
from apt_evap.io._apt_sections import read_sections
from apt_evap.io._pulses import ions_per_pulse, pulses_from_first, whole_pulses
from apt_evap.io._records import check_columns, fill
from apt_evap.warnings import DataWarning, warn

# columns of Hits: number of values per ion, unit, and names of their sections in lower case, the preferred one first
_COLUMNS: dict[str, tuple[int, str | None, tuple[str, ...]]] = {
    "time_of_flight": (1, "ns", ("tofc", "epos tof", "tof", "time of flight")),
    "mass_to_charge": (1, "Da", ("mass",)),
    "voltage": (1, "V", ("voltage", "v")),
    "pulse_voltage": (1, "V", ("pulse voltage", "vap")),
    "x": (1, "mm", ("xdet_mm",)),
    "y": (1, "mm", ("ydet_mm",)),
    "positions": (3, "nm", ("position",)),
    "pulses": (1, None, ("pulsedelta", "delta pulse")),
    "multiplicity": (1, None, ("multiplicity",)),
}
_COUNTS = ("pulses", "multiplicity")
_DETECTOR = "detector coordinates"

# dimension and power of ten of each unit, in lower case
_UNITS = {
    **{name: ("length", power) for name, power in {"m": 0, "cm": -2, "mm": -3, "um": -6, "\u03bcm": -6}.items()},
    **{name: ("length", power) for name, power in {"nm": -9, "\u00e5": -10, "angstrom": -10, "pm": -12}.items()},
    **{name: ("time", power) for name, power in {"s": 0, "ms": -3, "us": -6, "\u03bcs": -6}.items()},
    **{name: ("time", power) for name, power in {"ns": -9, "ps": -12}.items()},
    **{name: ("mass", power) for name, power in {"da": 0, "u": 0, "amu": 0, "kda": 3}.items()},
    **{name: ("voltage", power) for name, power in {"v": 0, "kv": 3, "mv": -3}.items()},
}


@dataclass
class _Column:
    """A section and its target: a column of Hits, or None for `extra`; conversion factor; index of the value."""

    section: object
    target: str | None
    factor: float = 1.0
    part: int | None = None


def read_apt(path: AnyPath, *, columns: Sequence[str] | None = None, partial: bool = False) -> Hits:
    """Read an .apt file.

    The sections of IVAS and AP Suite for times of flight, masses, voltages, detector coordinates, positions and pulses
    are converted to columns of `Hits`, in its units; a section without a unit has these units. All other sections, and
    those with an unknown unit, are stored unchanged in ``extra`` under their own names, with their units in ``units``.
    Upper or lower case of names and units does not matter. A second section with the same name is called "name (2)".

    Returns
    -------
    Hits
        `pulse_id` and `multiplicity` are computed from Multiplicity, which may contain the number of ions of a pulse
        for all its ions, or for the first ion only, with 0 for the others. Otherwise it is stored in ``extra``, with a
        warning.
    """
    with _open(path, columns, partial) as (file, n, chosen, grouping):
        ions = _ions(file, path, grouping, n) if grouping else None
        return _hits(file, path, chosen, grouping, ions, 0, n)


def chunk_apt(
    path: AnyPath, rows: int, *, columns: Sequence[str] | None = None, partial: bool = False
) -> Iterator[Hits]:
    """Read an .apt file in `Hits` of at most `rows` ions in complete pulses; otherwise as `read_apt`.

    The multiplicity of all ions is kept in memory (4 bytes per ion). Without multiplicity, chunks have `rows` ions.

    Yields
    ------
    Hits
    """
    with _open(path, columns, partial, chunks=True) as (file, n, chosen, grouping):
        ions = _ions(file, path, grouping, n) if grouping else None
        if ions is not None and rows < ions.max():
            raise ValueError(
                f"rows must be >= {ions.max()}, the number of ions in the largest pulse of {str(path)!r}, got {rows}"
            )
        start = first_pulse = 0
        while start < n:
            stop = min(start + rows, n)
            part = None
            if ions is not None:
                stop = start + whole_pulses(ions[start:stop])
                part = ions[start:stop].copy()
            pulses = 0 if part is None else np.count_nonzero(part)
            yield _hits(file, path, chosen, grouping, part, start, stop, first_pulse)
            first_pulse += pulses
            start = stop


@contextmanager
def _open(path, columns, partial, chunks=False):
    """Open a file; yield it with the number of ions, the columns to read, and the multiplicity section."""
    with open_for_reading(path) as file:
        n, sections = read_sections(file, path, partial)
        available = _assign(sections, path)
        names = dict.fromkeys(column.target or column.section.name for column in available)
        if "multiplicity" in names:
            names["pulse_id"] = None
        requested = check_columns(columns, tuple(names), path)
        grouping = None
        chosen = []
        for column in available:
            is_grouping = column.target == "multiplicity"
            if is_grouping and (chunks or {"multiplicity", "pulse_id"} & set(requested)):
                pulse_columns = [name for name in ("multiplicity", "pulse_id") if name in requested]
                grouping = _Grouping(column.section, pulse_columns)
            elif not is_grouping and (column.target or column.section.name) in requested:
                chosen.append(column)
        yield file, n, chosen, grouping


@dataclass
class _Grouping:
    """The multiplicity section, and the requested columns that are computed from it."""

    section: object
    columns: list


def _assign(sections, path):
    """Targets of all sections."""
    targets = {}
    named = {section.name.casefold(): section for section in reversed(sections)}
    for target, (values, unit, names) in _COLUMNS.items():
        for name in names:
            if name in named and _fits(named[name], target, values, unit, path):
                targets.setdefault(named[name].name, [(target, None)])
                break
    pair = named.get(_DETECTOR)
    if pair is not None and not {"xdet_mm", "ydet_mm"} & set(named) and _fits(pair, "x", 2, "mm", path):
        targets[pair.name] = [("x", 0), ("y", 1)]
    assigned = []
    for section in sections:
        for target, part in targets.get(section.name, [(None, None)]):
            factor = 1.0 if target is None else _factor(section.unit, _COLUMNS[target][1])
            assigned.append(_Column(section, target, factor, part))
    return assigned


def _fits(section, target, values, unit, path):
    """Whether a section can be a column of Hits; a warning says why not."""
    problem = ""
    if section.values != values:
        problem = f"{section.values} values per ion"
    elif _factor(section.unit, unit) is None:
        problem = f"the unknown unit {section.unit!r}"
    elif section.dtype.kind not in ("iu" if target in _COUNTS else "iuf"):
        problem = f"values of type {section.dtype}"
    if problem:
        warn(
            f"{str(path)!r}: section {section.name!r} has {problem}, so it is stored in extra, not {target}",
            DataWarning,
        )
    return not problem


def _factor(unit, target):
    """Conversion factor between two units; None if it is not known. A missing unit is the target."""
    if target is None or not unit:
        return 1.0
    dimension, power = _UNITS.get(unit.casefold(), (None, 0))
    target_dimension, target_power = _UNITS[target.casefold()]
    return 10.0 ** (power - target_power) if dimension == target_dimension else None


def _ions(file, path, grouping, n):
    """Ions per pulse for the first ion of each pulse and 0 for the others; None, with a warning, if inconsistent."""
    ions, problem = ions_per_pulse(_values(file, path, grouping.section, 0, n))
    if ions is None:
        warn(
            f"{str(path)!r}: pulses unknown, so its Multiplicity is stored in extra: it does not contain the number of "
            f"ions of each pulse, neither for all ions nor for the first ion only ({problem})",
            DataWarning,
        )
    return ions


def _hits(file, path, chosen, grouping, ions, start, stop, first_pulse=0):
    """Make Hits of the ions from start to stop."""
    columns, extra, units = {}, {}, {}
    section = values = None
    for column in chosen:
        if column.section is not section:
            section, values = column.section, _values(file, path, column.section, start, stop)
        if column.target is None:
            extra[section.name], units[section.name] = values, section.unit
            continue
        part = values if column.part is None else values[:, column.part]
        if column.factor != 1:
            with np.errstate(over="ignore"):
                part = part * (part.dtype.type(column.factor) if part.dtype.kind == "f" else column.factor)
        if column.target == "pulses" and part.dtype.kind == "i" and part.min() < 0:
            raise FileError(
                f"{str(path)!r}: section {section.name!r} must be the number of pulses since the last ion, >= 0, got "
                f"{part.min()}; choose other columns by their names"
            )
        columns[column.target] = part
    if grouping and ions is not None:
        pulse_id, multiplicity = pulses_from_first(ions, first_pulse)
        by_name = {"pulse_id": pulse_id, "multiplicity": multiplicity}
        columns.update({name: by_name[name] for name in grouping.columns})
    elif grouping and grouping.columns:
        section = grouping.section
        extra[section.name], units[section.name] = _values(file, path, section, start, stop), section.unit
    return Hits(**columns, extra=extra, units=units, source=str(path))


def _values(file, path, section, start, stop):
    """Read the records of a section from start to stop."""
    shape = (stop - start, section.values) if section.values > 1 else (stop - start,)
    values = np.empty(shape, section.dtype)
    file.seek(section.data + start * section.record_size)
    if fill(file, values.view(np.uint8)) < math.prod(shape) * section.dtype.itemsize:
        size = os.fstat(file.fileno()).st_size
        raise TruncatedFile(f"{str(path)!r} became shorter during reading, it now has {size} bytes")
    return values.astype(section.dtype.newbyteorder("="), copy=False)
