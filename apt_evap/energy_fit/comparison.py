"""Similarity of simulated maps with a measured one, with the noise of both taken into account.

What is compared is what `DetectorMap.flattened` and `ssim` give, of stacks of maps. The broad density that a stack is
flattened by is that of its first map, of which the others are resamples.

Noise is variance, which the structural similarity takes for contrast: with variances s² of signals and n² of noise, a
simulated signal of c times the contrast has a similarity near 2 c s² / (c² s² + s² + n²), which is greatest for c > 1.
With the variance of the noise, which is known, in the numerator too, it is greatest, and 1, for c = 1; and nothing is
divided by a small difference. In a twin experiment (Ni[111], R = 40 a, 150,000 simulated and 200,000 measured ions
under lateral energies of 0.3 eV, σ/mean 0.316; 20 pairs of draws, 128 bins, 16 draws an ion) the best σ/mean was 0.1 or
less in 19 of 20 without it, smoothed by a bin, and in all 20 smoothed by half of one. With it, it was 0.316 in all 20
either way, and half a bin told it from 0.1 by seven standard deviations instead of three.
"""

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.analysis.similarity import WINDOW, local_moments, local_similarity, window_fits, window_mean
from apt_evap.detection.detector_map import DetectorMap, blurred
from apt_evap.energy_fit.resampling import NOISE
from apt_evap.energy_fit.settings import StudySettings

NOISE_MAPS = 50
"""Least number of maps that the variance of the measured noise is taken from: to 20 % in a bin, less in a window."""


class Comparison:
    """Structural similarity with one measured map, resampled where it holds counts.

    Parameters
    ----------
    measured : DetectorMap
        The measured map; its mask is the region compared.
    settings : StudySettings
        How maps are compared, and how many resamples are drawn.

    Raises
    ------
    ValueError
        If no window fits into the mask, or the settings leave the flattening open.
    """

    def __init__(self, measured: DetectorMap, settings: StudySettings) -> None:
        if settings.flattening is None:
            raise ValueError("settings must have a flattening to compare maps with, got None")
        inside = window_fits(measured.mask)
        if not inside.any():
            raise ValueError(
                f"the region that both maps show must hold a window of {2 * WINDOW + 1} bins, it has "
                f"{np.count_nonzero(measured.mask)} bins"
            )
        rows, columns = (np.flatnonzero(measured.mask.any(axis=axis)) for axis in (1, 0))
        self.settings = settings
        self.box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        self.mask, self.inside = measured.mask[self.box], inside[self.box]
        sizes = np.array(measured.bin_size[::-1])
        self._smoothing, self._flattening = settings.smoothing / sizes, settings.flattening / sizes
        values = measured.values[self.box]
        self.measured = values[None].astype(float)
        self.measured_noise: Floats | float = 0.0
        """Variance of the measured noise in a window, shape (ny, nx)."""
        if measured.is_counts:
            number = max(settings.resamples, NOISE_MAPS) if settings.allow_noise else settings.resamples
            random = np.random.default_rng((settings.seed, 0))
            noise = random.poisson(values, (number, *values.shape)) - values
            if settings.allow_noise:
                self.measured_noise = self.variance_of(noise, self.measured)
            self.measured = np.concatenate([self.measured, values + NOISE * noise[: settings.resamples]])
        self._measured = local_moments(self.densities(self.measured))

    def densities(self, maps: Floats) -> Floats:
        """Densities as they are compared: flattened, smoothed, relative to their mean; shape (k, ny, nx)."""
        maps = self._smoothed(maps)
        mean = maps[:, self.mask].mean(axis=1)[:, None, None]
        return np.where(self.mask, np.divide(maps, mean, out=np.zeros_like(maps), where=mean > 0), 1.0)

    def variance_of(self, noise: Floats, map: Floats) -> Floats:
        """Variance in a window that noise, shape (k, ny, nx), gives the densities of a map, shape (1, ny, nx)."""
        first, *smoothed = self._smoothed(np.concatenate([map, noise]))
        mean = first[self.mask].mean()
        densities = np.divide(smoothed, mean, out=np.zeros_like(smoothed), where=mean > 0)
        return (window_mean(densities**2) - window_mean(densities) ** 2).mean(axis=0)

    def _smoothed(self, maps):
        maps = np.where(self.mask, maps, 0.0)
        if self._flattening.any():
            broad = blurred(maps[:1], self.mask, self._flattening)
            maps = np.divide(maps, broad, out=np.zeros_like(maps), where=broad > 0)
        return blurred(maps, self.mask, self._smoothing) if self._smoothing.any() else maps

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
        if self.settings.allow_noise and not plain:
            allowed = self.measured_noise + (0.0 if noise is None else self.variance_of(noise[None], maps[:1]))
        values = self._mean_similarity(local_moments(self.densities(maps)), self._measured, allowed)
        if len(values) > 1:
            values[1:] = values[0] + (values[1:] - values[1:].mean()) / NOISE
        return values

    def ceiling(self, divisions: int, seed: tuple[int, int]) -> Floats:
        """Similarities of the random halves of the measured counts, noise and all, shape (divisions,)."""
        random = np.random.default_rng(seed)
        counts = self.measured[0].astype(np.int64)
        half = random.binomial(counts, 0.5, (divisions, *counts.shape)).astype(float)
        first, second = (local_moments(self.densities(part)) for part in (half, counts - half))
        return self._mean_similarity(first, second)

    def _mean_similarity(self, first, second, noise=0.0):
        local = local_similarity(first, second, self.settings.data_range, noise)
        return local[:, self.inside].mean(axis=1)
