"""Ions in the flanks and tails of others: as many as the tails of other peaks leave."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.spectra.ion_names import Abundances, Ion
from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.peak_contents import Contents, PeakContents
from apt_evap.spectra.peak_scale import BINS, LIGHT

# All constants are chosen by us, on specimens with hydrides of the seeds 505101 and 505102. There 65 and 94 % of 51
# hydrides in broad peaks are within one and two errors, and 81 and 94 % of 191 that are tried and not there.
_FRONT, _BACK = 4.0, 25.0  # standard deviations of a peak on its two sides, the second with the long tail
_CLEAR = 3.0  # standard deviations of a peak that teaches its tail, to the next peak, and to its own hydride
_REACH = 6.0  # to which such a peak must be free
_TEACHER, _NEXT = 1000.0, 0.01  # ions of such a peak, and part of them from which another peak is its neighbour
_LOCAL = 0.7  # distance in ln m/n over which tails are alike, as in `PeakContents`
_TAUGHT = 2000.0  # ions of such peaks, by their distance, that are enough
_TAILS, _UNTAUGHT = (0.15, 0.15, 0.05), (1.0, 1.0, 0.3)
"""Standard deviations of the logarithms of the part of the tails, their length and the width of peaks, between ions
where other peaks teach the tails, and without these."""
_CORES, _MOVED = (0.5, 0.75, 1.0), (-1, 0, 1)
"""Widths of the normal distributions of peaks in standard deviations of the scale, which overlaps make larger, and
bins by which the middle of a peak may be beside its place. Without these, W3+ whose width is 1.6 times too large has
chi-squared 275 for 105 bins, and 148 with them."""
_SHIFT = 0.1  # error of the places of an ion, in standard deviations of a peak, beside that of the calibration
_BACKGROUND, _OUTER = 0.1, 0.05  # relative errors of the background, and of ions with their main peak elsewhere
_SHAPE = 0.05  # relative error of the tails below the peaks of the other ion
_SURE = 12.0
"""Of chi-squared, by which such an ion must be better than its cost: with 0, six hydrides that are not there were named
in the specimens above, L1 up to 6.6, and none with 12."""
_SMALL = 0.1  # of an ion, with which a search for ions in its flanks begins
_START = 20.0  # ions by which the mean shape counts among the peaks that teach
_LEARNT, _FITTED, _ENOUGH = 200, 25, 0.01  # steps of the fits, and logarithm of the likelihood from which they end
_STEPS = (0.02, 0.02, 0.01, 0.02)  # of the changes of a shape, for their slopes


@dataclass(frozen=True)
class Lines:
    """Peaks of an ion: m/n [Da], parts of its ions, and their shape."""

    mass: Floats
    share: Floats
    shape: Floats


@dataclass(frozen=True)
class Flank:
    """An ion in the flank of another one.

    Parameters
    ----------
    main, other : Ion
        The two; `other` may be the isotopes and the tails of `main`.
    ions, error : float
        Number of ions of `other`, below zero if the tails are short, with its standard error, which has the tails.
    gain : float
        By how much chi-squared is better with it.
    sure : bool
        Whether this is more than its cost.
    main_lines, lines : Lines
        Peaks of the two.
    """

    main: Ion
    other: Ion
    ions: float
    error: float
    gain: float
    sure: bool
    main_lines: Lines
    lines: Lines


class FlankFit:
    """Poisson fits of an ion beside another one, whose tails are those of other peaks within their differences.

    Parameters
    ----------
    peaks : PeakContents
        The spectrum.
    contents : Contents
        Its peaks.
    abundances : Abundances
        Isotopes.
    calibration : MassCalibration
        Measured places of ions.
    ions : sequence of Ion
        Ions with a name.
    shares : ndarray
        Part of each in each peak, shape (ions, peaks).
    amplitudes : ndarray
        Number of ions of each, shape (ions,).
    """

    def __init__(
        self,
        peaks: PeakContents,
        contents: Contents,
        abundances: Abundances,
        calibration: MassCalibration,
        ions: Sequence[Ion],
        shares: Floats,
        amplitudes: Floats,
    ) -> None:
        self.peaks, self.contents, self.abundances, self.calibration = peaks, contents, abundances, calibration
        self.ions, self.shares, self.amplitudes = list(ions), shares, amplitudes
        self._places = np.clip(peaks.scale.bins(contents.mass), 0, peaks.scale.size - 1)
        self._columns = peaks.columns(self._places, contents.shapes).tocsr()
        bases = [peaks.bases_of(core) for core in _CORES]
        self.bases = np.vstack([np.roll(base, moved, axis=1) for base in bases for moved in _MOVED])
        self._tables = np.array([
            peaks.columns(self._places, np.tile(base, (len(self._places), 1))) @ contents.ions for base in self.bases
        ]).T  # fmt: skip
        """All peaks with each of the shapes, shape (size, k)."""
        parts = shares * amplitudes[:, None]
        self._main = np.argmax(shares, axis=1) if len(parts) else np.zeros(0, int)
        self._owner = np.argmax(parts, axis=0) if len(parts) else np.zeros(len(contents.mass), int)
        self._named = parts.sum(0) > 0.5 * contents.ions

    def fit(self, main: Ion, costs: Mapping[Ion, float]) -> tuple[list[Flank], list[Ion], Floats]:
        """Ions in the flanks of one, of those that have costs; all ions there, and their covariance."""
        scale = self.peaks.scale
        lines = [self._lines(ion) for ion in (main, *costs)]
        place = float(lines[0][0][int(np.argmax(lines[0][1]))])
        ends = scale.bins(np.concatenate([mass[share > 1e-3] for mass, share in lines]))
        below, above = (_BACK / 2, _FRONT) if scale.mirrored else (_FRONT, _BACK / 2)
        low, high = max(int(ends.min() - below * BINS), 0), min(int(ends.max() + above * BINS), scale.size)
        if high - low < BINS:
            return [], [], np.zeros((0, 0))
        inside = (self._places >= low) & (self._places < high)
        company = [
            ion for ion, peak in zip(self.ions, self._main, strict=True) if inside[peak] and ion not in (main, *costs)
        ]
        group = (main, *costs, *company)
        lines += [self._lines(ion) for ion in company]
        weights, taught = self._tails(place, (main, *costs))
        errors = _TAILS if taught > _TAUGHT else _UNTAUGHT
        shift = math.hypot(_SHIFT, float(self.calibration.shift(place)[1][0] / scale.sigma(place)))
        size = float(max(self.amplitudes[self.ions.index(main)], 1.0))
        columns, sure = self._others(group, low, high)
        if taught <= _TAUGHT:
            weights = self._own_tails(lines, company, main, (low, high), columns.sum(1), weights)
        fits = _Group(
            self.peaks, self.bases, lines, weights, (low, high), columns, np.array([*sure, *errors, shift]), size
        )
        found, covariance = fits.flanks(main, costs, [self.amplitudes[self.ions.index(ion)] / size for ion in company])
        return found, list(group), covariance

    def _own_tails(self, lines, company, main, window, rest, weights):
        """Parts of the tails by the ions themselves, where no other peaks teach them."""
        low, high = window
        tables = []
        for mass, share in lines:
            places = np.clip(self.peaks.scale.bins(mass), 0, self.peaks.scale.size - 1)
            every = [self.peaks.columns(places, np.tile(base, (len(places), 1))) @ share for base in self.bases]
            tables.append(np.array(every)[:, low:high].T)
        tables = np.array(tables)  # (ions, bins, k)
        sums = tables.sum(1)
        ions = np.full(len(lines), _SMALL * self.amplitudes[self.ions.index(main)])
        ions[0] /= _SMALL
        ions[len(lines) - len(company) :] = [self.amplitudes[self.ions.index(ion)] for ion in company]
        counts, start = self.peaks.counts[low:high], (weights + 1 / len(weights)) / 2
        weights = start
        for _ in range(_LEARNT):
            ratio = np.einsum(
                "ibk,b->ik", tables, counts / (np.einsum("ibk,i,k->b", tables, ions, weights) + rest + 1e-9)
            )
            new = _START * start + weights * (ions @ ratio)
            ions = ions * (ratio @ weights) / np.maximum(sums @ weights, 1e-9)
            weights = new / (_START + ions @ sums)
            weights = weights / weights.sum()
        return weights

    def _lines(self, ion):
        """m/n of an ion [Da] as it is measured, and parts."""
        masses, shares = self.abundances.lines(ion.formula)
        return self.calibration.place(masses / ion.charge), shares

    def _others(self, group, low, high):
        """Tails of ions of elsewhere, unnamed peaks and the background, and the relative errors of their numbers."""
        columns, sure, contents = [], [], self.contents
        window = self._columns[low:high]
        inside = (self._places >= low) & (self._places < high)
        for at, ion in enumerate(self.ions):
            column = window @ self.shares[at] * self.amplitudes[at]
            if ion not in group and column.sum() >= 1:
                columns.append(column)
                sure.append(_OUTER)
        mine = self.shares[[at for at, ion in enumerate(self.ions) if ion in group]].sum(0) > 0
        for at in np.flatnonzero(~self._named & ~mine & contents.seen & inside):
            columns.append(window[:, [at]].toarray().ravel() * max(contents.ions[at], 1.0))
            sure.append(1.0)
        return np.array([*columns, contents.background[low:high]]).T, [*sure, _BACKGROUND]

    def _teachers(self, group):
        """Peaks of other ions without others near, and the windows [bins] that their tails have alone."""
        scale, contents = self.peaks.scale, self.contents
        sign = -1 if scale.mirrored else 1
        strong = contents.seen & (contents.ions > _TEACHER) & (contents.mass > LIGHT) & self._named
        for at in np.flatnonzero(strong):
            ion = self.ions[self._owner[at]]
            large = contents.ions > _NEXT * contents.ions[at]
            large[at] = False
            others = sign * (self._places[large] - self._places[at]) / BINS
            reach = min(others[others > 0].min(initial=_BACK + _CLEAR) - _CLEAR, _BACK)
            if sign > 0:
                mass = float(contents.mass[at])
                reach = min(reach, math.log1p(1 / (mass * ion.charge)) / float(scale.sigma(mass)) - _CLEAR)
            if ion in group or reach < _REACH or np.abs(others).min(initial=_BACK) < _FRONT:
                continue
            ends = (-_FRONT, reach) if sign > 0 else (-reach, _FRONT)
            low, high = (round(float(self._places[at]) + end * BINS) for end in ends)
            yield int(at), max(low, 0), min(high, scale.size)

    def _tails(self, mass, group):
        """Parts of the tails by the peaks of other ions, the near ones most, and the number of their ions."""
        peaks, contents = self.peaks, self.contents
        start = weights = (
            np.tile(peaks.mixture, len(self.bases) // len(peaks.bases)) * len(peaks.bases) / len(self.bases)
        )
        rows = list(self._teachers(group))
        numbers = np.array([at for at, _, _ in rows], int)
        local = np.exp(-0.5 * (np.log(contents.mass[numbers] / mass) / _LOCAL) ** 2)
        row = np.repeat(np.arange(len(rows)), [high - low for _, low, high in rows])
        bins = np.concatenate([np.arange(low, high) for _, low, high in rows]) if rows else row
        table, below, counts = self._tables[bins], contents.background[bins] + 1e-9, peaks.counts[bins]
        factor, weight = np.ones(len(rows)), local[row]
        sums = np.array([np.bincount(row, column, len(rows)) for column in table.T]).T
        for _ in range(_LEARNT if rows else 0):  # expectation and maximisation
            density = table @ weights
            ratio = counts / (factor[row] * density + below)
            held = _START * start + weights * ((weight * factor[row] * ratio) @ table)
            weights = held / (_START + (local * factor) @ sums)
            weights = weights / weights.sum()
            factor *= np.bincount(row, ratio * density, len(rows)) / np.maximum(sums @ weights, 1e-9)
        return weights, float((local * contents.ions[numbers]).sum())


class _Group:
    """Poisson likelihood of ions of one shape in a window, with others and the background."""

    def __init__(
        self,
        peaks: PeakContents,
        bases: Floats,
        lines: Sequence[tuple[Floats, Floats]],
        weights: Floats,
        window: tuple[int, int],
        columns: Floats,
        sure: Floats,
        size: float,
    ) -> None:
        self._bases = bases
        self.peaks, self.lines, self.weights, self.columns, self.size = peaks, lines, weights, columns, size
        self.low, self.high = window
        self.counts = peaks.counts[self.low : self.high]
        self.places = [np.clip(peaks.scale.bins(mass), 0, peaks.scale.size - 1) for mass, _ in lines]
        lengths = np.tile(np.pad(peaks.tails, (0, len(peaks.bases) - len(peaks.tails))), len(bases) // len(peaks.bases))
        self._tail = lengths > 0
        self._longer = np.where(self._tail, np.log(np.maximum(lengths, 1) / 3), 0.0)
        # numbers of the ions, over that of the first; of the others, over theirs; changes of the shape
        self.number = len(lines)
        self._sure = np.concatenate([np.zeros(self.number), 1 / sure**2])
        self._expected = np.concatenate([np.zeros(self.number), np.ones(columns.shape[1]), np.zeros(4)])
        self._expected[0] = 1.0
        self._start = self._expected.copy()
        self._fits: dict[frozenset[int], tuple] = {}

    def flanks(self, main: Ion, costs: Mapping[Ion, float], company: Sequence[float]) -> tuple[list[Flank], Floats]:
        """Those of `main`, by fits with and without each, beside a company of other ions."""
        self._tried = tried = len(costs) + 1
        self._start[tried : self.number] = company
        every = frozenset(range(1, tried))
        p, best, expected, hessian = self._best(every)
        clear = expected > 1
        rest = float(((self.counts - expected)[clear] ** 2 / expected[clear]).sum())
        misfit = float(max(rest / max(int(np.count_nonzero(clear)) - len(p), 1), 1.0))
        variance = misfit * np.diag(np.linalg.inv(hessian))[1:tried] * self.size**2
        more = np.array([self._tails_below(at, p) for at in sorted(every)]) ** 2
        gain = np.zeros(len(variance))
        for at in np.flatnonzero(p[1:tried] > 0).tolist():
            gain[at] = 2 * (best - self._best(every - {at + 1})[1]) / misfit * variance[at] / (variance[at] + more[at])
        gain, error = np.maximum(gain, 0.0), np.sqrt(variance + more)
        sure = frozenset((np.flatnonzero(gain > np.array([*costs.values()]) + _SURE) + 1).tolist())
        shape = self._shape(self._best(sure)[0][-4:])
        found = []
        for at, other in enumerate(costs, 1):
            ions = float((self._best(sure)[0] if at in sure else p)[at]) * self.size
            lines = Lines(*self.lines[0], shape), Lines(*self.lines[at], shape)
            numbers = ions, float(error[at - 1]), float(gain[at - 1])
            found.append(Flank(main, other, *numbers, at in sure, *lines))
        return found, self._covariance(sure, misfit, more)

    def _covariance(self, there, misfit, more):
        """Covariance of the numbers of all ions of the group with some of those that are tried."""
        free = self._free(there)
        known = np.zeros((len(free), len(free)))
        known[np.ix_(free, free)] = misfit * np.linalg.inv(self._best(there)[3][np.ix_(free, free)]) * self.size**2
        known = known[: self.number, : self.number]
        for at in there:  # more of one are less of the other
            way = np.zeros(self.number)
            way[[0, at]] = 1, -1
            known += more[at - 1] * np.outer(way, way)
        return known

    def _free(self, there):
        """Parameters that are free with some of the ions that are tried."""
        free = np.ones(len(self._expected), bool)
        free[[at for at in range(1, self._tried) if at not in there]] = False
        return free

    def _tails_below(self, other, p):
        """Error by the tails at the main line of an ion: of one peak of the first, and of all others."""
        shape = self._shape(p[-4:])
        first, main = (float(self.places[at][int(np.argmax(self.lines[at][1]))]) for at in (0, other))
        tail = np.interp(main - first + self.peaks.left, np.arange(len(shape)), shape) * p[0] * self.size
        at = int(np.clip(round(main) - self.low, 0, len(self.counts) - 1))
        group = self._group(p[-4:])[at]
        others = float(
            self.columns[at, :-1] @ p[self.number : -5] + group[self._tried :] @ p[self._tried : self.number]
        )
        return _SHAPE * math.hypot(float(tail), others) / float(shape.max())

    def _shape(self, change):
        """Shape of peaks with more and longer tails, broader and moved."""
        weights = self.weights * np.exp(change[0] * self._tail + change[1] * self._longer)
        shape = weights / weights.sum() @ self._bases
        at, factor = np.arange(len(shape)) - self.peaks.left, math.exp(change[2])
        return np.interp((at - change[3] * BINS) / factor, at, shape) / factor

    def _group(self, change):
        """Columns of the ions."""
        shape, columns = self._shape(change), []
        for places, (_, share) in zip(self.places, self.lines, strict=True):
            every = self.peaks.columns(places, np.tile(shape, (len(places), 1)))
            columns.append(self.size * (every @ share)[self.low : self.high])
        return np.array(columns).T

    def _value(self, p):
        """Logarithm of the likelihood, columns of the ions, and expected counts."""
        group = self._group(p[-4:])
        expected = np.maximum(group @ p[: self.number] + self.columns @ p[self.number : -4], 1e-3)
        value = self.counts @ np.log(expected) - expected.sum() - 0.5 * (self._sure * (p - self._expected) ** 2).sum()
        return float(value), group, expected

    def _best(self, there):
        """Parameters of the highest likelihood with some of the ions, the likelihood, counts, and information."""
        if there not in self._fits:
            self._fits[there] = self._scored(self._free(there))
        return self._fits[there]

    def _scored(self, free):
        """The same by scoring."""
        p = self._start.copy()
        best, group, expected = self._value(p)
        for _ in range(_FITTED):
            slopes = [
                (self._group(p[-4:] + step * (np.arange(4) == at)) - group) @ p[: self.number] / step
                for at, step in enumerate(_STEPS)
            ]
            table = np.column_stack([group, self.columns, np.array(slopes).T])
            hessian = (table / expected[:, None]).T @ table + np.diag(self._sure)
            hessian += (1e-9 * hessian[0, 0] + 1e-12) * np.eye(len(p))  # of ions that are almost the same
            slope = table.T @ (self.counts / expected - 1) - self._sure * (p - self._expected)
            move = np.zeros(len(p))
            move[free] = np.linalg.solve(hessian[np.ix_(free, free)], slope[free])
            for part in (1, 1 / 3, 1 / 9, 1 / 27, 1 / 81):
                trial = p + part * move
                trial[-4:] = np.clip(trial[-4:], (-3, -3, -0.6, -3), (3, 3, 0.6, 3))
                value, *model = self._value(trial)
                if value > best - 1e-9:
                    break
            else:
                break
            ended, (group, expected), p, best = value - best < _ENOUGH, model, trial, value
            if ended:
                break
        return p, best, expected, hessian
