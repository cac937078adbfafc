"""Maps in .npz files: a NumPy array with its bin edges."""

import math
import zipfile

import numpy as np

from apt_evap._common.files import FileError, open_for_reading
from apt_evap._common.types import AnyPath
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.io._records import MM

_MAX_BYTES = 8 * MAX_BINS**2


def read_map(
    path: AnyPath,
    *,
    values: str | None = None,
    x_edges: str | None = None,
    y_edges: str | None = None,
    mask: str | None = None,
    unit: str | None = None,
) -> "DetectorMap":
    """Read a detector map from an .npz file.

    By default, arrays are identified by name and shape. The values are the only numeric array with two dimensions,
    indexed [y, x]. With the name ``counts`` they are hits per bin, otherwise a density. The bin edges are ``x_edges``
    and ``y_edges`` with their unit: ``x_edges_mm``, ``_cm``, ``_m`` or ``_um``. The mask, if any, is the only bool
    array with the shape of the values.

    Parameters
    ----------
    path : str or path-like
        The file.
    values, x_edges, y_edges, mask : str, optional
        Names of the arrays.
    unit : {"mm", "cm", "m", "um"}, optional
        Unit of the edges, if their names do not end with it.

    Returns
    -------
    DetectorMap

    Raises
    ------
    FileError
        If the file is missing, damaged or not an .npz, or if an array is missing, not unique or invalid.

    Examples
    --------
    >>> edges = np.linspace(-20, 20, 41)
    >>> np.savez("measured.npz", counts=np.ones((40, 40), int), x_edges_mm=edges, y_edges_mm=edges)
    >>> ae.io.read_map("measured.npz")
    <DetectorMap: 1,600 ions from 'measured.npz', 40 x 40 bins of 1 x 1 mm>
    """
    with open_for_reading(path) as file:
        if file.read(2) != b"PK":
            raise FileError(f"{str(path)!r} does not begin like an .npz file, expected b'PK'")
        file.seek(0)
        try:
            _check_sizes(file)
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            if not all(isinstance(array, np.ndarray) for array in arrays.values()):
                raise ValueError("it contains files that are not arrays")
        except Exception as error:  # every compression method has its own errors
            text = (str(error) or type(error).__name__).splitlines()[0]  # may quote bytes of the file
            reason = text if len(text) < 100 and text.isprintable() else "it is damaged"
            raise FileError(f"cannot read {str(path)!r} as an .npz file: {reason}") from error
    contents = ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in arrays.items()) or "no array"

    def choose(what, name, candidates):
        if name is not None:
            candidates = [name] if name in arrays else []
        if len(candidates) == 1:
            return candidates[0]
        expected = f"an array {name!r}" if name is not None else f"exactly one array for the {what}"
        raise FileError(f"{str(path)!r} must contain {expected}, it contains {contents}")

    planes = [name for name, array in arrays.items() if array.ndim == 2 and array.dtype.kind in "iuf"]
    values = choose("values", values, ["counts"] if "counts" in planes else planes)
    plane = arrays[values]
    edges = []
    for axis, name in (("x_edges", x_edges), ("y_edges", y_edges)):
        name = choose(f"edges in {axis[0]} ({axis}_mm)", name, [array for array in arrays if array.startswith(axis)])
        length = unit if unit is not None else name.rpartition("_")[2]
        if length not in MM:
            got = f"got {unit!r}" if unit is not None else f"name it {name}_mm, or give unit=..."
            raise FileError(f"{str(path)!r}: the unit of {name} must be one of {', '.join(MM)}, {got}")
        if arrays[name].dtype.kind not in "iuf":
            raise FileError(f"{str(path)!r}: {name} must contain numbers, got {arrays[name].dtype}")
        edges.append(arrays[name] * MM[length])
    masks = [name for name, array in arrays.items() if array.shape == plane.shape and array.dtype == bool]
    inside = arrays[choose("mask", mask, masks)] if mask is not None or masks else None
    is_counts = values == "counts" and plane.dtype.kind in "iu"
    try:
        return DetectorMap.from_array(plane, *edges, inside, is_counts=is_counts, source=str(path))
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error


def _check_sizes(file):
    """Check from the headers of all arrays that they are stored completely, before memory is taken for them."""
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with zipfile.ZipFile(file) as archive:
        names = archive.namelist()
        if names and not any(name.endswith(".npy") for name in names):
            shown = ", ".join(map(repr, names[:3])) + (", ..." if len(names) > 3 else "")
            raise ValueError(f"it is a .zip archive with {shown}: unpack it")
        for info in archive.infolist():
            with archive.open(info) as member:
                version = np.lib.format.read_magic(member)
                if version not in headers:
                    raise ValueError(f"{info.filename} has a header of version {version[0]}, expected 1 or 2")
                shape, _, dtype = headers[version](member)
            if math.prod(shape) * dtype.itemsize > min(info.file_size, _MAX_BYTES):
                raise ValueError(
                    f"{info.filename} has the shape {shape}, too large for its {info.file_size} bytes or for a map"
                )
