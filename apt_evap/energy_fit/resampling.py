"""Maps drawn again and again as their noise would have it, and how alike they are.

What is compared is what `DetectorMap.flattened` and `ssim` give, of stacks of maps. The broad density that a stack is
flattened by is that of its first map, of which the others are resamples.

Noise is variance, which the structural similarity takes for contrast: with variances s² of signals and n² of noise, a
simulated signal of c times the contrast has a similarity near 2 c s² / (c² s² + s² + n²), which is greatest for c > 1.
With the variance of the noise, which is known, in the numerator too, it is greatest, and 1, for c = 1; and nothing is
divided by a small difference. In a twin experiment (Ni[111], R = 40 a, 150,000 simulated and 200,000 measured ions
under lateral energies of 0.3 eV, σ/mean 0.316; 20 pairs of draws, 128 bins, 16 draws an ion) the best σ/mean was 0.1 or
less in 19 of 20 without it, smoothed by a bin, and in all 20 smoothed by half of one. With it, it was 0.316 in all 20
either way, and half a bin told it from 0.1 by seven standard deviations instead of three.

Maps with all their noise once more on top would again be drawn to other energies. So resamples have a tenth of it, and
their deviations count tenfold: the first order in the noise (the infinitesimal jackknife of B. Efron, J. R. Statist.
Soc. B 54, 83 (1992)).
"""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy
import skimage

from apt_evap._common.types import Floats
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Perturbation
from apt_evap.registration.register import Registration
from apt_evap.simulation.run import Run

WINDOW = 5  # as in `ssim`: half width of the window [bins]
NOISE = 0.1
"""Noise of a resample, over that of the ions."""
NOISE_MAPS = 50
"""Least number of maps that the variance of the measured noise is taken from: to 20 % in a bin, less in a window."""
GROUPS = 1 << 16
"""Most ions that are resampled one by one. With 256 groups of ions, errors of similarities came out 20 % too large."""


class Comparison:
    """Structural similarity with one measured map, resampled where it holds counts.

    Parameters
    ----------
    measured : DetectorMap
        The measured map; its mask is the region compared.
    smoothing, flattening : float
        Standard deviations of the Gaussians that both maps are smoothed with and flattened by [mm]; 0 for none.
    data_range : float
        As for `ssim`.
    resamples : int
        Number of maps drawn for its noise, besides the map itself.
    seed : int
        Seed of the draws.
    allow_noise : bool
        Whether noise counts as alike: that of Poisson of measured counts, that of the draws of simulated ions.

    Raises
    ------
    ValueError
        If no window fits into the mask.
    """

    def __init__(
        self,
        measured: DetectorMap,
        smoothing: float,
        flattening: float,
        data_range: float,
        resamples: int,
        seed: Any,
        allow_noise: bool = True,
    ) -> None:
        inside = scipy.ndimage.binary_erosion(measured.mask, skimage.morphology.disk(WINDOW))
        if not inside.any():
            raise ValueError(
                f"the region that both maps show must hold a window of {2 * WINDOW + 1} bins, it has "
                f"{np.count_nonzero(measured.mask)} bins"
            )
        rows, columns = (np.flatnonzero(measured.mask.any(axis=axis)) for axis in (1, 0))
        self.box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        self.mask, self.inside = measured.mask[self.box], inside[self.box]
        self.c1, self.c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
        sizes = np.array(measured.bin_size[::-1])
        self._smoothing, self._flattening = smoothing / sizes, flattening / sizes
        values = measured.values[self.box]
        self.measured = values[None].astype(float)
        self.allow_noise, self._noise = allow_noise, 0.0
        if measured.is_counts:
            number = max(resamples, NOISE_MAPS) if allow_noise else resamples
            drawn = np.random.default_rng(seed).poisson(values, (number, *values.shape)) - values
            if allow_noise:
                self._noise = self._variance(self.measured, drawn)
            self.measured = np.concatenate([self.measured, values + NOISE * drawn[:resamples]])
        self._measured = self._moments(self.densities(self.measured))

    def densities(self, maps: Any) -> Floats:
        """Densities as they are compared: flattened, smoothed, relative to their mean; shape (k, ny, nx)."""
        maps = self._smoothed(maps)
        mean = maps[:, self.mask].mean(axis=1)[:, None, None]
        return np.where(self.mask, np.divide(maps, mean, out=np.zeros_like(maps), where=mean > 0), 1.0)

    def _smoothed(self, maps):
        maps = np.where(self.mask, maps, 0.0)
        if self._flattening.any():
            broad = self._blurred(maps[:1], self._flattening)
            maps = np.divide(maps, broad, out=np.zeros_like(maps), where=broad > 0)
        return self._blurred(maps, self._smoothing) if self._smoothing.any() else maps

    def _variance(self, map, noise):
        """Variance in a window that noise of shape (k, ny, nx) gives the densities of a map, shape (ny, nx)."""
        first, *noise = self._smoothed(np.concatenate([map, noise]))
        mean = first[self.mask].mean()
        noise = np.divide(noise, mean, out=np.zeros_like(noise), where=mean > 0)
        return (_window(noise**2) - _window(noise) ** 2).mean(axis=0)

    def _blurred(self, maps, sigmas):
        """Gaussian that sees only the inside of the mask, as in `DetectorMap.smoothed`."""
        weight = _filtered(self.mask.astype(float), sigmas)
        return np.divide(_filtered(maps, sigmas), weight, out=np.zeros_like(maps), where=self.mask)

    def similarities(self, maps: Floats, noise: Floats | None = None, *, plain: bool = False) -> Floats:
        """Similarity of a map of the box with the measured one, and of its resamples one by one, shape (k,).

        Those of the resamples have the noise of all ions, and the mean of the first.

        Parameters
        ----------
        maps, noise : ndarray
            What `Sampler.maps` gives.
        plain : bool
            Whether to count noise as unlike all the same.
        """
        allowed = 0.0
        if self.allow_noise and not plain:
            allowed = self._noise + (0.0 if noise is None else self._variance(maps[:1], noise[None]))
        values = self._similarities(self._moments(self.densities(maps)), self._measured, allowed)
        if len(values) > 1:
            values[1:] = values[0] + (values[1:] - values[1:].mean()) / NOISE
        return values

    def ceiling(self, divisions: int, seed: Any) -> Floats:
        """Similarities of the random halves of the measured counts, noise and all, shape (divisions,)."""
        random = np.random.default_rng(seed)
        counts = self.measured[0].astype(np.int64)
        halves = random.binomial(counts, 0.5, (divisions, *counts.shape))
        return self._similarities(*(self._moments(self.densities(part)) for part in (halves, counts - halves)))

    def _moments(self, densities):
        mean = _window(densities)
        return densities, mean, _window(densities**2) - mean**2

    def _similarities(self, first, second, noise=0.0):
        (a, mean_a, var_a), (b, mean_b, var_b) = first, second
        product = mean_a * mean_b
        both = _window(a * b) - product
        local = (2 * product + self.c1) * (2 * both + noise + self.c2)
        local /= (mean_a**2 + mean_b**2 + self.c1) * (var_a + var_b + self.c2)
        return local[:, self.inside].mean(axis=1)


class Sampler:
    """Maps of one run in the measured frame, of all its ions and of resamples of them.

    In a resample every ion has a weight of 1 and a tenth of the noise of a Poisson distribution of mean 1. All
    perturbations and all replicas of an ion share it: resamples are paired. Of more than `GROUPS` ions, some share it.

    Parameters
    ----------
    run : Run
        The run.
    registration : Registration
        Carries simulated hits into the measured frame.
    measured : DetectorMap
        Its edges are those of the maps.
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

    def maps(self, perturbation: Perturbation, replicas: int) -> tuple[Floats, Floats | None]:
        """Hits per bin of all ions and of each resample, and how the draws differ.

        Parameters
        ----------
        perturbation : perturbation
            How the ions start.
        replicas : int
            Draws of every ion, added up.

        Returns
        -------
        maps : ndarray
            Shape (1 + resamples, ny, nx).
        noise : ndarray or None
            Sum of the draws with weights of sum 0 and mean square 1: as much noise of the draws as in their sum, and no
            signal; shape (ny, nx). None for a single draw.
        """
        size = int(np.prod(self.shape))
        binned = [self._cells(perturbation, replica) for replica in range(replicas)]
        noise = None
        if replicas > 1:
            weights = np.linspace(-1, 1, replicas)
            weights /= np.sqrt((weights**2).mean())
            counts = (np.bincount(cells, minlength=size) for cells, _ in binned)
            noise = sum(w * count for w, count in zip(weights, counts, strict=True)).reshape(self.shape)
        cells, ions = (np.concatenate(parts) for parts in zip(*binned, strict=True))
        if not self.resamples:
            return np.bincount(cells, minlength=size).reshape(1, *self.shape).astype(float), noise
        ones = np.ones(len(cells), np.float32)
        table = scipy.sparse.coo_array((ones, (cells, self._groups[ions])), (size, len(self._weights))).tocsr()
        return (table @ self._weights).T.reshape(-1, *self.shape).astype(float), noise

    def _cells(self, perturbation, replica):
        """Bin of each ion that lies in the box, and which ions these are."""
        hits = self.registration.hits(drawn_hits(self.run, perturbation, replica))
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


def drawn_hits(run: Run, perturbation: Perturbation, replica: int) -> Hits:
    """Hits of one draw of the energies and directions of all ions; draw 0 is that of the run itself."""
    if replica:  # a seed next to that of the run may be that of another run
        seed = np.random.SeedSequence((run.seed, replica)).generate_state(1, np.uint64)[0]
        run = replace(run, seed=int(seed))
    # what was flown in the run was flown with its own seed
    return run.hits(perturbation, by_response=bool(replica))


def _filtered(maps, sigmas, truncate=4.0):
    """Gaussian along the last two axes, with nothing beyond the ends."""
    return scipy.ndimage.gaussian_filter(maps, sigmas, mode="constant", truncate=truncate, axes=(-2, -1))


def _window(maps):
    """Mean in the window of `ssim`."""
    return _filtered(maps, 1.5, truncate=3.5)
