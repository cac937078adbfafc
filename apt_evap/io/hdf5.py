"""HDF5 files: a run, ions in NXapm, or a file of PyCCAPT, recognised by their groups."""

from collections.abc import Sequence
from typing import Any

from apt_evap._common.checked_hdf5 import open_hdf5
from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap.io.nxapm import KIND, read_nxapm
from apt_evap.io.pyccapt import is_pyccapt, read_pyccapt


def read_hdf5(path: AnyPath, *, columns: Sequence[str] | None = None) -> Any:
    """Read an HDF5 file of any known kind.

    Parameters
    ----------
    path : str or path-like
        The file.
    columns : sequence of str, optional
        Names of the columns of the ions to read; not for a run. All by default.

    Returns
    -------
    Run or Hits

    Raises
    ------
    FileError
        If the file is missing, damaged, or of another kind.
    """
    name = str(check_path(path))
    with open_hdf5(path) as file:
        kind = file.label.kind if file.label else ""
        known = kind == KIND or is_pyccapt(file)
    if kind == "run":
        from apt_evap.simulation.run import load  # reading ions does not import the simulation

        if columns is not None:
            raise FileError(f"{name!r}: reading a run takes no columns, got {short_text(columns)}")
        return load(path)
    if not known:
        raise FileError(
            f"{name!r} is an HDF5 file of unknown kind, expected a run, ions in NXapm written by this package, or a "
            "file of PyCCAPT"
        )
    return read_nxapm(path, columns=columns) if kind == KIND else read_pyccapt(path, columns=columns)
