"""The simulation: atoms evaporate one by one, their flights follow in parallel, and the result is a run.

Events and flights form a pipeline. During the events of one batch, the ions of earlier batches fly on copies of the
surface that replay the events one by one. So each ion flies in exactly the field after its own event, for any number of
threads and any size of a batch.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from apt_evap._common.codec import to_plain
from apt_evap._common.files import FileError
from apt_evap._common.interrupts import interruptible
from apt_evap._common.ion_random import IonRandom
from apt_evap._common.memory import check_copies
from apt_evap._common.threads import thread_count
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_kind, check_number, check_seed, check_sequence, check_switch
from apt_evap.detection.detector import Detector
from apt_evap.emission.emissions import Emissions, check_launches
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.evaporation.charge_settings import ChargeSettings
from apt_evap.evaporation.emitter import BATCH, Emitter
from apt_evap.evaporation.law import Extremal, Law
from apt_evap.evaporation.rule import CompiledRule, Rule
from apt_evap.evaporation.voltage import VoltageControl, check_voltage
from apt_evap.simulation.checkpoint import Checkpoint, CheckpointWriter
from apt_evap.simulation.columns import Clock, Flown, events_of
from apt_evap.simulation.flight.field_of_view import scouts_of
from apt_evap.simulation.flight.flight_pool import WHOLE_DETECTOR, FlightPool, FlightSettings, check_reach
from apt_evap.simulation.flight.landing import land
from apt_evap.simulation.flight.response import ResponseModel, ResponseSettings
from apt_evap.simulation.history import CapHistory
from apt_evap.simulation.monitor import Monitor
from apt_evap.simulation.recorder import Recorder
from apt_evap.simulation.run import Run
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.specimen.tip import Tip
from apt_evap.warnings import RunWarning, warn

BACKLOG = 4  # batches whose flights may be pending during further events


class Simulation:
    """Field evaporation of a specimen in front of a detector.

    Parameters
    ----------
    tip : Tip
        The specimen.
    voltage : float
        Applied voltage [V].
    seed : int
        Seed of the random numbers of the perturbations.
    detector : Detector, optional
        By default a square of 300 mm at 100 mm.
    law : law, optional
        Selects the next atom to evaporate; by default `Extremal`.
    charge_settings : ChargeSettings, optional
        Accuracy of the charges.
    flight_settings : FlightSettings, optional
        Accuracy and end of the flights.
    response_settings : ResponseSettings, optional
        Flights and polynomials of the responses.
    n_threads : int, optional
        Number of threads; by default the number of processors that this process may use. The results do not depend on
        it.
    rule : charging rule, optional
        Distribution of the charge over the surface; by default `Robin`.
    monitor : Monitor, optional
        Monitoring of the run.
    control : VoltageControl, optional
        Rate, pulses and control of the voltage, for a law with a temperature (by default a usual one), and for real
        units. Flights are simulated at `voltage`, because their paths do not depend on it.

    Raises
    ------
    ValueError
        If a setting is outside its range.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> simulation = ae.Simulation(tip, seed=1, detector=ae.Detector(distance=90.0, width=80.0))
    >>> simulation.run(100)
    <Run: 100 ions of Ni at 1000 V; responses, 0 of them flagged>
    >>> simulation.run(50)  # the next atoms of the same specimen
    <Run: 50 ions of Ni at 1000 V; responses, 0 of them flagged>
    >>> simulation.n_evaporated
    150
    """

    def __init__(
        self,
        tip: Tip,
        voltage: float = 1000.0,
        seed: int = 0,
        detector: Detector | None = None,
        law: Law | None = None,
        charge_settings: ChargeSettings | None = None,
        flight_settings: FlightSettings | None = None,
        response_settings: ResponseSettings | None = None,
        n_threads: int | None = None,
        rule: Rule | CompiledRule | None = None,
        monitor: Monitor | None = None,
        control: VoltageControl | None = None,
    ) -> None:
        self.voltage = check_voltage(voltage)
        self.seed = check_seed(seed)
        self.detector = Detector() if detector is None else check_kind(detector, "detector", Detector, "a Detector")
        self.law = Extremal() if law is None else law
        self.flight_settings = FlightSettings() if flight_settings is None else flight_settings
        check_kind(self.flight_settings, "flight_settings", FlightSettings, "FlightSettings")
        if self.flight_settings.field_of_view == WHOLE_DETECTOR:
            # as a number, because a run can be shown on other detectors
            self.flight_settings = replace(self.flight_settings, field_of_view=self.detector.half_angle)
        self.response_settings = ResponseSettings() if response_settings is None else response_settings
        check_kind(self.response_settings, "response_settings", ResponseSettings, "ResponseSettings")
        if charge_settings is not None:
            check_kind(charge_settings, "charge_settings", ChargeSettings, "ChargeSettings")
        self.monitor = Monitor() if monitor is None else monitor
        check_kind(self.monitor, "monitor", Monitor, "Monitor")
        self.n_threads = thread_count(n_threads)
        check_reach(self.flight_settings, check_kind(tip, "tip", Tip, "a Tip"), self.detector)
        self.emitter = Emitter(
            tip,
            self.voltage,
            self.law,
            charge_settings,
            self.n_threads,
            rule,
            control,
            self.seed,
            self.response_settings.shells,
        )
        self.control = self.emitter.control or control
        check_copies(len(self.emitter), self.n_threads)
        self.settings = self._settings_of(tip)
        self.n_evaporated = 0
        self._running = threading.Lock()
        self._flight_pool = FlightPool(tip, self.flight_settings, self.n_threads, self.detector)

    @property
    def tip(self) -> Tip:
        """The specimen, with its current shell."""
        return self.emitter.tip

    def __repr__(self) -> str:
        tip, detector = repr(self.tip).removeprefix("<Tip: ").removesuffix(">"), self.detector
        return (
            f"<Simulation: {self.n_evaporated:,} evaporated of {tip}; {self.voltage:g} V, seed {self.seed}, detector "
            f"of {detector.width:g} mm at {detector.distance:g} mm>"
        )

    def run(
        self,
        n_ions: int,
        emissions: Iterable[Perturbation] = (),
        *,
        responses: bool = True,
        progress: bool | Callable[[int, int], object] | None = None,
        batch_size: int = BATCH,
        checkpoint: Checkpoint | AnyPath | None = None,
        seconds: float | Callable[[int], float] | None = None,
        fewest: int = 1,
    ) -> Run:
        """Evaporate atoms and fly their ions.

        Ctrl-C ends the run after the current batch and keeps all ions so far; a second Ctrl-C ends it at once. Another
        call continues where the previous run ended.

        Parameters
        ----------
        n_ions : int
            Number of atoms to evaporate; for a resumed run, including its earlier ions.
        emissions : sequence of perturbations
            Perturbations with their own flights, in addition to the responses. Needed for a user-defined perturbation
            that does not launch from the site or the rolled-up position along the surface.
        responses : bool
            Whether to compute responses, so that `Run.hits` accepts any built-in perturbation in post-processing.
            Without them, and without `emissions`, the unperturbed ions are flown.
        progress : bool or callable, optional
            Whether to show a progress bar; by default if the output is a terminal or a notebook. A function is called
            after every batch instead, with the number of ions so far and the requested number.
        batch_size : int
            Events per batch; the results do not depend on it.
        checkpoint : Checkpoint or str or path-like, optional
            File in which the run is stored at intervals and at its end; a file name for the default settings. A run
            that is killed and resumed gives the same bits as an uninterrupted one.
        seconds : float or callable, optional
            Time after which the run ends with the ions so far, as with Ctrl-C [s]; or a function of the number of ions
            so far that returns it. The ions are the first ones of the whole run, bit by bit; their number depends on
            the machine.
        fewest : int
            Ions before which this time does not end the run.

        Returns
        -------
        Run

        Raises
        ------
        FileError
            If the checkpoint file cannot be written, is in use by another process, or is of another run.
        ValueError
            If an argument is outside its range, or a perturbation has no method `launch`.
        RunInterrupted
            If an error ends the run after its first ions; its attribute `run` contains them.
        """
        n_ions = check_count(n_ions, "n_ions", at_least=1)
        batch_size = check_count(batch_size, "batch_size", at_least=1)
        check_switch(responses, "responses")
        time_over = _time_limit(seconds, fewest)
        if progress is not None and not callable(progress):
            check_switch(progress, "progress")
        emissions = check_sequence(emissions, "emissions", "perturbations")
        for perturbation in emissions:
            check_kind(perturbation, "emissions", "launch", "perturbations with a method launch")
        self._check_atoms(n_ions)
        if not emissions and not responses:
            emissions = (Unperturbed(),)
        if checkpoint is None:
            return self._run(n_ions, emissions, responses, progress, batch_size, None, time_over)
        if not isinstance(checkpoint, Checkpoint):
            checkpoint = Checkpoint(checkpoint)
        with CheckpointWriter(checkpoint, self.settings, emissions, responses, n_ions) as writer:
            return self._run(n_ions, emissions, responses, progress, batch_size, writer, time_over)

    def __reduce__(self):
        raise TypeError("a Simulation cannot be pickled or copied: save its run, and make a new simulation")

    def _run(self, *arguments):
        if not self._running.acquire(blocking=False):
            raise ValueError(
                "a run of this simulation is active in another thread: wait for it, or make another simulation"
            )
        try:
            return self._run_alone(*arguments)
        finally:
            self._running.release()

    def _run_alone(self, n_ions, emissions, responses, progress, batch_size, writer, time_over):
        self._catch_up(writer.previous if writer else None)
        self.emitter.request_tree_copy()  # atoms may have evaporated without flights before
        if not (writer and writer.previous):
            self.emitter.request_cap()
        backlog = BACKLOG if self.n_threads > 1 else 0
        with (
            self._flight_pool.at_work(),
            interruptible() as interrupted,
            Recorder(self.emitter, self.monitor, n_ions, self.n_evaporated, progress, writer) as recorder,
        ):
            for batch in self.emitter.advance(recorder.missing, batch_size, self._flight_pool.paused):
                part = self._start_flights(batch, emissions, responses)
                recorder.add(batch, part, self.n_evaporated, backlog)
                if interrupted.is_set() or time_over(n_ions - recorder.missing):
                    recorder.end_early(StopReason.INTERRUPTED if interrupted.is_set() else StopReason.TIME_OVER)
                    break
        return recorder.run

    def _catch_up(self, previous):
        """Bring a new surface to the end of a resumed run, by its stored state and the events since then.

        Raises ValueError if atoms have already evaporated, or if the events differ from those of the run.
        """
        if previous is None:
            return
        emitter = self.emitter
        if n_evaporated := emitter.counts["events"]:
            raise ValueError(f"resume needs a new Simulation, got one with {n_evaporated:,} evaporated atoms")
        if previous.state is not None:
            try:
                emitter.restore(previous.state)
            except (ValueError, KeyError) as error:
                raise FileError(f"the run cannot be resumed, its state does not fit: {error}") from error
        # evaporated ions of the run; negative before its first ion
        ions = emitter.counts["events"] - previous.first_event
        same = ions <= len(previous)
        for batch in emitter.advance(max(len(previous) - ions, 0)):
            stored = slice(max(ions, 0), max(ions + len(batch), 0))
            common = slice(len(batch) - (stored.stop - stored.start), None)
            same = same and np.array_equal(batch.site[common], previous.site[stored])
            same = same and np.array_equal(batch.charges[common], previous.charges[stored])
            ions += len(batch)
            if not same:
                break
        if not same or ions != len(previous):
            raise ValueError(
                "the run cannot be resumed: its recomputed events differ; possible reasons are another version of the "
                "program, a changed rule or law, or a surface changed by hand"
            )
        self.n_evaporated = int(previous.emissions.ions[-1]) + 1

    # ---- one batch -------------------------------------------------------------------------------------------------

    def _start_flights(self, batch, emissions, responses):
        """Start the flights of a batch; return a function that waits for them and returns the batch as a Run."""
        first_ion = self.n_evaporated
        self.n_evaporated += len(batch)
        ions = np.arange(first_ion, self.n_evaporated, dtype=np.int64)
        emission_batch = self._emissions(batch, ions)
        launches = [
            check_launches(perturbation, perturbation.launch(emission_batch, IonRandom(self.seed, ions)), len(batch))
            for perturbation in (emissions if len(batch) else ())
        ]
        slowness = emission_batch.slowness
        no_launches = np.empty((0, 1, 3))
        groups = [(launch.positions[:, None], (launch.velocities * slowness[:, None])[:, None]) for launch in launches]
        groups += [(no_launches, no_launches)] * (len(emissions) - len(launches))
        model = ResponseModel(self.response_settings, self.detector)
        limited, scouts = self.flight_settings.field_of_view is not None, None
        if responses:
            groups.append(model.launches(emission_batch))
            scouts = scouts_of(emission_batch, self.response_settings) if limited else None
        flight = self._flight_pool.start(batch, groups, scouts, len(emissions))

        def finish():
            (ends, every), apex = flight(), self.tip.apex
            flown_ions = every if limited else None
            flown = []
            for flights in ends[: len(emissions)]:
                directions, times = land(flights, slowness, self.detector, apex)
                flown.append(Flown(directions[:, 0], times[:, 0]))
            return Run(
                emissions=emission_batch,
                site=batch.site,
                species=self.tip.species[batch.site],
                charges=batch.charges,
                fields=batch.fields,
                perturbations=emissions,
                flown=tuple(flown),
                responses=model.fit(ends[-1], slowness, apex, flown_ions) if responses else None,
                seed=self.seed,
                voltage=self.voltage,
                detector=self.detector,
                response_settings=self.response_settings,
                elements=tuple(element.name for element in self.tip.elements),
                settings=self.settings,
                detached=batch.detached,
                phase=self.tip.phase_at(batch.site),
                cap=CapHistory.of(first_ion, batch.cap),
                clock=None if batch.waits is None else Clock(batch.waits, batch.voltages),
                events=events_of(batch.columns),
            )

        return finish

    def _emissions(self, batch, ions):
        species = self.tip.species[batch.site]
        positions = self.tip.positions
        known = batch.targets >= 0
        targets = np.where(known[..., None], positions[batch.targets], np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = batch.target_charges / batch.charges[:, None]
        return Emissions(
            positions=positions[batch.site],
            normals=batch.normals,
            neighbours=np.ascontiguousarray(targets[:, 0]),
            charge_states=self.tip.charge_states[species],
            masses=self.tip.masses[species],
            ions=ions,
            nearest_neighbour_distance=self.tip.nearest_neighbour_distance,
            targets=targets,
            charge_ratios=np.where(known, ratios, np.nan),
            rollup_distances=self._rollup_distances(batch),
        )

    def _rollup_distances(self, batch):
        """Mean nearest neighbour distance of the phases of each ion and of its neighbour; None if all are equal."""
        distances = np.array([criterion.nearest_neighbour_distance for criterion in self.tip.criteria])
        if (distances == distances[0]).all():
            return None
        phase = self.tip.phase_at(batch.site)
        target = batch.targets[:, 0]
        other = np.where(target >= 0, self.tip.phase_at(target), phase)
        return 0.5 * (distances[phase] + distances[other])

    def _check_atoms(self, n_ions):
        """Warn if there are fewer evaporable atoms than requested ions."""
        available = self.tip.max_ions - self.emitter.counts["events"]
        if n_ions > available:
            warn(
                f"n_ions is {n_ions:,} but only about {max(available, 0):,} atoms can evaporate: the run will be "
                "shorter",
                RunWarning,
            )

    def _settings_of(self, tip):
        """All settings of a run, in plain types."""
        return {
            "tip": tip.settings,
            "voltage": self.voltage,
            "seed": self.seed,
            "detector": to_plain(self.detector),
            "law": to_plain(self.law),
            "rule": to_plain(self.emitter.rule),
            "charges": to_plain(self.emitter.settings),
            "flights": to_plain(self.flight_settings),
            "responses": to_plain(self.response_settings),
            "monitor": to_plain(self.monitor),
            "control": to_plain(self.control),
            "pulse_length": self.emitter.pulse_length,
        }


def _time_limit(seconds, fewest):
    """Whether the time of a run is over, as a function of the number of its ions; it begins now."""
    fewest = check_count(fewest, "fewest", at_least=1)
    if seconds is None:
        return lambda ions: False
    began = time.monotonic()
    if callable(seconds):
        return lambda ions: ions >= fewest and time.monotonic() - began >= seconds(ions)
    length = check_number(seconds, "seconds", at_least=0, unit="s")
    return lambda ions: ions >= fewest and time.monotonic() - began >= length
