"""Calibration grids of detectors in .csv files."""

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.detection.distortion import DistortionGrid
from apt_evap.io._tables import read_table
from apt_evap.warnings import DataWarning, warn

_COLUMNS = ("detectorX", "detectorY", "gridX", "gridY")
_MAX_BYTES = 1 << 24  # a crossing takes about 40 bytes


def read_grid(path: AnyPath, *, exchange: bool = False) -> DistortionGrid:
    """Read a calibration grid: a .csv or text file with the columns detectorX, detectorY [mm], gridX and gridY.

    detectorX runs along the x of the hits, and detectorY along their y.

    Parameters
    ----------
    path : str or path-like
        The file. Its first line names the columns, in any order and case; other columns are ignored. Commas,
        semicolons, tabs or spaces divide them.
    exchange : bool
        Exchange detectorX and detectorY, for files of programs whose x is the y of the hits.

    Returns
    -------
    DistortionGrid

    Raises
    ------
    FileError
        If the file is missing or too large, a column is missing, a value is not a number, or the crossings do not
        form a grid.

    Warns
    -----
    DataWarning
        If the grid fits the detector better if it is mirrored.
    """
    table = read_table(path, "a calibration grid", _MAX_BYTES)
    header = [name.lower() for name in table.names]
    missing = [name for name in _COLUMNS if name.lower() not in header]
    if missing:
        columns = ", ".join(header) or "none"
        raise FileError(f"{str(path)!r} must have the columns {', '.join(_COLUMNS)}, it has {columns:.200}")
    values = np.column_stack([table.floats(header.index(name.lower())) for name in _COLUMNS])
    for number, row in zip(table.numbers, values, strict=True):
        if not np.isfinite(row).all():
            raise FileError(f"{str(path)!r}, line {number}: expected four numbers, got {row.tolist()}")
    if exchange:
        values = values[:, [1, 0, 2, 3]]
    try:
        grid = DistortionGrid(values[:, :2], values[:, 2:], str(path))
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error
    if grid.mirrored:
        warn(
            f"{str(path)!r} fits the detector only mirrored: are detectorX and detectorY exchanged "
            "(read_grid(..., exchange=True), or --exchange-axes)?",
            DataWarning,
        )
    return grid
