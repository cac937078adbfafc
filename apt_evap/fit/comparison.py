"""Noise-corrected similarity of simulated maps with a measured one.

The comparison equals that of `DetectorMap.flattened` and `similarity`, for stacks of maps. A stack is flattened by the
broad density of its first map; the other maps are resamples of the first.

Noise adds variance, which the structural similarity interprets as contrast. With variances s² of the signals and n² of
the noise, a simulated signal with c times the contrast has a similarity of about 2 c s² / (c² s² + s² + n²), with its
maximum at c > 1. The variance of the noise is known. If it is added to the numerator too, the maximum is 1 at c = 1,
and no division by a small difference is needed.

Measured in a twin experiment (Ni[111], R = 40 a, 150,000 simulated and 200,000 measured ions with lateral energies of
0.3 eV, σ/mean 0.316; 20 pairs of draws, 128 bins, 16 draws per ion): without the correction the best σ/mean was 0.1 or
less in 19 of 20 pairs with smoothing by one bin, and in all 20 with smoothing by half a bin. With the correction it was
0.316 in all 20 pairs for both. The difference to 0.1 was seven standard deviations with half a bin, and three with one.
"""

import numpy as np
import scipy

from apt_evap._common.types import Floats, Integers
from apt_evap.detection.detector_map import DetectorMap, check_sigma, masked_gaussian
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.resampling import NOISE
from apt_evap.maps.similarity import WINDOW, local_moments, local_similarity, window_fits, window_mean

_FEWEST_CELLS = 50
NOISE_MAPS = 50
"""Smallest number of maps for the variance of the measured noise: error 20 % in a bin, less in a window."""


class Comparison:
    """Structural similarity with a measured map, with resamples if it contains counts.

    Parameters
    ----------
    measured : DetectorMap
        The measured map; its mask is the compared region.
    settings : FitSettings
        Settings of the comparison, and number of resamples.

    Raises
    ------
    ValueError
        If the mask contains no window, or the flattening is not set, or a width is larger than the map.
    """

    def __init__(self, measured: DetectorMap, settings: FitSettings) -> None:
        if settings.flattening is None or settings.smoothing is None:
            raise ValueError("settings must have a smoothing and a flattening, got None")
        for name in ("smoothing", "flattening"):
            check_sigma(getattr(settings, name), name, measured)
        inside = window_fits(measured.mask)
        if not inside.any():
            raise ValueError(
                f"the common region of both maps must contain a window of {2 * WINDOW + 1} bins, got a region of "
                f"{np.count_nonzero(measured.mask)} bins"
            )
        self.settings = settings
        self.box = _box(measured.mask)
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
        self._measured = self._moments(self.densities(self.measured))

    def densities(self, maps: Floats) -> Floats:
        """Densities for the comparison: flattened, smoothed, relative to their mean; shape (k, ny, nx)."""
        maps = self._smoothed(maps)
        mean = maps[:, self.mask].mean(axis=1)[:, None, None]
        return np.where(self.mask, np.divide(maps, mean, out=np.zeros_like(maps), where=mean > 0), 1.0)

    def variance_of(self, noise: Floats, map: Floats) -> Floats:
        """Variance in a window from noise, shape (k, ny, nx), in the densities of a map, shape (1, ny, nx)."""
        first, *smoothed = self._smoothed(np.concatenate([map, noise]))
        mean = first[self.mask].mean()
        densities = np.divide(smoothed, mean, out=np.zeros_like(smoothed), where=mean > 0)
        return self._variance(densities).mean(axis=0)

    def _variance(self, densities):
        return window_mean(densities**2) - window_mean(densities) ** 2

    def _moments(self, densities):
        return local_moments(densities)

    def _smoothed(self, maps):
        maps = np.where(self.mask, maps, 0.0)
        if self._flattening.any():
            broad = masked_gaussian(maps[:1], self.mask, self._flattening)
            maps = np.divide(maps, broad, out=np.zeros_like(maps), where=broad > 0)
        return masked_gaussian(maps, self.mask, self._smoothing) if self._smoothing.any() else maps

    def similarities(self, maps: Floats, noise: Floats | None = None, *, plain: bool = False) -> Floats:
        """Similarities of a map of the box and of its resamples with the measured map and its resamples, shape (k,).

        The similarities of the resamples are scaled to the full noise of the ions, with the first one as their mean.

        Parameters
        ----------
        maps, noise : ndarray
            Result of `Sampler.maps`.
        plain : bool
            Whether to omit the noise correction.
        """
        correction = 0.0
        if self.settings.allow_noise and not plain:
            correction = self.measured_noise + (0.0 if noise is None else self.variance_of(noise[None], maps[:1]))
        values = self._mean_similarity(self._moments(self.densities(maps)), self._measured, correction)
        if len(values) > 1:
            values[1:] = values[0] + (values[1:] - values[1:].mean()) / NOISE
        return values

    def ceiling(self, divisions: int, seed: tuple[int, int]) -> Floats:
        """Uncorrected similarities of random halves of the measured counts, shape (divisions,)."""
        random = np.random.default_rng(seed)
        counts = self.measured[0].astype(np.int64)
        half = random.binomial(counts, 0.5, (divisions, *counts.shape)).astype(float)
        first, second = (self._moments(self.densities(part)) for part in (half, counts - half))
        return self._mean_similarity(first, second)

    def _mean_similarity(self, first, second, noise=0.0):
        local = local_similarity(first, second, self.settings.data_range, noise)
        return local[:, self.inside].mean(axis=1)


class FoldedComparison(Comparison):
    """Concordance of maps that are folded about a pole.

    With the folded densities x and y, their covariance and variances over all cells, and the noise variances ν, it is

    2 cov(x, y) + ν_x + ν_y over var x + var y,

    the correlation times 2 / (σ_x/σ_y + σ_y/σ_x): 1 for the same lines with the same contrast, 0 for none, negative
    for lines of the other sign (Lin, Biometrics 45, 255 (1989); the form of the noise correction is that of the
    similarity). Lines of the measured contrast are best wherever they are, so blurring is not rewarded.

    Parameters
    ----------
    measured, settings
        As for `Comparison`.
    cells : ndarray of int
        Result of `symmetric_cells` for the measured map.

    Raises
    ------
    ValueError
        As for `Comparison`, or if fewer than 50 cells are on the map.
    """

    def __init__(self, measured: DetectorMap, settings: FitSettings, cells: Integers) -> None:
        labels = cells[_box(measured.mask)].ravel()
        bins = np.flatnonzero(labels >= 0)
        _, number, counts = np.unique(labels[bins], return_inverse=True, return_counts=True)
        if len(counts) < _FEWEST_CELLS:
            raise ValueError(f"a folded comparison needs {_FEWEST_CELLS} cells about the pole, got {len(counts)}")
        self._weights = counts / counts.sum()
        self._fold = scipy.sparse.csr_array((1 / counts[number], (number, bins)), (len(counts), len(labels)))
        super().__init__(measured, settings)

    def _moments(self, densities):
        """Folded densities less their mean, shape (cells, k), and their variances."""
        folded = self._fold @ densities.reshape(len(densities), -1).T
        folded -= self._weights @ folded
        return folded, self._weights @ folded**2

    def _variance(self, densities):
        return self._moments(densities)[1]

    def _mean_similarity(self, first, second, noise=0.0):
        (x, first_values), (y, other) = first, second
        return (2 * self._weights @ (x * y) + noise) / (first_values + other)


def _box(mask):
    """Rows and columns of the mask."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
