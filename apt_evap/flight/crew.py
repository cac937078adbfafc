"""Flights of a batch of ions, in parallel, each on a copy of the surface that replays the events."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_count, check_number
from apt_evap._core.flights import LEFT, Flights
from apt_evap._core.octree import Octree
from apt_evap.detection.detector import Detector
from apt_evap.evaporation.emitter import Batch
from apt_evap.flight.landing import Ends
from apt_evap.specimen.tip import Tip
from apt_evap.units import COULOMB, NM_PER_MM

_MAX_STEPS = 1_000_000  # flights take some tens


@dataclass(frozen=True)
class FlightSettings:
    """How the flights are integrated.

    Parameters
    ----------
    opening_angle : float
        Full angle under which a cell of the octree stands for its atoms [rad]. Measured on Ni[111], R = 20 a: 0.3 puts
        ions within 2 um (median) and 6 um (largest of 40) of where exact sums put them on a detector at 100 mm.
    tolerance : float
        Error of a step relative to path and velocity; at 1e-3 it moves ions by 0.1 um.
    reach : float
        Distance from the apex, in nearest neighbour distances, at which a flight ends and the ion goes straight on;
        11,314 is 8,000 lattice constants of fcc, as in Shaikh et al.
    max_steps : int
        Steps after which an ion counts as one that never left.
    """

    opening_angle: float = 0.3
    tolerance: float = 1e-3
    reach: float = 11314.0
    max_steps: int = 500

    def __post_init__(self):
        check_number(self.opening_angle, "opening_angle", at_least=0, at_most=1.0, unit="rad")
        check_number(self.tolerance, "tolerance", above=0, at_most=0.1)
        check_number(self.reach, "reach", at_least=100, unit="d_nn")
        check_count(self.max_steps, "max_steps", at_least=1, at_most=_MAX_STEPS)


def check_reach(settings: FlightSettings, tip: Tip, detector: Detector) -> None:
    """Refuse flights that would end beside the specimen, or behind the detector."""
    height = tip.apex - float(tip.positions[tip.evaporable, 2].min(initial=tip.apex))
    reach = settings.reach * tip.nearest_neighbour_distance
    if reach < 3 * height:
        raise ValueError(
            f"reach must be at least three times the {height:.4g} nm between the apex and the lowest atom that may "
            f"leave, got {settings.reach:g} d_nn, which is {reach:.4g} nm"
        )
    if detector.distance * NM_PER_MM < reach:
        raise ValueError(
            f"distance of the detector must be at least the {reach / NM_PER_MM:.4g} mm that ions fly through the "
            f"field (reach), got {detector.distance:g} mm: it would be behind the end of the flights"
        )


@dataclass(frozen=True, eq=False)
class _Record:
    """The surface after a relaxation, and the journals of the batches since."""

    tree: Octree
    journals: list = field(default_factory=list)


class FlightCrew:
    """Threads that take the ions of one batch after the other from its counter.

    Of n threads n - 1 fly while the one that calls lets events happen; that one takes part once it waits for a batch.
    Each has a copy of the surface, made to follow the events when it comes to fly.

    Parameters
    ----------
    tip : Tip
        The specimen.
    settings : FlightSettings
        How flights are integrated.
    n_threads : int
        Threads.
    """

    def __init__(self, tip: Tip, settings: FlightSettings, n_threads: int) -> None:
        self._n_helpers = n_threads - 1
        self._pool = self._record = None
        self._own = threading.local()  # of each thread: its flights, the record and how many journals they followed
        self._halt, self._go = np.zeros(1, np.int64), threading.Event()
        self._go.set()
        self._options = {
            "coulomb": COULOMB,
            "length": tip.nearest_neighbour_distance,
            "centre": (0.0, 0.0, tip.apex),
            "reach": settings.reach * tip.nearest_neighbour_distance,
            "opening_angle": settings.opening_angle,
            "tolerance": settings.tolerance,
            "max_steps": settings.max_steps,
        }

    @contextmanager
    def at_work(self) -> Iterator[Any]:
        """The threads, as long as there are batches. What is still to be flown at the end is left."""
        with ThreadPoolExecutor(max(1, self._n_helpers)) as self._pool:
            try:
                yield self
            finally:
                self._pool.shutdown(wait=False, cancel_futures=True)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Let the flights stand still while all threads are needed elsewhere."""
        self._halt[0] = 1
        self._go.clear()
        try:
            yield
        finally:
            self._halt[0] = 0
            self._go.set()

    def start(self, batch: Batch, groups: Sequence[tuple[Floats, Floats]]) -> Callable[[], list[Ends]]:
        """Begin the flights of a batch.

        Parameters
        ----------
        batch : Batch
            Of n events, the one after that of the call before; its first one comes with a tree.
        groups : sequence of (ndarray, ndarray)
            Positions [nm] and velocities [sqrt(V)] of launches, each of shape (n, m, 3): m of every ion, which share
            their steps. NaN for an ion that is not flown.

        Returns
        -------
        callable
            Flies what is left of the batch, and gives the `Ends` of each group.
        """
        if batch.tree is not None:
            self._record = _Record(batch.tree)
        record, number = self._record, len(self._record.journals)
        record.journals.append(batch.journal)
        n, sizes = len(batch), [group[0].shape[1] for group in groups]
        positions = np.concatenate([group[0] for group in groups], axis=1).reshape(-1, 3)
        velocities = np.concatenate([group[1] for group in groups], axis=1).reshape(-1, 3)
        # an ion without a neighbour has no rolled-up position: its launches are not flown
        flown = np.isfinite(positions).all(axis=1)
        counts = np.concatenate(
            [
                flown.reshape(n, sum(sizes))[:, start : start + size].sum(axis=1)[:, None]
                for start, size in zip(np.cumsum([0, *sizes[:-1]]), sizes, strict=True)
            ],
            axis=1,
        ).ravel()
        end = np.empty((int(counts.sum()), 7))
        outcome = np.empty(len(end), np.int8)
        event = np.repeat(np.arange(n), len(groups))
        start = np.concatenate([[0], np.cumsum(counts)])
        launches = np.ascontiguousarray(positions[flown]), np.ascontiguousarray(velocities[flown])
        counter = np.zeros(1, np.int64)

        def fly():
            while counter[0] < len(event):
                self._go.wait()
                flights = self._caught_up(record, number)
                flights.fly(batch.journal, event, start, *launches, end, outcome, counter, self._halt)

        helpers = [self._pool.submit(fly) for _ in range(self._n_helpers)]

        def wait():
            fly()
            for helper in helpers:
                helper.result()
            ends = np.full((len(flown), 7), np.nan)
            ends[flown] = end
            left = np.zeros(len(flown), bool)
            left[flown] = outcome == LEFT
            ends, left = ends.reshape(n, sum(sizes), 7), left.reshape(n, sum(sizes))
            edges = np.cumsum([0, *sizes])
            return [
                Ends(ends[:, a:b, :3], ends[:, a:b, 3:6], ends[:, a:b, 6], left[:, a:b]) for a, b in pairwise(edges)
            ]

        return wait

    def _caught_up(self, record, number):
        """Flights of the calling thread, after the events of all journals of the record before this number."""
        own = self._own
        if getattr(own, "record", None) is not record:
            own.flights, own.record, own.followed = Flights(record.tree, **self._options), record, 0
        while own.followed < number:
            own.flights.follow(record.journals[own.followed])
            own.followed += 1
        return own.flights
