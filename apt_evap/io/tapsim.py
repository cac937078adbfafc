"""Result tables of TAPSim: one row with 26 columns for each evaporated atom, as text or binary.

Oberdorfer, Eich and Schmitz, Ultramicroscopy 128, 55 (2013). Lengths are in m, times in s, fields in V/m. Binary rows
have 102 bytes in the byte order of the machine, here little-endian.
"""

import re
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, TruncatedFile, replace_file
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_switch
from apt_evap.detection.hits import Hits
from apt_evap.io._texts import read_bytes
from apt_evap.warnings import DataWarning, warn

SIGNATURE = b"TAPSIM RESULTS DATA"
_MAX_BYTES = 1 << 36
_HEADER = 1 << 16  # bytes that contain the header
_CHUNK = 1 << 14
_NM_PER_M, _MM_PER_M, _NS_PER_S, _V_PER_NM = 1e9, 1e3, 1e9, 1e-9
_ROW = np.dtype(
    [
        ("index", "<u4"),
        ("id", "<i2"),
        ("number", "<u4"),
        ("voltage", "<f4"),
        ("start", "<f4", 3),
        ("stop", "<f4", 3),
        ("tof", "<f4"),
        ("probability", "<f4"),
        ("potentialBefore", "<f4"),
        ("fieldBefore", "<f4", 3),
        ("potentialAfter", "<f4"),
        ("fieldAfter", "<f4", 3),
        ("normal", "<f4", 3),
        ("apex", "<f4", 3),
    ]
)
_UNITS = {"voltage": "V", "start": "m", "stop": "m", "tof": "s", "normal": "m", "apex": "m"}
_UNITS |= {f"potential{when}": "V" for when in ("Before", "After")}
_UNITS |= {f"field{when}": "V/m" for when in ("Before", "After")}
_NAMES = tuple(_ROW.names or ())
_INTEGERS = ("index", "id", "number")
_TEXT_ROW = np.dtype([(name, _ROW[name].base if name in _INTEGERS else "f8", _ROW[name].shape) for name in _NAMES])
# columns of `extra`: name in the table, factor to the unit here, unit
_EXTRA: dict[str, tuple[str, float, str]] = {
    "id": ("id", 1, ""),
    "stop_z": ("stop", _MM_PER_M, "mm"),
    "probability": ("probability", 1, ""),
    "potential_before": ("potentialBefore", 1, "V"),
    "field_before": ("fieldBefore", _V_PER_NM, "V/nm"),
    "potential_after": ("potentialAfter", 1, "V"),
    "field_after": ("fieldAfter", _V_PER_NM, "V/nm"),
    "normal": ("normal", 1, ""),
    "apex": ("apex", _NM_PER_M, "nm"),
}
WRITTEN = ("x", "y", "time_of_flight", "voltage", "positions", "ion", "site", *_EXTRA)


def read_tapsim(path: AnyPath, *, partial: bool = False) -> Hits:
    """Read a result table of TAPSim.

    Returns
    -------
    Hits
        With voltage [V], time_of_flight [ns], positions [nm] (where the atom started), x, y [mm] (where its trajectory
        ended, NaN if unknown), ion (index of the event) and site (number of the node). ``extra`` contains "id" of the
        type of atom, "stop_z" [mm], "probability", "potential_before" and "potential_after" [V], "field_before" and
        "field_after" [V/nm], "normal" and "apex" [nm]; the vectors have shape (n, 3).
    """
    check_switch(partial, "partial")
    data = read_bytes(path, "a result table of TAPSim", _MAX_BYTES)
    head = data[:_HEADER]
    if not head.startswith(SIGNATURE):
        raise FileError(f"{str(path)!r} does not begin like a result table of TAPSim, expected {SIGNATURE!r}")
    match = re.search(rb"^(ASCII|BINARY)\r?\n", head, re.MULTILINE)
    if match is None:
        raise FileError(f"{str(path)!r} has no line ASCII or BINARY after its header, as in a table of TAPSim")
    data = data[match.end() :]
    if match[1] == b"BINARY":
        rows = _binary(data, path, partial)
    else:
        rows = _text(data, head[: match.end()].count(b"\n"), path, partial)
    if not len(rows):
        raise FileError(f"{str(path)!r} has no rows, expected one for each evaporated atom")
    extra = {}
    for name, (column, factor, _) in _EXTRA.items():
        values = rows[column][:, 2] if name == "stop_z" else rows[column]
        extra[name] = values if factor == 1 else values.astype(float) * factor
    return Hits(
        x=rows["stop"][:, 0].astype(float) * _MM_PER_M,
        y=rows["stop"][:, 1].astype(float) * _MM_PER_M,
        time_of_flight=rows["tof"].astype(float) * _NS_PER_S,
        voltage=rows["voltage"],
        positions=rows["start"].astype(float) * _NM_PER_M,
        ion=rows["index"],
        site=rows["number"],
        extra=extra,
        units={name: unit for name, (_, _, unit) in _EXTRA.items() if unit},
        source=str(path),
    )


def _binary(data, path, partial):
    n, tail = divmod(len(data), _ROW.itemsize)
    if tail and not partial:
        raise _truncated(path, n)
    return np.frombuffer(data, _ROW, n)


def _text(data, n_lines, path, partial):
    """Rows of the text after a header of some lines."""
    lines = data.split(b"\n")
    rows = []
    width = sum(np.prod(_ROW[name].shape, dtype=int) for name in _NAMES)
    numbered = [(at, line) for at, line in enumerate(lines, n_lines + 1) if line.strip() and not line.startswith(b"#")]
    for k, (at, line) in enumerate(numbered):
        cells = line.split()
        is_last = k == len(numbered) - 1
        if is_last and (len(cells) < width or not data.endswith(b"\n")):
            if not partial:
                raise _truncated(path, len(rows))
            break
        try:
            if len(cells) != width or b"_" in line:  # Python takes 1_0 for a number
                raise ValueError(f"{len(cells)} values")
            values = [float(cell) for cell in cells]
            if not all(_fits(value, kind) for value, kind in zip(values, ("u4", "i2", "u4"), strict=False)):
                raise ValueError("no integers")
        except ValueError as error:
            raise FileError(
                f"{str(path)!r}, line {at}: expected {width} numbers as in a table of TAPSim, got {line[:60]!r}"
            ) from error
        rows.append(values)
    table = np.array(rows, float).reshape(-1, width)
    result = np.empty(len(rows), _TEXT_ROW)
    at = 0
    for name in _NAMES:
        size = int(np.prod(_ROW[name].shape, dtype=int))
        result[name] = table[:, at : at + size].reshape(len(rows), *_ROW[name].shape)
        at += size
    return result


def _fits(value, kind):
    bounds = np.iinfo(kind)
    return bounds.min <= value <= bounds.max and value == int(value)


def _truncated(path, n):
    return TruncatedFile(
        f"{str(path)!r} ends in the middle of a row after {n} complete rows; partial=True (--partial) reads the "
        "complete rows"
    )


def write_tapsim(path: AnyPath, hits: Hits, *, binary: bool = False) -> None:
    """Write ions as a result table of TAPSim.

    The columns are those of `read_tapsim`. A number that the ions do not have is "nan", the index their row, the id and
    the number of the node 0. The ions of a run have neither the potentials nor the direction of the field. Text has
    nine digits, TAPSim itself writes seven; binary numbers are float32.
    """
    check_switch(binary, "binary")
    n = len(hits)
    rows = np.zeros(n, _ROW if binary else _TEXT_ROW)
    for name in _NAMES:
        if name not in _INTEGERS:
            rows[name] = np.nan
    rows["index"] = np.arange(n) if hits.ion is None else hits.ion
    columns: dict[str, tuple[Any, float]] = {
        "voltage": (hits.voltage, 1),
        "tof": (hits.time_of_flight, _NS_PER_S),
        "start": (hits.positions, _NM_PER_M),
    }
    columns |= {name: (hits.extra.get(key), factor) for key, (name, factor, _) in _EXTRA.items() if name != "stop"}
    with np.errstate(over="ignore", invalid="ignore"):
        for name, (values, factor) in columns.items():
            if values is not None and np.shape(values) == rows[name].shape:
                rows[name] = values / factor
        for k, values in enumerate((hits.x, hits.y, hits.extra.get("stop_z"))):
            if values is not None:
                rows["stop"][:, k] = values / _MM_PER_M
    if hits.site is not None:
        if hits.site.max(initial=0) > np.iinfo("u4").max:
            warn(f"{str(path)!r}: node numbers beyond 32 bits are written as 0", DataWarning)
        rows["number"] = np.where((hits.site >= 0) & (hits.site <= np.iinfo("u4").max), hits.site, 0)
    with replace_file(path) as file:
        file.write(_header(binary).encode())
        if binary:
            file.write(rows.tobytes())
            return
        row = "\t".join("%d" if name in _INTEGERS else "%.8e" for name, _ in _cells_of_row()) + "\n"
        for start in range(0, n, _CHUNK):
            part = rows[start : start + _CHUNK]
            cells = [part[name] if k is None else part[name][:, k] for name, k in _cells_of_row()]
            file.write("".join([row % values for values in zip(*(c.tolist() for c in cells), strict=True)]).encode())


def _cells_of_row():
    """Name and index of each of the 26 columns."""
    for name in _NAMES:
        yield from [(name, k) for k in range(3)] if _ROW[name].shape else [(name, None)]


def _header(binary):
    lines = [SIGNATURE.decode(), "VERSION 1.0"]
    for name, k in _cells_of_row():
        kind = " (unsigned int)" if name == "number" else " (int)" if name in _INTEGERS else " (float)"
        lines.append(f"# {name}{'' if k is None else 'XYZ'[k]} [{_UNITS.get(name, '1')}]{kind if binary else ''}")
    return "\n".join([*lines, "BINARY" if binary else "ASCII", ""])
