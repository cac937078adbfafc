"""Fit of the emission energies of a run to a measured map, with its files in a folder."""

import csv
import json
import shutil
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap import plot
from apt_evap._common.files import FileError, check_path, read_small_file, replace_file
from apt_evap._common.types import AnyPath
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.fit.fit_energies import fit_energies
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import EnergyGrid
from apt_evap.fit.indexed_registration import emission_of_pattern, index_as_run, indexed_start, register_near
from apt_evap.fit.measured_map import measured_map
from apt_evap.fit.study import Study
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.registration.register import Registration
from apt_evap.simulation.run import Run, load
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.warnings import MapWarning, RegistrationWarning, ResponseWarning, StructureWarning, warn
from apt_evap.workflows.measured_source import MeasuredSource, source_of
from apt_evap.workflows.simulate_file import Simulated, no_note
from apt_evap.workflows.written_pictures import check_output

STUDY, TABLE, OVERLAY, REPORT = "study.json", "scores.csv", "registration.png", "report.html"
IN_LINES = (RegistrationWarning, StructureWarning)
"""Warnings that are also in the lines of a study."""
MAX_STUDY = 1 << 28  # bytes: a study contains three numbers for each point of its grid


def compare(
    run: Run | Simulated | AnyPath,
    measured: MeasuredSource | Hits | DetectorMap | AnyPath,
    folder: AnyPath | None = None,
    grid: EnergyGrid | None = None,
    settings: FitSettings | None = None,
    *,
    registration: Registration | None = None,
    distance: float | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: bool | None = None,
    note: Callable[[str], None] = no_note,
    command: str = "",
    sections: Callable[[Study], Sequence[str]] | None = None,
) -> Study:
    """Fit the emission energies of a run to a measured map, as ``apt-evap compare`` does.

    Parameters
    ----------
    run : Run, Simulated, str or path-like
        A run with responses, what `simulate` returned, or the file of a run.
    measured : Hits, DetectorMap, str or path-like
        Measured ions, a map, or the file of one of them.
    folder : str or path-like, optional
        Folder for study.json, scores.csv, pictures and report.html; by default nothing is written.
    grid : EnergyGrid, optional
        Mechanism of emission and energies.
    settings : FitSettings, optional
        Bins, smoothing, draws and resamples.
    registration : Registration, optional
        Carries simulated hits into the measured frame. By default the map is indexed, and if it decides, the run is
        registered where its axis is on the map; otherwise it is searched by `fit_energies`.
    distance : float, optional
        Flight length of the instrument [mm], which bounds the scale of the indexing.
    threads : int, optional
        Number of threads; by default the number of processors that this process may use.
    overwrite : bool
        Whether to replace files of the folder that were not made by this package.
    progress : bool, optional
        Whether to show a progress bar; by default if the output is a terminal or a notebook.
    note : callable
        Receives lines of text: the result, and the files.
    command : str
        Command line to repeat the study, for the report.
    sections : callable, optional
        Returns more parts of the report of a study, as HTML.

    Returns
    -------
    Study

    Raises
    ------
    FileError
        If a file cannot be read or written, or was not made by this package.
    ValueError
        If the run has no responses, or an argument is outside its range.

    Examples
    --------
    >>> from pathlib import Path
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1)), seed=1).run(600)
    >>> measured = run.hits(ae.RollUp(0.2)).map(bins=16, extent=(-60, 60, -60, 60))  # energy to be found
    >>> grid = ae.fit.EnergyGrid("roll-up", means=(0.1, 0.2, 0.3), relative_spreads=(0.5, 1.0))
    >>> identity = ae.Registration(rotation=0.0, scale=1.0, shift=(0.0, 0.0))
    >>> quick = ae.fit.FitSettings(resamples=0)
    >>> study = ae.compare(run, measured, "ni_study", grid, quick, registration=identity, progress=False)
    >>> print(f"{study.optimum.mean} eV"); Path("ni_study/report.html").exists()
    0.2 eV
    True
    """
    from apt_evap._common.recorded_warnings import recorded_warnings

    with recorded_warnings() as messages:
        if folder is not None:
            folder = check_path(folder)
            _check_folder(folder, overwrite)
            done, place = ("replaced", "in") if (folder / STUDY).exists() else ("wrote", "to")
        source = source_of(measured)
        content = source.read(note)
        simulated, path = _run_and_file(run)
        simulated.require_responses("run" if path is None else repr(str(path)))
        if registration is None:
            registration = _indexed_registration(simulated, content, distance, note)
        study = fit_energies(
            simulated, content, grid, settings, registration=registration, n_threads=threads, progress=progress
        )
        if folder is not None:
            _write(
                study,
                simulated,
                folder,
                title=f"{source.name}: emission energies from {'a run' if path is None else path.name}",
                files=[file for file in (path, source.path) if file is not None],
                command=command,
                # the report says by itself that a registration is doubtful; its readers cannot follow an advice
                warnings=[
                    getattr(message, "fact", "") or str(message)
                    for message in messages
                    if not isinstance(message, RegistrationWarning)
                ],
                sections=() if sections is None else sections(study),
                spectrum=_spectrum(source, content, note),
            )
    note("\n".join(study.lines()))
    if folder is not None:
        check = f"; check {OVERLAY}, --registration sets a known registration" if study.registration.doubtful else ""
        note(f"{done} {', '.join(FILES)} {place} {folder}{check}")
    return study


def _spectrum(source, content, note):
    """Spectrum of the measured ions, None without one."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the file: said when it was read first
            return source.spectrum(content)
    except ValueError as error:
        note(f"no composition in the report: {error}")
        return None


def _run_and_file(run: Run | Simulated | AnyPath) -> tuple[Run, Path | None]:
    """A run, and its file if it has one."""
    if isinstance(run, Run):
        return run, None
    if isinstance(run, Simulated):
        return run.run, run.path
    return load(run), check_path(run)


def _indexed_registration(run, measured, distance, note):
    """Registration where the axis of the run is on the measured map; None if the map does not decide."""
    target = measured_map(measured)
    indexing = index_as_run(target, Orientation.known(run.settings["tip"]), distance)
    if indexing is None or not indexing.decided:
        return None
    emission = emission_of_pattern(indexing.best.rolled, run.response_settings.height)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResponseWarning)
            registration = register_near(run.hits(emission), target, indexed_start(run, indexing))
    except ValueError as error:
        warn(f"{error}; so the run is registered by a search", MapWarning)
        return None
    note(f"the map shows {indexing.best}, where the run is registered")
    return registration


def _check_folder(folder: Path, overwrite: bool) -> None:
    """Check that the files can be written, and that no files of other programs would be overwritten."""
    if folder.is_dir():
        ours = _is_study(folder / STUDY)
        for name in FILES:
            check_output(folder / name, lambda path: ours, overwrite)
    else:
        check_output(folder, is_run, False)  # a file of this name, of any kind, is not a folder
        if folder.exists():
            raise FileError(f"cannot write to {str(folder)!r}: it is not a folder")


def _is_study(path):
    try:
        return str(json.loads(read_small_file(path, MAX_STUDY, "a study")).get("made_by", "")).startswith("apt_evap")
    except (ValueError, AttributeError, RecursionError):
        return False


def _write(study: Study, run: Run, folder: Path, **parts: Any) -> None:
    """Write all files to a temporary folder, and move them when they are complete; `parts` are of the report."""
    from apt_evap.plot.report.study_report import write_study

    figures = {name: draw(study, run) for name, draw in _FIGURES.items()}
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
            written = Path(temporary)
            study.save(written / STUDY)
            _write_table(study, written / TABLE)
            for name, figure in figures.items():
                figure.savefig(written / name)
            write_study(study, written / REPORT, **parts)
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
FILES = (STUDY, TABLE, *_FIGURES, REPORT)
"""Names of the files that are written."""
