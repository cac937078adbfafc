"""A measurement that is read when it is needed: a file, ions or a map, and what it is made from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from apt_evap._common.files import check_path, sha256_of
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import digest, short_text
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.simulation.read_file import read


@dataclass(frozen=True)
class MeasuredSource:
    """A measurement that is read when it is needed.

    Parameters
    ----------
    read : callable
        Reads it, without arguments: Hits or a DetectorMap.
    path : Path or None
        The file, for reports and names.
    hashes : callable
        SHA-256 of the files that it is made from, by name; called by those who need them.
    options : dict
        How the files are read and which ions are selected, in plain types by name.
    words : tuple of str
        Words of a command line that selects the same ions of the file.
    """

    read: Callable[[], Hits | DetectorMap]
    path: Path | None = None
    hashes: Callable[[], Mapping[str, str | None]] = dict
    options: Mapping[str, Any] = field(default_factory=dict)
    words: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the file, or "measured"."""
        return "measured" if self.path is None else self.path.name


def source_of(measured: MeasuredSource | Hits | DetectorMap | AnyPath) -> MeasuredSource:
    """Source of a measurement: of a path, of ions or of a map.

    Raises
    ------
    FileError
        If a file cannot be read.
    ValueError
        If it is something else.
    """
    if isinstance(measured, MeasuredSource):
        return measured
    if isinstance(measured, Hits | DetectorMap):
        return MeasuredSource(lambda: measured, hashes=lambda: {"FILE": _digest_of(measured)})
    path = check_path(measured)
    return MeasuredSource(partial(_read, path), path, lambda: {"FILE": sha256_of(path)})


def _read(path):
    content = read(path)
    if not isinstance(content, Hits | DetectorMap):
        kind = type(content).__name__
        raise ValueError(f"measured must be ions or a map, {short_text(str(path))} contains a {kind}")
    return content


def _digest_of(measured):
    """Hash of all that a workflow uses of ions or of a map; their source is only a name."""
    if isinstance(measured, DetectorMap):
        names = ("is_counts", "ions", "position_step", "smoothing", "detected")
        arrays = [measured.values, measured.x_edges, measured.y_edges, measured.mask]
    else:
        names = ("columns", "extent", "units")
        arrays = [getattr(measured, name) for name in measured.columns] + [
            measured.extra[name] for name in sorted(measured.extra)
        ]
        names += ("extra",) if measured.extra else ()
    values = [sorted(measured.extra) if name == "extra" else getattr(measured, name) for name in names]
    kinds = [(array.dtype.str, array.shape) for array in arrays]
    return digest(repr((type(measured).__name__, values, kinds)).encode(), *(array.tobytes() for array in arrays))
