"""Twin of a measured specimen: its map is indexed, simulated, registered and fitted, with a report."""

import json
import os
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError, check_path
from apt_evap._common.notebook import as_table
from apt_evap._common.threads import thread_count
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_kind
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.detection.projection import Projection
from apt_evap.fit.fit_energies import seconds_of_fit
from apt_evap.fit.grid import EnergyGrid
from apt_evap.fit.indexed_registration import (
    HEIGHT,
    ROLLS,
    SHARPNESS,
    emission_of_pattern,
    register_near,
    registration_start,
)
from apt_evap.fit.measured_constants import Measurement, constants_of
from apt_evap.fit.start_settings import FEWEST_IONS, StartSettings, settings_of
from apt_evap.fit.study import Study
from apt_evap.io.formats import read_ranges
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.index_map import Candidate, Indexing, index
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.maps.registration.register import Registration
from apt_evap.simulation.config.material_text import write_material
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.run import Run, load
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.specimen.materials import Material, as_material
from apt_evap.warnings import MapWarning, warn
from apt_evap.workflows.advice import advice_as_notes
from apt_evap.workflows.compare_maps import IN_LINES, REPORT, compare
from apt_evap.workflows.indexing_record import IndexingRecord
from apt_evap.workflows.kept_files import KeptFiles
from apt_evap.workflows.measured_source import MeasuredSource, source_of
from apt_evap.workflows.simulate_file import no_note, simulate
from apt_evap.workflows.twin_options import TwinOptions

SETTINGS, FACTS, RUN, REGISTRATION, STUDY, ANSWER = (
    "specimen.toml", "start.json", "run.h5", "registration.json", "study", "answer.txt",
)  # fmt: skip
_REPORT = f"{STUDY}/{REPORT}"
_FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)  # that roll up, in the fit
_HEIGHT: Mapping[str, Sequence[float]] = {"height": (HEIGHT,)}
_BINS = 128  # of a map of ions
# s; pictures of the run, registration and report, whatever the ions and the threads are. Measured with tungsten, nickel
# and aluminium, 10,000 to 33,000 ions: registration 1 to 2, fit beside its maps 3 to 5, comparison and report 4 to 8
_REPORTING = 14.0
_LEAST_PART = 0.2  # of the time is for the simulation, however long the fit takes
_PART = 0.5  # of the time is for the simulation where the radius is chosen; it had 0.57 to 0.78 of three minutes
_COPIED = "score", "confidence", "rolled", "contrast", "angle_error", "rim_change", "scale_error"  # of a candidate
_SPARE = 4.0  # times the ions that the estimate allows are asked for, because the clock ends the run


class Twin:
    """Twin of a measured specimen; made by `twin`.

    What an earlier call has left in the folder is read. The indexing, the study and the measurement are not in it as
    objects: they are computed again when they are first asked for, with the same result.
    """

    def __init__(
        self,
        folder: Path,
        source: MeasuredSource,
        options: TwinOptions,
        *,
        threads: int | None,
        progress: Any,
        note: Callable[[str], None],
        command: str,
    ) -> None:
        self.folder = folder
        self._source, self._options, self._threads = source, options, threads
        self._progress, self._note, self._command = progress, note, command
        chosen = options.to_plain()  # first: a difference of the element is named before that of its peaks
        made_from = {**chosen, **source.made_from(), **chosen}
        self._kept = KeptFiles(folder, made_from, (SETTINGS, FACTS, RUN, REGISTRATION, STUDY, ANSWER))

    # ---- results -----------------------------------------------------------------------------------------------------

    @cached_property
    def measured(self) -> Hits | DetectorMap:
        """The measured ions, or the measured map."""
        return check_kind(self._source.read(self._note), "measured", (Hits, DetectorMap), "Hits or a DetectorMap")

    @cached_property
    def measured_map(self) -> DetectorMap:
        """The measured map."""
        return self.measured.map(bins=_BINS) if isinstance(self.measured, Hits) else self.measured

    @cached_property
    def indexing(self) -> Indexing:
        """Which crystal direction is where on the measured map."""
        options = self._options
        return index(
            self.measured_map,
            options.element,
            scales=options.scales,
            distance=None if options.scales else options.distance,
            poles=options.poles,
            lines=options.lines,
        )

    @cached_property
    def run(self) -> Run:
        """The run of the simulated specimen."""
        return load(self.folder / RUN)

    @cached_property
    def registration(self) -> Registration:
        """Carries simulated hits into the measured frame."""
        return self._read(REGISTRATION, Registration, "a registration")

    @cached_property
    def candidate(self) -> Candidate:
        """The first candidate of the indexing, as it is simulated."""
        best = self._facts.best
        crystal = as_material(self._options.element)
        patterns = master_patterns(crystal.structure)
        try:
            return Candidate(
                orientation=Orientation(crystal, best.axis, best.rotation),
                projection=Projection(best.scale, best.centre, barrel=best.barrel),
                pattern=min(patterns, key=lambda pattern: abs(pattern.apex_radius - best.pattern_radius)),
                **{name: getattr(best, name) for name in _COPIED},
            )
        except ValueError as error:
            raise FileError(f"{str(self.folder / FACTS)!r} is not a result of apt-evap twin: {error}") from None

    @cached_property
    def measurement(self) -> Measurement:
        """Constants of the measurement with errors, and checks."""
        options = self._options
        return constants_of(
            self.measured_map,
            self.candidate,
            self.measured if isinstance(self.measured, Hits) else None,
            lens=options.electrode,
            field_factor=options.field_factor,
            distance=options.distance,
            efficiency=options.efficiency,
            ranges=None if options.ranges is None else read_ranges(options.ranges),
        )

    @cached_property
    def study(self) -> Study:
        """The fit of the emission energies."""
        return self._compared(self.run, self.measured, None)

    @property
    def answer(self) -> list[str]:
        """Lines of the result: constants of the measurement, and what they depend on."""
        return self._kept.read(ANSWER).decode(errors="replace").splitlines()

    def report(self) -> Path:
        """File of the report, HTML, Path."""
        return self.folder / _REPORT

    def __repr__(self) -> str:
        return f"<Twin in {str(self.folder)!r}: {self._facts.verdict}, {self.candidate}>"

    _repr_html_ = as_table

    def notebook_contents(self) -> dict[str, Any]:
        """Table that a notebook shows, dict."""
        return {"result": self.answer, "report": str(self.report())}

    # ---- steps -------------------------------------------------------------------------------------------------------

    def make(self) -> None:
        """Do the steps that are not done yet."""
        ends_at = time.monotonic() + 60 * self._options.minutes
        kept, path = self._kept, self.folder / RUN
        self._make_start()
        _ = self.candidate
        if os.path.lexists(path) and not is_run(path):
            raise FileError(f"{str(path)!r} is not a run: remove it, or give another folder with -o (folder=...)")
        config = read_config(self.folder / SETTINGS)
        earlier = load(path) if path.exists() else None
        if earlier is None or not _ended_in_time(earlier, config.key):
            whole = earlier is not None and earlier.ended == StopReason.COMPLETE
            self._make_run(path, None if whole else self._seconds(ends_at))
        else:
            self._note(f"{path} has the {len(earlier):,} ions of its time: nothing to do")
        told: list[str] = []
        if not (kept.has(REGISTRATION) and kept.has(ANSWER) and kept.has(_REPORT)):
            if not kept.has(REGISTRATION):
                with advice_as_notes(self._note):
                    self._make_registration()
            kept.forget(ANSWER, _REPORT)
            with advice_as_notes(self._note):
                self.study = self._compared(path, self._as_read(), self.folder / STUDY)
            told = self.study.lines()  # by `compare`
            kept.write({ANSWER: self._made_answer()}, [_REPORT])
        self._note("\n".join(line for line in self.answer if line not in told))
        self._note(f"wrote {self.report()}")

    def _seconds(self, ends_at):
        """Time of the simulation [s], which leaves that of the fit; a function of its ions so far."""
        now, least = time.monotonic(), _LEAST_PART * 60 * self._options.minutes
        measured, grid, threads = self.measured_map, self._grid, thread_count(self._threads)

        def seconds(ions):
            fit = _REPORTING + seconds_of_fit(measured, grid, ions) / threads
            return max(ends_at - now - fit, least)

        return seconds

    def _make_run(self, path, seconds):
        """Simulate until this time is over, or until the tip has evaporated as far as it may."""
        with advice_as_notes(self._note):
            simulated = simulate(
                self.folder / SETTINGS,
                path,
                threads=self._threads,
                seconds=seconds,
                fewest=FEWEST_IONS,
                resume=True,
                progress=self._progress,
                note=self._note,
            )
        if simulated.interrupted:
            raise KeyboardInterrupt
        self.run = simulated.run

    def _make_start(self):
        """Write the settings of the simulation, and the indexing."""
        kept = self._kept
        if kept.has(SETTINGS) and kept.has(FACTS):
            return
        start = self._start()
        self._note(str(start.indexing))
        self._note(start.size_text)
        if not start.indexing.decided:
            text = "the map does not decide: the first candidate is simulated; --pole, --line and --scales help"
            warn(text, MapWarning)
        kept.forget(SETTINGS, FACTS, REGISTRATION, ANSWER, _REPORT)
        facts = (json.dumps(start.to_dict(), indent=1) + "\n").encode()
        kept.write({SETTINGS: start.text.encode(), FACTS: facts})

    def _start(self) -> StartSettings:
        options = self._options
        return settings_of(
            self.indexing,
            self.measured if isinstance(self.measured, Hits) else None,
            lens=options.electrode,
            field_factor=options.field_factor,
            minutes=options.minutes,
            threads=thread_count(self._threads),
            part=_PART,
            spare=_SPARE,
        )

    def _make_registration(self):
        self._kept.forget(ANSWER, _REPORT)
        best = self._facts.best
        hits = self.run.hits(emission_of_pattern(best.rolled))
        registration = register_near(hits, self.measured_map, registration_start(best.centre, best.scale))
        self._kept.write({REGISTRATION: (json.dumps(to_plain(registration), indent=1) + "\n").encode()})

    def _compared(self, run, measured, folder):
        """The study, with its files if there is a folder."""
        from apt_evap._common.recorded_warnings import recorded_warnings

        written = folder is not None
        with recorded_warnings(IN_LINES):
            return compare(
                run,
                measured,
                folder,
                self._grid,
                registration=self.registration,
                threads=self._threads,
                progress=False if self._progress is False else None,
                note=self._note if written else no_note,
                command=self._command,
                sections=self._sections if written else None,
            )

    @cached_property
    def _facts(self) -> IndexingRecord:
        return self._read(FACTS, IndexingRecord, "the result of the first step")

    def _read(self, name, kind, what):
        try:
            return from_plain(json.loads(self._kept.read(name)), kind, what=what)
        except (ValueError, RecursionError) as error:
            path = self.folder / name
            raise FileError(f"{str(path)!r} is not a result of apt-evap twin: {error}") from None

    @property
    def _grid(self):
        """Energies of the fit: of a roll-up if the measured ions roll up."""
        if self._facts.best.rolled < ROLLS:
            return EnergyGrid("lateral", options=_HEIGHT)
        return EnergyGrid("roll-up", options={"probability": _FRACTIONS, "sharpness": (SHARPNESS,)} | _HEIGHT)

    def _as_read(self):
        """The measurement; its file, for the report, is read again for the composition of all its ions only."""
        return MeasuredSource(lambda _: self.measured, self._source.path, self._source.file)

    # ---- texts -------------------------------------------------------------------------------------------------------

    def _sections(self, study):
        """Part of the report: the constants."""
        from apt_evap.plot.report.measurement_report import measurement_section

        known = self._known(study)
        doubt = self._crystal_doubt(study)
        return [measurement_section(known.constants, known.checks, self._reconstruct_command(study), doubt)]

    def _crystal_doubt(self, study):
        """Reason why constants that depend on the crystal are not given, "" if they are."""
        verdict = study.likeness.verdict
        if verdict == "not alike":
            return "the maps are not alike: check the material, the axis and the radius of the tip"
        if verdict == "doubtful" and self._facts.verdict != "indexed":
            return "the map does not decide its orientation, and it is doubtful that the maps are alike"
        return ""

    def _known(self, study):
        """The measurement, or what of it does not depend on the crystal if that is in doubt."""
        return self.measurement.without_crystal() if self._crystal_doubt(study) else self.measurement

    def _reconstruct_command(self, study):
        """Command that reconstructs with the constants, "" if they are in doubt, or without file or flight length."""
        known, file, lens = self._known(study).arguments, self._source.file, self._options.lens_text
        if "distance" not in known or file is None:
            return ""
        element = write_material(as_material(self._options.element))
        # the flight length is one of the constants
        words = ["apt-evap", "reconstruct", *replace(file, distance=None).words("peaks"), "--element", element]
        for name in ("distance", "detector_radius", "efficiency", "compression", "field_factor", "projection"):
            if name in known:
                # masses follow from the flight length
                value = f"{known[name]}" if name in ("projection", "distance") else f"{known[name]:.4g}"
                words += [f"--{name.replace('_', '-')}", value]
        words += ["--lens", lens] if lens else []
        return shlex.join(words)

    def _made_answer(self):
        """Constants of the measurement, and what they depend on, as the content of a file."""
        facts, best = self._facts, self._facts.best
        lines = [
            f"indexing: {facts.verdict}, {facts.reason}",
            f"axis [{' '.join(f'{component:.3f}' for component in best.axis)}] at the centre of the map, rotation "
            f"{best.rotation:.1f}, errors {best.angle_error:.1f} degrees by noise",
            *str(self._known(self.study)).splitlines(),
        ]
        if doubt := self._crystal_doubt(self.study):
            lines.append(f"scale, radius and shank are not given: {doubt}")
        elif not self.measurement.arguments:
            lines.append("radius: not known, the file has no voltages")
        lines.append(f"simulated with R = {facts.simulated_radius:.1f} nm")
        lines += self.study.lines()
        if not self.study.no_energy:
            lines.append("the energies depend on the radius and the voltage, and on the rule of the roll-up")
        if command := self._reconstruct_command(self.study):
            lines.append(f"reconstruct with: {command}")
        return ("\n".join(lines) + "\n").encode(errors="backslashreplace")


def _ended_in_time(run, key):
    """Whether a run of these settings is as an earlier call has left it when its time was over."""
    return run.ended == StopReason.TIME_OVER and run.provenance.get("settings") == key


def twin(
    measured: MeasuredSource | Hits | DetectorMap | AnyPath,
    element: str | Material,
    *,
    minutes: float = 10.0,
    folder: AnyPath | None = None,
    lens: str | LocalElectrode | None = None,
    field_factor: float | None = None,
    distance: float | None = None,
    efficiency: float = 0.5,
    scales: Sequence[float] | None = None,
    poles: Sequence[Any] = (),
    lines: Sequence[Any] = (),
    ranges: AnyPath | None = None,
    threads: int | None = None,
    progress: Any = None,
    note: Callable[[str], None] = no_note,
    command: str = "",
) -> Twin:
    r"""Make a twin of a measured specimen, as ``apt-evap twin`` does.

    The map is indexed, its specimen is simulated, the simulated map is registered on the measured one, the emission is
    fitted, and a report is written. The same call continues after an interruption. A folder belongs to one measurement
    and one set of arguments: others are refused.

    Parameters
    ----------
    measured : str, path-like, Hits or DetectorMap
        The file of measured ions or of a map, or ions, or a map. All ions count: those of the crystal alone are
        ``spectrum(hits, "W").select("W")``, as ``apt-evap twin`` takes them.
    element : str or Material
        The crystal.
    minutes : float
        Time for all steps together [min]: the simulation ends when only the time of the fit is left. Its tip is smaller
        than the measured one if necessary.
    folder : str or path-like, optional
        Folder for all files; by default the name of the file with _twin, in this folder.
    lens : str or LocalElectrode, optional
        Lens of the instrument, for the radius; a text as for `read_lens`.
    field_factor : float, optional
        Field factor without a lens; 3.3 by default.
    distance : float, optional
        Flight length of the instrument [mm].
    efficiency : float
        Fraction of the evaporated atoms that are among the ions, for the angle of the shank.
    scales : sequence of two float, optional
        Bounds of the scale of the map [mm/rad], if it is known.
    poles, lines : sequence, optional
        Poles and zone lines that you see, as for `index`.
    ranges : str or path-like, optional
        File of ranges of mass, for the charge states of the element.
    threads : int, optional
        Number of threads; by default the number of processors that this process may use.
    progress : bool or callable, optional
        Progress of the simulation, as for `simulate`.
    note : callable
        Receives lines of text on what is done.
    command : str
        Command line to repeat it, for the report.

    Returns
    -------
    Twin
        With ``indexing``, ``run``, ``registration``, ``study``, ``measurement``, and ``report()``, the path of the
        report.

    Raises
    ------
    FileError
        If a file cannot be read or written, or the folder has files of another measurement or of other arguments.
    ValueError
        If an argument is outside its range.
    KeyboardInterrupt
        If it is interrupted; what is done so far is kept.

    Examples
    --------
    The simulation takes minutes, so that this example is not run:

    >>> made = ae.twin("R5083.epos", "Ni", distance=90.0, minutes=10)  # doctest: +SKIP
    >>> print("\n".join(made.answer))  # doctest: +SKIP
    >>> made.report()  # doctest: +SKIP
    PosixPath('R5083_twin/study/report.html')
    """
    source = source_of(measured, distance)
    options = TwinOptions(
        element=element,
        minutes=minutes,
        lens=lens,
        field_factor=field_factor,
        distance=distance,
        efficiency=efficiency,
        scales=None if scales is None else tuple(scales),
        poles=tuple(poles),
        lines=tuple(lines),
        ranges=ranges,
    )
    if folder is None:
        folder = f"{Path(source.name).stem}_twin"
    made = Twin(check_path(folder), source, options, threads=threads, progress=progress, note=note, command=command)
    made.make()
    return made
