"""`apt-evap index`: which crystal direction is where on a measured map."""

import argparse
from pathlib import Path
from typing import Any

from apt_evap.cli._options import add_indexing, add_reading, add_speech
from apt_evap.cli._output import tell, tell_json


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
    from apt_evap import plot
    from apt_evap.cli._files import measured_of
    from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path, save_figure

    picture = picture_path(options.output or f"{Path(options.file).stem}_indexed.png")
    check_output(picture, is_picture, options.force)
    indexing = indexed(measured_of(options), options)
    tell(options, f"{indexing}")
    found = indexing.to_dict()
    if indexing.decided and options.distance:
        found["compression"] = options.distance / indexing.best.projection.scale
        tell(
            options,
            f"image compression {found['compression']:.2f}, flight length / scale: --compression of reconstruct",
        )
    written = {}
    if indexing.candidates:  # of a map that can show no orientation there is no picture
        tell(options, save_figure(picture, plot.indexing(indexing)[0].figure))
        written = {"wrote": str(picture)}
    tell_json(options, {**written, "file": options.file, **found})
    return 0


def indexed(measured: Any, options: argparse.Namespace) -> Any:
    """Index measured ions or a map by the options."""
    from apt_evap.maps.indexing.index_map import index
    from apt_evap.simulation.config.material_text import read_material

    return index(
        measured,
        read_material(options.element, "--element"),
        scales=options.scales,
        distance=None if options.scales else options.distance,
        poles=options.pole or (),
        lines=options.line or (),
    )
