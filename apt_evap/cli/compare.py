"""`apt-evap compare`: find the emission energies that make a run look most like a measured map."""

import argparse
import csv
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap import plot
from apt_evap._common.files import FileError, check_path, open_for_reading
from apt_evap.cli._files import check_output, read, select
from apt_evap.cli._options import SHAPE, add_reading_options, smoothing, whole
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.energy_fit.fit_energies import fit_energies
from apt_evap.energy_fit.grid import MEANS, MECHANISMS, ROLLUP_FRACTIONS, RSDS
from apt_evap.registration.register import Registration
from apt_evap.simulation.run import Run, load
from apt_evap.simulation.run_hdf5 import is_run

_STUDY = "study.json"


def add_parser(commands: Any) -> None:
    """Describe the command."""
    command = commands.add_parser(
        "compare",
        help="find the emission energies that make a run look most like a measured map",
        description="Find the emission energies that make a run look most like a measured map: the structural\n"
        "similarity for a grid of energies, its maximum, its errors, and what no energy and thermal energies give.",
        epilog="writes to FOLDER:\n"
        "  study.json        results and every setting\n"
        "  ssim.csv          similarity, error and share of the resamples for every energy\n"
        "  ssim.png          the same as a picture\n"
        "  maps.png          measured, unperturbed and best map side by side, and a part of them magnified\n"
        "  registration.png  the simulated map laid over the measured one\n\n"
        "example: apt-evap compare ni111.h5 R5083.epos -o R5083_study --mechanism roll-up",
        **SHAPE,
    )
    command.add_argument("run", metavar="RUN.h5", help="a run with responses")
    command.add_argument("file", metavar="MEASURED", help="measured ions (.epos, ...), a map (.npz), or a run (.h5)")
    command.add_argument("-o", "--output", metavar="FOLDER", help="default: MEASURED_study, here")
    command.add_argument("--mechanism", choices=MECHANISMS, default="roll-up", help="default: roll-up")
    for name, default, what in (
        ("means", MEANS, "of the energy [eV]"),
        ("rsds", RSDS, "standard deviations over the means"),
        ("rollup-fractions", ROLLUP_FRACTIONS, "for combined"),
    ):
        shown = ",".join(f"{value:g}" for value in default)
        command.add_argument(f"--{name}", type=_numbers, metavar="N,N,...", help=f"{what}; default: {shown}")
    command.add_argument(
        "--registration",
        metavar="R",
        help="a JSON file (such as study.json) or ROTATION,SCALE,DX,DY[,mirror] in degrees and mm; found by default",
    )
    command.add_argument("--bins", type=whole(11, MAX_BINS), metavar="N", help="along the longer side")
    command.add_argument(
        "--smooth", type=smoothing, metavar="MM", help="sigma of a Gaussian; default: half a bin, of densities one"
    )
    command.add_argument("--flatten", type=smoothing, metavar="MM", help="sigma of a broad Gaussian; 0 for not")
    command.add_argument("--temperature", type=float, default=50.0, metavar="K", help="of the thermal map; default: 50")
    command.add_argument("--plain", action="store_true", help="SSIM as it is, without allowance for noise")
    command.add_argument("--replicas", type=whole(1), metavar="N", help="draws of every ion; default: 4 to 16")
    command.add_argument("--resamples", type=whole(0), default=200, metavar="N", help="for the errors; default: 200")
    command.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of the resamples; default: 0")
    command.add_argument("--threads", type=whole(1), metavar="N", help="default: all processors")
    command.add_argument("--quiet", action="store_true", help="no progress bar, no summary")
    command.add_argument("--force", action="store_true", help="overwrite files that apt-evap did not make")
    reading = add_reading_options(command)
    reading.add_argument("--perturbation", metavar="P", help="of the ions of MEASURED where it is a run")
    command.set_defaults(command=_compare)


def _compare(options):
    folder = check_path(options.output or f"{Path(options.file).stem}_study")
    _check_folder(folder, options.force)
    registration = None if options.registration is None else _registration(options.registration)
    measured = _measured(options)
    run = load(options.run)
    if run.responses is None:
        raise ValueError(f"{options.run!r} has no responses: run again with responses = true in [simulation]")
    study = fit_energies(
        run,
        measured,
        options.mechanism,
        registration=registration,
        bins=options.bins,
        smoothing=options.smooth,
        flattening=options.flatten,
        temperature=options.temperature,
        allow_noise=not options.plain,
        replicas=options.replicas,
        resamples=options.resamples,
        seed=options.seed,
        n_threads=options.threads,
        progress=False if options.quiet else None,
        **{name: getattr(options, name) for name in ("means", "rsds", "rollup_fractions") if getattr(options, name)},
    )
    _write(study, run, folder)
    if not options.quiet:
        print(repr(study).strip("<>"))
        print(f"wrote {', '.join(FILES)} to {folder}")
    return 0


# ---- what comes in -------------------------------------------------------------------------------------------------


def _numbers(text):
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers with commas between, got {text!r}") from None


def _registration(text):
    """A registration from a file, its own or that of a study, or from numbers."""
    parts = text.split(",")
    try:
        mirror = parts[4:] == ["mirror"]
        rotation, scale, *shift = (float(part) for part in (parts[:4] if mirror else parts))
    except ValueError:
        numbers = None
    else:
        numbers = (rotation, scale, tuple(shift), mirror) if len(shift) == 2 else None
    if numbers is not None:
        return Registration(*numbers)
    if Path(text).suffix.lower() != ".json":
        raise ValueError(f"--registration must be a .json file or ROTATION,SCALE,DX,DY[,mirror], got {text!r}")
    with open_for_reading(text) as file:
        try:
            held = json.loads(file.read())
            return Registration.from_dict(dict(held.get("registration", held)))
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            raise FileError(f"{text!r} does not hold a registration: {error}") from error


def _measured(options):
    held = read(options)
    if isinstance(held, Run):
        if options.perturbation is None:
            raise ValueError(f"{options.file!r} is a run: say by --perturbation how its ions start")
        return select(held.hits(read_perturbation(options.perturbation)), options)
    if options.perturbation is not None:
        raise ValueError(f"--perturbation is for a run as MEASURED, {options.file!r} holds measured ions")
    if isinstance(held, DetectorMap):
        return held
    if held.x is None or held.y is None:
        raise ValueError(
            f"{options.file!r} has no detector coordinates x and y, which a map needs, only {', '.join(held.columns)}"
        )
    return select(held, options)


# ---- what goes out -------------------------------------------------------------------------------------------------


def _check_folder(folder, force):
    """Make sure that the files can be written, and that nobody else's are overwritten."""
    if folder.is_dir():
        ours = _is_study(folder / _STUDY)
        for name in FILES:
            check_output(folder / name, lambda path: ours, force)
    else:
        check_output(folder, is_run, False)  # a file of that name, of whatever kind, is no folder
        if folder.exists():
            raise FileError(f"cannot write to {str(folder)!r}: it is not a folder")


def _is_study(path):
    try:
        return str(json.loads(path.read_bytes()).get("made_by", "")).startswith("apt_evap")
    except (OSError, ValueError, AttributeError):
        return False


def _write(study, run, folder):
    """Write all files aside, and put them into the folder once they are complete."""
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as aside:
            for name, write in FILES.items():
                write(study, run, Path(aside) / name)
            folder.mkdir(exist_ok=True)
            for name in FILES:
                os.replace(Path(aside) / name, folder / name)
    except OSError as error:
        raise FileError(f"cannot write to {str(folder)!r}: {error.strerror or error}") from error


def _write_table(study, run, path):
    with open(path, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["rollup_fraction", "rsd", "mean_eV", "ssim", "error", "share_of_resamples"])
        for cell in study.grid.cells:
            values = (matrix[cell] for matrix in (study.ssim, study.errors, study.shares))
            energies = study.grid.values_at(np.array(cell))
            table.writerow([f"{value:.6g}" for value in (*energies, *values)])


def _write_overlay(study, run, path):
    ax = plot.overlay(run.hits(study.optimum.perturbation), study.measured, study.registration)
    ax.figure.savefig(path)


FILES = {
    _STUDY: lambda study, run, path: study.save(path),
    "ssim.csv": _write_table,
    "ssim.png": lambda study, run, path: plot.ssim_matrix(study)[0].figure.savefig(path),
    "maps.png": lambda study, run, path: plot.side_by_side(study)[0].figure.savefig(path),
    "registration.png": _write_overlay,
}
