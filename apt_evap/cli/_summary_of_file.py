"""Summary that `apt-evap info` prints, by its options."""

import argparse
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.files import FileError
from apt_evap.cli._files import blocks_of, file_of, read
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.io._texts import without_compression
from apt_evap.io.formats import RANGE_FORMATS, read_ranges
from apt_evap.io.specimens import read_atoms, specimen_format, tip_of, types_of
from apt_evap.simulation.description import UNITS, describe, describe_atoms, describe_blocks
from apt_evap.simulation.run import Run
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.specimen.orientation_check import warn_of_shape
from apt_evap.warnings import SpecimenWarning


def summary_of_file(options: argparse.Namespace) -> dict[str, Any]:
    """Summary of the file of a command, in plain types."""
    return _ranges(options) or _specimen(options) or _content(options)


def _ranges(options):
    """Summary of a file of mass ranges, or None for another file."""
    suffix = without_compression(Path(options.file)).suffix.lower() if options.format is None else options.format
    if suffix not in RANGE_FORMATS:
        return None
    if file_of(options).selects:
        raise FileError(f"{options.file!r} contains ranges of mass: there are no ions to select")
    ranges = read_ranges(options.file, format=options.format)
    spans: dict[str, list[list[float]]] = {}
    for name, low, high in zip(ranges.names, ranges.low.tolist(), ranges.high.tolist(), strict=True):
        spans.setdefault(name, []).append([low, high])
    return {
        "kind": "ranges of mass",
        "ranges": len(ranges.names),
        "mass_to_charge": [float(ranges.low.min()), float(ranges.high.max())],
        "species": {name: [f"{low:g} to {high:g}" for low, high in parts] for name, parts in spans.items()},
    }


def _content(options):
    """Summary of a run, of ions or of a map."""
    if (blocks := blocks_of(options)) is not None:
        return describe_blocks(blocks)
    content, summary, file = read(options), {}, file_of(options)
    if file.selects and not isinstance(content, DetectorMap):
        ions = content.hits(content.first_perturbation) if isinstance(content, Run) else content
        summary["selected_of"], content = len(ions), file.select(ions)
    summary |= describe(content)
    if isinstance(content, Run) and content.ended == StopReason.UNFINISHED:
        summary["kind"] = f"unfinished run of {len(content):,} ions"
        summary["ended"] = "not yet: the same command goes on"
    return summary


def _specimen(options):
    """Summary of a file of a specimen, or None for a file of ions."""
    path = Path(options.file)
    if options.format is not None or not path.is_file():
        return None
    kind = specimen_format(path)
    if kind == "ase" and without_compression(path).suffix.lower() not in _SPECIMENS:
        return None
    obstacles, materials = [], dict(options.types or ())
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", SpecimenWarning)
        try:
            atoms = read_atoms(path)
        except ImportError as error:
            raise FileError(str(error)) from error
        types = types_of(atoms, materials)
        kinds = [name for name, _ in Counter(types).most_common()]
        number = {name: k for k, name in enumerate(kinds)}
        numbers, names = np.array([number[name] for name in types]), [materials.get(name, name) for name in kinds]
        contents = {"format": kind} | describe_atoms(atoms.positions, numbers, names)
        try:
            contents["evaporable"] = int(tip_of(path, atoms, materials).evaporable.sum())
        except FileError as error:
            obstacles = [str(error)]
            warn_of_shape(atoms.positions)
    obstacles += dict.fromkeys(str(doubt.message) for doubt in doubts)
    return contents | {"obstacles_to_a_simulation": obstacles}


def summary_lines(summary: Mapping[str, Any], indent: int = 0, of_columns: bool = False) -> Iterator[str]:
    """Lines of a summary, one for each of its numbers."""
    labels = {
        key: f"{key.replace('_', ' ')} [{UNITS[key]}]" if key in UNITS else key.replace("_", " ") for key in summary
    }
    width = max(map(len, labels.values()), default=0)
    for key, value in summary.items():
        if isinstance(value, dict) and value and key != "law":
            yield f"{'':{indent}}{labels[key]}"
            yield from summary_lines(value, indent + 2, key == "columns")
        else:
            between = " to " if of_columns or key in _EXTENTS else " x " if key in _SIZES else "   "
            text = _law_text(value) if key == "law" else _text(value, between)
            if key == "field_before_leaving":
                text += f" at {summary['voltage']:g} V (only its ratio to the evaporation field matters)"
            yield f"{'':{indent}}{labels[key]:{width}}  {text}"


_SPECIMENS = (".xyz", ".cfg", ".cif", ".vasp")  # of ASE; other formats are recognised by their content
_EXTENTS = (
    "mass_to_charge",
    "extent_x",
    "extent_y",
    "extent_z",
    "field_before_leaving",
    "x",
    "y",
    "values",
    "voltages",
)
_SIZES = ("bins", "bin_size", "detector_extent", "detector_quantum")


def _law_text(law):
    """Name and parameters of a law."""
    parameters = ", ".join(
        f"{name}={_parameter_text(value)}" for name, value in law.items() if name != "name" and value is not None
    )
    return f"{law['name']}({parameters})"


def _parameter_text(value):
    return _law_text(value) if isinstance(value, dict) and "name" in value else _text(value)


def _text(value, between="   "):
    if isinstance(value, list | dict):
        return between.join(_text(item) for item in value) or "none"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
