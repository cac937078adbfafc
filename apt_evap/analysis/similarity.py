"""Structural similarity of two detector maps, and of two halves of one, which its noise limits."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_kind, check_number, check_seed
from apt_evap.detection.detector_map import DetectorMap, gaussian
from apt_evap.detection.hits import Hits

SIGMA, TRUNCATE = 1.5, 3.5
"""Standard deviation of the Gaussian window [bins], and where it is cut off, in standard deviations."""
WINDOW = int(SIGMA * TRUNCATE + 0.5)
"""Half width of the window [bins]."""


class Moments(NamedTuple):
    """Densities with their mean and variance in the window about every bin, all of shape (..., ny, nx)."""

    density: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


def window_mean(values: Floats) -> Floats:
    """Mean in the window about every bin, of maps of shape (..., ny, nx)."""
    return gaussian(values, SIGMA, TRUNCATE)


def window_fits(mask: Booleans) -> Booleans:
    """Whether the disc of radius `WINDOW` about a bin lies inside a mask, bool of shape (ny, nx)."""
    step = np.arange(-WINDOW, WINDOW + 1)
    return scipy.ndimage.binary_erosion(mask, step[:, None] ** 2 + step**2 <= WINDOW**2)


def local_moments(density: Floats) -> Moments:
    """The `Moments` of densities, shape (..., ny, nx)."""
    mean = window_mean(density)
    return Moments(density, mean, window_mean(density**2) - mean**2)


def local_similarity(first: Moments, second: Moments, data_range: float, noise: float | Floats = 0.0) -> Floats:
    r"""Structural similarity in the window about every bin.

    Parameters
    ----------
    first, second : Moments
        Those of two maps, or of two stacks of maps, one by one.
    data_range : float
        Range L of the densities.
    noise : float or ndarray
        Sum of the variances of the noise of both maps, which counts as alike, shape (ny, nx); none by default.

    Returns
    -------
    ndarray
        Shape (..., ny, nx); it means something where `window_fits`.

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


@dataclass(frozen=True, eq=False, repr=False)
class Similarity:
    """Structural similarity of two maps with everything it depends on; ``float(similarity)`` is its value.

    Parameters
    ----------
    value : float
        Mean of the local similarity where a window fits into the common mask, 1 for equal maps.
    local : ndarray
        Local similarity, NaN where no window fits, shape (ny, nx).
    bins : tuple of int
        Number of bins in x and y.
    bin_size : tuple of float
        Width and height of a bin [mm].
    smoothing : float
        Standard deviation of the Gaussian both maps were smoothed with first [mm].
    data_range : float
        Range L of densities (relative to their mean) in the constants (0.01 L)^2 and (0.03 L)^2.
    inside : int
        Number of bins where a window fits into the common mask.
    """

    value: float
    local: np.ndarray
    bins: tuple
    bin_size: tuple
    smoothing: float
    data_range: float
    inside: int

    def __float__(self) -> float:
        return self.value

    def __repr__(self) -> str:
        return (
            f"<Similarity: {self.value:.4f}, {self.bins[0]} x {self.bins[1]} bins of "
            f"{self.bin_size[0]:.4g} x {self.bin_size[1]:.4g} mm ({self.inside:,} of them compared), "
            f"smoothed by {self.smoothing:g} mm, data range {self.data_range:g}>"
        )


def ssim(map_a: DetectorMap, map_b: DetectorMap, *, smoothing: float = 0.0, data_range: float = 2.0) -> Similarity:
    """Structural similarity of two maps on the same bins.

    Both maps are smoothed, brought to densities relative to their mean in the common mask and compared
    wherever a window fits into it. A window over the rim would see an edge between a dark rim and whatever
    fills the outside, the same in both maps: that raised the similarity of two noisy halves of a measured map
    from 0.05 to 0.10.

    Parameters
    ----------
    map_a, map_b : DetectorMap
        Maps with equal edges (``like=`` of `DetectorMap.from_hits` makes one on the bins of the other).
    smoothing : float
        Standard deviation of a Gaussian [mm]; noise lowers the similarity of maps that are not smoothed.
    data_range : float
        Range of densities, relative to their mean, that the constants of the measure refer to. It is fixed
        rather than taken from the data, so that values of many pairs can be compared.

    Returns
    -------
    Similarity

    Raises
    ------
    ValueError
        If the bins differ, are fewer than 11 along a side, or the masks share too little.

    Notes
    -----
    Wang, Bovik, Sheikh and Simoncelli, IEEE Trans. Image Process. 13, 600 (2004): Gaussian windows of
    1.5 bins, K1 = 0.01, K2 = 0.03 (`local_similarity`).
    """
    smoothing = check_number(smoothing, "smoothing", at_least=0, unit="mm")
    data_range = check_number(data_range, "data_range", above=0)
    for name, each in (("map_a", map_a), ("map_b", map_b)):
        check_kind(each, name, DetectorMap, "a DetectorMap")
    _check_bins(map_a, map_b)
    common = map_a.mask & map_b.mask
    inside = window_fits(common)
    if not inside.any():
        raise ValueError(
            f"the masks of the two maps must share more than a window of {2 * WINDOW + 1} bins, they share "
            f"{np.count_nonzero(common)} bins"
        )
    first, second = (
        local_moments(np.where(common, replace(each.smoothed(smoothing), mask=common).density, 1.0))
        for each in (map_a, map_b)
    )
    local = local_similarity(first, second, data_range)
    return Similarity(
        value=float(local[inside].mean()),
        local=np.where(inside, local, np.nan),
        bins=common.shape[::-1],
        bin_size=map_a.bin_size,
        smoothing=smoothing,
        data_range=data_range,
        inside=int(inside.sum()),
    )


def half_ceiling(
    hits: Hits | DetectorMap, *, smoothing: float = 0.0, data_range: float = 2.0, seed: int = 0, **options: Any
) -> Similarity:
    """Structural similarity of two random halves of one measurement: a scale for how noisy it is.

    Each ion falls to either half with equal chance. The halves are noisier than the whole, so that a good simulation,
    which may have more ions besides, can come out higher against the whole.

    Parameters
    ----------
    hits : Hits or DetectorMap
        The measurement; a map must be one of counts.
    smoothing, data_range : float
        As for `ssim`.
    seed : int
        Seed of the division.
    **options
        Passed to `DetectorMap.from_hits`, such as ``bins``, ``extent`` or ``like``.

    Returns
    -------
    Similarity

    Raises
    ------
    ValueError
        If the map is one of densities, or what `ssim` and `DetectorMap.from_hits` raise.
    """
    seed = check_seed(seed)
    if isinstance(hits, DetectorMap):
        if options:
            raise ValueError(f"a map is already binned and takes no {', '.join(options)}")
        whole = hits
    else:
        check_kind(hits, "hits", Hits, "Hits or a DetectorMap")
        whole = DetectorMap.from_hits(hits, **options)
    # dividing every bin binomially is the same as dividing the ions one by one
    half = np.random.default_rng(seed).binomial(whole.counts, 0.5)
    halves = [
        replace(whole, values=part, ions=int(part[whole.mask].sum()), detected=None)
        for part in (half, whole.counts - half)
    ]
    return ssim(*halves, smoothing=smoothing, data_range=data_range)


def _check_bins(map_a, map_b):
    for name in ("x_edges", "y_edges"):
        a, b = getattr(map_a, name), getattr(map_b, name)
        if a.shape != b.shape or not np.allclose(a, b, rtol=0, atol=0.01 * (a[1] - a[0])):
            raise ValueError(
                f"the two maps must have the same bins, got {map_a!r} and {map_b!r} with {name} from "
                f"{a[0]:g} to {a[-1]:g} and {b[0]:g} to {b[-1]:g} mm"
            )
        if len(a) - 1 < 2 * WINDOW + 1:
            raise ValueError(f"ssim needs at least {2 * WINDOW + 1} bins along a side, got {len(a) - 1} from {name}")
