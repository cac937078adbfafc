"""`apt-evap index`: which crystal direction is where on a measured map."""

import argparse
from pathlib import Path

from apt_evap import plot
from apt_evap.cli._files import check_output, ions_of_map, is_picture, picture_path, read, save_figure, with_masses
from apt_evap.cli._options import add_indexing, add_reading, add_speech
from apt_evap.cli._output import tell, tell_json
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.maps.indexing.index_map import Indexing, index
from apt_evap.simulation.run import Run


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Find the orientation of the crystal from a measured map, by a search over all orientations, and\n"
        "draw poles and zone lines over the map. The answer may be that the map does not decide."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap index R5083.epos --element Ni\n"
        "  apt-evap index R5083.epos --element Al --ranges R5083.rrng --species Al --distance 90\n"
        "  apt-evap index R5083.epos --element W --pole 3.5,-8,0,1,1 --line -20,5,18,9 --line 10,-20,4,22"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    add_reading(parser)
    add_indexing(parser)
    parser.add_argument(
        "-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_indexed.png in this folder"
    )
    parser.add_argument("--force", action="store_true", help="overwrite a file not made by apt-evap")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    picture = picture_path(options.output or f"{Path(options.file).stem}_indexed.png")
    check_output(picture, is_picture, options.force)
    found, _ = indexed(options)
    tell(options, f"{found}")
    save_figure(picture, plot.indexing(found)[0].figure)
    tell(options, f"wrote {picture}")
    tell_json(options, {"wrote": str(picture), "file": options.file, **found.to_dict()})
    return 0


def map_of(options: argparse.Namespace) -> tuple[DetectorMap, Hits | None]:
    """The map of a command, and the selected ions if it is made of ions."""
    content = read(options)
    if isinstance(content, Run):
        raise ValueError(f"a measured file is needed, {options.file!r} contains a run, whose orientation is known")
    if isinstance(content, DetectorMap):
        return content, None
    ions = ions_of_map(with_masses(content, options), options)
    return ions.map(bins=128), ions


def indexed(options: argparse.Namespace) -> tuple[Indexing, Hits | None]:
    """Index the map of a command; the answer, and the ions that the map is made of."""
    detector_map, ions = map_of(options)
    found = index(
        detector_map,
        options.element,
        scales=options.scales,
        distance=None if options.scales else options.distance,
        poles=options.pole or (),
        lines=options.line or (),
    )
    return found, ions
