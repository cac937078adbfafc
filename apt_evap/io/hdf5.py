"""HDF5 files: a run, ions in NXapm, or a file of PyCCAPT, recognised by their groups."""

from collections.abc import Sequence
from typing import Any

from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap.io.nxapm import has_ions, read_nxapm
from apt_evap.io.pyccapt import is_pyccapt, read_pyccapt
from apt_evap.simulation.checked_hdf5 import open_checked


def read_hdf5(path: AnyPath, *, columns: Sequence[str] | None = None, partial: bool = False) -> Any:
    """Read an HDF5 file of any known kind.

    Parameters
    ----------
    path : str or path-like
        The file.
    columns : sequence of str, optional
        Names of the columns of the ions to read; not for a run. All by default.
    partial : bool
        Read the undamaged ions of a damaged run.

    Returns
    -------
    Run or Hits

    Raises
    ------
    FileError
        If the file is missing, damaged, or of another kind.
    """
    # imported on demand, so that reading ions does not import the simulation
    from apt_evap.simulation.run import load
    from apt_evap.simulation.run_hdf5 import is_run

    name = str(check_path(path))
    if is_run(path):
        if columns is not None:
            raise FileError(f"{name!r}: reading a run takes no columns, got {short_text(columns)}")
        return load(path, partial=partial)
    with open_checked(path, with_data=False) as file:
        try:
            reader = read_nxapm if has_ions(file) else read_pyccapt if is_pyccapt(file) else None
        except (OSError, RuntimeError, ValueError, KeyError):
            reader = None
    if reader is None:
        raise FileError(
            f"{name!r} is an HDF5 file of unknown kind, expected a run, ions in NXapm written by this package, or a "
            "file of PyCCAPT"
        )
    if partial:
        raise FileError(f"{name!r}: only a run can be read partially")
    return reader(path, columns=columns)
