"""`apt-evap paper`: figures 2 to 7 of Shaikh et al. (2025), of twins or of a measured map."""

import argparse
import shlex
from typing import Any

from apt_evap.cli._options import add_indexing, add_reading, add_specimen, integer_type
from apt_evap.cli._output import put


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Make figures 2 to 7 of Shaikh et al. (2025), arXiv 2509.13744, with captions that say what agrees with\n"
        "the paper. Simulated twins take the place of its experiments, which are not public. With --measured, figures\n"
        "3 to 6 are those of a measured map, which is indexed, simulated and registered first. The runs are made once\n"
        "and kept in FOLDER: the same command continues after an interruption, and adds figures."
    )
    parser.epilog = (
        "writes to FOLDER:\n"
        "  figure2.png, .txt, .json ...   figures, captions, numbers\n"
        "  figures.html                   all of them in one file\n"
        "  runs/, or twin/                simulations, as of apt-evap run, or of apt-evap twin for a measured map\n\n"
        "example:\n"
        "  apt-evap paper                 all figures, R = 20 a\n"
        "  apt-evap paper --figure 7 -o lines\n"
        "  apt-evap paper --measured R5083.epos --element Ni --distance 90 -o R5083_paper"
    )
    parser.add_argument(
        "--figure", type=integer_type(0), action="append", metavar="N", help="2 to 7; repeat it; default: all"
    )
    parser.add_argument("--full", action="store_true", help="R = 80 a and 120 a, as in the paper: many hours")
    parser.add_argument("-o", "--output", metavar="FOLDER", default="paper", help="default: paper")
    parser.add_argument("--measured", dest="file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    add_reading(parser)
    add_indexing(parser, required=False)
    add_specimen(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command; finished runs are not repeated."""
    from apt_evap.cli._files import measured_source
    from apt_evap.cli._progress import run_progress
    from apt_evap.simulation.config.material_text import read_material
    from apt_evap.workflows.figures_of_paper import paper

    if (options.file is None) != (options.element is None):
        raise ValueError("--measured FILE and --element E belong together: the map, and its crystal")
    command = shlex.join(["apt-evap", *options.arguments])
    made: dict[str, Any] = {} if options.file is None else {
        "measured": measured_source(options),
        "element": read_material(options.element, "--element"),
        "twin_options": {
            "minutes": options.minutes,
            "lens": options.lens,
            "field_factor": options.field_factor,
            "distance": options.distance,
            "scales": options.scales,
            "poles": options.pole or (),
            "lines": options.line or (),
            "ranges": options.ranges,
        },
    }  # fmt: skip
    paper(
        options.output,
        options.figure,
        full=options.full,
        threads=options.threads,
        progress=lambda: run_progress(quiet=False),
        note=put,
        command=command,
        **made,
    )
    return 0
