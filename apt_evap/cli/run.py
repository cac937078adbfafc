"""`apt-evap run`: run the simulation of a TOML file."""

import argparse
from functools import partial

from apt_evap.cli._options import add_speech, integer_type, number_type
from apt_evap.cli._output import INTERRUPTED, tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Run the simulation of a TOML file, save the run and draw its detector maps.\n"
        "Ctrl-C or SIGTERM ends the simulation and saves the ions so far. During the simulation checkpoints are\n"
        "stored in RUN.h5.unfinished. The same command goes on from there, also after a crash, with the same bits\n"
        "as an uninterrupted run; more --ions make a complete run longer. The progress bar shows: charges (RMS\n"
        "residual relative to the mean charge); fractions of the last ions that missed, never left the tip, or are\n"
        "flagged (inexact responses). Without a terminal: one line per minute. Classes of your own that the file\n"
        "names (module:Class) are imported and executed."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap run mine.toml -o ni.h5 --ions 5000\n"
        "  apt-evap run precipitate                 a shipped example: copies precipitate.toml to this folder\n"
        "shipped examples, less than a minute of one processor each: ni111.toml (a pure tip), precipitate.toml,\n"
        "core_shell.toml, gamma_prime.toml, gp_zone.toml, multilayer.toml, multilayer_across.toml, grain_boundary.toml"
    )
    parser.add_argument("config", metavar="CONFIG.toml", help="settings file, or the name of a shipped example")
    parser.add_argument("-o", "--output", metavar="RUN.h5", help="default: output in the file, or its name with .h5")
    parser.add_argument(
        "--ions", type=integer_type(1), metavar="N", help="number of atoms to evaporate; default: ions in the file"
    )
    parser.add_argument("--threads", type=integer_type(1), metavar="N", help="default: all processors")
    parser.add_argument("--seed", type=integer_type(0), metavar="N", help="default: seed in the file")
    parser.add_argument("--map", metavar="MAP.png", help="picture of the maps; default: beside the run")
    parser.add_argument(
        "--resume", action="store_true", help="continue or extend the run, as without it; not with --force"
    )
    parser.add_argument(
        "--checkpoint",
        type=number_type("min"),
        default=10.0,
        metavar="MINUTES",
        help="time between two checkpoints; default: 10",
    )
    add_speech(parser)
    parser.add_argument(
        "--force", action="store_true", help="begin again: overwrite a run, and files not made by apt-evap"
    )


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap.cli._progress import run_progress
    from apt_evap.cli._shipped import settings_file
    from apt_evap.workflows.simulate_file import simulate

    simulated = simulate(
        settings_file(options, options.config),
        options.output,
        ions=options.ions,
        seed=options.seed,
        picture=options.map,
        threads=options.threads,
        resume=options.resume or not options.force,
        overwrite=options.force,
        checkpoint=options.checkpoint,
        own_classes=True,
        progress=run_progress(options.quiet),
        note=partial(tell, options),
    )
    tell_json(options, simulated.to_dict())
    return INTERRUPTED if simulated.interrupted else 0
