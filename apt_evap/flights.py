"""Flights of a batch of ions, in parallel, each on a copy of the surface that replays the events."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from apt_evap._arrays import check_count, check_number
from apt_evap._core.flight import LEFT, Flights
from apt_evap.units import COULOMB, NM_PER_MM

_MOST_STEPS = 1_000_000  # flights take some tens


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
    most_steps : int
        Steps after which an ion counts as one that never left.
    """

    opening_angle: float = 0.3
    tolerance: float = 1e-3
    reach: float = 11314.0
    most_steps: int = 500

    def __post_init__(self):
        check_number(self.opening_angle, "opening_angle", at_least=0, at_most=1.0, unit="rad")
        check_number(self.tolerance, "tolerance", above=0, at_most=0.1)
        check_number(self.reach, "reach", at_least=100, unit="d_nn")
        check_count(self.most_steps, "most_steps", at_least=1, at_most=_MOST_STEPS)


def check_reach(settings, tip, detector):
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


class FlightCrew:
    """One `Flights` a thread, which take the ions of a batch from one counter.

    Parameters
    ----------
    tip : Tip
        The specimen.
    settings : FlightSettings
        How flights are integrated.
    n_threads : int
        Threads.
    """

    def __init__(self, tip, settings, n_threads):
        self._n_threads = n_threads
        self._workers = []
        self._options = {
            "coulomb": COULOMB,
            "length": tip.nearest_neighbour_distance,
            "centre": (0.0, 0.0, tip.apex),
            "reach": settings.reach * tip.nearest_neighbour_distance,
            "opening_angle": settings.opening_angle,
            "tolerance": settings.tolerance,
            "most_steps": settings.most_steps,
        }

    def start(self, batch, groups, pool):
        """Begin the flights of a batch.

        Parameters
        ----------
        batch : Batch
            Of n events, the one after that of the call before.
        groups : sequence of (ndarray, ndarray)
            Positions [nm] and velocities [sqrt(V)] of launches, each of shape (n, m, 3): m of every ion, which share
            their steps. NaN for an ion that is not flown.
        pool : ThreadPoolExecutor
            Of at least as many threads.

        Returns
        -------
        callable
            Waits, and gives for each group the positions, velocities and reduced times at the end (n, m, ...), NaN
            where there was no flight, and whether the ion left (n, m).
        """
        if batch.tree is not None:
            while len(self._workers) < self._n_threads:
                self._workers.append(Flights(batch.tree, **self._options))
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
        job = (
            batch.journal,
            np.repeat(np.arange(n), len(groups)),
            np.concatenate([[0], np.cumsum(counts)]),
            np.ascontiguousarray(positions[flown]),
            np.ascontiguousarray(velocities[flown]),
            end,
            outcome,
            np.zeros(1, np.int64),
        )

        def work(worker):
            if batch.tree is not None:
                worker.begin(batch.tree)
            else:
                worker.go_on()
            worker.fly(*job)

        futures = [pool.submit(work, worker) for worker in self._workers]

        def wait():
            for future in futures:
                future.result()
            ends = np.full((len(flown), 7), np.nan)
            ends[flown] = end
            left = np.zeros(len(flown), bool)
            left[flown] = outcome == LEFT
            ends, left = ends.reshape(n, sum(sizes), 7), left.reshape(n, sum(sizes))
            edges = np.cumsum([0, *sizes])
            return [(ends[:, a:b, :3], ends[:, a:b, 3:6], ends[:, a:b, 6], left[:, a:b]) for a, b in pairwise(edges)]

        return wait
