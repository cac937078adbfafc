"""Local composition of reconstructed ions, and the dependence of the evaporation field on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats

CONTRAST_GATE = 3.0
"""Least contrast over its noise: no contrast gave up to 0.8, 4 against 2 % up to 2.3, 6 against 2 % from 2.7."""

_FEWEST, _MOST = 30, 250  # neighbours for a composition
_NEIGHBOURS = 60  # for the contrast
_CELLS = 1_500_000  # largest grid
_CORE_SHARES = 0.92, 0.8, 0.6  # of the neighbours of an ion in the core of a phase
_FEWEST_OF_CORE = 100
_LEAST = 1e-9
_TURNS = 60  # of the mixture of two binomials
_SHARPNESS = 2.1  # cells per standard deviation of the Gaussian; wider cells would blur


@dataclass(frozen=True)
class SoluteContrast:
    """Two contents of a solute, and whether they differ by more than the counts.

    Parameters
    ----------
    matrix, phase : float
        Fraction of the solute in the matrix and in the other phase, by a mixture of two binomials.
    contrast : float
        Covariance of the compositions of both halves of the ions, over its standard deviation without any contrast.
    neighbours : int
        Ions within the Gaussian that a composition is taken from.
    """

    matrix: float
    phase: float
    contrast: float
    neighbours: int

    @property
    def is_seen(self) -> bool:
        """Whether the contrast is larger than its gate."""
        return self.contrast >= CONTRAST_GATE and self.phase > self.matrix


@dataclass(frozen=True, eq=False)
class LocalComposition:
    """Fraction of a solute about each ion, by all ions and by each of two halves of them.

    Parameters
    ----------
    all, first, second : ndarray
        Fractions, shape (n,).
    """

    all: Floats = field(repr=False)
    first: Floats = field(repr=False)
    second: Floats = field(repr=False)


def local_composition(
    positions: Floats, solute: Booleans, halves: Booleans, neighbours: int, volume: float
) -> LocalComposition:
    """Fraction of a solute about each ion at positions (n, 3) [nm], on a grid with a Gaussian.

    `halves` are the ions of the first half. The variance of the composition is that of so many draws as there are
    neighbours in the Gaussian. `volume` is that of the specimen per ion [nm^3].
    """
    choices = [halves, halves & solute, ~halves, ~halves & solute]
    ions, ours, others, theirs = _counted(positions, choices, neighbours, volume)
    return LocalComposition(
        (ours + theirs) / np.maximum(ions + others, _LEAST), ours / np.maximum(ions, _LEAST),
        theirs / np.maximum(others, _LEAST),
    )  # fmt: skip


def local_share(positions: Floats, chosen: Booleans, neighbours: int, volume: float) -> Floats:
    """Fraction of chosen ions about each ion, as in `local_composition`, shape (n,)."""
    ions, ours = _counted(positions, [np.ones(len(chosen), bool), chosen], neighbours, volume)
    return ours / np.maximum(ions, _LEAST)


def _counted(positions, choices, neighbours, volume):
    """Ions of each choice within the Gaussian about each ion, in units of a cell."""
    # n ions count as many as those of a Gaussian of standard deviation s: n = (2 sqrt(pi) s)^3 / volume
    scale = (neighbours * volume) ** (1 / 3) / math.sqrt(4 * math.pi)
    low = positions.min(axis=0) - 2 * scale
    extent = positions.max(axis=0) + 2 * scale - low
    cell = max(scale / _SHARPNESS, float(np.prod(extent) / _CELLS) ** (1 / 3))
    shape = np.ceil(extent / cell).astype(int) + 1
    places = (positions - low) / cell
    flat = np.ravel_multi_index(tuple(places.astype(int).T), tuple(shape))
    # the cells add a variance of 1/12, and the interpolation between them 1/6
    width = math.sqrt(max((scale / cell) ** 2 - 1 / 4, 0.01))
    counts = []
    for chosen in choices:
        count = np.bincount(flat[chosen], minlength=int(shape.prod())).reshape(shape).astype(np.float32)
        smooth = scipy.ndimage.gaussian_filter(count, width, truncate=3.0)
        counts.append(scipy.ndimage.map_coordinates(smooth, (places - 0.5).T, order=1, output=np.float64))
    return counts


def solute_contrast(positions: Floats, solute: Booleans, halves: Booleans, volume: float) -> SoluteContrast:
    r"""Contents of a solute in the matrix and in a phase that is enriched, and their contrast.

    Arguments as for `local_composition`. The number of neighbours is such that both contents are three standard
    deviations apart, 30 to 250. The noise of the covariance of the halves a and b of k neighbours is :math:`c (1 - c) /
    (k/2) / \\sqrt{n/k}`.
    """
    share = float(solute.mean())
    found = local_composition(positions, solute, halves, _NEIGHBOURS, volume)
    noise = share * (1 - share) / (_NEIGHBOURS / 2) / math.sqrt(len(solute) / _NEIGHBOURS)
    contrast = _covariance(found.first, found.second) / max(noise, 1e-12)
    matrix, phase = _two_binomials(found.all, _NEIGHBOURS)
    middle = (matrix + phase) / 2
    neighbours = int(np.clip(9 * middle * (1 - middle) / (phase - matrix) ** 2, _FEWEST, _MOST))
    return SoluteContrast(matrix, phase, contrast, neighbours)


def contents(
    positions: Floats, solute: Booleans, halves: Booleans, found: LocalComposition, neighbours: int, volume: float
) -> tuple[float, float, float]:
    """Content of the matrix and of the core of the enriched phase, and the standard error of the latter by its counts.

    Other arguments as for `local_composition`. A mixture of two binomials takes the interface, which the Gaussian
    blurs, for part of both. It only tells the richer ions of one half; where most neighbours are such or are not, the
    ions of the other half, whose noise is independent, are counted.
    """
    mixture = _two_binomials(found.all, neighbours)
    parts = [half > sum(mixture) / 2 for half in (found.first, found.second)]
    ions, *near = _counted(positions, [np.ones(len(solute), bool), *parts], neighbours, volume)
    counts = np.zeros((2, 2))  # of ions and of solutes, in the matrix and in the phase
    for richer, richer_near, counted in zip(parts, near, (~halves, halves), strict=True):
        share = richer_near / np.maximum(ions, _LEAST)
        for place, core in enumerate((core_of(~richer, 1 - share), core_of(richer, share))):
            counts[:, place] += np.count_nonzero(core & counted), np.count_nonzero(core & counted & solute)
    matrix, core = counts[1] / np.maximum(counts[0], 1)
    phase = max(float(core), mixture[1])  # what is too small to have a core
    return float(matrix), phase, math.sqrt(phase * (1 - phase) / max(counts[0, 1], 1))


def core_of(chosen: Booleans, near: Floats) -> Booleans:
    """Those of chosen ions of whose neighbours a part is chosen: 92 %, or less until 100 ions are left, shape (n,)."""
    cores = (chosen & (near >= share) for share in _CORE_SHARES)
    return next((core for core in cores if np.count_nonzero(core) > _FEWEST_OF_CORE), chosen)


def noise_free_slopes(values: Floats, found: list[LocalComposition]) -> Floats:
    r"""Slopes (k,) of values of ions over their compositions of k solutes, without the bias by the noise of the counts.

    The composition a of one half of the neighbours is an instrument for that of the other half, b, because their noise
    is independent: :math:`2\,\mathrm{cov}(a_i, b_j)\,\beta_j = \mathrm{cov}(v, a_i) + \mathrm{cov}(v, b_i)`. The slope
    over the composition of all neighbours is 5 to 10 % smaller at a contrast of 40 %, and a third at 10 %.
    """
    k = len(found)
    matrix, right = np.empty((k, k)), np.empty(k)
    for i, one in enumerate(found):
        right[i] = _covariance(values, one.first) + _covariance(values, one.second)
        for j, other in enumerate(found):
            matrix[i, j] = _covariance(one.first, other.second) + _covariance(one.second, other.first)
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=1e-3)[0], dtype=np.float64)


def _covariance(first, second):
    return float(np.mean((first - first.mean()) * (second - second.mean())))


def _two_binomials(fractions, neighbours):
    """Contents of two phases by expectation and maximisation over the table of counts."""
    counts = np.clip(np.rint(fractions * neighbours), 0, neighbours).astype(np.intp)
    table = np.bincount(counts, minlength=neighbours + 1).astype(np.float64)
    numbers = np.arange(neighbours + 1)
    low = max(1e-3, float(np.quantile(counts, 0.3)) / neighbours)
    high = min(max(float(np.quantile(counts, 0.98)) / neighbours, 2 * low + 0.02), 0.999)
    low, share = min(low, high - 1e-3), 0.15
    for _ in range(_TURNS):
        # the ratio of both probabilities, in which the binomial coefficient cancels
        odds = numbers * np.log(high / low) + (neighbours - numbers) * np.log((1 - high) / (1 - low))
        belongs = scipy.special.expit(odds + np.log(share / (1 - share)))
        share = float(np.clip((table * belongs).sum() / table.sum(), 1e-4, 0.9999))
        high = float((table * belongs * numbers).sum() / max((table * belongs).sum(), 1e-9) / neighbours)
        low = float((table * (1 - belongs) * numbers).sum() / max((table * (1 - belongs)).sum(), 1e-9) / neighbours)
        low = max(low, 1e-4)
        high = float(np.clip(high, low + 1e-3, 0.9999))
    return low, high
