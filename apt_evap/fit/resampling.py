"""Resampled maps of a run, for the statistical errors from the noise of its ions.

Resamples with the full noise would have twice the noise of the maps, and favour other energies. So what they change is
taken to first order in the noise (infinitesimal jackknife of B. Efron, J. R. Statist. Soc. B 54, 83 (1992)): the
derivative of a score with respect to the counts of the bins, times the noise of each resample.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Outcome
from apt_evap.emission.perturbations import Perturbation
from apt_evap.maps.registration.register import Registration
from apt_evap.simulation.run import Run

GROUPS = 1 << 16
"""Largest number of ions with separate weights. Measured: with 256 groups of ions, errors were 20 % too large."""


@dataclass(frozen=True, eq=False, repr=False)
class DrawnMap:
    """Map of the draws of a run in the measured frame.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx)
        Hits per bin, summed over the draws.
    noise : ndarray or None, shape (ny, nx)
        Sum of the draws with weights of sum 0 and mean square 1: it has the same noise as the sum of the draws, but no
        signal. None for a single draw.
    cells, groups : ndarray of int, shape (n,)
        Bin of each hit, and the row of its ion in `weights`.
    weights : ndarray of float32, shape (groups, resamples)
        What each resample changes of the weight of an ion.
    """

    counts: Floats
    noise: Floats | None
    cells: Integers
    groups: Integers
    weights: np.ndarray

    def changes(self, gradient: Floats) -> Floats:
        """Change of a score in each resample, shape (resamples,), from its derivatives with respect to `counts`."""
        of_groups = np.bincount(self.groups, gradient.ravel()[self.cells], minlength=len(self.weights))
        return np.einsum("g,gr->r", of_groups, self.weights)


class Sampler:
    """Maps of a run in the measured frame, with resamples of its ions.

    A resample changes the weight of an ion, 1, by the deviation of a Poisson number of mean 1 from its mean. It is the
    same for all perturbations and draws of an ion: resamples are paired. With more than `GROUPS` ions, some ions have
    common weights.

    Parameters
    ----------
    run : Run
        The run.
    registration : Registration
        Transform of simulated hits into the measured frame.
    measured : DetectorMap
        Map with the edges of the bins.
    box : tuple of slice
        Rows and columns to keep.
    resamples : int
        Number of resamples.
    seed : int
        Seed of the draws.
    """

    def __init__(
        self,
        run: Run,
        registration: Registration,
        measured: DetectorMap,
        box: tuple[slice, ...],
        resamples: int,
        seed: Any,
    ) -> None:
        self.run, self.registration = run, registration
        random = np.random.default_rng(seed)
        self._edges = [
            edges[part.start : part.stop + 1]
            for edges, part in zip((measured.y_edges, measured.x_edges), box, strict=True)
        ]
        self.shape = tuple(len(edges) - 1 for edges in self._edges)
        self._groups = random.permutation(len(run)) % GROUPS
        shape = self._groups.max() + 1, resamples
        self._weights = (random.poisson(1.0, shape) - 1).astype(np.float32)

    def map(self, perturbation: Perturbation, number: int) -> DrawnMap:
        """Hits per bin of all ions.

        Parameters
        ----------
        perturbation : perturbation
            Perturbation of the ions.
        number : int
            Number of draws per ion, which are summed.

        Returns
        -------
        DrawnMap
        """
        size = int(np.prod(self.shape))
        draws = [self._cells(perturbation, draw) for draw in range(number)]
        noise = None
        if number > 1:
            weights = np.linspace(-1, 1, number)
            weights /= np.sqrt((weights**2).mean())
            counts = (np.bincount(cells, minlength=size) for cells, _ in draws)
            noise = sum(w * count for w, count in zip(weights, counts, strict=True)).reshape(self.shape)
        cells, ions = (np.concatenate(parts) for parts in zip(*draws, strict=True))
        counts = np.bincount(cells, minlength=size).reshape(self.shape).astype(float)
        return DrawnMap(counts, noise, cells, self._groups[ions], self._weights)

    def _cells(self, perturbation, draw):
        """Bins and indices of the ions within the box."""
        x, y, detected = places_of_draw(self.run, perturbation, draw)
        index = []
        for values, edges in zip(reversed(self.registration.points(x, y)), self._edges, strict=True):
            number = len(edges) - 1
            place = (values - edges[0]) * (number / (edges[-1] - edges[0]))
            detected &= (place >= 0) & (place < number)
            index.append(place)
        inside = np.flatnonzero(detected)
        row, column = (place[inside].astype(np.int64) for place in index)
        return row * self.shape[1] + column, inside


def places_of_draw(run: Run, perturbation: Perturbation, draw: int) -> tuple[Floats, Floats, Booleans]:
    """Positions x, y [mm] of all ions for one draw of their energies and directions, and whether they are detected.

    Draw 0 is that of the run.
    """
    if draw:  # derived, because an adjacent seed may be that of another run
        seed = np.random.SeedSequence((run.seed, draw)).generate_state(1, np.uint64)[0]
        run = replace(run, seed=int(seed))
    # flights of the run used its own seed
    x, y, outcome = run.places(perturbation, by_response=bool(draw))
    return x, y, outcome == Outcome.HIT
