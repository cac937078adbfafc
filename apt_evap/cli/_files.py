"""Files of the commands: reading by the options, and selection of ions."""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apt_evap._common.codec import declared, from_plain
from apt_evap._common.files import FileError, read_small_file
from apt_evap.cli._output import say
from apt_evap.cli._progress import reading_progress
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.simulation.read_file import read as read_file
from apt_evap.simulation.run import Run, load
from apt_evap.specimen.isotopes import ISOTOPES

if TYPE_CHECKING:
    from apt_evap.detection.microscope.local_electrode import LocalElectrode
    from apt_evap.maps.registration.register import Registration
    from apt_evap.workflows.measured_source import MeasuredSource


def file_of(options: argparse.Namespace) -> MeasuredFile:
    """The FILE of a command: how it is read, and which of its ions are used.

    With --element of a crystal these are the ions in its peaks, unless the options select masses or all ions.
    """
    values = {name: value for name in declared(MeasuredFile) if (value := getattr(options, name, None)) is not None}
    file = MeasuredFile(options.file, **values)
    element = getattr(options, "element", None)
    chosen = getattr(options, "all_ions", True) or file.mass is not None or file.species is not None
    if chosen or element is None or file.is_map:
        return file
    from apt_evap.simulation.config.material_text import read_material

    name = read_material(element, "--element").name
    return replace(file, peaks=name) if name in ISOTOPES else file


def read(options: argparse.Namespace) -> Hits | Run | DetectorMap:
    """Read the FILE of a command, and remove its distortion if the options have a calibration grid."""
    return file_of(options).load(_read)


def blocks_of(
    options: argparse.Namespace,
    columns: tuple[str, ...] | None = None,
    *,
    further: tuple[str, ...] = (),
    without: tuple[str, ...] = (),
) -> Any:
    """Blocks of the ions of a large FILE, which is read twice, with progress; None for other files.

    `columns` are needed, `further` ones are read if the file has them; options `without` an effect select no ions.
    """
    if options.file.endswith(".unfinished"):
        return None
    changes: dict[str, Any] = dict.fromkeys(without)
    file = replace(file_of(options), **changes)
    return file.blocks(columns, reading_progress(2, quiet=getattr(options, "quiet", False)), further)


def _read(path, **options):
    if path.endswith(".unfinished"):
        return load(path)
    try:
        return read_file(path, **options)
    except FileError as error:
        unfinished = Path(f"{path}.unfinished")
        if unfinished.exists() and not Path(path).exists():
            raise FileError(f"{error}; an unfinished run is in {str(unfinished)!r}") from error
        raise


def in_real_units(run: Run, options: argparse.Namespace) -> Run:
    """The run, in real units with one of --real-units and --lens; a run that already is keeps its own."""
    lens, reference = lens_of(options), options.real_units
    if lens is None and reference in (None, run.observation.operating.field_reference):
        return run
    return run.at_evaporation_field(lens, **({} if reference is None else {"field_reference": reference}))


def lens_of(options: argparse.Namespace) -> "LocalElectrode | None":
    """The lens of the options."""
    if options.lens is None:
        return None
    from apt_evap.simulation.config.lens_text import read_lens

    return read_lens(options.lens)


def note(text: str) -> None:
    """Print which ions are used."""
    say("note", text)


def read_registration(text: str) -> "Registration":
    """Registration from a file (of a registration or a study), or from numbers."""
    from apt_evap.maps.registration.register import Registration
    from apt_evap.workflows.compare_maps import MAX_STUDY

    parts = text.split(",")
    try:
        mirror = parts[4:] == ["mirror"]
        rotation, scale, *shift = (float(part) for part in (parts[:4] if mirror else parts))
    except ValueError:
        numbers = None
    else:
        numbers = (rotation, scale, tuple(shift), mirror) if len(shift) == 2 else None
    if numbers is not None:
        return Registration(*numbers)
    if Path(text).suffix.lower() != ".json":
        raise ValueError(f"--registration must be a .json file or ROTATION,SCALE,DX,DY[,mirror], got {text!r:.80}")
    written = read_small_file(text, MAX_STUDY, "a registration or a study")
    try:
        content = json.loads(written)
        registration = dict(content.get("registration", content))
        registration.pop("doubtful", None)  # follows from the others
        return from_plain(registration, Registration, what="registration")
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise FileError(f"{text!r} does not contain a registration: {error}") from error


def measured_source(options: argparse.Namespace) -> "MeasuredSource":
    """The measured ions that the options select, or the measured map; read when they are needed."""
    from apt_evap.workflows.measured_source import MeasuredSource

    file = file_of(options)

    def read_measured(path, **reading):
        content = _read(path, **reading)
        if isinstance(content, Run):
            raise ValueError(f"a measured file is needed, {path!r} contains a run, whose orientation is known")
        return content

    return MeasuredSource(lambda _: file.measured(note, read_measured), Path(file.path), file)


def measured_of(options: argparse.Namespace) -> Hits | DetectorMap:
    """The measured ions that the options select, or the measured map."""
    return measured_source(options).read(note)
