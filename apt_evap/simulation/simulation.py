"""The simulation: atoms leave one by one, their flights follow in parallel, and a run comes out.

Events and flights are a pipeline. While a batch of events happens, the flights of batches before are flown on copies of
the surface that replay the events one by one, so each ion flies in exactly the field that its own event left behind,
whatever the number of threads and the size of a batch.
"""

import warnings
from collections.abc import Callable, Iterable

import numpy as np
from tqdm.auto import tqdm

from apt_evap._common.files import FileError
from apt_evap._common.interrupts import interruptible
from apt_evap._common.memory import check_copies
from apt_evap._common.threads import thread_count
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_kind, check_seed, check_sequence, check_switch
from apt_evap._core.evaporation import EXHAUSTED, SWEEP_DUE, TOO_SHALLOW
from apt_evap._core.robin import ChargingRule
from apt_evap.detection.detector import Detector
from apt_evap.emission.emissions import Emissions, Launches
from apt_evap.emission.ion_random import IonRandom
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.emission.surface_frame import tangent_frame
from apt_evap.evaporation.emitter import Emitter
from apt_evap.evaporation.law import Extremal, Law
from apt_evap.evaporation.settings import ChargeSettings, check_voltage
from apt_evap.flight.crew import FlightCrew, FlightSettings, check_reach
from apt_evap.flight.response import Responses, ResponseSettings, flattened
from apt_evap.simulation.checkpoint import NOTHING_LEFT, Checkpoint, Keeper
from apt_evap.simulation.monitor import Watch, WatchSettings
from apt_evap.simulation.run import Flown, Run
from apt_evap.simulation.run_parts import Parts, catch_up
from apt_evap.specimen.tip import Tip
from apt_evap.units import FLIGHT_TIME

BATCH = 256  # events at a time; the results do not depend on it
BACKLOG = 4  # batches whose flights may wait while events happen


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
    law : Extremal, optional
        Which atom leaves next.
    charge_settings : ChargeSettings, optional
        How finely charges are solved.
    flight_settings : FlightSettings, optional
        How flights are integrated.
    response_settings : ResponseSettings, optional
        Flights and polynomials of the responses.
    n_threads : int, optional
        Threads; by default the processors this process may use. The results do not depend on it.
    rule : ChargingRule, optional
        How charge settles; by default Robin's iteration.
    watch_settings : WatchSettings, optional
        How the run is watched as it goes on.

    Raises
    ------
    ValueError
        If a setting is out of its range.
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
        rule: ChargingRule | None = None,
        watch_settings: WatchSettings | None = None,
    ) -> None:
        self.voltage = check_voltage(voltage)
        self.seed = check_seed(seed)
        self.detector = Detector() if detector is None else check_kind(detector, "detector", Detector, "a Detector")
        self.law = Extremal() if law is None else law
        self.flight_settings = FlightSettings() if flight_settings is None else flight_settings
        check_kind(self.flight_settings, "flight_settings", FlightSettings, "FlightSettings")
        self.response_settings = ResponseSettings() if response_settings is None else response_settings
        check_kind(self.response_settings, "response_settings", ResponseSettings, "ResponseSettings")
        if charge_settings is not None:
            check_kind(charge_settings, "charge_settings", ChargeSettings, "ChargeSettings")
        self.watch_settings = WatchSettings() if watch_settings is None else watch_settings
        check_kind(self.watch_settings, "watch_settings", WatchSettings, "WatchSettings")
        self.n_threads = thread_count(n_threads)
        check_reach(self.flight_settings, check_kind(tip, "tip", Tip, "a Tip"), self.detector)
        self.emitter = Emitter(tip, self.voltage, self.law, charge_settings, self.n_threads, rule)
        check_copies(len(self.emitter), self.n_threads)
        self.settings = self._settings_of(tip)
        self.n_evaporated = 0
        self._crew = FlightCrew(tip, self.flight_settings, self.n_threads)

    @property
    def tip(self) -> Tip:
        """The specimen, as deep as it is held by now."""
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
    ) -> Run:
        """Evaporate atoms and fly their ions.

        Ctrl-C ends the run after the batch under way, with everything done so far; a second one ends it at once. A run
        after a run goes on where the one before ended.

        Parameters
        ----------
        n_ions : int
            Number of atoms to evaporate; of a run that is resumed, those done before included.
        emissions : sequence of perturbations
            Flown as they are, beside the responses: needed for one of your own that launches from elsewhere than the
            site or the rolled-up position.
        responses : bool
            Whether to fly what the responses need, so that `Run.hits` takes any built-in perturbation afterwards.
            Without, and without `emissions`, the unperturbed ions are flown.
        progress : bool or callable, optional
            Whether to show a progress bar; by default if the output is a terminal or a notebook. A function is called
            after every batch instead, with the ions done and the ions asked for.
        batch_size : int
            Events at a time; the results do not depend on it.
        checkpoint : Checkpoint or str or path-like, optional
            Where the run is kept while it goes on, and saved once it has ended; a file name for the usual settings. A
            run that is killed and resumed has the bits of one that was not.

        Returns
        -------
        Run

        Raises
        ------
        FileError
            If the file of the checkpoints cannot be written, belongs to somebody else or does not fit.
        ValueError
            If an argument is out of its range, or a perturbation has no `launch`. Whatever is raised once ions are done
            has them in its attribute `run`.
        """
        n_ions = check_count(n_ions, "n_ions", at_least=1)
        batch_size = check_count(batch_size, "batch_size", at_least=1)
        check_switch(responses, "responses")
        if progress is not None and not callable(progress):
            check_switch(progress, "progress")
        emissions = check_sequence(emissions, "emissions", "perturbations")
        for perturbation in emissions:
            check_kind(perturbation, "emissions", "launch", "perturbations with a method launch")
        self._check_atoms(n_ions)
        if not emissions and not responses:
            emissions = (Unperturbed(),)
        if checkpoint is None:
            return self._run(n_ions, emissions, responses, progress, batch_size, None)
        if not isinstance(checkpoint, Checkpoint):
            checkpoint = Checkpoint(checkpoint)
        with Keeper(checkpoint, self.settings, emissions, responses, n_ions) as keeper:
            return self._run(n_ions, emissions, responses, progress, batch_size, keeper)

    def _run(self, n_ions, emissions, responses, progress, batch_size, keeper):
        parts = Parts(keeper, self.emitter)
        if parts.done:
            catch_up(self.emitter, parts.done[0], BATCH)
            self.n_evaporated = int(parts.done[0].emissions.ions[-1]) + 1
        interval = self.watch_settings.interval or 10 * self.emitter.sweep_interval
        watch = parts.watch = Watch(self.watch_settings, interval, self.n_evaporated - len(parts), parts.done)
        ended = ""
        self.emitter.hand_out_tree()  # somebody may have let atoms evaporate without flights
        told = progress if callable(progress) else None
        disable = True if told else None if progress is None else not progress
        with (
            tqdm(
                total=n_ions, initial=len(parts), unit=" ions", smoothing=0.1, disable=disable, mininterval=0.5
            ) as bar,
            self._crew.at_work(),
            interruptible() as interrupted,
        ):

            def collect(most=0):
                nonlocal landed
                while len(waiting) > most:
                    part = waiting.pop(0)()
                    parts.append(part)
                    watch.count(part)
                    bar.set_postfix(watch.shown, refresh=False)
                    bar.update(len(part))
                    landed += len(part)
                    if told:
                        told(landed, n_ions)

            waiting = []
            started = landed = len(parts)
            try:
                while started < n_ions and not ended:
                    batch = self.emitter.evaporate(min(batch_size, n_ions - started))
                    started += len(batch)
                    waiting.append(self._start_flights(batch, emissions, responses))
                    collect(BACKLOG if self.n_threads > 1 else 0)
                    if batch.status == SWEEP_DUE:
                        if watch.due(self.n_evaporated):
                            collect()
                            watch.look(self.emitter, self.n_evaporated)
                        with self._crew.paused():
                            self.emitter.relax()
                    elif batch.status == EXHAUSTED:
                        ended = NOTHING_LEFT
                    elif batch.status == TOO_SHALLOW:
                        self.emitter.deepen()
                    if interrupted.is_set() and not ended and started < n_ions:
                        ended = "interrupted"
                    if keeper and keeper.due(started):
                        collect()
                        parts.keep()
                collect()
            except KeyboardInterrupt:  # the second Ctrl-C: what is in a checkpoint's run stays
                parts.keep()
                raise
            except Exception as error:  # nothing done is lost: a caller may save it
                collect()
                if len(parts):
                    error.run = done = parts.run(f"{type(error).__name__}: {error}")  # type: ignore[attr-defined]
                    error.add_note(f"the {len(done):,} ions done so far are in the attribute `run` of this exception")
                parts.keep()
                raise
        run = parts.run(ended)
        if keeper and not keeper.complete:
            try:
                keeper.finish(run)
            except FileError as error:
                error.run = run
                raise
        return run

    # ---- one batch -------------------------------------------------------------------------------------------------

    def _start_flights(self, batch, emissions, responses):
        """Begin the flights of a batch; return a function that waits for them and gives the batch as a Run."""
        ions = np.arange(self.n_evaporated, self.n_evaporated + len(batch))
        self.n_evaporated += len(batch)
        emitted = self._emissions(batch, ions)
        nobody = Launches(emitted.positions, emitted.positions, np.zeros(len(batch), bool))
        launches = [
            perturbation.launch(emitted, IonRandom(self.seed, ions)) if len(batch) else nobody
            for perturbation in emissions
        ]
        for perturbation, launch in zip(emissions, launches, strict=True):
            if len(launch.positions) != len(batch):
                raise ValueError(
                    f"{perturbation!r} must launch {len(batch)} ions, one per emission, got {len(launch.positions)}"
                )
        slowness = FLIGHT_TIME * np.sqrt(emitted.masses / emitted.charge_states)  # ns per reduced time
        groups = [(launch.positions[:, None], (launch.velocities * slowness[:, None])[:, None]) for launch in launches]
        if responses:
            groups += self._designs(emitted)
        flight = self._crew.start(batch, groups)

        def finish():
            ends = flight()
            flown = []
            for position, velocity, time, left in ends[: len(emissions)]:
                directions, times = self._landed(position[:, 0], velocity[:, 0], time[:, 0], left[:, 0], slowness)
                flown.append(Flown(directions, times))
            fitted = self._fit(ends[len(emissions) :], slowness) if responses else None
            return Run(
                emissions=emitted,
                site=batch.site,
                species=self.tip.species[batch.site],
                charges=batch.charges,
                fields=batch.fields,
                perturbations=emissions,
                flown=tuple(flown),
                responses=fitted,
                seed=self.seed,
                voltage=self.voltage,
                detector=self.detector,
                response_settings=self.response_settings,
                elements=tuple(element.name for element in self.tip.elements),
                settings=self.settings,
            )

        return finish

    def _emissions(self, batch, ions):
        species = self.tip.species[batch.site]
        positions = self.tip.positions
        neighbours = np.where((batch.neighbour >= 0)[:, None], positions[batch.neighbour], np.nan)
        return Emissions(
            positions=positions[batch.site],
            normals=batch.normals,
            neighbours=neighbours,
            charge_states=self.tip.charge_states[species],
            masses=self.tip.masses[species],
            ions=ions,
            nearest_neighbour_distance=self.tip.nearest_neighbour_distance,
        )

    def _designs(self, emitted):
        """Launches of the two designs: positions and velocities of shape (n, m, 3)."""
        settings = self.response_settings
        first, second = tangent_frame(emitted.normals)
        lifted = emitted.neighbours + emitted.nearest_neighbour_distance * emitted.normals
        groups = []
        for design, start in ((settings.site, emitted.positions), (settings.rolled, lifted)):
            speeds = settings.launched(design.velocities, emitted.charge_states)
            velocities = speeds[..., :1] * first[:, None] + speeds[..., 1:] * second[:, None]
            groups.append((np.broadcast_to(start[:, None], velocities.shape), velocities))
        return groups

    def _landed(self, position, velocity, time, left, slowness):
        """Stereographic directions (n, 2) and times of flight (n,) [ns]; NaN where an ion never left."""
        directions, remaining = self.detector.directions(position, velocity, self.tip.apex)
        directions[~left] = np.nan
        return directions, np.where(left, (time + remaining) * slowness, np.nan)

    def _fit(self, ends, slowness):
        coefficients, residuals = [], []
        designs = (self.response_settings.site, self.response_settings.rolled)
        for design, (position, velocity, time, left) in zip(designs, ends, strict=True):
            n, m = left.shape
            directions, times = self._landed(
                position.reshape(-1, 3),
                velocity.reshape(-1, 3),
                time.ravel(),
                left.ravel(),
                np.repeat(slowness, m),
            )
            fitted, residual = design.fit(flattened(directions, times).reshape(n, m, 3))
            coefficients.append(fitted)
            # a small change of the stereographic direction is half as large on a plane at unit distance
            residuals.append(2.0 * self.detector.distance * residual)
        return Responses(*coefficients, np.stack(residuals, axis=1).astype(np.float32))

    def _check_atoms(self, n_ions):
        """Warn of a run that cannot be as long as asked for."""
        left = self.tip.most_ions - self.emitter.counts["events"]
        if n_ions > left:
            warnings.warn(
                f"n_ions is {n_ions:,} but only about {max(left, 0):,} atoms may leave: the run ends with the last",
                stacklevel=3,
            )

    def _settings_of(self, tip):
        """Everything a run is made with, in plain types."""
        return {
            "tip": tip.settings,
            "voltage": self.voltage,
            "seed": self.seed,
            "detector": vars(self.detector),
            "law": {"name": type(self.law).__name__, "repr": repr(self.law)},
            "rule": type(self.emitter.rule).__name__,
            "charges": vars(self.emitter.settings),
            "flights": vars(self.flight_settings),
            "responses": {
                "energy_limit": self.response_settings.energy_limit,
                "bound": self.response_settings.bound,
                "site": vars(self.response_settings.site),
                "rolled": vars(self.response_settings.rolled),
            },
            "watch": vars(self.watch_settings),
        }
