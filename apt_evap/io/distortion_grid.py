"""Calibration grids of detectors in .csv files."""

import csv
import io

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.detection.distortion import DistortionGrid
from apt_evap.io._texts import read_text

_COLUMNS = ("detectorX", "detectorY", "gridX", "gridY")
_MAX_BYTES = 1 << 24  # a crossing takes about 40 bytes


def read_grid(path: AnyPath) -> DistortionGrid:
    """Read a calibration grid: a .csv file with the columns detectorX, detectorY [mm], gridX and gridY.

    Parameters
    ----------
    path : str or path-like
        The file. Its first line names the columns, in any order and case; other columns are ignored.

    Returns
    -------
    DistortionGrid

    Raises
    ------
    FileError
        If the file is missing or too large, a column is missing, a value is not a number, or the crossings do not
        form a grid.
    """
    text = read_text(path, "a calibration grid", _MAX_BYTES)
    try:
        rows = [row for row in csv.reader(io.StringIO(text, newline="")) if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise FileError(f"{str(path)!r} is not a calibration grid: {error}") from error
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    missing = [name for name in _COLUMNS if name.lower() not in header]
    if missing:
        columns = ", ".join(header) or "none"
        raise FileError(f"{str(path)!r} must have the columns {', '.join(_COLUMNS)}, it has {columns}")
    columns = [header.index(name.lower()) for name in _COLUMNS]
    values = np.empty((len(rows) - 1, 4))
    for number, row in enumerate(rows[1:]):
        try:
            values[number] = [float(row[column]) for column in columns]
        except (ValueError, IndexError):
            raise FileError(f"{str(path)!r}: row {number + 2} must have numbers, got {','.join(row)[:80]!r}") from None
    try:
        return DistortionGrid(values[:, :2], values[:, 2:], str(path))
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error
