"""`apt-evap compare`: fit the emission energies of a run to a measured map."""

import argparse
import shlex
from pathlib import Path
from typing import Any

from apt_evap.cli._options import MAX_BINS, add_reading, integer_type, number_type, numbers_type
from apt_evap.cli._output import put


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
    parser.add_argument("--mechanism", choices=("roll-up", "lateral", "combined"), help="default: roll-up")
    for name, default, what in (
        ("means", "0.01,0.0825,0.155,0.2275,0.3,0.3725", "means of the energy [eV]"),
        ("relative-spreads", "0.01,0.0316,0.1,0.316,1,3.16", "standard deviations relative to the means"),
        ("rollup-fractions", "0,0.25,0.5,0.75,1", "roll-up fractions for the mechanism combined"),
    ):
        parser.add_argument(f"--{name}", type=numbers_type, metavar="N,N,...", help=f"{what}; default: {default}")
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
    parser.add_argument(
        "--objective",
        choices=("similarity", "folded"),
        help="what is compared: the maps place by place (SSIM), or folded about a pole, the default if they show one",
    )
    parser.add_argument("--bins", type=integer_type(11, MAX_BINS), metavar="N", help="bins along the longer side")
    parser.add_argument(
        "--smooth",
        dest="smoothing",
        type=number_type("mm"),
        metavar="MM",
        help="sigma of a Gaussian; default: half a bin, for densities one bin",
    )
    parser.add_argument(
        "--flatten",
        dest="flattening",
        type=number_type("mm"),
        metavar="MM",
        help="sigma of the Gaussian for flattening; 0 for none",
    )
    parser.add_argument("--temperature", type=float, metavar="K", help="temperature of the thermal map; default: 50")
    parser.add_argument(
        "--plain", dest="allow_noise", action="store_const", const=False, help="SSIM without noise correction"
    )
    parser.add_argument("--replicas", type=integer_type(1), metavar="N", help="draws per ion; default: 4 to 16")
    parser.add_argument("--resamples", type=integer_type(0), metavar="N", help="resamples for errors; default: 200")
    parser.add_argument("--seed", type=integer_type(0), metavar="N", help="seed of the resamples; default: 0")
    parser.add_argument(
        "--same-radius",
        action="store_const",
        const=True,
        help="the specimen is known to have the radius of the run, within 5%%: narrower intervals of mean energies",
    )
    parser.add_argument("--threads", type=integer_type(1), metavar="N", help="default: all processors")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, no summary")
    parser.add_argument("--force", action="store_true", help="overwrite files not made by apt-evap")
    reading = add_reading(parser)
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
    from apt_evap.cli._files import read_registration
    from apt_evap.fit.fit_settings import FitSettings
    from apt_evap.fit.grid import EnergyGrid
    from apt_evap.plot.report.origin import recorded_warnings
    from apt_evap.studies.workflows.compare_maps import IN_LINES, compare
    from apt_evap.studies.workflows.measured_source import MeasuredSource

    def set_by_options(kind):
        return kind(**{name: value for name in declared(kind) if (value := getattr(options, name, None)) is not None})

    with recorded_warnings(() if options.quiet else IN_LINES):
        compare(
            options.run,
            MeasuredSource(lambda: _measured(options), Path(options.file)),
            options.output or f"{Path(options.file).stem}_study",
            set_by_options(EnergyGrid),
            set_by_options(FitSettings),
            registration=None if options.registration is None else read_registration(options.registration),
            threads=options.threads,
            overwrite=options.force,
            progress=False if options.quiet else None,
            note=(lambda text: None) if options.quiet else put,
            command=shlex.join(["apt-evap", *options.arguments]),
        )
    return 0


def _measured(options):
    """Ions or a map of MEASURED; the ions of a run under a perturbation."""
    from apt_evap.cli._files import ions_of_map, read, select
    from apt_evap.config.perturbation_text import read_perturbation
    from apt_evap.detection.detector_map import DetectorMap
    from apt_evap.simulation.run import Run

    content = read(options)
    if isinstance(content, Run):
        if options.perturbation is None:
            raise ValueError(f"{options.file!r} is a run: its ions need --perturbation")
        return select(content.hits(read_perturbation(options.perturbation)), options)
    if options.perturbation is not None:
        raise ValueError(f"--perturbation is only for a run as MEASURED, {options.file!r} contains measured ions")
    return content if isinstance(content, DetectorMap) else ions_of_map(content, options)
