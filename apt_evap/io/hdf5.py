"""HDF5 files: ions in NXapm, of this package or of others, or a file of PyCCAPT, recognised by their groups."""

from collections.abc import Sequence

from apt_evap._common.checked_hdf5 import open_hdf5
from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath
from apt_evap.detection.hits import Hits
from apt_evap.io.nxapm import KIND, read_nxapm
from apt_evap.io.nxapm_others import is_nxapm, read_nxapm_of_others
from apt_evap.io.pyccapt import KIND as PYCCAPT
from apt_evap.io.pyccapt import is_pyccapt, read_pyccapt


def read_hdf5(path: AnyPath, *, columns: Sequence[str] | None = None) -> Hits:
    """Read the ions of an HDF5 file."""
    name = str(check_path(path))
    with open_hdf5(path) as file:
        kind = file.label.kind if file.label else ""
        if kind == KIND:
            reader = read_nxapm
        elif kind in ("", PYCCAPT) and is_pyccapt(file):
            reader = read_pyccapt
        elif not kind and is_nxapm(file):
            reader = read_nxapm_of_others
        else:
            what = f"the kind {kind!r}" if kind else "unknown kind"
            raise FileError(f"{name!r} is an HDF5 file of {what}, expected a run, ions in NXapm, or a file of PyCCAPT")
    return reader(path, columns=columns)
