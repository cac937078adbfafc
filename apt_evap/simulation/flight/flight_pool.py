"""Parallel flights of a batch of ions; each thread has a copy of the surface that replays the events."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from apt_evap._common.codec import checked, count, number, settings
from apt_evap._common.threads import map_of_threads
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_number
from apt_evap._core.flights import LEFT, NEVER_LEFT, NOT_FLOWN, Flights
from apt_evap._core.journal import Journal
from apt_evap._core.octree import Octree
from apt_evap.detection.detector import Detector
from apt_evap.evaporation.emitter import Batch, Emitter
from apt_evap.simulation.flight.field_of_view import LEAST_MARGIN, MARGIN, Scouts, stereographic_rim
from apt_evap.simulation.flight.landing import Ends
from apt_evap.specimen.tip import Tip
from apt_evap.units import COULOMB, NM_PER_MM

_MAX_STEPS = 1_000_000  # flights take a few tens
WHOLE_DETECTOR = "detector"


def _field_of_view(angle, name):
    if angle == WHOLE_DETECTOR:
        return angle
    return check_number(angle, name, above=0, at_most=90, unit="degrees", why=f'or "{WHOLE_DETECTOR}"')


@settings
class FlightSettings:
    """Accuracy and end of the flights.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> hits = []
    >>> coarse = ae.simulation.FlightSettings(opening_angle=0.6, tolerance=1e-2)
    >>> for settings in (ae.simulation.FlightSettings(), coarse):
    ...     hits.append(ae.Simulation(tip, flight_settings=settings).run(30).hits(ae.Unperturbed()))
    >>> deviation = np.hypot(hits[1].x - hits[0].x, hits[1].y - hits[0].y)
    >>> print(f"median {np.nanmedian(deviation):.3f}, largest {np.nanmax(deviation):.3f} mm")
    median 0.017, largest 0.040 mm
    """

    opening_angle: float = number(
        "Largest full angle of an octree cell that replaces its atoms. Measured on Ni[111], R = 20 a: with 0.3, hits "
        "on a detector at 100 mm deviate by 2 um (median) and 6 um (largest of 40) from those of direct sums.",
        default=0.3,
        at_least=0,
        at_most=1.0,
        unit="rad",
    )
    tolerance: float = number(
        "Error of a step relative to path and velocity, ten times as large for the launches of an ion together; 1e-3 "
        "moves hits by 0.1 um.",
        default=1e-3,
        above=0,
        at_most=0.1,
    )
    reach: float = number(
        "Distance from the apex at which the integration ends and the ion continues in a straight line; 11,314 is "
        "8,000 lattice constants of fcc, as in Shaikh et al.",
        default=11314.0,
        at_least=100,
        unit="d_nn",
    )
    max_steps: int = count(
        "Number of steps after which an ion counts as one that never left.",
        default=500,
        at_least=1,
        at_most=_MAX_STEPS,
    )
    field_of_view: float | str | None = checked(
        "Largest polar angle of the flights that count, seen from the apex: half the opening angle of the field of "
        'view. "detector" for that of the corners of the detector. All atoms evaporate, but the responses are computed '
        "only for ions that can arrive in the field of view, with any energy up to that of the responses. By default, "
        "all ions fly.",
        'float, at most 90, or "detector"',
        _field_of_view,
        default=None,
        unit="degrees",
    )


def check_reach(settings: FlightSettings, tip: Tip, detector: Detector) -> None:
    """Raise a ValueError if flights would end beside the specimen, or behind the detector."""
    height = tip.apex - float(tip.positions[tip.evaporable, 2].min(initial=tip.apex))
    reach = settings.reach * tip.nearest_neighbour_distance
    if reach < 3 * height:
        raise ValueError(
            f"reach must be >= 3 times the height of {height:.4g} nm between the apex and the lowest evaporable "
            f"atom, got {settings.reach:g} d_nn, which is {reach:.4g} nm"
        )
    if detector.distance * NM_PER_MM < reach:
        raise ValueError(
            f"distance of the detector must be >= {reach / NM_PER_MM:.4g} mm, the reach of the flights in the field, "
            f"got {detector.distance:g} mm"
        )


@dataclass(frozen=True, eq=False)
class _Record:
    """The surface after a relaxation, and the journals of the batches since then."""

    tree: Octree
    journals: list = field(default_factory=list)


class FlightPool:
    """Threads that fly the ions of successive batches, each taken from the counter of its batch.

    Of n threads, n - 1 fly ions while the calling thread computes events. The calling thread also flies ions while it
    waits for a batch. Each thread has a copy of the surface, which follows the events before a flight.

    Parameters
    ----------
    tip : Tip
        The specimen.
    settings : FlightSettings
        Accuracy and end of the flights.
    n_threads : int
        Number of threads.
    detector : Detector
        The detector, for the directions of scouts.
    """

    def __init__(self, tip: Tip, settings: FlightSettings, n_threads: int, detector: Detector) -> None:
        self._n_helpers = n_threads - 1
        self._pool = self._record = None
        self._own = threading.local()  # per thread: its flights, the record and the number of journals they followed
        self._halt, self._go = np.zeros(1, np.int64), threading.Event()
        self._go.set()
        self._options = _options(tip, settings)
        self._view: dict[str, float] = {}
        if settings.field_of_view is not None:
            rim = stereographic_rim(min(90.0, settings.field_of_view + LEAST_MARGIN))  # type: ignore[operator]
            self._view = {"rim": rim, "margin": MARGIN, "plane": tip.apex + detector.distance * NM_PER_MM}

    @contextmanager
    def at_work(self) -> Iterator[Any]:
        """Start the threads, and end them with the block. Flights that are not complete by then are cancelled."""
        with ThreadPoolExecutor(max(1, self._n_helpers)) as self._pool:
            try:
                yield self
            finally:
                self._pool.shutdown(wait=False, cancel_futures=True)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the flights while all threads are needed elsewhere."""
        self._halt[0] = 1
        self._go.clear()
        try:
            yield
        finally:
            self._halt[0] = 0
            self._go.set()

    def start(
        self, batch: Batch, groups: Sequence[tuple[Floats, Floats]], scouts: Scouts | None = None, n_always: int = 0
    ) -> Callable[[], tuple[list[Ends], Booleans]]:
        """Start the flights of a batch.

        Parameters
        ----------
        batch : Batch
            Batch of n events, which follows that of the previous call; the first batch contains a tree.
        groups : sequence of (ndarray, ndarray)
            Positions [nm] and velocities [sqrt(V)] of launches, each of shape (n, m, 3): m launches per ion, with
            common time steps. NaN for launches that are not flown.
        scouts : Scouts, optional
            Launches that decide for each ion whether it is flown, if the settings have a field of view.
        n_always : int
            Number of groups that are flown whatever the scouts say, before them.

        Returns
        -------
        callable
            Completes the flights of the batch and returns the `Ends` of each group, and whether each ion was flown in
            all groups, bool (n,).
        """
        if batch.tree is not None:
            self._record = _Record(batch.tree)
        record, number = self._record, len(self._record.journals)
        record.journals.append(batch.journal)
        view: dict[str, Any] = {}
        if scouts is not None and self._view:
            groups = [*groups[:n_always], (scouts.positions, scouts.velocities), *groups[n_always:]]
            view = self._view | {"families": scouts.families, "scouts": n_always}
        n, sizes = len(batch), [group[0].shape[1] for group in groups]
        positions = np.concatenate([group[0] for group in groups], axis=1).reshape(-1, 3)
        velocities = np.concatenate([group[1] for group in groups], axis=1).reshape(-1, 3)
        # an ion without a neighbour has no rolled-up position: its launches are not flown
        finite = np.isfinite(positions).all(axis=1)
        counts = np.concatenate(
            [
                finite.reshape(n, sum(sizes))[:, start : start + size].sum(axis=1)[:, None]
                for start, size in zip(np.cumsum([0, *sizes[:-1]]), sizes, strict=True)
            ],
            axis=1,
        ).ravel()
        end = np.empty((int(counts.sum()), 7))
        outcome = np.empty(len(end), np.int8)
        event = np.arange(n, dtype=np.int64)
        start = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        launches = np.ascontiguousarray(positions[finite]), np.ascontiguousarray(velocities[finite])
        counter = np.zeros(1, np.int64)

        def fly():
            while counter[0] < n:
                self._go.wait()
                flights = self._flights_at(record, number)
                flights.fly(batch.journal, event, start, *launches, end, outcome, counter, self._halt, **view)

        helpers = [self._pool.submit(fly) for _ in range(self._n_helpers)]

        def wait():
            fly()
            for helper in helpers:
                helper.result()
            ends = np.full((len(finite), 7), np.nan)
            ends[finite] = end
            outcomes = np.full(len(finite), NEVER_LEFT, np.int8)
            outcomes[finite] = outcome
            ends, outcomes = ends.reshape(n, sum(sizes), 7), outcomes.reshape(n, sum(sizes))
            left, edges = outcomes == LEFT, np.cumsum([0, *sizes])
            every = [
                Ends(ends[:, a:b, :3], ends[:, a:b, 3:6], ends[:, a:b, 6], left[:, a:b]) for a, b in pairwise(edges)
            ]
            if view:
                del every[n_always]
            return every, ~(outcomes == NOT_FLOWN).any(axis=1)

        return wait

    def _flights_at(self, record, number):
        """Flights of the calling thread, after the events of the first `number` journals of the record."""
        local = self._own
        if getattr(local, "record", None) is not record:
            local.flights, local.record, local.followed = Flights(record.tree, **self._options), record, 0
        while local.followed < number:
            local.flights.follow(record.journals[local.followed])
            local.followed += 1
        return local.flights


def fly_at_rest(emitter: Emitter, positions: Floats, settings: FlightSettings) -> Ends:
    """Fly ions that start at rest at positions (n, 3) [nm] in the field of an emitter, which does not change."""
    n, tree = len(positions), emitter.tree
    end, outcome, counter = np.empty((n, 7)), np.empty(n, np.int8), np.zeros(1, np.int64)
    event = np.full(n, -1, np.int64)  # before the first event of the journal: nothing is replayed
    start, halt = np.arange(n + 1, dtype=np.int64), np.zeros(1, np.int64)
    places, velocities = np.ascontiguousarray(positions), np.zeros((n, 3))
    journal = Journal(emitter.tip.positions, 1)

    def fly(number):
        flights = Flights(tree, **_options(emitter.tip, settings))
        flights.fly(journal, event, start, places, velocities, end, outcome, counter, halt)

    with map_of_threads(emitter.n_threads) as apply:
        list(apply(fly, range(emitter.n_threads)))
    end = end[:, None]
    return Ends(end[..., :3], end[..., 3:6], end[..., 6], (outcome == LEFT)[:, None])


def _options(tip, settings):
    """Arguments of `Flights`."""
    return {
        "coulomb": COULOMB,
        "length": tip.nearest_neighbour_distance,
        "centre": (0.0, 0.0, tip.apex),
        "reach": settings.reach * tip.nearest_neighbour_distance,
        "opening_angle": settings.opening_angle,
        "tolerance": settings.tolerance,
        "max_steps": settings.max_steps,
    }
