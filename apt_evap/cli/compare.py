"""`apt-evap compare`: fit the emission energies of a run to a measured map."""

import argparse
import shlex
from pathlib import Path
from typing import Any

from apt_evap.cli._declared_options import add_declared
from apt_evap.cli._options import add_flight, add_reading, integer_type, numbers_type
from apt_evap.cli._output import put

_OF_FIT = (
    "bins",
    "smoothing",
    "flattening",
    "objective",
    "replicas",
    "resamples",
    "seed",
    "temperature",
    "same_radius",
)
"""Fields of `FitSettings` that are options of their own."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Fit the emission energies of a run to a measured map: the score of both maps for a grid of\n"
        "energies, its maximum and errors, and for comparison the scores without energy and with thermal\n"
        "energies. The score is the concordance of maps folded about a pole, or the structural similarity."
    )
    parser.epilog = (
        "writes to FOLDER:\n"
        "  study.json        results and all settings\n"
        "  scores.csv        score, error, fraction of the resamples and misfit of rings for every energy\n"
        "  scores.png        plot of the scores\n"
        "  maps.png          measured, unperturbed and best map side by side, and an enlarged part\n"
        "  registration.png  overlay of the simulated map on the measured one\n"
        "  report.html       all of this in one file, with both maps on one place: send it around\n\n"
        "example: apt-evap compare ni111.h5 R5083.epos -o R5083_study --mechanism roll-up"
    )
    parser.add_argument("run", metavar="RUN.h5", help="a run with responses")
    parser.add_argument("file", metavar="MEASURED", help="measured ions (.epos, ...), a map (.npz), or a run (.h5)")
    parser.add_argument("-o", "--output", metavar="FOLDER", help="default: MEASURED_study in this folder")
    add_declared(parser, "fit.grid", "EnergyGrid", ("mechanism", "means", "relative_spreads", "rollup_fractions"))
    parser.add_argument(
        "--option",
        dest="options",
        action=_Options,
        type=_option,
        metavar="NAME=N,N,...",
        help="one more axis: a parameter of the perturbation and the numbers to try",
    )
    parser.add_argument(
        "--registration",
        metavar="R",
        help="a JSON file (such as study.json) or ROTATION,SCALE,DX,DY[,mirror] in degrees and mm; default: automatic",
    )
    flags = {"smoothing": "--smooth", "flattening": "--flatten"}
    add_declared(parser, "fit.fit_settings", "FitSettings", _OF_FIT, flags)
    parser.add_argument(
        "--plain", dest="allow_noise", action="store_const", const=False, help="SSIM without noise correction"
    )
    parser.add_argument("--threads", type=integer_type(1), metavar="N", help="default: all processors")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, no summary")
    parser.add_argument("--force", action="store_true", help="overwrite files not made by apt-evap")
    reading = add_reading(parser)
    add_flight(reading)
    reading.add_argument("--perturbation", metavar="P", help="perturbation of the ions of MEASURED if it is a run")


class _Options(argparse.Action):
    """Collects pairs of a name and its numbers in a dict."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        name, numbers = values
        setattr(namespace, self.dest, {**(getattr(namespace, self.dest) or {}), name: numbers})


def _option(text: str) -> tuple[str, tuple[float, ...]]:
    """Name of an option and its numbers."""
    name, equals, numbers = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"must be NAME=N,N,..., got {text!r:.80}")
    return name, numbers_type(numbers)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap._common.codec import declared
    from apt_evap._common.recorded_warnings import recorded_warnings
    from apt_evap.cli._files import read_registration
    from apt_evap.fit.fit_settings import FitSettings
    from apt_evap.fit.grid import EnergyGrid
    from apt_evap.workflows.compare_maps import IN_LINES, compare
    from apt_evap.workflows.measured_source import MeasuredSource

    def set_by_options(kind):
        return kind(**{name: value for name in declared(kind) if (value := getattr(options, name, None)) is not None})

    with recorded_warnings(() if options.quiet else IN_LINES):
        compare(
            options.run,
            MeasuredSource(lambda _: _measured(options), Path(options.file), _file(options)),
            options.output or f"{Path(options.file).stem}_study",
            set_by_options(EnergyGrid),
            set_by_options(FitSettings),
            registration=None if options.registration is None else read_registration(options.registration),
            distance=options.distance,
            threads=options.threads,
            overwrite=options.force,
            progress=False if options.quiet else None,
            note=(lambda text: None) if options.quiet else put,
            command=shlex.join(["apt-evap", *options.arguments]),
        )
    return 0


def _file(options):
    """How MEASURED is read, None if it is a run: its composition is known."""
    from apt_evap.cli._files import file_of

    return file_of(options) if options.perturbation is None else None


def _measured(options):
    """Ions or a map of MEASURED; the ions of a run under a perturbation."""
    from apt_evap.cli._files import file_of, note, read
    from apt_evap.detection.detector_map import DetectorMap
    from apt_evap.simulation.config.perturbation_text import read_perturbation
    from apt_evap.simulation.run import Run

    content = read(options)
    if isinstance(content, Run):
        if options.perturbation is None:
            raise ValueError(f"{options.file!r} is a run: its ions need --perturbation")
        return file_of(options).of_run().select(content.hits(read_perturbation(options.perturbation)))
    if options.perturbation is not None:
        raise ValueError(f"--perturbation is only for a run as MEASURED, {options.file!r} contains measured ions")
    if isinstance(content, DetectorMap):
        return content
    return file_of(options).ions_of_map(content, note)
