"""CSV: a text table with one row per ion, for spreadsheets and other programs."""

from apt_evap._common.files import replace_file
from apt_evap._common.types import AnyPath
from apt_evap.detection.hits import Hits

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


def write_csv(path: AnyPath, hits: Hits) -> None:
    """Write ions as CSV: commas between the columns, points in the numbers, UTF-8.

    The first line has the names of the columns with their units, such as "x [mm]". Positions are three columns. All
    ions are written, also those that missed the detector; a value that is not a number is "nan". Numbers have at most
    nine digits for float32 and seventeen for float64, so that reading restores the exact values.

    Parameters
    ----------
    path : str or path-like
        The file; an existing one is replaced when the new one is complete.
    hits : Hits
        The ions.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
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
        is_float = values.dtype.kind == "f"
        formats += [("%.17g" if values.dtype.itemsize > 4 else "%.9g") if is_float else "%s"] * len(parts)
        columns += parts
    row = ",".join(formats) + "\r\n"  # RFC 4180
    with replace_file(path) as file:
        file.write((",".join(titles) + "\r\n").encode())
        for start in range(0, len(hits), _CHUNK):
            block = [_cells(column[start : start + _CHUNK]) for column in columns]
            file.write("".join([row % values for values in zip(*block, strict=True)]).encode())


def _cells(values):
    cells = values.tolist()
    if values.dtype.kind == "b":
        return [int(cell) for cell in cells]
    return cells if values.dtype.kind in "iuf" else [_quoted(str(cell)) for cell in cells]


def _quoted(text):
    """Text as one cell."""
    return '"' + text.replace('"', '""') + '"' if any(character in text for character in ',"\r\n') else text
