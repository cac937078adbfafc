"""Numbers of ions in the peaks of a spectrum: all peaks and the background at once, by their likelihood."""

import math
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.types import Booleans, Floats
from apt_evap.spectra.peak_scale import APART, BINS, HIGHEST, LIGHT, LOWEST, PeakScale, centroid, find_places

_SHORT, _LONG = 30 * BINS, 110 * BINS  # bins of a peak on both sides of its place; the long tail is at high masses
_TAILS = (0.0, 1.5, 2.5, 4.5, 10.0, 25.0)  # lengths of exponential tails to high masses, in standard deviations
_CORE = 0.75
"""Standard deviation of the normal distribution of a peak with a tail, over that of the left side, which has a part of
the tail. Measured with four made peaks of 100,000 ions, three seeds, as the largest difference of sums of ions: 3.2,
2.6, 2.0, 1.3, 0.9, 3.1 and 4.6 % of a peak for 0.5, 0.6, 0.7, 0.75, 0.8, 0.9 and 1. Compositions did not judge 0.8."""
_LONGEST = 0.016
"""Length in ln m/n at 30 Da of the longest tail, also where 25 standard deviations are more."""
_TAILS_BEFORE = (2.0, 8.0)  # lengths of tails to low masses
_MIXTURE = ((0.4, 0.25, 0.15, 0.1, 0.04, 0.02), (0.03, 0.01))  # of the tails, at the start
_STRONG = 3000  # ions of a peak that has a mixture of tails of its own
_STRONG_LIGHT = 200
"""The same of a light peak whose width is not that of the others. Of 96 made peaks of hydrogen two to eight times as
broad as the others 80 % have errors below 0.92, 0.83 and 0.83 % for 100, 200 and 400 (seed 202706)."""
_ALONE = 12.0  # standard deviations to the next peaks, for tails of its own
_SMALL = 0.03  # height over its own of a peak that does not count
_BACKGROUND_STEP = 0.15  # of ln m/n, between knots of the background
_NEIGHBOURS, _NEIGHBOURS_UNSEEN = 0.10, 0.3
"""Relative error of the tails of other peaks below a peak, and below a place without one: with 0.1, half of the tails
of 1,000 ions of Pt+ were ions of Pt2 2+."""
_SAME_TAILS = 0.7
"""Distance in ln m/n over which peaks have common tails. Mean L1 from the ions drawn of 50 broad specimens (seeds
404102 and 404104, elements given): 0.166 with the same tails at all m/n, 0.126 with 1.2, 0.122 with 0.7."""
_ROUNDS, _ITERATIONS = 3, 120
_FLANK = 0.1
"""Relative error of the shape of a peak, and of its place in standard deviations, for shoulders: 48 of the new peaks of
`_SHOULDER` are lines and 8 are not with 0.05, 26 and 3 with 0.2."""
_SHOULDER, _FEWEST = 4.0, 60.0
"""Errors by which there are more ions, and ions of a shoulder. Of the new peaks in 40 made spectra (seed 202701),
beside 3,000 ions or more, 38 are lines and 3 are not; 41 and 6 with 3 errors, 32 and 3 with 5; 40 and 4 with 30 ions,
38 and 3 with 120."""
_APART_MOVED = 1.5  # standard deviations between a shoulder and another peak at their best places
_PLAIN = 1000
"""Ions of a peak that may have shoulders: with 300, in a measured spectrum of silicon, whose sharp peaks were searched
then, SiO+ was CO2+."""
_BROAD = 1e-3
"""Standard deviation of ln m/n at 30 Da from which peaks may have shoulders. Made broad peaks have 1.4e-3 to 1.7e-3. In
sharp ones, of 5e-4, the places of overlapping lines are not sure enough for a million ions of a nickel alloy: L1 0.13
to 0.17 in place of 0.04 to 0.05 at.% (seeds 3, 302701 and 302702)."""
_SEARCHES, _STEPS = 2, 6  # for shoulders, and of their places towards the best ones
CORE = 2 * BINS
"""Half width of the core of a peak [bins]: the error of its content is that of the counts there."""


class Contents(NamedTuple):
    """Peaks of a spectrum, and places where ions are expected."""

    mass: Floats
    """m/n [Da], shape (n,), increasing."""
    seen: Booleans
    """Whether a peak is there, and not only an expected one."""
    ions: Floats
    """Number of ions."""
    variance: Floats
    """Variance of the number of ions: counts of the core, and tails of the neighbours."""
    background: Floats
    """Background in each bin of the scale."""
    shapes: Floats
    """Shape of each peak, shape (n, bins)."""
    around: Floats
    """Counts about each bin, as far as the core of a peak goes."""

    @property
    def total(self) -> float:
        """Ions in all peaks that are seen."""
        return float(self.ions[self.seen].sum())


class PeakContents:
    """Likelihood fit of peaks of one learnt shape on a smooth background.

    Parameters
    ----------
    mass : ndarray
        m/n of the ions [Da], between `LOWEST` and `HIGHEST`.
    """

    def __init__(self, mass: Floats) -> None:
        self.scale = PeakScale(mass)
        self.counts = self.scale.counts(mass)
        self.places, self._smooth = find_places(self.counts)
        self.seen_at = self.scale.mass(self.places) if len(self.places) else np.zeros(0)
        """m/n of the peaks [Da]."""
        longest = _LONGEST / float(self.scale.sigma(30.0))
        self.tails = [length for length in _TAILS if length < longest]
        if len(self.tails) < len(_TAILS) and longest > 1.5 * self.tails[-1]:
            self.tails.append(longest)
        """Lengths of the tails to high masses."""
        self.left = _LONG if self.scale.mirrored else _SHORT
        self.bases = self.bases_of(_CORE)
        """Shapes of peaks: normal, with each of the tails, shape (k, bins)."""
        self._smooth_background = _background_basis(self.scale)
        self._mixture = np.array([*_MIXTURE[0][: len(self.tails)], *_MIXTURE[1]])
        self._start: Floats | None = None  # amplitudes of the background of the last fit
        if len(self.places) and self.scale.sigma(30.0) > _BROAD:
            self.places = self._with_shoulders(self.places)
            self.seen_at = self.scale.mass(self.places)

    def fit(self, expected: Floats | None = None) -> Contents:
        """Numbers of ions at the peaks, and at further places where ions are expected [Da]."""
        more = np.zeros(0) if expected is None else np.asarray(expected, float)
        mass = np.concatenate([self.seen_at, more])
        seen = np.arange(len(mass)) < len(self.seen_at)
        order = np.argsort(mass, kind="stable")
        mass, seen = mass[order], seen[order]
        place = np.clip(self.scale.bins(mass), 0, self.scale.size - 1)
        # strong peaks have tails of their own, or common ones if other peaks are near; the others have their mean
        height, main = self._heights(place)
        own = (self.scale.light > 1) & (mass < LIGHT)  # of a shape of their own
        strong = seen & main & (height * BINS * 2.5 > np.where(own, _STRONG_LIGHT, _STRONG))
        common = (strong & ~own & ~_isolated(place, height))[strong]
        mixture = self._mixture / self._mixture.sum()
        rounds = _ROUNDS if self._start is None else _ROUNDS - 1  # the next fits begin with the shape of the last
        for number in range(rounds):
            last = number == rounds - 1
            iterations = _ITERATIONS if last else _ITERATIONS // 3
            ions, shares, below = self._maximise(place, height, strong, common, mixture, iterations)
            if (strong & ~own).any():
                weights = np.sqrt(ions[strong & ~own])
                mixture = np.maximum((shares[strong & ~own] * weights[:, None]).sum(0) / max(weights.sum(), 1e-9), 1e-4)
                mixture /= mixture.sum()
        self._mixture = mixture
        shapes = np.where(strong[:, None], shares, mixture) @ self.bases
        return Contents(mass, seen, ions, self._variance(place, seen, ions, shapes, below, mixture), below, shapes,
                        np.convolve(self.counts, np.ones(2 * CORE + 1), "same"))  # fmt: skip

    def bases_of(self, core: float) -> Floats:
        """Shapes of peaks with normal distributions of some width, 0.75 for that of the scale, shape (k, bins)."""
        from scipy.special import ndtr

        size = _SHORT + _LONG + 1
        shapes = []
        for length, before in [(t, False) for t in self.tails] + [(t, True) for t in _TAILS_BEFORE]:
            zero, shift = (_LONG if before else _SHORT), 0.0
            for _ in range(2):  # with the middle of the peak, as `find_places` sees it, at its place
                edges = (np.arange(size + 1) - zero - 0.5 + shift) / BINS
                shape = np.diff(ndtr(edges / (core if length else core / _CORE)))
                if length:
                    decay = np.exp(-np.arange(size) / (BINS * length))
                    shape = np.convolve(shape, decay / decay.sum())[:size]
                shift = centroid(shape, int(np.argmax(shape))) - zero
            shapes.append(shape[::-1] if before else shape)
        bases = np.array(shapes)
        bases[bases < 1e-7] = 0
        return bases[:, ::-1] if self.scale.mirrored else bases

    def _heights(self, places):
        """Height of the histogram at some places [bins], and whether it is not that of the tail of another."""
        height = self._smooth[np.clip(np.rint(places).astype(int), 0, self.scale.size - 1)]
        near = np.array([height[np.abs(places - centre) < 60 * BINS].max() for centre in places])
        return height, height > 0.03 * near

    def _with_shoulders(self, places):
        """Places of peaks [bins], and of those in the flanks and tails of others, where these have fewer ions.

        All peaks have the mean shape here: one with tails of its own would have the ions of a shoulder in them.
        """
        mixture = self._mixture / self._mixture.sum()
        for _ in range(_SEARCHES):
            height, main = self._heights(places)
            strong = main & (height * BINS * 2.5 > _STRONG)
            if not strong.any():
                break
            common = np.ones(int(strong.sum()), bool)
            for _ in range(2):
                ions, shares, below = self._maximise(places, height, strong, common, mixture, _ITERATIONS // 3)
                mixture = np.maximum(shares[strong].mean(0), 1e-4)
                mixture /= mixture.sum()
            found = self._places_of_more(places, ions, below, mixture @ self.bases)
            found = found[np.abs(found[:, None] - places[height * BINS * 2.5 > _PLAIN]).min(1) < _ALONE * BINS]
            if not len(found):
                break
            places = self._moved(places, found, mixture)
        return places

    def _places_of_more(self, places, ions, below, shape):
        """Places [bins] where the histogram has more ions than peaks of a shape and a background."""
        from scipy.ndimage import gaussian_filter1d
        from scipy.signal import find_peaks

        peaks = gaussian_filter1d(self.columns(places, np.tile(shape, (len(places), 1))) @ ions, BINS)
        expected = peaks + gaussian_filter1d(below, BINS)
        more, wide = self._smooth - expected, 2 * math.sqrt(math.pi) * BINS  # bins that are effectively in the filter
        error = np.sqrt(expected / wide + (_FLANK * peaks) ** 2 + (_FLANK * BINS * np.gradient(peaks)) ** 2 + 0.1)
        tops, _ = find_peaks(more / error, height=_SHOULDER)
        apart = np.abs(tops[:, None] - places).min(1) > APART * BINS
        return tops[apart & (self.scale.mass(tops) > LIGHT) & (more[tops] * wide > _FEWEST)].astype(float)

    def _moved(self, places, found, mixture):
        """Places of peaks and of new ones [bins], these and their neighbours where the likelihood is best."""
        new = np.arange(len(places) + len(found)) >= len(places)
        places = np.append(places, found)
        first, none = places, np.zeros(len(places), bool)
        moved = np.abs(places[:, None] - found).min(1) < _ALONE / 2 * BINS
        shapes = np.tile(mixture @ self.bases, (len(places), 1))
        for _ in range(_STEPS):
            ions, _, below = self._maximise(places, self._heights(places)[0], none, none[:0], mixture, _ITERATIONS // 4)
            weights = 1 / (self.columns(places, shapes) @ ions + below + 1e-3)
            slope = self.columns(places + 0.5, shapes) - self.columns(places - 0.5, shapes)
            step = slope.T @ (self.counts * weights - 1) / np.maximum(slope.power(2).T @ weights * ions, 1e-9)
            step = np.clip(step, -BINS / 2, BINS / 2)
            places = first + np.clip(places + np.where(moved, step, 0) - first, -APART * BINS, APART * BINS)
        others = np.abs(places[:, None] - places) + np.where(np.eye(len(places), dtype=bool), np.inf, 0)
        return np.sort(places[~new | ((ions > _FEWEST) & (others.min(1) > _APART_MOVED * BINS))])

    def _maximise(self, place, height, strong, common, mixture, iterations):
        """Ions and shares of the tails of each peak, and the background, by expectation and maximisation."""
        from scipy.sparse import hstack

        owner = np.repeat(np.arange(len(place)), np.where(strong, len(self.bases), 1))
        first = np.concatenate([[True], owner[1:] != owner[:-1]]) if len(owner) else np.zeros(0, bool)
        kind = np.arange(len(owner)) - np.maximum.accumulate(np.where(first, np.arange(len(owner)), 0))
        kinds = np.where(strong[owner], kind, len(self.bases))
        peaks = self.columns(place[owner], np.vstack([self.bases, mixture @ self.bases])[kinds])
        every = hstack([peaks, self._smooth_background]).tocsc()
        norm = np.maximum(np.asarray(every.sum(0)).ravel(), 1e-12)
        held = np.flatnonzero(self.counts)  # other bins add zeros
        counts, every = self.counts[held], every.tocsr()[held].tocsc()
        transposed = every.T
        amplitudes = np.empty(len(norm))
        share = np.append(mixture, 1.0)[kinds]
        amplitudes[: len(owner)] = np.maximum(height * BINS * 2.6, 1.0)[owner] * share
        if self._start is None:
            self._start = np.full(self._smooth_background.shape[1], np.percentile(self.counts, 30) / 2 + 1e-3)
            self._start /= max(float(np.median(np.asarray(self._smooth_background.sum(1)).ravel())), 1e-9)
        amplitudes[len(owner) :] = np.maximum(self._start, 1e-6 * self._start.max() + 1e-12)
        own = kinds < len(self.bases)
        rows = np.flatnonzero(own).reshape(-1, len(self.bases))
        logs = np.log(self.scale.mass(place[strong]))
        alike = np.exp(-0.5 * ((logs[common][:, None] - logs) / _SAME_TAILS) ** 2)
        for _ in range(iterations):
            amplitudes *= (transposed @ (counts / (every @ amplitudes + 1e-9))) / norm
            if common.any():
                parts = amplitudes[rows]
                near = alike @ parts
                amplitudes[rows[common]] = parts[common].sum(1, keepdims=True) * (
                    near / np.maximum(near.sum(1, keepdims=True), 1e-300)
                )
        self._start = amplitudes[len(owner) :].copy()
        of_kind = np.zeros((len(place), len(self.bases)))
        of_kind[owner[own], kinds[own]] = amplitudes[: len(owner)][own]
        ions = np.bincount(owner, amplitudes[: len(owner)], minlength=len(place))
        shares = of_kind / np.maximum(of_kind.sum(1, keepdims=True), 1e-9)
        return ions, shares, self._smooth_background @ amplitudes[len(owner) :]

    @property
    def mixture(self) -> Floats:
        """Parts of the tails in the mean shape, shape (k,)."""
        return self._mixture / self._mixture.sum()

    @property
    def shape(self) -> Floats:
        """Mean shape of the strong peaks, shape (bins,)."""
        return self.mixture @ self.bases

    def columns(self, place: Floats, shapes: Floats) -> Any:
        """Sparse matrix of shapes of peaks at places [bins], shape (size, n)."""
        from scipy.sparse import csc_matrix

        low = np.floor(place).astype(int)
        part = (place - low)[:, None]
        values = shapes * (1 - part)
        values[:, 1:] += shapes[:, :-1] * part
        rows = low[:, None] + np.arange(-self.left, shapes.shape[1] - self.left)
        inside = (rows >= 0) & (rows < self.scale.size) & (values > 0)
        ends = np.concatenate([[0], np.cumsum(inside.sum(1))])
        return csc_matrix((values[inside], rows[inside], ends), shape=(self.scale.size, len(place)))

    def between(self, shape: Floats, bounds: Floats) -> Floats:
        """Part of a shape between bounds relative to its place [bins], of shape (2, n)."""
        sums = np.pad(np.cumsum(shape), (1, 0))
        low, high = np.interp(bounds + self.left + 0.5, np.arange(len(sums)), sums)
        return high - low

    def _variance(self, place, seen, ions, shapes, below, mixture):
        """Variance of contents: the counts of the core, tails of the neighbours, and four ions."""
        model = self.columns(place, shapes) @ ions + below
        core = float((mixture @ self.bases)[self.left - CORE : self.left + CORE + 1].sum())
        sums, sums_below = (np.pad(np.cumsum(values), (1, 0)) for values in (model, below))
        middle = np.floor(place).astype(int)
        low = np.clip(middle - CORE, 0, self.scale.size)
        high = np.clip(middle + CORE + 1, 0, self.scale.size)
        every, of_background = sums[high] - sums[low], sums_below[high] - sums_below[low]
        others = np.maximum(every - of_background - ions * core, 0)
        core = max(core, 0.3)
        return (
            np.maximum(every, 1) / core**2
            + (np.where(seen, _NEIGHBOURS, _NEIGHBOURS_UNSEEN) * others / core) ** 2
            + 4.0
        )


def _isolated(place, height):
    """Whether no other peak of some height is so near that tails could be exchanged."""
    near = (np.abs(place[:, None] - place) < _ALONE * BINS) & (height > _SMALL * height[:, None])
    return near.sum(1) < 2  # itself


def _background_basis(scale):
    """Sparse matrix of cubic splines in ln m/n, times a density that is constant in time of flight."""
    from scipy.interpolate import BSpline
    from scipy.sparse import diags

    logs = np.log(np.clip(scale.centres, LOWEST, HIGHEST))
    first, last = math.log(LOWEST), math.log(HIGHEST)
    inner = np.linspace(first, last, math.ceil((last - first) / _BACKGROUND_STEP) + 1)
    knots = np.concatenate([[first] * 3, inner, [last] * 3])
    splines = BSpline.design_matrix(logs, knots, 3)
    return (diags(np.gradient(np.log(scale.centres)) * np.sqrt(scale.centres)) @ splines).tocsc()
