"""Maps in .npz files: an array of NumPy with its edges."""

import numpy as np

from apt_evap._common.files import FileError, open_for_reading
from apt_evap._common.types import AnyPath
from apt_evap.detection.detector_map import DetectorMap

_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3}


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

    Arrays are found by their names and shapes, or named. Values are the one array of numbers of two dimensions,
    indexed [y, x]; called ``counts`` they are hits per bin, anything else is a density. Edges are called ``x_edges``
    and ``y_edges`` with their unit behind: ``x_edges_mm``, ``_cm``, ``_m`` or ``_um``. The mask, if any, is the one
    array of bool of the shape of the values.

    Parameters
    ----------
    path : str or path-like
        The file.
    values, x_edges, y_edges, mask : str, optional
        Names of the arrays.
    unit : {"mm", "cm", "m", "um"}, optional
        Unit of the edges, where their names do not end in it.

    Returns
    -------
    DetectorMap

    Raises
    ------
    FileError
        If the file is missing, damaged or no .npz, or an array is missing, not the only one, or not as it should be.
    """
    with open_for_reading(path) as file:
        if file.read(2) != b"PK":
            raise FileError(f"{str(path)!r} does not begin as an .npz file does, expected b'PK'")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as held:
                arrays = {name: held[name] for name in held.files}
            if not all(isinstance(array, np.ndarray) for array in arrays.values()):
                raise ValueError("it holds files that are no arrays")
        except Exception as error:  # every way to compress has errors of its own
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise FileError(f"cannot read {str(path)!r} as an .npz file: {reason}") from error
    shown = ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in arrays.items()) or "nothing"

    def chosen(what, name, found):
        if name is not None:
            found = [name] if name in arrays else []
        if len(found) == 1:
            return found[0]
        wanted = f"an array {name!r}" if name is not None else f"one array to be the {what}"
        raise FileError(f"{str(path)!r} must hold {wanted}, it holds {shown}")

    planes = [name for name, array in arrays.items() if array.ndim == 2 and array.dtype.kind in "iuf"]
    values = chosen("values", values, ["counts"] if "counts" in planes else planes)
    plane = arrays[values]
    edges = []
    for axis, name in (("x_edges", x_edges), ("y_edges", y_edges)):
        name = chosen(f"edges in {axis[0]} ({axis}_mm)", name, [each for each in arrays if each.startswith(axis)])
        length = unit if unit is not None else name.rpartition("_")[2]
        if length not in _MM:
            raise FileError(f"{str(path)!r}: the unit of {name} must be one of {', '.join(_MM)}, got {length!r}")
        if arrays[name].dtype.kind not in "iuf":
            raise FileError(f"{str(path)!r}: {name} must hold numbers, got {arrays[name].dtype}")
        edges.append(arrays[name] * _MM[length])
    masks = [name for name, array in arrays.items() if array.shape == plane.shape and array.dtype == bool]
    inside = arrays[chosen("mask", mask, masks)] if mask is not None or masks else None
    is_counts = values == "counts" and plane.dtype.kind in "iu"
    try:
        return DetectorMap.from_array(plane, *edges, inside, is_counts=is_counts, source=str(path))
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error
