"""Combs of isotopes: where the isotopes of an ion lie in a spectrum whose masses are only known to a factor."""

import math
from collections.abc import Iterator, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from apt_evap._common.types import Booleans, Floats
from apt_evap.spectra.ion_names import Abundances, ion_name

STEP = 5e-4
"""Width of a bin of the logarithm of m/n: half the width of a peak of a good instrument."""
_LARGEST_MISFIT = 0.3
"""Largest part of the ions about a comb that it does not explain. Measured: 0.10 for W, 0.32 for Re and 0.55 for Ta in
the spectrum of W."""
_LOWEST, _HIGHEST = 0.5, 400.0  # m/n [Da]
_MARGIN = 0.02  # of m/n, on both sides of a comb: no ions should be there
_RARE = 1e-3  # abundance of isotopes that a comb has not
_WIDTHS = (7e-4, 1.4e-3)  # standard deviation of a peak over m/n; peaks are not wider
_TAILS = (0.0, -3e-3, 3e-3)  # mean of an exponential tail over m/n: to lower or higher masses
_SIGNIFICANT = 5.0  # standard deviations of the ions of a comb above the background
_FEWEST = 20.0  # ions of a comb
_BACKGROUND = 0.1  # half width of the window of a background, of m/n
_ROUNDS = 8  # of excluding peaks from the background
_ABOVE = 2.5  # standard deviations above the background: part of a peak
_ENOUGH = 0.003  # abundance over the largest of an isotope with a peak of its own
_BESIDE = 0.005  # of m/n, beside a peak: its tails
_TOO_MANY = 3.0  # ions of an isotope over the expected ones: they are of another ion
_EVIDENT = 3.0  # standard deviations above the background of such a peak, and its fewest ions
_FOOT = 0.01  # height over that of the peak at its ends
_RISE = 1.3  # another peak begins at this many times the lowest height between them
_PEAK = 9  # bins over which ions are added to see a peak
_NATURAL = Abundances()


def in_intervals(masses: Floats, intervals: Sequence[tuple[float, float]]) -> Booleans:
    """Whether masses are in one of some intervals, shape (n,)."""
    inside = np.zeros(len(masses), bool)
    for low, high in intervals:
        inside |= (masses >= low) & (masses < high)
    return inside


class Comb(NamedTuple):
    """Comb of the isotopes of an ion in a spectrum."""

    formula: str
    """Such as "W" or "CrO"."""
    charge: int
    """Charge state."""
    factor: float
    """Measured m/n over that of the isotopes."""
    fill: float
    """Part of the ions about the comb that it explains."""
    ions: float
    """Ions of the comb above the background."""
    width: float
    """Standard deviation of a peak over m/n."""
    intervals: tuple[tuple[float, float], ...]
    """Measured m/n of its peaks [Da], without gaps between them."""

    @property
    def name(self) -> str:
        """Such as "W³⁺"."""
        return ion_name(self.formula, self.charge)


class LogSpectrum:
    """Number of ions by the logarithm of m/n, in which a factor is a shift, with the background below the peaks.

    Parameters
    ----------
    mass : ndarray
        m/n of the ions [Da], shape (n,).

    Attributes
    ----------
    edges : ndarray
        m/n at the edges of the bins [Da], shape (k + 1,).
    counts, background : ndarray
        Number of ions, and that of the background, in each bin, shape (k,).
    """

    def __init__(self, mass: Floats) -> None:
        self._first = math.floor(math.log(_LOWEST) / STEP)
        last = math.ceil(math.log(_HIGHEST) / STEP)
        self.edges = np.exp(STEP * np.arange(self._first, last + 1))
        inside = mass[(mass > self.edges[0]) & (mass < self.edges[-1])].astype(np.float64)
        bins = np.clip(np.floor(np.log(inside) / STEP).astype(np.int64) - self._first, 0, last - self._first - 1)
        self.counts = np.bincount(bins, minlength=last - self._first).astype(np.float64)
        self.background = _background_of(self.counts)
        self._combs: dict[tuple[str, int, float, float], Comb | None] = {}
        self._add_up()

    def _add_up(self):
        self._sums, self._below = (np.pad(np.cumsum(c), (1, 0)) for c in (self.counts, self.background))

    def without(self, intervals: Sequence[tuple[float, float]]) -> "LogSpectrum":
        """The spectrum with only the background in some intervals of m/n [Da]."""
        rest = copy(self)
        rest.counts = self.counts.copy()
        for low, high in intervals:
            first, last = np.searchsorted(self.edges, (low * (1 - _BESIDE), high * (1 + _BESIDE)))
            rest.counts[first:last] = self.background[first:last]
        rest._combs = {
            key: comb
            for key, comb in self._combs.items()
            if not any(_reaches(*key, low * (1 - _BESIDE), high * (1 + _BESIDE)) for low, high in intervals)
        }
        rest._add_up()
        return rest

    def comb(self, formula: str, charge: int, low: float, high: float) -> Comb | None:
        """The best comb of an ion for factors between two bounds.

        Parameters
        ----------
        formula : str
            The ion.
        charge : int
            Its charge state.
        low, high : float
            Bounds of the factor of m/n.

        Returns
        -------
        Comb or None
            None without ions above the background, or if it does not explain enough of those about it.
        """
        key = formula, charge, low, high
        if key not in self._combs:
            self._combs[key] = self._best_comb(*key)
        return self._combs[key]

    def _best_comb(self, formula, charge, low, high):
        """The same, computed."""
        from scipy.ndimage import gaussian_filter1d

        masses, abundances = _NATURAL.lines(formula)
        common = abundances > _RARE
        masses, abundances = masses[common], abundances[common] / abundances[common].sum()
        places = np.log(masses / charge) / STEP - self._first  # in bins
        margin = math.ceil(_MARGIN / STEP)
        first, size = math.floor(places[0]) - margin, math.ceil(places[-1]) - math.floor(places[0]) + 2 * margin
        shifts = np.arange(round(math.log(low) / STEP), round(math.log(high) / STEP) + 1)
        starts = first + shifts
        shifts = shifts[(starts >= 0) & (starts + size < len(self.counts))]
        starts = starts[(starts >= 0) & (starts + size < len(self.counts))]
        if not len(shifts):
            return None
        ions, below = (sums[starts + size] - sums[starts] for sums in (self._sums, self._below))
        net = ions - below
        enough = net > np.maximum(_SIGNIFICANT * np.sqrt(below), _FEWEST)
        shifts, starts, net = shifts[enough], starts[enough], net[enough]
        if not len(shifts):
            return None
        rows = starts[:, None] + np.arange(size)
        # noise on both sides of zero cancels in the sum of a few bins
        observed = np.maximum(gaussian_filter1d(self.counts[rows] - self.background[rows], 1.0, axis=1), 0.0)
        observed /= np.maximum(observed.sum(axis=1, keepdims=True), 1e-300)
        best: tuple[float, int, float] = (0.0, 0, 0.0)
        for shape, width in _shapes(places - first, abundances, size):
            explained = np.minimum(observed, shape).sum(axis=1)
            at = int(np.argmax(explained * net))  # many ions, and most of them
            if explained[at] * net[at] > best[0]:
                best = float(explained[at] * net[at]), at, width
        score, at, width = best
        fill = score / float(net[at])
        if fill < 1 - _LARGEST_MISFIT:
            return None
        intervals = self._intervals(places + shifts[at], abundances, width / STEP, score)
        factor = math.exp(STEP * shifts[at])
        return Comb(formula, charge, factor, fill, score, width, intervals)

    def _intervals(self, places, abundances, width, number):
        """Bounds of the peaks of a number of ions at some places [bins], joined where they touch."""
        from scipy.ndimage import uniform_filter1d

        smooth = uniform_filter1d(self.counts, 3)
        bounds: list[list[int]] = []
        common = abundances > _ENOUGH * abundances.max()
        for place, share in zip(places[common].tolist(), abundances[common].tolist(), strict=True):
            low, high = (self._end_of_peak(smooth, place, step, width) for step in (-1, 1))
            ions, below = (float(counts[low : high + 1].sum()) for counts in (self.counts, self.background))
            evident = max(_EVIDENT * math.sqrt(below), _EVIDENT)
            touches = bool(bounds) and low <= bounds[-1][1] + 1
            if ions - below < evident or (ions - below > _TOO_MANY * share * number + evident and not touches):
                continue
            if touches:
                bounds[-1][1] = high
            else:
                bounds.append([low, high])
        return tuple((float(self.edges[low]), float(self.edges[high + 1])) for low, high in bounds)

    def _end_of_peak(self, smooth, place, step, width):
        """Last bin of a peak in a direction: before the background, or before the spectrum rises again."""
        near = round(place) + np.arange(-math.ceil(width), math.ceil(width) + 1)
        near = near[(near >= 0) & (near < len(smooth))]
        at = int(near[np.argmax(smooth[near])])
        top = lowest = float(smooth[at])
        last, end = at, min(max(at + step * round(_MARGIN / STEP), 0), len(smooth) - 1)
        for at in range(last, end, step):
            level = float(self.background[at])
            if smooth[at] < level + max(1.0, 2 * math.sqrt(level / 3), _FOOT * (top - level)):
                break
            if smooth[at] < lowest:
                lowest, last = float(smooth[at]), at
            elif smooth[at] > _RISE * lowest + 3 * math.sqrt(lowest + 1):
                return last
        return at


def _reaches(formula, charge, low, high, first, last):
    """Whether a comb of an ion, for factors between low and high, depends on the ions from first to last m/n [Da]."""
    masses = _NATURAL.lines(formula)[0] / charge
    return low * masses[0] * (1 - 2 * _MARGIN) < last and high * masses[-1] * (1 + 2 * _MARGIN) > first


def _shapes(places, abundances, size) -> Iterator[tuple[Floats, float]]:
    """Combs with peaks of several widths and tails, each with the sum 1, and their widths."""
    from scipy.special import ndtr

    edges = np.arange(size + 1)
    for width in _WIDTHS:
        cumulative = ndtr((edges - places[:, None]) * STEP / width)
        sharp = abundances @ np.diff(cumulative, axis=1)
        for tail in _TAILS:
            shape = sharp
            if tail:
                reach = np.arange(size)
                decay = np.exp(-reach * STEP / abs(tail))
                forward = sharp if tail > 0 else sharp[::-1]
                shape = np.convolve(forward, decay / decay.sum())[:size]
                shape = shape if tail > 0 else shape[::-1]
            yield shape / shape.sum(), width


def _background_of(counts):
    """Smooth number of ions below the peaks."""
    from scipy.ndimage import uniform_filter1d

    half = round(_BACKGROUND / STEP)
    inside = np.ones(len(counts))
    # several bins together show peaks of few ions
    sums = uniform_filter1d(counts, _PEAK) * _PEAK
    background = uniform_filter1d(counts, 2 * half + 1)
    for _ in range(_ROUNDS):
        expected = _PEAK * background
        inside = (sums <= expected + _ABOVE * np.sqrt(expected + 1)).astype(float)
        weights, total = (uniform_filter1d(v, 2 * half + 1) for v in (inside, inside * counts))
        background = np.where(weights > 0.02, total / np.maximum(weights, 0.02), background)
    return background
