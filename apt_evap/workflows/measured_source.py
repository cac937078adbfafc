"""A measurement that is read when it is needed: a file, ions or a map, and what it is made from."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apt_evap._common.files import check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import digest
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.simulation.read_file import read
from apt_evap.spectra.mass_spectrum import Spectrum, spectrum


@dataclass(frozen=True)
class MeasuredSource:
    """A measurement that is read when it is needed.

    Parameters
    ----------
    read : callable
        Reads it: Hits or a DetectorMap. Takes a function that receives notes.
    path : Path or None
        The file, for reports and names.
    file : MeasuredFile or None
        How the file is read, and which of its ions are used.
    """

    read: Callable[[Callable[[str], None]], Hits | DetectorMap]
    path: Path | None = None
    file: MeasuredFile | None = None

    @property
    def name(self) -> str:
        """Name of the file, or "measured"."""
        return "measured" if self.path is None else self.path.name

    def spectrum(self, content: Hits | DetectorMap) -> Spectrum | None:
        """Spectrum of all ions of the file, or of the ions in memory; None without masses, and of a run."""
        if self.file is not None:
            return self.file.spectrum(read)
        has_masses = self.path is None and isinstance(content, Hits) and content.mass_to_charge is not None
        return spectrum(content) if has_masses else None  # type: ignore[arg-type]

    def made_from(self) -> dict[str, Any]:
        """Record of the file and its options, or of the ions or the map."""
        return {"FILE": _digest_of(self.read(lambda text: None))} if self.file is None else self.file.made_from()


def source_of(measured: MeasuredSource | Hits | DetectorMap | AnyPath, distance: float | None = None) -> MeasuredSource:
    """Source of a measurement: of a path, with its flight length if masses follow from it, of ions or of a map."""
    if isinstance(measured, MeasuredSource):
        return measured
    if isinstance(measured, Hits | DetectorMap):
        return MeasuredSource(lambda note: measured)
    path = check_path(measured)
    file = MeasuredFile(str(path), distance=distance)
    return MeasuredSource(lambda note: file.measured(note, read), path, file)


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
