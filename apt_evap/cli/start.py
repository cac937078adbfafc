"""`apt-evap start`: a settings file for a simulation of a measured specimen."""

import argparse
import shlex
from pathlib import Path

from apt_evap.cli._options import add_indexing, add_reading, add_specimen, add_speech
from apt_evap.cli._output import tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Index a measured map, and write a settings file for a simulation of its specimen: axis,\n"
        "rotation, radius, detector and emission, with the origin of every number as a comment."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap start R5083.epos --element Ni --distance 90 -o specimen.toml\n"
        "  apt-evap run specimen.toml"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    parser.add_argument("-o", "--output", metavar="FILE.toml", help="default: the name of FILE with .toml")
    add_reading(parser)
    add_indexing(parser)
    add_specimen(parser)
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap._common.files import FileError, check_path
    from apt_evap._common.threads import thread_count
    from apt_evap.cli._files import lens_of, measured_of
    from apt_evap.cli.index import indexed
    from apt_evap.detection.hits import Hits
    from apt_evap.fit.start_settings import is_start, settings_of
    from apt_evap.io.measured_file import path_word
    from apt_evap.workflows.written_pictures import check_output

    path = check_path(options.output or f"{Path(options.file).stem}.toml")
    check_output(path, is_start, options.force)
    if path.exists() and not options.force:  # its numbers may have been changed
        raise FileError(f"{str(path)!r} exists: --force overwrites it")
    measured = measured_of(options)
    start = settings_of(
        indexed(measured, options),
        measured if isinstance(measured, Hits) else None,
        lens=lens_of(options),
        field_factor=options.field_factor,
        minutes=options.minutes,
        threads=thread_count(options.threads),
    )
    tell(options, f"{start.indexing}")
    start.save(path)
    doubt = "" if start.indexing.decided else " NOT DECIDED, settings of the first candidate:"
    command = f"apt-evap run {shlex.quote(path_word(path))}"
    tell(options, f"wrote {path}:{doubt} {start.cost} of one thread; simulate with {command}")
    tell_json(options, {"wrote": str(path), "file": options.file, **start.to_dict()})
    return 0
