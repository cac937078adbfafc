"""Refinement of an orientation by the likelihood of the counts of a map.

The expected counts of a bin in the direction v are ``mu = s(x, y) (1 + a_0 (D_0(v) - 1) + a_1 (D_1(v) - 1))`` with the
densities D of the master pattern of ions that do not roll up and of ions that do. s is the exponential of a polynomial
of degree four: the efficiency of the detector, the decrease of the density towards the rim, and everything else that is
slow. The amplitudes a are at least 0, their sum is at most 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.detection.projection import Projection
from apt_evap.maps.indexing.marked_poles import Mark
from apt_evap.maps.indexing.master_pattern import sampled
from apt_evap.maps.indexing.orientation_search import DEGREE, Disc
from apt_evap.maps.noise import effective_ions

BINS = 56
"""Bins across the disc: 1 degree for a field of view of 36 degrees half angle."""
_STEPS = 15  # iterations at most
_FINE = 0.3  # change of the deviance that ends the iteration: far below one standard error
_DIFFERENCE = 2e-3  # [rad] of the numerical derivatives: a quarter of a pixel of the patterns
_LONGEST = 3.0  # radii; a square has 1.4
_FEWEST = 100  # bins, for 15 slow polynomials and 7 numbers of an orientation
_LEAST = 0.05  # expected counts of a bin at least, where residuals are divided by their error
_REACH = 5  # bins: residuals farther apart count as independent
NO_STRETCH = -0.01
"""Radial stretch above which the projection of the answer is equidistant."""
_STRETCH = 0.05  # standard deviation of the prior of the radial stretch at the rim


class Bins(NamedTuple):
    """Bins of a map for the likelihood."""

    inside: np.ndarray
    """Which of the combined bins of the map are used, bool (ny, nx)."""

    places: np.ndarray
    """Relative to the centre of the disc, in radii of the disc, shape (n, 2)."""
    counts: np.ndarray
    """Hits, for densities of equal noise, shape (n,)."""
    slow: np.ndarray
    """Polynomials of x and y, shape (n, k)."""
    fit: np.ndarray
    """Coefficients of the slow polynomials that fit the logarithm of the counts alone, shape (k,)."""
    mu: np.ndarray
    """Counts by this fit, shape (n,)."""

    @property
    def deviance(self) -> float:
        """Deviance of the counts from the fit of the slow polynomials."""
        return deviance(self.counts, self.mu)

    @property
    def structure(self) -> float:
        """Sum of the squared deviations from this fit, beyond that of noise."""
        return pearson(self.counts, self.mu) - len(self.counts) + self.slow.shape[1]

    @property
    def structure_error(self) -> float:
        """Standard deviation of `structure` by noise."""
        return math.sqrt((2 + 1 / np.maximum(self.mu, _LEAST)).sum())


@dataclass(frozen=True)
class Refined:
    """A refined orientation."""

    matrix: np.ndarray
    """Rotation from crystal to specimen, shape (3, 3)."""
    scale: float
    """[mm/rad], from the centre to the rim of the disc."""
    stretch: float
    """Radial stretch: angles are (r / scale) (1 + stretch (r^2 / radius^2 - 1))."""
    amplitudes: np.ndarray
    """Of the two patterns, shape (2,)."""
    gain: float
    """Decrease of the deviance by the pattern."""
    explained: float
    """Fraction of the structure of the map beyond noise and slow changes that the model explains."""
    dispersion: float
    """Variance of the sum of neighbouring counts about the model, relative to that of Poisson's distribution."""
    misfit: float
    """Sum of the squared deviations of the marks in standard errors, and of their penalties."""
    deviations: np.ndarray
    """Deviation of each mark from what it may be [standard errors], shape (n_marks,)."""
    covariance: np.ndarray
    """Of the rotation vector [rad] and the logarithm of the scale, shape (4, 4)."""

    @property
    def scale_at_centre(self) -> float:
        """Scale of the projection [mm/rad]."""
        return self.scale / _widened(self.stretch)


def _widened(stretch):
    """Ratio of the scale from the centre to the rim to that at the centre, as in the projection of the answer."""
    return 1.0 - stretch if stretch <= NO_STRETCH else 1.0


def resolution(disc: Disc, scale: float) -> float:
    """Smoothing of a pattern for the bins of a map [degrees]: a third of a bin, at least half a degree."""
    return max(0.35 * float(np.degrees(2 * disc.radius / BINS / scale)), 0.5)


def bins_of(disc: Disc) -> Bins:
    """Combine the bins of a map to about `BINS` across its disc."""
    map = disc.map
    factor = max(1, round(2 * disc.radius / BINS / max(map.bin_size)))
    values = np.where(map.mask, map.values, 0.0)
    if not map.is_counts:
        hits = effective_ions(map)
        values = values * (min(hits, 1e7) / values.sum())
    x, y = np.meshgrid(*map.centres)
    ny, nx = (size // factor * factor for size in values.shape)

    def combined(array):
        return array[:ny, :nx].reshape(ny // factor, factor, nx // factor, factor).sum(axis=(1, 3))

    inside = combined(map.mask.astype(float)) == factor**2
    places = np.column_stack([combined(each)[inside] / factor**2 for each in (x, y)])
    places = (places - disc.centre) / disc.radius
    counts = combined(values)[inside]
    if len(counts) < _FEWEST:
        raise ValueError(
            f"the map must have at least {_FEWEST} bins in its field of view, got {len(counts)} in {map!r}"
        )
    if (longest := float(np.hypot(*places.T).max())) > _LONGEST:
        raise ValueError(
            f"the field of view must reach at most {_LONGEST:g} radii of its circle, got {longest:.1f} in {map!r}"
        )
    # well-conditioned polynomials
    terms = [places[:, 0] ** i * places[:, 1] ** j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    slow = np.linalg.qr(np.column_stack(terms))[0] * np.sqrt(len(places))
    mean = counts.mean()
    fit = np.zeros(slow.shape[1])
    fit += np.linalg.lstsq(slow, np.full(len(slow), np.log(mean)), rcond=None)[0]
    mu = np.exp(slow @ fit)
    for _ in range(_STEPS):
        step = _solve(slow * mu[:, None], counts - mu, 1 / mu)[0]
        fit += np.clip(step, -1, 1)
        mu = np.exp(np.clip(slow @ fit, -20, 20))
    return Bins(inside, places, counts, slow, fit, mu)


def deviance(counts: Floats, mu: Floats) -> float:
    """Twice the logarithm of the likelihood ratio of the counts themselves and expected counts."""
    return float(2 * (scipy.special.xlogy(counts, counts / mu) - counts + mu).sum())


def pearson(counts: Floats, mu: Floats) -> float:
    """Sum of the squared deviations of counts in standard errors."""
    return float(((counts - mu) ** 2 / np.maximum(mu, _LEAST)).sum())


def directions_of(places: Floats, radius: float, scale: float, stretch: float) -> Floats:
    """Directions in the specimen at places in radii of the disc: theta = r (1 + stretch (r^2 - 1)) / scale."""
    r = np.hypot(*places.T)
    theta = (radius / scale) * (1 + stretch * (r * r - 1))
    return Projection(1.0).directions(places * theta[:, None])


def _solve(columns, residuals, weights, prior=None):
    normal = columns.T @ (columns * weights[:, None])
    right = columns.T @ (residuals * weights)
    if prior is not None:
        normal = normal + np.diag(prior)
    normal = normal + 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.linalg.solve(normal, right), normal


def refine(
    bins: Bins,
    disc: Disc,
    densities: Floats,
    matrix: Floats,
    scale: float,
    rolled: float,
    marks: Sequence[Mark] = (),
    steps: int = _STEPS,
    bounds: tuple[float, float] | None = None,
) -> Refined:
    """Maximise the likelihood near a start.

    Parameters
    ----------
    bins : Bins
        The map.
    disc : Disc
        Its disc.
    densities : ndarray
        Densities of the master pattern, smoothed for the size of the bins.
    matrix, scale, rolled
        Start: rotation from crystal to specimen, scale [mm/rad], share of the second pattern.
    marks : sequence of Mark
        Marks of a user.
    steps : int
        Largest number of iterations.
    bounds : tuple of float, optional
        Bounds of the scale at the centre [mm/rad].

    Returns
    -------
    Refined
    """
    n_slow = bins.slow.shape[1]

    def contrast(turn, log_scale, stretch):
        directions = directions_of(bins.places, disc.radius, float(np.exp(log_scale)), stretch)
        rotation = scipy.spatial.transform.Rotation.from_rotvec(turn).as_matrix() @ matrix
        return sampled(densities, directions @ rotation) - 1.0

    def limits(stretch):
        """Bounds of the logarithm of the scale from the centre to the rim."""
        low, high = (-math.inf, math.inf) if bounds is None else np.log(bounds)
        return np.array([low, high]) + math.log(_widened(stretch))

    geometry = np.array([0.0, 0.0, 0.0, np.log(scale), 0.0])
    geometry[3] = np.clip(geometry[3], *limits(0.0))
    amplitudes = 0.5 * np.array([1 - rolled, rolled])
    fit = bins.fit

    def model(fit, amplitudes, contrasts):
        factor = np.maximum(1 + amplitudes @ contrasts, 0.02)
        return np.exp(np.clip(bins.slow @ fit, -20, 20)) * factor, factor

    spots = [(mark.places - disc.centre) / disc.radius for mark in marks]

    def of_marks(geometry):
        """Crystal directions of the places of every mark."""
        rotation = scipy.spatial.transform.Rotation.from_rotvec(geometry[:3]).as_matrix() @ matrix
        scale, stretch = float(np.exp(geometry[3])), geometry[4]
        return [directions_of(spot, disc.radius, scale, stretch) @ rotation for spot in spots]

    # each mark keeps the target that it has at the start; one that is far from all of them does not count
    targets = [mark.nearest(each) for mark, each in zip(marks, of_marks(geometry), strict=True)]

    def deviations(geometry):
        """Of the marks from their targets, and of the stretch from 0, in standard errors."""
        parts = [
            mark.signed(each, target)
            for mark, each, target in zip(marks, of_marks(geometry), targets, strict=True)
            if target is not None
        ]
        return np.concatenate([*parts, [geometry[4] / _STRETCH]])

    def penalty(geometry):
        return float((deviations(geometry) ** 2).sum())

    contrasts = contrast(geometry[:3], *geometry[3:])
    damping = 1e-3
    for step in range(steps):
        mu, factor = model(fit, amplitudes, contrasts)
        value = deviance(bins.counts, mu) + penalty(geometry)
        columns = [bins.slow * mu[:, None], (contrasts * (mu / factor)).T]
        moving = step >= 2  # first the slow part and the amplitudes
        if moving:
            for k in range(5):
                shifted = geometry.copy()
                shifted[k] += _DIFFERENCE
                columns.append(
                    ((amplitudes @ (contrast(shifted[:3], *shifted[3:]) - contrasts)) / _DIFFERENCE * mu / factor)[
                        :, None
                    ]
                )
        columns = np.hstack(columns)
        weights = 1 / mu
        normal = columns.T @ (columns * weights[:, None])
        right = columns.T @ ((bins.counts - mu) * weights)
        if moving:
            now = deviations(geometry)
            slopes = np.stack(
                [(deviations(geometry + shift) - now) / _DIFFERENCE for shift in _DIFFERENCE * np.eye(5)], axis=1
            )
            normal[-5:, -5:] += slopes.T @ slopes
            right[-5:] -= slopes.T @ now
        solved = normal
        low, high = limits(geometry[4])
        if moving and ((geometry[3] <= low and right[-2] < 0) or (geometry[3] >= high and right[-2] > 0)):
            solved = normal.copy()  # the scale stays at its bound
            solved[-2, :], solved[:, -2], right[-2] = 0.0, 0.0, 0.0
            solved[-2, -2] = normal[-2, -2]
        improved = False
        for _ in range(6):
            damped = solved + np.diag(damping * np.diag(solved) + 1e-12 * np.trace(solved))
            change = np.linalg.solve(damped, right)
            new_fit = fit + np.clip(change[:n_slow], -1, 1)
            new_amplitudes = np.maximum(amplitudes + np.clip(change[n_slow : n_slow + 2], -0.3, 0.3), 0)
            new_amplitudes /= max(1.0, new_amplitudes.sum())
            new_geometry = geometry + (np.clip(change[n_slow + 2 :], -0.05, 0.05) if moving else 0.0)
            if bounds is not None:
                new_geometry[3] = np.clip(new_geometry[3], *limits(new_geometry[4]))
            new_contrasts = contrast(new_geometry[:3], *new_geometry[3:]) if moving else contrasts
            new_value = deviance(bins.counts, model(new_fit, new_amplitudes, new_contrasts)[0]) + penalty(new_geometry)
            if new_value <= value:
                improved = True
                break
            damping *= 10
        if not improved:
            if moving:
                break
            continue
        fit, amplitudes, geometry, contrasts = new_fit, new_amplitudes, new_geometry, new_contrasts
        damping = max(damping / 5, 1e-6)
        if moving and value - new_value < _FINE:
            break
    mu, _ = model(fit, amplitudes, contrasts)
    freedom = max(1, len(mu) - n_slow - 7)
    dispersion = max(pearson(bins.counts, mu) / freedom, 1.0)
    covariance = (
        np.linalg.pinv(normal)[n_slow + 2 : n_slow + 6, n_slow + 2 : n_slow + 6] if moving else np.full((4, 4), np.nan)
    )
    rotation = scipy.spatial.transform.Rotation.from_rotvec(geometry[:3]).as_matrix() @ matrix
    return Refined(
        rotation,
        float(np.exp(geometry[3])),
        float(geometry[4]),
        amplitudes,
        bins.deviance - deviance(bins.counts, mu),
        1 - (pearson(bins.counts, mu) - freedom) / bins.structure if bins.structure > bins.structure_error else 0.0,
        dispersion * _correlated(bins, mu),
        sum(mark.misfit(each)[0] for mark, each in zip(marks, of_marks(geometry), strict=True)),
        np.array([mark.deviation(each) for mark, each in zip(marks, of_marks(geometry), strict=True)]),
        covariance,
    )


def _correlated(bins, mu):
    """Number of bins with a common residual: the sum of the autocorrelation of the residuals over near bins."""
    image = np.zeros(bins.inside.shape)
    image[bins.inside] = (bins.counts - mu) / np.sqrt(np.maximum(mu, _LEAST))
    shape = [size + _REACH + 1 for size in image.shape]
    spectra = (scipy.fft.rfft2(each, shape) for each in (image, bins.inside.astype(float)))
    products, pairs = (scipy.fft.irfft2(np.abs(each) ** 2, shape) for each in spectra)
    lags = np.arange(-_REACH, _REACH + 1)
    near = np.hypot(*np.meshgrid(lags, lags)) <= _REACH
    products, pairs = (each[np.ix_(lags, lags)][near] for each in (products, pairs))
    correlations = products / np.maximum(pairs, 1) / (products.max() / pairs.max())
    return max(1.0, float(correlations.sum()))
