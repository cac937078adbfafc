"""Refinement of an orientation by the likelihood of the counts of a map.

The expected counts of a bin in the direction v are ``mu = s(x, y) (1 + sum_k a_k (D_k(v) - 1))`` with the densities D_k
of the master patterns of all radii, of ions that do not roll up and of ions that do. A mixture has poles of any size,
so their size alone does not set the scale. s is the exponential of a polynomial of degree four: the efficiency of the
detector, the decrease of the density towards the rim, and everything else that is slow. The amplitudes a_k are at least
0, their sum is at most 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.detection.projection import angle_of
from apt_evap.maps.indexing.marked_poles import Mark
from apt_evap.maps.indexing.master_pattern import sampled
from apt_evap.maps.indexing.orientation_search import DEGREE, Disc, UnusableMap
from apt_evap.maps.noise import effective_ions

BINS = 56
"""Bins across the disc: 1 degree for a field of view of 36 degrees half angle."""
_STEPS = 15  # iterations at most
_FIRST_MOVE = 2  # iteration: before, the slow part and the amplitudes are fitted alone
_ATTEMPTS = 6  # values of the damping in an iteration
_FINE = 0.3  # change of the deviance that ends the iteration: far below one standard error
_DIFFERENCE = 2e-3  # [rad] of the numerical derivatives: a quarter of a pixel of the patterns
_LONGEST = 3.0  # radii; a square has 1.4
_FEWEST = 100  # bins, for 15 slow polynomials and 7 numbers of an orientation
_LEAST = 0.05  # expected counts of a bin at least, where residuals are divided by their error
_REACH = 5  # bins: residuals farther apart count as independent
STRETCH, LARGEST_STRETCH = 0.05, 0.3
"""Standard deviation of the prior of the radial stretch at the rim, and its bound: from 1/3 on the image is folded."""


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
    """Radial stretch b at the rim, positive for a barrel: r = scale_at_centre t (1 - b (t / t_rim)^2), angle t."""
    amplitudes: np.ndarray
    """Of the densities, shape (k,)."""
    slow: np.ndarray
    """Coefficients of the slow polynomials beside the pattern, shape (k,)."""
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
    """Of the rotation vector [rad], the logarithm of the scale and the stretch, shape (5, 5)."""

    @property
    def scale_at_centre(self) -> float:
        """Scale of the projection [mm/rad]."""
        return self.scale / (1.0 - self.stretch)

    @property
    def scale_error(self) -> float:
        """Standard error of `scale_at_centre` [mm/rad], with the dispersion, and with what the stretch leaves open."""
        slopes = np.array([0.0, 0.0, 0.0, 1.0, 1.0 / (1.0 - self.stretch)])
        return self.scale_at_centre * math.sqrt(max(slopes @ self.covariance @ slopes, 0.0) * self.dispersion)


def resolution(disc: Disc, scale: float) -> float:
    """Smoothing of a pattern for the bins of a map [degrees]: a third of a bin, at least half a degree."""
    return max(0.35 * float(np.degrees(2 * disc.radius / BINS / scale)), 0.5)


def bins_of(disc: Disc) -> Bins:
    """Combine the bins of a map to about `BINS` across its disc."""
    map = disc.map
    factor = max(1, round(2 * disc.radius / BINS / max(map.bin_size)))
    values = np.where(map.mask, map.values, 0.0)
    if not map.is_counts:
        hits = effective_ions(map) if disc.hits is None else disc.hits
        values = values * (min(hits, 1e7) / values.sum())
    x, y = np.meshgrid(*map.centres)
    ny, nx = (size // factor * factor for size in values.shape)

    def combined(array):
        return array[:ny, :nx].reshape(ny // factor, factor, nx // factor, factor).sum(axis=(1, 3))

    inside = combined(map.mask.astype(float)) == factor**2
    places = np.column_stack([combined(coordinate)[inside] / factor**2 for coordinate in (x, y)])
    places = (places - disc.centre) / disc.radius
    counts = combined(values)[inside]
    if len(counts) < _FEWEST:
        raise UnusableMap(
            f"the map must have at least {_FEWEST} bins in its field of view, got {len(counts)} in {map!r}"
        )
    if (longest := float(np.hypot(*places.T).max())) > _LONGEST:
        raise UnusableMap(
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
        step = _solve(slow * mu[:, None], counts - mu, 1 / mu)
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
    """Directions in the specimen at places in radii of the disc, with the stretch of a `Refined`.

    Places in float32 give directions in float32, in a third of the time.
    """
    x, y = places.T
    r = np.hypot(x, y)
    theta = (radius / scale) * angle_of(r * (1 - stretch), None, stretch)
    across = np.divide(np.sin(theta), r, out=np.full_like(r, radius / scale * (1 - stretch)), where=r > 0)
    return np.column_stack([x * across, y * across, np.cos(theta)])


def rotation_of(vector: Floats) -> Floats:
    """Matrix of a rotation vector [rad], shape (3, 3)."""
    x, y, z = vector.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-8:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    s, c = math.sin(angle) / angle, 2 * (math.sin(angle / 2) / angle) ** 2
    xy, yz, zx = c * x * y, c * y * z, c * z * x
    return np.array(
        [
            [1 - c * (y * y + z * z), xy - s * z, zx + s * y],
            [xy + s * z, 1 - c * (z * z + x * x), yz - s * x],
            [zx - s * y, yz + s * x, 1 - c * (x * x + y * y)],
        ]
    )


def _solve(columns, residuals, weights):
    normal = columns.T @ (columns * weights[:, None])
    right = columns.T @ (residuals * weights)
    normal = normal + 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.linalg.solve(normal, right)


class _State(NamedTuple):
    """Parameters of the model, and the densities that follow from them."""

    fit: Floats
    """Coefficients of the slow polynomials, shape (k,)."""
    amplitudes: Floats
    """Of the densities, shape (k,)."""
    geometry: Floats
    """Rotation vector from the start [rad], logarithm of the scale at the rim [mm/rad], radial stretch; shape (5,)."""
    contrasts: Floats
    """Densities in each bin, minus 1, shape (k, n)."""


class _Likelihood:
    """Likelihood of the counts of a map, with the marks of a user, as a function of a `_State`.

    Parameters
    ----------
    bins, disc, densities, matrix, marks, bounds
        As for `refine`.
    geometry : ndarray
        Start. Each mark keeps the target that it has there; one that is far from all of them does not count.
    prior : float
        Standard deviation of the prior of the stretch.
    """

    def __init__(
        self,
        bins: Bins,
        disc: Disc,
        densities: Floats,
        matrix: Floats,
        marks: Sequence[Mark],
        bounds: tuple[float, float] | None,
        geometry: Floats,
        prior: float,
    ) -> None:
        self._bins, self._disc, self._densities, self._matrix, self._prior = bins, disc, densities, matrix, prior
        self._marks = marks
        self._bounds = (-math.inf, math.inf) if bounds is None else np.log(bounds)
        self._places = bins.places.astype(np.float32)
        self._mark_places = [(mark.places - disc.centre) / disc.radius for mark in marks]
        self._local: tuple[tuple[float, float], Floats] | None = None
        self.n_slow = bins.slow.shape[1]
        directions = self.mark_directions(geometry)
        self._targets = [mark.nearest(places) for mark, places in zip(marks, directions, strict=True)]

    def rotation(self, geometry: Floats) -> Floats:
        """Rotation from crystal to specimen, shape (3, 3)."""
        return rotation_of(geometry[:3]) @ self._matrix

    def _crystal_directions(self, places, geometry):
        """Directions in the crystal of places on the disc, shape (n, 3)."""
        scale, stretch = float(np.exp(geometry[3])), float(geometry[4])
        if places is not self._places:
            return directions_of(places, self._disc.radius, scale, stretch) @ self.rotation(geometry)
        if self._local is None or self._local[0] != (scale, stretch):  # rotations do not change them
            self._local = (scale, stretch), directions_of(places, self._disc.radius, scale, stretch)
        return self._local[1] @ self.rotation(geometry).astype(np.float32)

    def contrasts(self, geometry: Floats) -> Floats:
        """Densities in each bin, minus 1, shape (k, n)."""
        return sampled(self._densities, self._crystal_directions(self._places, geometry)) - 1.0

    def limits(self, stretch: float) -> Floats:
        """Bounds of the logarithm of the scale from the centre to the rim, shape (2,)."""
        return np.array(self._bounds) + math.log(1.0 - stretch)

    def expected(self, state: _State) -> tuple[Floats, Floats]:
        """Expected counts, and the factor in them that comes from the patterns, each of shape (n,)."""
        factor = np.maximum(1 + state.amplitudes @ state.contrasts, 0.02)
        return np.exp(np.clip(self._bins.slow @ state.fit, -20, 20)) * factor, factor

    def mark_directions(self, geometry: Floats) -> list[Floats]:
        """Directions in the crystal of the places of every mark."""
        return [self._crystal_directions(places, geometry) for places in self._mark_places]

    def deviations(self, geometry: Floats) -> Floats:
        """Of the marks from their targets, and of the stretch from 0, in standard errors."""
        parts = [
            mark.signed(directions, target)
            for mark, directions, target in zip(self._marks, self.mark_directions(geometry), self._targets, strict=True)
            if target is not None
        ]
        return np.concatenate([*parts, [geometry[4] / self._prior]])

    def value(self, state: _State) -> float:
        """Deviance of the counts, and the squared deviations of the marks: what is minimised."""
        penalty = float((self.deviations(state.geometry) ** 2).sum())
        return deviance(self._bins.counts, self.expected(state)[0]) + penalty

    def normal_equations(self, state: _State, moving: bool) -> tuple[Floats, Floats]:
        """Normal matrix and right side of a Gauss-Newton step; of the geometry only if it moves."""
        mu, factor = self.expected(state)
        # derivatives of the counts by the parameters, and residuals, in standard errors
        error = np.sqrt(mu)
        rows = [self._bins.slow.T * error, state.contrasts * (error / factor)]
        if moving:
            rows.append(self._slopes(state, error / factor))
        rows = np.vstack(rows)
        normal = rows @ rows.T
        right = rows @ ((self._bins.counts - mu) / error)
        if moving:
            geometry = state.geometry
            start = self.deviations(geometry)
            shifts = _DIFFERENCE * np.eye(5)
            slopes = np.stack([(self.deviations(geometry + shift) - start) / _DIFFERENCE for shift in shifts], axis=1)
            normal[-5:, -5:] += slopes.T @ slopes
            right[-5:] -= slopes.T @ start
        return normal, right

    def _slopes(self, state, slow):
        """Numerical derivatives of the expected counts by the numbers of the geometry, shape (5, n)."""
        image = np.tensordot(state.amplitudes.astype(np.float32), self._densities, 1)[None]
        shifted = state.geometry + _DIFFERENCE * np.eye(5)
        places = np.concatenate([self._crystal_directions(self._places, geometry) for geometry in shifted])
        moved = sampled(image, places)[0].reshape(5, -1) - state.amplitudes.sum()
        return (moved - state.amplitudes @ state.contrasts) / _DIFFERENCE * slow

    def fixed_at_bounds(self, state: _State, normal: Floats, right: Floats, moving: bool) -> tuple[Floats, Floats]:
        """The same equations, without changes of amplitudes and of a scale that would leave their bounds."""
        fixed = np.zeros(len(right), bool)
        parts = slice(self.n_slow, self.n_slow + len(state.amplitudes))
        fixed[parts] = (state.amplitudes <= 0) & (right[parts] < 0)
        if moving:
            low, high = self.limits(state.geometry[4])
            scale = state.geometry[3]
            fixed[-2] = (scale <= low and right[-2] < 0) or (scale >= high and right[-2] > 0)
        kept = np.where(fixed[:, None] | fixed, np.diag(np.diag(normal)), normal)
        return kept, np.where(fixed, 0.0, right)

    def moved(self, state: _State, change: np.ndarray, moving: bool) -> _State:
        """State after a change of all parameters, limited to what a step may be."""
        n_slow = self.n_slow
        fit = state.fit + np.clip(change[:n_slow], -1, 1)
        n_moved = n_slow + len(state.amplitudes)
        amplitudes = np.maximum(state.amplitudes + np.clip(change[n_slow:n_moved], -0.3, 0.3), 0)
        amplitudes /= max(1.0, amplitudes.sum())
        if not moving:
            return _State(fit, amplitudes, state.geometry, state.contrasts)
        geometry = state.geometry + np.clip(change[n_moved:], -0.05, 0.05)
        geometry[4] = np.clip(geometry[4], -LARGEST_STRETCH, LARGEST_STRETCH)
        geometry[3] = np.clip(geometry[3], *self.limits(geometry[4]))
        return _State(fit, amplitudes, geometry, self.contrasts(geometry))


def refine(
    bins: Bins,
    disc: Disc,
    densities: Floats,
    matrix: Floats,
    scale: float,
    amplitudes: Floats | None = None,
    marks: Sequence[Mark] = (),
    steps: int = _STEPS,
    bounds: tuple[float, float] | None = None,
    stretch: float = 0.0,
    prior: float = STRETCH,
) -> Refined:
    """Maximise the likelihood near a start.

    It is a rotation from crystal to specimen, a scale [mm/rad], and amplitudes (k,), by default equal ones. `densities`
    are those of the master patterns, smoothed for the size of the bins, shape (k, m, m); `steps` is the largest number
    of iterations, `bounds` are those of the scale at the centre [mm/rad], `prior` is the standard deviation of that of
    the stretch.
    """
    geometry = np.array([0.0, 0.0, 0.0, np.log(scale), stretch])
    if bounds is not None:
        geometry[3] = np.clip(geometry[3], *(np.log(bounds) + math.log(1 - stretch)))
    likelihood = _Likelihood(bins, disc, densities, matrix, marks, bounds, geometry, prior)
    if amplitudes is None:
        amplitudes = np.full(len(densities), 0.5 / len(densities))
    state = _State(bins.fit, amplitudes, geometry, likelihood.contrasts(geometry))
    damping, value = 1e-3, likelihood.value(state)
    for step in range(steps):
        moving = step >= _FIRST_MOVE
        normal, right = likelihood.normal_equations(state, moving)
        solved, right = likelihood.fixed_at_bounds(state, normal, right, moving)
        # Levenberg's damping, larger until the likelihood improves
        better = None
        for _ in range(_ATTEMPTS):
            damped = solved + np.diag(damping * np.diag(solved) + 1e-12 * np.trace(solved))
            candidate = likelihood.moved(state, np.linalg.solve(damped, right), moving)
            if (new_value := likelihood.value(candidate)) <= value:
                better = candidate
                break
            damping *= 10
        if better is None:
            if moving:
                break
            continue
        gain, value, state = value - new_value, new_value, better
        damping = max(damping / 5, 1e-6)
        if moving and gain < _FINE:
            break
    return _refined(bins, likelihood, state, normal if moving else None, marks)


def _refined(bins, likelihood, state, normal, marks):
    """Result for the parameters at the end; `normal` is the normal matrix there, None if the geometry did not move."""
    mu, _ = likelihood.expected(state)
    n_slow = likelihood.n_slow
    used = np.count_nonzero(state.amplitudes)
    freedom = max(1, len(mu) - n_slow - used - 5)
    dispersion = max(pearson(bins.counts, mu) / freedom, 1.0)
    covariance = np.full((5, 5), np.nan)
    if normal is not None:
        free = np.concatenate([np.ones(n_slow, bool), state.amplitudes > 0, np.ones(5, bool)])
        part = slice(n_slow + used, n_slow + used + 5)
        covariance = np.linalg.pinv(normal[np.ix_(free, free)])[part, part]
    directions = likelihood.mark_directions(state.geometry)
    return Refined(
        likelihood.rotation(state.geometry),
        float(np.exp(state.geometry[3])),
        float(state.geometry[4]),
        state.amplitudes,
        state.fit,
        bins.deviance - deviance(bins.counts, mu),
        1 - (pearson(bins.counts, mu) - freedom) / bins.structure if bins.structure > bins.structure_error else 0.0,
        dispersion * _correlated(bins, mu),
        sum(mark.misfit(places)[0] for mark, places in zip(marks, directions, strict=True)),
        np.array([mark.deviation(places) for mark, places in zip(marks, directions, strict=True)]),
        covariance,
    )


def _correlated(bins, mu):
    """Number of bins with a common residual: the sum of the autocorrelation of the residuals over near bins."""
    image = np.zeros(bins.inside.shape)
    image[bins.inside] = (bins.counts - mu) / np.sqrt(np.maximum(mu, _LEAST))
    shape = [size + _REACH + 1 for size in image.shape]
    spectra = (scipy.fft.rfft2(values, shape) for values in (image, bins.inside.astype(float)))
    products, pairs = (scipy.fft.irfft2(np.abs(spectrum) ** 2, shape) for spectrum in spectra)
    lags = np.arange(-_REACH, _REACH + 1)
    near = np.hypot(*np.meshgrid(lags, lags)) <= _REACH
    products, pairs = (sums[np.ix_(lags, lags)][near] for sums in (products, pairs))
    correlations = products / np.maximum(pairs, 1) / (products.max() / pairs.max())
    return max(1.0, float(correlations.sum()))
