"""`apt-evap compare`: fit the emission energies of a run to a measured map."""

import argparse
import csv
import json
import shlex
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap import plot
from apt_evap._common.codec import declared
from apt_evap._common.files import FileError, check_path, read_small_file, replace_file
from apt_evap.cli._files import MAX_STUDY, check_output, ions_of_map, read, read_registration, select
from apt_evap.cli._options import add_reading, integer_type, number_type, numbers_type
from apt_evap.cli._output import put
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.fit.fit_energies import fit_energies
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import MEANS, MECHANISMS, ROLLUP_FRACTIONS, RSDS, EnergyGrid
from apt_evap.fit.study import Study
from apt_evap.plot.report.origin import recorded_warnings
from apt_evap.plot.report.study_report import write_study
from apt_evap.simulation.run import Run, load
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.warnings import RegistrationWarning, StructureWarning

_STUDY = "study.json"
_TABLE = "scores.csv"
OVERLAY, REPORT = "registration.png", "report.html"


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
    parser.add_argument("--mechanism", choices=MECHANISMS, help="default: roll-up")
    for name, default, what in (
        ("means", MEANS, "means of the energy [eV]"),
        ("relative_spreads", RSDS, "standard deviations relative to the means"),
        ("rollup-fractions", ROLLUP_FRACTIONS, "roll-up fractions for the mechanism combined"),
    ):
        numbers = ",".join(f"{value:g}" for value in default)
        parser.add_argument(f"--{name}", type=numbers_type, metavar="N,N,...", help=f"{what}; default: {numbers}")
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
    compare(options)
    return 0


def compare(
    options: argparse.Namespace, measured: Hits | DetectorMap | None = None, sections: Sequence[str] = ()
) -> Study:
    """Compare as the command does; another command may give the measurement, and more sections of the report."""
    # these are a line of the result
    with recorded_warnings(() if options.quiet else (RegistrationWarning, StructureWarning)) as messages:
        return _compare(options, measured, messages, sections)


def _compare(options, measured, messages, sections):
    folder = check_path(options.output or f"{Path(options.file).stem}_study")
    _check_folder(folder, options.force)
    registration = None if options.registration is None else read_registration(options.registration)
    measured = _measured(options) if measured is None else measured
    run = load(options.run)
    run.require_responses(repr(options.run))
    study = fit_energies(
        run,
        measured,
        EnergyGrid(**_given(options, EnergyGrid)),
        FitSettings(**_given(options, FitSettings)),
        registration=registration,
        n_threads=options.threads,
        progress=False if options.quiet else None,
    )
    _write(study, run, folder, options, messages, sections)
    if not options.quiet:
        put("\n".join(study.lines()))
        check = f"; check {OVERLAY}, --registration sets a known registration" if study.registration.doubtful else ""
        put(f"wrote {', '.join(FILES)} to {folder}{check}")
    return study


def _given(options, kind):
    """Fields of a class of settings that the command line gives."""
    return {name: value for name in declared(kind) if (value := getattr(options, name, None)) is not None}


# ---- input ---------------------------------------------------------------------------------------------------------


def _measured(options):
    content = read(options)
    if isinstance(content, Run):
        if options.perturbation is None:
            raise ValueError(f"{options.file!r} is a run: its ions need --perturbation")
        return select(content.hits(read_perturbation(options.perturbation)), options)
    if options.perturbation is not None:
        raise ValueError(f"--perturbation is only for a run as MEASURED, {options.file!r} contains measured ions")
    if isinstance(content, DetectorMap):
        return content
    return ions_of_map(content, options)


# ---- output --------------------------------------------------------------------------------------------------------


def _check_folder(folder, force):
    """Check that the files can be written, and that no files of other programs would be overwritten."""
    if folder.is_dir():
        ours = _is_study(folder / _STUDY)
        for name in FILES:
            check_output(folder / name, lambda path: ours, force)
    else:
        check_output(folder, is_run, False)  # a file of this name, of any kind, is not a folder
        if folder.exists():
            raise FileError(f"cannot write to {str(folder)!r}: it is not a folder")


def _is_study(path):
    try:
        return str(json.loads(read_small_file(path, MAX_STUDY, "a study")).get("made_by", "")).startswith("apt_evap")
    except (ValueError, AttributeError, RecursionError):
        return False


def _write(study, run, folder, options, messages, sections):
    """Write all files to a temporary folder, and move them when they are complete."""
    figures = {name: draw(study, run) for name, draw in _FIGURES.items()}
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
            written = Path(temporary)
            study.save(written / _STUDY)
            _write_table(study, written / _TABLE)
            for name, figure in figures.items():
                figure.savefig(written / name)
            write_study(
                study,
                written / REPORT,
                title=f"{Path(options.file).name}: emission energies from {Path(options.run).name}",
                figures={_CAPTIONS[name]: figure for name, figure in figures.items() if name in _CAPTIONS},
                files=[options.run, options.file],
                command=shlex.join(["apt-evap", *options.arguments]),
                # the report tells a doubtful registration by itself
                warnings=[str(each) for each in messages if not isinstance(each, RegistrationWarning)],
                sections=sections,
            )
            folder.mkdir(exist_ok=True)
            for name in FILES:
                with replace_file(folder / name) as file, open(written / name, "rb") as source:
                    shutil.copyfileobj(source, file)
    except OSError as error:
        raise FileError(f"cannot write to {str(folder)!r}: {error.strerror or error}") from error


def _write_table(study, path):
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        matrices = [study.scores, study.errors, study.shares]
        names = [
            *study.grid.options,
            "rollup_fraction",
            "relative_spread",
            "mean_eV",
            "score",
            "error",
            "share_of_resamples",
        ]
        if study.structure is not None:
            matrices += [study.structure.misfit, study.structure.errors]
            names += ["ring_misfit", "ring_misfit_error"]
        table.writerow(names)
        for cell in study.grid.cells:
            values = (matrix[cell] for matrix in matrices)
            energies = study.grid.values_at(np.array(cell))
            table.writerow([f"{value:.6g}" for value in (*energies, *values)])


def _overlay(study, run):
    return plot.overlay(run.hits(study.optimum.perturbation), study.measured, study.registration).figure


_FIGURES = {
    "scores.png": lambda study, run: plot.score_matrix(study)[0].figure,
    "maps.png": lambda study, run: plot.side_by_side(study)[0].figure,
    OVERLAY: _overlay,
}
_CAPTIONS = {
    "maps.png": "Maps as compared: flattened, smoothed, inside the common region.",
    OVERLAY: "Registration: contours of the simulated map on the measured one, and the simulated map.",
}
FILES = (_STUDY, _TABLE, *_FIGURES, REPORT)
