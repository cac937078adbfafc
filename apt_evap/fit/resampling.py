"""Resampled maps of a run, for the statistical errors from the noise of its ions.

Resamples with the full noise would have twice the noise of the maps, and favour other energies. So they have a tenth of
the noise, and their deviations are multiplied by ten: first order in the noise (infinitesimal jackknife of B. Efron,
J. R. Statist. Soc. B 54, 83 (1992)).
"""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Perturbation
from apt_evap.maps.registration.register import Registration
from apt_evap.simulation.run import Run

NOISE = 0.1
"""Noise of a resample, relative to that of the ions."""
GROUPS = 1 << 16
"""Largest number of ions with separate weights. Measured: with 256 groups of ions, errors were 20 % too large."""


class Sampler:
    """Maps of a run in the measured frame, for all its ions and for resamples of them.

    In a resample the weight of an ion is 1 plus a tenth of the deviation of a Poisson number of mean 1 from its mean.
    The weight is the same for all perturbations and draws of an ion: resamples are paired. With more than `GROUPS`
    ions, some ions have common weights.

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
        self.run, self.registration, self.resamples = run, registration, resamples
        random = np.random.default_rng(seed)
        self._edges = [
            edges[part.start : part.stop + 1]
            for edges, part in zip((measured.y_edges, measured.x_edges), box, strict=True)
        ]
        self.shape = tuple(len(edges) - 1 for edges in self._edges)
        self._groups = random.permutation(len(run)) % GROUPS
        shape = self._groups.max() + 1, resamples
        weights = 1 + NOISE * (random.poisson(1.0, shape) - 1)
        self._weights = np.concatenate([np.ones((shape[0], 1)), weights], axis=1, dtype=np.float32)

    def maps(self, perturbation: Perturbation, number: int) -> tuple[Floats, Floats | None]:
        """Hits per bin of all ions and of each resample, and the noise of the draws.

        Parameters
        ----------
        perturbation : perturbation
            Perturbation of the ions.
        number : int
            Number of draws per ion, which are summed.

        Returns
        -------
        maps : ndarray
            Shape (1 + resamples, ny, nx).
        noise : ndarray or None
            Sum of the draws with weights of sum 0 and mean square 1: it has the same noise as the sum of the draws, but
            no signal; shape (ny, nx). None for a single draw.
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
        if not self.resamples:
            return np.bincount(cells, minlength=size).reshape(1, *self.shape).astype(float), noise
        ones = np.ones(len(cells), np.float32)
        table = scipy.sparse.coo_array((ones, (cells, self._groups[ions])), (size, len(self._weights))).tocsr()
        return (table @ self._weights).T.reshape(-1, *self.shape).astype(float), noise

    def _cells(self, perturbation, draw):
        """Bins and indices of the ions within the box."""
        hits = self.registration.hits(hits_of_draw(self.run, perturbation, draw))
        detected = hits.detected
        index = []
        for values, edges in zip((hits.y, hits.x), self._edges, strict=True):
            number = len(edges) - 1
            place = (values - edges[0]) * (number / (edges[-1] - edges[0]))
            detected &= (place >= 0) & (place < number)
            index.append(place)
        inside = np.flatnonzero(detected)
        row, column = (place[inside].astype(np.int64) for place in index)
        return row * self.shape[1] + column, inside


def hits_of_draw(run: Run, perturbation: Perturbation, draw: int) -> Hits:
    """Hits for one draw of the energies and directions of all ions; draw 0 is that of the run."""
    if draw:  # derived, because an adjacent seed may be that of another run
        seed = np.random.SeedSequence((run.seed, draw)).generate_state(1, np.uint64)[0]
        run = replace(run, seed=int(seed))
    # flights of the run used its own seed
    return run.hits(perturbation, by_response=bool(draw))
