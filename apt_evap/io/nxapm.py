"""NeXus NXapm: ions in an HDF5 file with the groups and fields of this standard for atom probe data.

Columns for which NXapm has no name are in the group ``entry1/ions`` (NXcollection). See `apt_evap._common.nexus`.
"""

import datetime
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from apt_evap._common.checked_hdf5 import CheckedFile, open_hdf5, put_field, put_text, write_hdf5
from apt_evap._common.files import FileError
from apt_evap._common.nexus import (
    ENTRY,
    HITS,
    IONS,
    MASSES,
    MULTIPLICITY,
    POSITIONS,
    PULSER,
    TIMES,
    put_group,
    put_links,
    put_nxapm,
)
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_kind, check_sequence, short_text
from apt_evap._common.version import __version__
from apt_evap.detection.hits import Hits
from apt_evap.io._records import check_columns
from apt_evap.io._texts import ELEMENTS

KIND = "ions"
_OWN = f"{ENTRY}/ions"
_NAMED = {"time_of_flight": TIMES, "mass_to_charge": MASSES, "multiplicity": MULTIPLICITY, "ion": IONS}
# paths of other programs for columns in the group of this package
_LINKED = {
    "positions": POSITIONS,
    "voltage": f"{PULSER}/standing_voltage",
    "pulse_voltage": f"{PULSER}/pulse_voltage",
    "pulse_id": f"{PULSER}/pulse_number",
}
_UNITS = {"x": "mm", "y": "mm", "voltage": "V", "pulse_voltage": "V", "positions": "nm"}


def write_nxapm(path: AnyPath, hits: Hits, *, elements: Sequence[str], start_time: str | None = None) -> None:
    """Write ions as NXapm.

    All ions and all numeric columns are written, those of `extra`, too. `read` returns the same arrays.

    Parameters
    ----------
    elements : sequence of str
        Chemical symbols of the elements in the specimen, which NXapm requires, such as ``("Si", "O")``.
    start_time : str, optional
        Start of the measurement in ISO 8601 with the offset from UTC, such as "2026-05-04T09:30:00+02:00", which NXapm
        requires. By default the time of writing.
    """
    elements = check_sequence(elements, "elements", "chemical symbols, such as ('Si', 'O')")
    for element in elements or (None,):
        if element not in ELEMENTS:
            raise ValueError(f"elements must be chemical symbols, such as ('Si', 'O'), got {short_text(element)}")
    names = [name for name in hits.columns if name not in _NAMED]
    positions = None
    if hits.x is not None and hits.y is not None and hits.x.dtype == hits.y.dtype:
        positions = np.column_stack([hits.x, hits.y])
        names = [name for name in names if name not in ("x", "y")]
    with write_hdf5(path, KIND, len(hits)) as file:
        put_nxapm(
            file,
            ions=np.arange(len(hits)) if hits.ion is None else hits.ion,
            hits=positions,
            times=hits.time_of_flight,
            masses=hits.mass_to_charge,
            multiplicity=hits.multiplicity,
            elements=elements,
            start_time=_time(start_time),
            version=__version__,
            is_simulation=hits.outcome is not None or hits.site is not None,
        )
        group = put_group(file, _OWN, "NXcollection")
        put_text(group, "columns", json.dumps(hits.columns))
        put_text(group, "source", hits.source or "unknown")
        if hits.extent is not None:
            group.attrs["extent"] = hits.extent
        for name in names:
            put_field(group, name, getattr(hits, name), _UNITS.get(name))
        put_links(file, {place: group[name] for name, place in _LINKED.items() if name in names})
        numeric = {name: values for name, values in hits.extra.items() if values.dtype.kind in "biuf"}
        put_text(group, "extra", json.dumps([[name, hits.units.get(name)] for name in numeric]))
        for index, (name, values) in enumerate(numeric.items()):
            put_field(group, f"extra_{index}", values, hits.units.get(name)).attrs["name"] = name


def _time(text):
    if text is None:
        return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    try:
        time = datetime.datetime.fromisoformat(check_kind(text, "start_time", str, "a time in ISO 8601"))
        if time.tzinfo is None:
            raise ValueError("no offset")
    except ValueError as error:
        raise ValueError(
            f"start_time must be in ISO 8601 with the offset from UTC, such as '2026-05-04T09:30:00+02:00', got "
            f"{short_text(text)}"
        ) from error
    return text


def read_nxapm(path: AnyPath, *, columns: Sequence[str] | None = None) -> Hits:
    """Read the ions of an NXapm file that was written by `write_nxapm`."""
    with open_hdf5(path, "NXapm") as file:
        if file.label is None or file.label.kind != KIND:
            raise FileError(f"{file.name!r} is not an NXapm file of this package: it has no group {_OWN!r}")
        return _read(file, columns)


def _read(file: CheckedFile, columns: Sequence[str] | None) -> Hits:
    extent = file.attribute("extent", _OWN)
    stored = file.json(f"{_OWN}/columns")
    extra, units = {}, {}
    for index, (name, unit) in enumerate(file.json(f"{_OWN}/extra")):
        extra[name] = f"{_OWN}/extra_{index}"
        if unit:
            units[name] = unit
    chosen = check_columns(columns, (*stored, *extra), file.name)
    values: dict[str, Any] = {}
    if HITS in file and {"x", "y"} & set(chosen):
        values = dict(zip(("x", "y"), numbers(file, HITS).T, strict=True))
        values = {name: column for name, column in values.items() if name in chosen}
    for name in stored:
        if name in chosen and name not in values:
            values[name] = numbers(file, _NAMED.get(name, f"{_OWN}/{name}"))
    source = file.text(f"{_OWN}/source")
    return Hits(
        **values,
        extra={name: numbers(file, dataset) for name, dataset in extra.items() if name in chosen},
        units={name: unit for name, unit in units.items() if name in chosen},
        source=file.name if source == "unknown" else source,
        extent=None if extent is None else tuple(float(value) for value in extent),  # type: ignore[arg-type]
    )


def numbers(file: CheckedFile, path: str, *, compressed: bool = False) -> Any:
    """Read a complete dataset of numbers of any type, with one or more values per row, in native byte order."""
    values = file.read(path, None, None, compressed=compressed)
    if values.dtype.kind not in "biuf" or not values.shape:
        raise ValueError(f"{path} must contain numbers, got {values.dtype} of shape {values.shape}")
    return values.astype(values.dtype.newbyteorder("="), copy=False)
