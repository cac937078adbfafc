"""Structural similarity of two detector maps, and of two halves of one map, which is limited by its noise."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
import skimage

from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_kind, check_number, check_seed
from apt_evap.detection.detector_map import DetectorMap, gaussian
from apt_evap.detection.hits import Hits

SIGMA, TRUNCATE = 1.5, 3.5
"""Standard deviation of the Gaussian window [bins], and its cutoff in standard deviations."""
WINDOW = int(SIGMA * TRUNCATE + 0.5)
"""Half width of the window [bins]."""


class Moments(NamedTuple):
    """Densities, with mean and variance in the window around every bin, all of shape (..., ny, nx)."""

    density: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


def window_mean(values: Floats) -> Floats:
    """Mean in the window around every bin, for maps of shape (..., ny, nx)."""
    return gaussian(values, SIGMA, TRUNCATE)


def window_fits(mask: Booleans) -> Booleans:
    """Whether the disc of radius `WINDOW` around each bin is inside a mask, bool of shape (ny, nx)."""
    step = np.arange(-WINDOW, WINDOW + 1)
    return scipy.ndimage.binary_erosion(mask, step[:, None] ** 2 + step**2 <= WINDOW**2)


def local_moments(density: Floats) -> Moments:
    """`Moments` of densities, shape (..., ny, nx)."""
    mean = window_mean(density)
    return Moments(density, mean, window_mean(density**2) - mean**2)


def local_similarity(first: Moments, second: Moments, data_range: float, noise: float | Floats) -> Floats:
    r"""Structural similarity in the window around every bin, corrected for noise, of maps or of stacks of maps.

    Parameters
    ----------
    first, second : Moments
        Moments of two maps, or of two stacks of maps, compared in pairs.
    data_range : float
        Range L of the densities.
    noise : float or ndarray
        Sum of the noise variances of both maps, which counts as common structure, shape (ny, nx); 0 for none.

    Returns
    -------
    ndarray
        Shape (..., ny, nx); meaningful where `window_fits` is True.

    Notes
    -----
    With means μ, variances σ^2 and the covariance σ_xy in the window, and the noise ν,

    .. math:: \frac{2 μ_x μ_y + C_1}{μ_x^2 + μ_y^2 + C_1} \; \frac{2 σ_{xy} + ν + C_2}{σ_x^2 + σ_y^2 + C_2}

    where C_1 = (0.01 L)^2 and C_2 = (0.03 L)^2 (Wang, Bovik, Sheikh and Simoncelli, IEEE Trans. Image Process. 13, 600
    (2004), equation 13, for which ν = 0).
    """
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    product = first.mean * second.mean
    covariance = window_mean(first.density * second.density) - product
    local = (2 * product + c1) * (2 * covariance + noise + c2)
    return local / ((first.mean**2 + second.mean**2 + c1) * (first.variance + second.variance + c2))


def similarity_gradients(
    first: Moments, second: Moments, data_range: float, noise: float | Floats, weights: Floats
) -> tuple[Floats, Floats]:
    """Derivatives (ny, nx) of a weighted sum of `local_similarity` with respect to the densities of either map."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    product = first.mean * second.mean
    covariance = window_mean(first.density * second.density) - product
    means, structure = 2 * product + c1, 2 * covariance + noise + c2
    squares = first.mean**2 + second.mean**2 + c1
    variances = first.variance + second.variance + c2
    # with respect to the window means of x y and of x^2, and to the means themselves; a window is symmetric
    by_product = weights * 2 * means / (squares * variances)
    by_square = -weights * means * structure / (squares * variances**2)
    of_product, of_square = window_mean(by_product), window_mean(by_square)
    by_means = weights * 2 * structure / (squares * variances) - by_product
    by_own = -weights * 2 * means * structure / (squares**2 * variances) - 2 * by_square

    def gradient(own, other):
        by_mean = window_mean(by_means * other.mean + by_own * own.mean)
        return by_mean + 2 * own.density * of_square + other.density * of_product

    return gradient(first, second), gradient(second, first)


@dataclass(frozen=True, eq=False, repr=False)
class Similarity(float):
    """Structural similarity of two maps, a float with the parameters of the comparison.

    Parameters
    ----------
    value : float
        Mean of the local similarity over all windows within the common mask; 1 for equal maps.
    local : ndarray
        Local similarity, NaN where the window is not within the common mask, shape (ny, nx).
    bins : tuple of int
        Number of bins in x and y.
    bin_size : tuple of float
        Width and height of a bin [mm].
    smoothing : float
        Standard deviation of the Gaussian smoothing of both maps [mm].
    data_range : float
        Range L of densities (relative to their mean) in the constants (0.01 L)^2 and (0.03 L)^2.
    inside : int
        Number of bins with a window within the common mask.
    """

    value: float
    local: np.ndarray
    bins: tuple
    bin_size: tuple
    smoothing: float
    data_range: float
    inside: int

    def __new__(cls, value: float, *parameters: Any, **named: Any) -> "Similarity":  # noqa: D102
        return super().__new__(cls, value)

    def __repr__(self) -> str:
        return (
            f"<Similarity: {self.value:.4f}, {self.bins[0]} x {self.bins[1]} bins of "
            f"{self.bin_size[0]:.4g} x {self.bin_size[1]:.4g} mm ({self.inside:,} of them compared), "
            f"smoothed by {self.smoothing:g} mm, data range {self.data_range:g}>"
        )


def similarity(
    map_a: DetectorMap, map_b: DetectorMap, *, smoothing: float = 0.0, data_range: float = 2.0
) -> Similarity:
    """Structural similarity of two maps on the same bins.

    Both maps are smoothed, normalised to densities relative to their mean in the common mask, and compared in all
    windows within the mask. Windows across the rim would contain the same edge in both maps: measured, this raised the
    similarity of two noisy halves of a measured map from 0.05 to 0.10.

    Parameters
    ----------
    map_a, map_b : DetectorMap
        Maps with equal edges (``like=`` of `DetectorMap.from_hits` uses the bins of another map).
    smoothing : float
        Standard deviation of a Gaussian [mm]; noise reduces the similarity of unsmoothed maps.
    data_range : float
        Range of densities, relative to their mean, in the constants of the similarity. It is fixed, not taken from the
        data, so that values of different pairs can be compared.

    Returns
    -------
    Similarity

    Raises
    ------
    ValueError
        If the bins differ, if there are fewer than 11 along a side, or if the common mask is too small.

    Notes
    -----
    Wang, Bovik, Sheikh and Simoncelli, IEEE Trans. Image Process. 13, 600 (2004): Gaussian windows of
    1.5 bins, K1 = 0.01, K2 = 0.03, computed by ``skimage.metrics.structural_similarity``.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1)), seed=1).run(300)
    >>> first = run.hits(ae.RollUp(0.2)).map(bins=40)
    >>> for energy in (0.2, 0.3, 0.5):
    ...     second = run.hits(ae.RollUp(energy)).map(bins=40)
    ...     print(f"{energy} eV: {ae.similarity(first, second, smoothing=5.0):.2f}")
    0.2 eV: 1.00
    0.3 eV: 0.95
    0.5 eV: 0.86
    """
    smoothing = check_number(smoothing, "smoothing", at_least=0, unit="mm")
    data_range = check_number(data_range, "data_range", above=0)
    for name, value in (("map_a", map_a), ("map_b", map_b)):
        check_kind(value, name, DetectorMap, "a DetectorMap")
    _check_bins(map_a, map_b)
    common = map_a.mask & map_b.mask
    inside = window_fits(common)
    if not inside.any():
        raise ValueError(
            f"the common mask of the two maps must contain a window of {2 * WINDOW + 1} bins, got "
            f"{np.count_nonzero(common)} common bins"
        )
    densities = (
        np.where(common, replace(smooth, mask=common).density, 1.0)
        for smooth in (map_a.smoothed(smoothing), map_b.smoothed(smoothing))
    )
    # its window ends at 3.5 sigma, as TRUNCATE
    _, local = skimage.metrics.structural_similarity(
        *densities, data_range=data_range, gaussian_weights=True, sigma=SIGMA, use_sample_covariance=False, full=True
    )
    return Similarity(
        value=float(local[inside].mean()),
        local=np.where(inside, local, np.nan),
        bins=common.shape[::-1],
        bin_size=map_a.bin_size,
        smoothing=smoothing,
        data_range=data_range,
        inside=int(inside.sum()),
    )


def similarity_ceiling(
    hits: Hits | DetectorMap, *, smoothing: float = 0.0, data_range: float = 2.0, seed: int = 0, **options: Any
) -> Similarity:
    """Structural similarity of two random halves of a measurement: a measure of its noise.

    Each ion belongs to either half with equal probability. The halves are noisier than the complete measurement. So a
    good simulation, which may also have more ions, can be more similar to the complete measurement than the halves to
    each other.

    Parameters
    ----------
    hits : Hits or DetectorMap
        The measurement; a map must be one of counts.
    smoothing, data_range : float
        As for `similarity`.
    seed : int
        Seed of the random halves.
    **options
        Passed to `DetectorMap.from_hits`, such as ``bins``, ``extent`` or ``like``.

    Returns
    -------
    Similarity

    Raises
    ------
    ValueError
        If the map is one of densities, or as in `similarity` and `DetectorMap.from_hits`.
    """
    seed = check_seed(seed)
    if isinstance(hits, DetectorMap):
        if options:
            raise ValueError(f"options {', '.join(options)} are for hits, got a map, which has bins already")
        complete = hits
    else:
        check_kind(hits, "hits", Hits, "Hits or a DetectorMap")
        complete = DetectorMap.from_hits(hits, **options)
    # a binomial division of every bin is equivalent to a division of the single ions
    half = np.random.default_rng(seed).binomial(complete.counts, 0.5)
    halves = [
        replace(complete, values=part, ions=int(part[complete.mask].sum()), detected=None)
        for part in (half, complete.counts - half)
    ]
    return similarity(*halves, smoothing=smoothing, data_range=data_range)


def _check_bins(map_a, map_b):
    for name in ("x_edges", "y_edges"):
        a, b = getattr(map_a, name), getattr(map_b, name)
        if a.shape != b.shape or not np.allclose(a, b, rtol=0, atol=0.01 * (a[1] - a[0])):
            raise ValueError(
                f"the two maps must have equal bins, got {map_a!r} and {map_b!r} with {name} from "
                f"{a[0]:g} to {a[-1]:g} and {b[0]:g} to {b[-1]:g} mm"
            )
        if len(a) - 1 < 2 * WINDOW + 1:
            raise ValueError(
                f"similarity needs at least {2 * WINDOW + 1} bins along a side, got {len(a) - 1} from {name}"
            )
