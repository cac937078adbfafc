"""Search of the registration of a run on a measurement: the best of several emissions."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.emission.perturbations import Perturbation
from apt_evap.fit.indexed_registration import index_as_run, indexed_start, register_near
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.registration.register import Registration, register
from apt_evap.simulation.run import Run
from apt_evap.warnings import AptWarning


class RegistrationSearch:
    """Search for a run, with what is known of its place on the measurement."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self.options: dict[str, Any] = {}
        """Options of `register` that say where the run is on the measurement."""
        self._indexed: dict[str, Any] | None = None  # the same by an indexing of these ions; {} if undecided

    def forget_ions(self) -> None:
        """Other ions of the measurement are selected: these may be indexed otherwise."""
        self._indexed = None

    def best(
        self,
        target: DetectorMap,
        distance: float | None,
        perturbations: Sequence[Perturbation],
        better: Callable[[Registration], None],
        progress: Callable[[float, int], None] | None = None,
        apply: Callable[..., Any] | None = None,
    ) -> Registration:
        """Best registration of several emissions on a measured map.

        Parameters
        ----------
        target : DetectorMap
            The measured map.
        distance : float or None
            Flight length of the measured ions [mm].
        perturbations : sequence of perturbation
            Emissions to try.
        better : callable
            Called with each registration that is better than those before and not doubtful.
        progress : callable, optional
            Called at the start and after each emission, with the number of those that are done, and of all. The
            indexing of the measured map is the first of them if it is not known yet, and is told in parts. An error
            that it raises ends the search.
        apply : callable, optional
            Calls a function with a tuple of arguments, such as `SearchProcess.call`.
        """
        call = apply or (lambda function, arguments, options={}, progress=None: function(*arguments, **options))
        best: Registration | None = None
        registration: Registration | None
        failed = ValueError("perturbations must contain at least one perturbation, got none")
        progress = progress or (lambda done, number: None)
        indexes = not self.options and self._indexed is None
        number = len(perturbations) + indexes
        progress(0, number)
        options = self._start(target, distance, call, lambda part: progress(part, number))
        for done, perturbation in enumerate(perturbations, 1 + indexes):
            try:
                registration = call(_registration, (self._run.hits(perturbation), target, options))
            except ValueError as error:  # such as a map that is too empty with this emission
                registration, failed = None, error
            progress(done, number)
            if registration is not None and (best is None or registration.score > best.score):
                best = registration
                if not best.doubtful:
                    better(best)
        if best is None:
            raise failed
        return best

    def _start(self, target, distance, call, progress):
        """Options that say where the run is: given ones, or by an indexing of the measured map, once for its ions."""
        if self.options:
            return self.options
        if (start := self._indexed) is None:
            start = {}
            arguments = target, Orientation.known(self._run.settings["tip"]), distance
            indexing = call(index_as_run, arguments, {}, progress)
            if indexing is not None and indexing.decided:
                with suppress(ValueError):  # the axis of the run is not on the map
                    start = indexed_start(self._run, indexing)
            self._indexed = start
        return start


def _registration(simulated, measured, options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AptWarning)  # given once, for the best one
        if "start" in options:
            return register_near(simulated, measured, options)
        return register(simulated, measured, **options)
