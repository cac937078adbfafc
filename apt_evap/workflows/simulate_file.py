"""Simulation of a settings file: the run, its file, and the picture of its maps."""

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError, check_path
from apt_evap._common.notebook import as_table
from apt_evap._common.types import AnyPath
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.simulation.checkpoint import Checkpoint
from apt_evap.simulation.config.cost_estimate import estimate_cost
from apt_evap.simulation.config.simulation_file import config_of, read_document
from apt_evap.simulation.config.simulation_settings import Config
from apt_evap.simulation.description import real_units_line
from apt_evap.simulation.recorder import RunInterrupted
from apt_evap.simulation.run import Run, load
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.simulation.simulation import Simulation
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.warnings import WorkflowWarning, warn
from apt_evap.workflows.maps_of_run import map_summaries, phase_maps, run_maps
from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path, save_picture

_CONTINUE = "--resume continues (resume=True in Python)"


def no_note(text: str) -> None:
    """Ignore a line on the progress."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """What `simulate` has made of a settings file.

    Parameters
    ----------
    run : Run
        The run, as it is saved.
    path : Path
        File of the run.
    picture : Path or None
        Picture of its maps; None if the run was complete already.
    maps : list of DetectorMap
        Maps of the picture.
    titles : list of str
        Titles of the maps.
    seconds : float
        Time of the simulation [s].
    """

    run: Run
    path: Path
    picture: Path | None
    maps: list[DetectorMap]
    titles: list[str]
    seconds: float

    @property
    def interrupted(self) -> bool:
        """Whether the run was interrupted; the ions so far are saved."""
        return self.run.ended == StopReason.INTERRUPTED

    def to_dict(self) -> dict[str, Any]:
        """Return files, maps and numbers of ions in plain types, dict."""
        written = None if self.picture is None else str(self.path)
        picture = None if self.picture is None else str(self.picture)
        counts = self.run.summary() | {"seconds": round(self.seconds, 3), "ended": self.run.ended or "as planned"}
        return {"wrote": written, "picture": picture, "maps": map_summaries(self.maps, self.titles), **counts}

    def __repr__(self) -> str:
        return f"<Simulated: {self.run!r} in {str(self.path)!r}>"

    def _repr_html_(self) -> str | None:
        return as_table(self.run)


def simulate(
    settings: AnyPath,
    output: AnyPath | None = None,
    *,
    ions: int | None = None,
    seed: int | None = None,
    picture: AnyPath | None = None,
    threads: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    checkpoint: float = 10.0,
    seconds: float | Callable[[int], float] | None = None,
    fewest: int = 1,
    own_classes: bool = False,
    progress: Any = None,
    note: Callable[[str], None] = no_note,
) -> Simulated:
    """Run the simulation of a settings file, save the run and draw its maps, as ``apt-evap run`` does.

    Ctrl-C ends the simulation and saves the ions so far. During the simulation they are also stored in a file with
    ".unfinished" appended, from which `resume` continues with the same bits.

    Parameters
    ----------
    settings : str or path-like
        The settings file (TOML, see `read_config`).
    output : str or path-like, optional
        File of the run, .h5; by default ``output`` of the settings, or their name with .h5 in this folder.
    ions : int, optional
        Number of atoms to evaporate, instead of that of the settings.
    seed : int, optional
        Seed of the random numbers, instead of that of the settings.
    picture : str or path-like, optional
        File for the maps, .png, .pdf or .svg; by default the name of the run with .png.
    threads : int, optional
        Number of threads; by default the number of processors that this process may use.
    resume : bool
        Whether to continue an unfinished run, or to extend a run.
    overwrite : bool
        Whether to replace unfinished and other runs, and files that were not made by this package.
    checkpoint : float
        Time between two checkpoints [min].
    seconds : float or callable, optional
        Time from this call after which the events end, with the ions so far [s]; or a function of the number of ions
        so far that returns it.
    fewest : int
        Ions before which this time does not end the events.
    own_classes : bool
        Whether modules with classes of one's own are imported, which executes them; as for `read_config`.
    progress : bool or callable, optional
        As for `Simulation.run`. A callable is also called at the beginning. One that is a context manager is entered
        for the time of the events.
    note : callable
        Receives lines of text on what is done.

    Returns
    -------
    Simulated
        With the ``run``.

    Raises
    ------
    FileError
        If the settings are wrong, or a file cannot be written or was not made by this package.
    ValueError
        If an argument is outside its range, or the maps cannot be drawn; the run is saved then.

    Warns
    -----
    WorkflowWarning
        If the run ends early, most of its ions miss the detector, or a table of the settings is not used.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("tiny.toml").write_text('''
    ... [tip]
    ... material = "Ni"
    ... apex_radius = "5 a"
    ... [simulation]
    ... ions = 100
    ... ''')
    >>> done = ae.simulate("tiny.toml", progress=False)
    >>> len(done.run), done.path.name, done.picture.name
    (100, 'tiny.h5', 'tiny.png')
    """
    called = time.monotonic()
    config = _config(check_path(settings), own_classes, ions=ions, seed=seed)
    path = check_path(output or config.output or f"{config.path.stem}.h5")
    if path.suffix.lower() != ".h5":
        raise FileError(f"a run is saved in an HDF5 file with the suffix .h5, got {str(path)!r}")
    picture = picture_path(picture or path.with_suffix(".png"))
    # before the long computation
    check_output(path, is_run, overwrite)
    check_output(picture, is_picture, overwrite)

    n_ions = config.n_ions
    cost = estimate_cost(config, 1)
    stored = Checkpoint(path, checkpoint, resume=resume, overwrite=overwrite)
    n_previous = stored.ions_there() if resume else 0
    complete = n_previous == n_ions and not stored.unfinished.exists() and not (run := load(path)).ended
    if complete and run.provenance.get("settings") == config.key:
        if picture.exists():
            note(f"{path} is complete: nothing to do, overwrite=True (--force) begins again")
            return Simulated(run, path, None, [], [], 0.0)
        note(f"{path} is complete")
        return _drawn(run, path, picture, config, 0.0, note)
    if seconds is not None:
        note(f"at most {n_ions:,} ions, as many as the time allows")
    elif n_previous != n_ions:
        note(f"{cost}" if cost.hours is None else f"{cost} of one thread")
    note("building the specimen and relaxing the charges of its surface")
    simulation = config.simulation(n_threads=threads)
    note(f"{str(simulation.tip).strip('<>')}; {len(simulation.emitter):,} atoms on the surface")
    began, replaced = time.perf_counter(), path.exists()
    if 0 < n_previous < n_ions:
        note(f"resumed at {n_previous:,} of {n_ions:,} ions")
    left = None if seconds is None else _less(seconds, time.monotonic() - called)
    run = _evaporated(config, simulation, stored, n_previous, progress, {"seconds": left, "fewest": fewest})
    seconds = time.perf_counter() - began
    run = config.as_saved(run)
    run.save(path)
    new = "" if not n_previous else f", {len(run) - n_previous:,} of them new,"
    note(f"{len(run):,} ions{new} in {seconds:.1f} s, {(len(run) - n_previous) / seconds:,.0f} ions/s")
    _note_outcomes(config, run, path, note)
    if line := real_units_line(run):
        note(line)
    note(f"{'replaced' if replaced and not resume else 'wrote'} {path}")
    return _drawn(run, path, picture, config, seconds, note)


def _less(seconds, spent):
    """The time that is left for the events, or a function that gives it."""
    if callable(seconds):
        return lambda ions: seconds(ions) - spent
    return max(seconds - spent, 0.0)


def _drawn(run, path, picture, config, seconds, note):
    """Draw the maps of a saved run."""
    from apt_evap.plot.map_figures import specimen_title  # with Matplotlib

    try:
        maps, titles = run_maps(run, config.maps)
        phases = phase_maps(run, maps, config.maps)
        done = save_picture(picture, maps, titles, title=specimen_title(run), phases=phases)
    except ValueError as error:
        raise ValueError(f"no maps are drawn, the run is in {str(path)!r}: {error}") from error
    note(done)
    return Simulated(run, path, picture, maps, titles, seconds)


def _config(settings: Path, own_classes: bool, **changes: int | None) -> Config:
    """Settings of a file, with changed values of the table [simulation] unless they are None."""
    document = read_document(settings)
    if isinstance(table := document.get("simulation", {}), dict):  # config_of refuses anything else
        document["simulation"] = table | {name: value for name, value in changes.items() if value is not None}
    config = config_of(document, settings, own_classes=own_classes)
    if "responses" in document and not config.responses:
        warn("the table [responses] is not used: [simulation] has responses = false", WorkflowWarning)
    return config


def _evaporated(
    config: Config,
    simulation: Simulation,
    stored: Checkpoint,
    n_previous: int,
    progress: Any,
    limit: Mapping[str, Any],
) -> Run:
    """The run of a simulation; after an interrupt or an error a warning names the file of its ions."""
    n_ions = config.n_ions
    is_entered = isinstance(progress, contextlib.AbstractContextManager)
    try:
        with progress if is_entered else contextlib.nullcontext(progress) as shown:
            if callable(shown):
                shown(n_previous, n_ions)
            return simulation.run(
                n_ions,
                config.emissions,
                responses=config.responses,
                progress=shown,
                checkpoint=stored,
                **limit,
            )
    except KeyboardInterrupt:
        if ions := stored.ions_there():
            path = stored.unfinished if stored.unfinished.exists() else stored.path
            warn(f"{ions:,} of {n_ions:,} ions are in {str(path)!r}", WorkflowWarning, _CONTINUE)
        raise
    except RunInterrupted as error:
        config.with_origin(error.run).save(stored.path)
        warn(f"the {len(error.run):,} ions so far are in {str(stored.path)!r}", WorkflowWarning)
        raise


def _note_outcomes(config: Config, run: Run, path: Path, note: Callable[[str], None]) -> None:
    """Give the numbers of hits as lines, and problems as warnings."""
    frequent_misses = []
    for panel in config.maps.panels:
        hit, missed, never_left, outside = run.hits(panel.perturbation).counts.values()
        frequent_misses += [missed] if 2 * missed > len(run) else []
        view = f", {outside:,} are outside the field of view" if outside else ""
        note(f"{panel.title}: {hit:,} hit the detector, {missed:,} missed it, {never_left:,} never left the tip{view}")
    if run.responses is not None:
        not_flown = int(run.not_flown.sum())
        view = f", {not_flown:,} ions not flown" if not_flown else ""
        note(f"responses: {run.flagged.sum():,} ions flagged as inexact{view}")
    if frequent_misses:
        warn(
            f"{max(frequent_misses):,} of {len(run):,} ions miss the detector, which is {run.detector.width:g} mm "
            f"wide at {run.detector.distance:g} mm",
            WorkflowWarning,
            "use a larger width or a smaller distance in [detector]",
        )
    if run.ended == StopReason.INTERRUPTED:
        text = f"interrupted; {len(run):,} of {config.n_ions:,} ions are in {str(path)!r}"
        warn(text, WorkflowWarning, _CONTINUE)
    elif run.ended and run.ended != StopReason.TIME_OVER:
        warn(f"the run ended early: {run.ended}; its {len(run):,} ions are saved", WorkflowWarning)
