"""Point clouds of the commands: ions with positions of a file, or the true sites of a run."""

import argparse
from pathlib import Path
from typing import Any

from apt_evap.cli._options import add_speech


def add_cloud(parser: argparse.ArgumentParser, what: str) -> Any:
    """Add the file, its solute and its ranges; return the group of the method."""
    parser.add_argument("file", metavar="FILE", help="ions with positions (.pos, .epos, ...), or a run: its true sites")
    parser.add_argument("--solute", metavar="NAME[,NAME]", required=True, help="elements, or species of the ranges")
    parser.add_argument("--ranges", metavar="FILE.rrng", help="or .rng, .env: species of measured ions")
    parser.add_argument("--format", metavar="SUFFIX", help="read ions in this format, such as .pos")
    parser.add_argument("-o", "--output", metavar="P.png", help=f"picture; default: FILE_{what}.png in this folder")
    return parser.add_argument_group("method")


def add_end(parser: argparse.ArgumentParser) -> None:
    """Add the last options."""
    parser.add_argument("--force", action="store_true", help="overwrite a file not made by apt-evap")
    add_speech(parser)


def read_cloud(options: argparse.Namespace, what: str) -> tuple[Any, list[str], Path]:
    """Point cloud of the file, its solutes, and the path of the picture."""
    from apt_evap.detection.hits import Hits
    from apt_evap.io.formats import read_ranges
    from apt_evap.measures.point_cloud import PointCloud
    from apt_evap.simulation.read_file import read
    from apt_evap.simulation.run import Run
    from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path

    picture = picture_path(options.output or f"{Path(options.file).stem}_{what}.png")
    check_output(picture, is_picture, options.force)
    content = read(options.file, format=options.format)
    if isinstance(content, Run):
        if options.ranges is not None:
            raise ValueError(f"--ranges is for measured ions, {options.file!r} contains a run")
        return content.sites(), options.solute.split(","), picture
    if not isinstance(content, Hits):
        raise ValueError(f"{what} needs ions with positions, {options.file!r} contains a map")
    if options.ranges is None and "element" not in content.extra:
        raise ValueError(f"--ranges is missing: the species of the ions of {options.file!r} are not known")
    ranges = None if options.ranges is None else read_ranges(options.ranges)
    return PointCloud.of(content, ranges), options.solute.split(","), picture
