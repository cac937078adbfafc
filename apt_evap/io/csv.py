"""CSV and text: a table with one row per ion, for spreadsheets and other programs."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, replace_file
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice, check_count
from apt_evap.detection.hits import Hits
from apt_evap.io._records import check_any, check_columns
from apt_evap.io._tables import read_table

_CHUNK = 1 << 14
_UNITS = {
    "x": "mm",
    "y": "mm",
    "time_of_flight": "ns",
    "voltage": "V",
    "pulse_voltage": "V",
    "mass_to_charge": "Da",
    "positions": "nm",
}

SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t"}
"""Dividers of columns by their names."""
_MOST_DECIMALS = 17
_LARGEST = 1 << 30  # bytes of a file, which is read as a whole
_INTEGERS = ("pulses", "multiplicity", "pulse_id", "site", "ion", "outcome")
# names of other programs without units, in lower case, and units with their factors to those of `Hits`
_NAMES = {
    "x": ["detector_x", "det_x", "x_det", "xdet", "detx", "detectorx"],
    "y": ["detector_y", "det_y", "y_det", "ydet", "dety", "detectory"],
    "time_of_flight": ["tof", "t"],
    "voltage": ["v", "vdc", "v_dc", "dc_voltage", "standing_voltage", "high_voltage"],
    "pulse_voltage": ["vp", "v_p", "vpulse", "pulse_v"],
    "mass_to_charge": [
        "m/n",
        "m/z",
        "m/q",
        "m/c",
        "m",
        "m_n",
        "m_z",
        "mc",
        "mass",
        "mass_to_charge_ratio",
        "mass_to_charge_state_ratio",
        "da",
    ],
    "position_x": ["pos_x"],
    "position_y": ["pos_y"],
    "position_z": ["pos_z"],
}
_KNOWN = {name: column for column, names in _NAMES.items() for name in (column, *names)}
_POSITIONS = ("position_x", "position_y", "position_z")
_LENGTHS = {"m": 1e9, "cm": 1e7, "mm": 1e6, "um": 1e3, "nm": 1.0, "a": 0.1, "\u00e5": 0.1, "angstrom": 0.1}  # [nm]
_FACTORS = {
    "mm": {unit: nm * 1e-6 for unit, nm in _LENGTHS.items()},
    "nm": _LENGTHS,
    "ns": {"s": 1e9, "ms": 1e6, "us": 1e3, "\u00b5s": 1e3, "ns": 1.0, "ps": 1e-3},
    "V": {"v": 1.0, "kv": 1e3, "mv": 1e-3},
    "Da": {"da": 1.0, "u": 1.0, "amu": 1.0},
}
_ALL_UNITS = {unit for factors in _FACTORS.values() for unit in factors}


def read_csv(path: AnyPath, *, columns: Sequence[str] | None = None) -> Hits:
    """Read ions from a text table: a .csv of `write`, or one of another program.

    Commas, semicolons, tabs or spaces divide the columns; where commas do not, they are decimal commas. The first line,
    or a comment just before the numbers, names the columns, with units such as "x [mm]", "m/n (Da)" or "tof_ns". With
    x, y and z, these are positions [nm]; x and y alone are detector coordinates [mm]. Four columns without names are x,
    y, z [nm] and m/n [Da]. Other columns become further columns with their names.
    """
    table = read_table(path, "a table of ions", _LARGEST)
    known = {*_KNOWN, *_INTEGERS, "z"}
    in_comment = table.comment and all(_plain(_split(word)[0]) in known for word in table.comment)
    titles = table.names or (table.comment if in_comment else ["x", "y", "z", "m/n"])
    if len(titles) != len(table.rows[0]):
        raise FileError(
            f"{table.path!r} must name its columns in the first line, such as x [mm],y [mm],mass_to_charge [Da]; only "
            f"four columns without names are x, y, z [nm] and m/n [Da], got {len(table.rows[0])} columns"
        )
    split = [_split(title) for title in titles]
    plain = [_plain(name) for name, _ in split]
    spatial = "z" in plain and "position_z" not in plain
    read: dict[str, Any] = {}
    units: dict[str, str] = {}
    for index, (name, unit) in enumerate(split):
        column = _KNOWN.get(plain[index], plain[index] if plain[index] in _INTEGERS else name)
        if spatial and plain[index] in ("x", "y", "z"):
            column = f"position_{plain[index]}"
        if column in read:
            raise FileError(f"{table.path!r} must have different columns, got {column!r} twice")
        read[column] = _values(table, index, column, unit, units)
    if not set(read) & {*_UNITS, *_POSITIONS}:
        raise FileError(f"{table.path!r} has no column of ions such as x, y or m/n, only {', '.join(titles):.200}")
    _group(read, units)
    chosen = check_columns(columns, tuple(read), table.path)
    read = {name: read[name] for name in chosen}
    check_any(read, table.path)
    own = {name: read.pop(name) for name in list(read) if name in _UNITS or name in _INTEGERS}
    return Hits(**own, extra=read, units={name: units[name] for name in read if name in units}, source=table.path)


def _split(title):
    """Name and unit of "x [mm]", "x (nm)", "x", or of a known name such as "XDet_mm"."""
    match = re.fullmatch(r"(.*?)\s*[\[(]([^\])]*)[\])]", title.strip())
    if match is None:
        match = re.fullmatch(r"(.+)[_ ]([^_ ]+)", title.strip())
        if match and not (_plain(match[1]) in {*_KNOWN, "z"} and match[2].casefold() in _ALL_UNITS):
            match = None
    return (match[1].strip() or title.strip(), match[2].strip()) if match else (title.strip(), "")


def _plain(name):
    """The name in lower case, with underscores: blanks and hyphens divide words, too."""
    return re.sub(r"[\s_-]+", "_", name.strip().casefold())


def _values(table, index, column, unit, units):
    """Values of a column in the unit of `Hits`."""
    if not table.is_numeric(index):
        if column in _UNITS or column in _POSITIONS or column in _INTEGERS:
            table.floats(index, f"a number of {column}")
        return table.texts(index)
    values = table.floats(index)
    target = "nm" if column in _POSITIONS else _UNITS.get(column)
    if target is None:
        if unit:
            units[column] = unit
        whole = np.isfinite(values).all() and (values == np.rint(values)).all() and np.abs(values).max() < 2**53
        if column in _INTEGERS and not whole:
            raise FileError(f"{table.path!r}: the column {column} must have integers")
        exact = whole and not any("." in row[index] or "e" in row[index].lower() for row in table.rows)
        return values.astype(np.int64) if exact or column in _INTEGERS else _as_written(values)
    factor = _FACTORS[target].get(unit.casefold(), None) if unit else 1.0
    if factor is None:
        known = ", ".join(_FACTORS[target])
        raise FileError(f"{table.path!r}: the unit of {column} must be one of {known}, got {unit!r:.40}")
    return _as_written(values) if factor == 1.0 else values * factor


def _as_written(values):
    """The float32 values that nine digits were written of, exactly; other values stay."""
    with np.errstate(all="ignore"):
        single = values.astype(np.float32)
        unit = 10.0 ** (np.floor(np.log10(np.abs(values))) - 8)
        digits = values / unit
        # a tie of the rounding differs by half a unit
        nine = (np.abs(digits - np.rint(digits)) < 1e-5) & (np.abs(single - values) <= 0.5 * unit * (1 + 1e-6))
        long = np.abs(digits / 100 - np.rint(digits / 100)) > 1e-6  # more than seven digits
    is_written = ((values == single) | nine | np.isnan(values)).all()
    # of short numbers none can tell: they stay float64 unless they are those of float32 exactly
    return single if is_written and (long.mean() > 0.5 or (values == single)[np.isfinite(values)].all()) else values


def _group(read, units):
    """Join the parts of positions and of columns with several values per ion, such as a_0 and a_1."""
    if all(name in read for name in _POSITIONS):
        read["positions"] = np.column_stack([read.pop(name) for name in _POSITIONS])
    for name in [name.removesuffix("_0") for name in read if name.endswith("_0")]:
        parts = []
        while (part := f"{name}_{len(parts)}") in read:
            parts.append(part)
        if len(parts) > 1 and name not in read:
            if parts[0] in units:
                units[name] = units[parts[0]]
            read[name] = np.column_stack([read.pop(part) for part in parts])


def write_csv(path: AnyPath, hits: Hits, *, decimals: int | None = None, separator: str = "comma") -> None:
    """Write ions as CSV: points in the numbers, UTF-8.

    The first line has the names of the columns with their units, such as "x [mm]". Positions are three columns. All
    ions are written, also those that missed the detector; a value that is not a number is "nan". Numbers have at most
    nine digits for float32 and seventeen for float64, so that reading restores the exact values.

    Parameters
    ----------
    decimals : int, optional
        Digits after the point, 0 to 17; by default as many as restore the exact values.
    separator : {"comma", "semicolon", "tab"}
        What divides the columns.
    """
    divider = SEPARATORS[check_choice(separator, "separator (--separator)", SEPARATORS)]
    if decimals is not None and check_count(decimals, "decimals (--decimals)", at_least=0) > _MOST_DECIMALS:
        raise ValueError(f"decimals (--decimals) must be from 0 to {_MOST_DECIMALS}, got {decimals}")
    titles, formats, columns = [], [], []
    units = {**_UNITS, **hits.units}
    for name, values in (*((name, getattr(hits, name)) for name in hits.columns), *hits.extra.items()):
        parts = [values] if values.ndim == 1 else list(values.T)
        suffixes = (
            [""] if values.ndim == 1 else [f"_{'xyz'[k] if name == 'positions' else k}" for k in range(len(parts))]
        )
        unit = f" [{units[name]}]" if units.get(name) else ""
        label = "position" if name == "positions" else name
        titles += [_quoted(f"{label}{suffix}{unit}") for suffix in suffixes]
        number = "%s"
        if values.dtype.kind == "f":
            exact = "%.17g" if values.dtype.itemsize > 4 else "%.9g"
            number = exact if decimals is None else f"%.{decimals}f"
        formats += [number] * len(parts)
        columns += parts
    row = divider.join(formats) + "\r\n"  # RFC 4180
    with replace_file(path) as file:
        file.write((divider.join(titles) + "\r\n").encode())
        for start in range(0, len(hits), _CHUNK):
            block = [_cells(column[start : start + _CHUNK]) for column in columns]
            file.write("".join([row % values for values in zip(*block, strict=True)]).encode())


def _cells(values):
    cells = values.tolist()
    if values.dtype.kind == "b":
        return [int(cell) for cell in cells]
    return cells if values.dtype.kind in "iuf" else [_quoted(str(cell)) for cell in cells]


def _quoted(text):
    """Text as one cell, with quotes if it has anything that could divide cells or lines."""
    return '"' + text.replace('"', '""') + '"' if any(character in text for character in ',;\t"\r\n') else text
