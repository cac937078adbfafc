"""`apt-evap twin`: from a measured file to a simulation of its specimen, a fit and a report."""

import argparse
import shlex

from apt_evap.cli._options import add_indexing, add_reading, add_specimen, number_type
from apt_evap.cli._output import put


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Index a measured map, simulate its specimen, register the simulated map on the measured one, fit\n"
        "the emission, and write a report. The same command continues after an interruption. A folder belongs\n"
        "to one FILE and one set of options: others are refused."
    )
    parser.epilog = (
        "writes to FOLDER:\n"
        "  specimen.toml, start.json   settings of the simulation, and the indexing\n"
        "  run.h5, run.png             the simulation\n"
        "  registration.json, study/   as of apt-evap compare; study/report.html has it all\n"
        "  answer.txt                  constants of the measurement, what they depend on, and checks\n"
        "  twin.json                   SHA-256 of these files and of FILE, and the options\n\n"
        "example:\n"
        "  apt-evap twin R5083.epos --element Ni --distance 90 --minutes 10\n"
        "  apt-evap twin map.npz --element Ni --pole=-9.6,-0.4,1,1,1 --pole 2.4,6.2,1,1,3 --pole=-7.5,-13.5,1,3,1"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    parser.add_argument("-o", "--output", metavar="FOLDER", help="default: FILE_twin in this folder")
    add_reading(parser)
    add_indexing(parser)
    add_specimen(parser).add_argument(
        "--efficiency",
        type=number_type("1"),
        default=0.5,
        metavar="ETA",
        help="part of the evaporated atoms that are among the selected ions, for the angle of the shank; default: 0.5",
    )


def execute(options: argparse.Namespace) -> int:
    """Run the command; finished steps are not repeated."""
    from apt_evap.cli._files import measured_source
    from apt_evap.cli._progress import run_progress
    from apt_evap.simulation.config.material_text import read_material
    from apt_evap.workflows.twin_of_map import twin

    twin(
        measured_source(options),
        read_material(options.element, "--element"),
        minutes=options.minutes,
        folder=options.output,
        lens=options.lens,
        field_factor=options.field_factor,
        distance=options.distance,
        efficiency=options.efficiency,
        scales=options.scales,
        poles=options.pole or (),
        lines=options.line or (),
        ranges=options.ranges,
        threads=options.threads,
        progress=run_progress(quiet=False),
        note=put,
        command=shlex.join(["apt-evap", *options.arguments]),
    )
    return 0
