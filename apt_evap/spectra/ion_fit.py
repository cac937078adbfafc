"""Joint non-negative fit of ions to the contents and the places of all peaks of a spectrum."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import Booleans, Floats
from apt_evap.spectra.ion_names import Abundances, Ion
from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.peak_contents import CORE, Contents
from apt_evap.spectra.peak_scale import LIGHT, PeakScale

_LIGHT_ERROR, _LIGHT_WINDOW = 5e-3, 0.015  # relative error of their places, and how far a peak may be
_SHAPE_ERROR = 0.05  # of a place, in standard deviations of a peak
_READING_ERROR = 2e-4  # of a place [Da]
_WINDOW = 3.0  # standard deviations of a place
_UNSEEN = 1.0  # added to the distance of a place without a peak: a peak comes first
_JOINED = 2.5  # standard deviations of two lines that are one peak
_OWN_LINE, _OWN_LINES = 0.02, 2  # abundance and number of lines elsewhere, for which an ion may have a part of it
_HIDDEN = 6.0
"""Errors of all lines of an ion without a peak together, from which one of them may be its main line: with 10, UH+ in
the tail of U+ is lost."""
MISSED = 0.25  # part of the isotopes of an ion that may have no place in a spectrum

Rows = NDArray[np.int64]


class IonFit:
    """Ions as columns of a linear system, and its non-negative solutions.

    The number of ions in a peak k is the sum of the amplitudes of its ions times the abundances of their isotopes. The
    centre of gravity of the places where these should be is the place of the peak. Both are linear in the amplitudes.
    Isotopes where no peak is count against an ion.
    The first n ions are peaks without a name, one for each of the n peaks.

    Parameters
    ----------
    contents : Contents
        The peaks.
    scale : PeakScale
        Their widths.
    calibration : MassCalibration
        Measured places of ions.
    abundances : Abundances
        Isotopes.
    shape_error : float
        Relative error of the content of a peak.
    window : float
        Largest relative distance of a peak from the place of an ion.
    own_shift : float
        Relative shift of an ion of its own.
    """

    def __init__(
        self,
        contents: Contents,
        scale: PeakScale,
        calibration: MassCalibration,
        abundances: Abundances,
        shape_error: float,
        window: float,
        own_shift: float = 0.0,
    ) -> None:
        self.contents, self.scale, self.calibration, self.abundances = contents, scale, calibration, abundances
        mass, ions = contents.mass, contents.ions
        self.number = len(mass)
        self.error = np.sqrt(contents.variance + (shape_error * ions) ** 2)
        sigma = scale.sigma(mass)
        place = np.sqrt(
            (1.5 * sigma / np.sqrt(np.maximum(ions, 4))) ** 2
            + calibration.scatter**2
            + (_SHAPE_ERROR * sigma) ** 2
            + (_READING_ERROR / mass) ** 2
            + calibration.shift(mass)[1] ** 2
            + own_shift**2
        )
        light = mass < LIGHT
        self.place_error = np.where(light, np.maximum(place, _LIGHT_ERROR), place)
        most = np.where(light, _LIGHT_WINDOW, window)
        self._window = np.maximum(
            np.minimum(_WINDOW * self.place_error, most), np.where(contents.seen, 1, _JOINED) * sigma
        )
        self._unseen = np.where(contents.seen, 0.0, 1 / contents.variance)
        self._target = ions / self.error
        self.all_chi2 = float(self._target @ self._target)
        """Chi-squared without ions."""
        self.ions: list[Ion | None] = [None] * self.number
        self._numbers: dict[Ion, int] = {}
        self._rows = np.hstack([np.diag(1 / self.error), np.zeros((self.number, self.number))])
        self._products: dict[int, Floats] = {}
        self._refresh()
        self._absent, self._own = np.zeros(self.number), np.zeros(self.number, bool)
        self.missed, self.main, self.largest = np.zeros(self.number), np.arange(self.number), np.ones(self.number)
        self.shares = np.eye(self.number)
        """Share of the ions of each column in each peak, shape (columns, n)."""
        self._hidden = self._clear_unseen(self.shares)

    def _refresh(self):
        self._diagonal = np.einsum("ij,ij->i", self._rows, self._rows)
        self._projections = self._rows[:, : self.number] @ self._target

    def numbers(self, ions: Sequence[Ion]) -> Rows:
        """Numbers of the columns of ions; new columns are made for new ions."""
        new = [ion for ion in dict.fromkeys(ions) if ion not in self._numbers]
        if new:
            self._add(new)
        return np.array([self._numbers[ion] for ion in ions], np.int64)

    def _add(self, new):
        """Columns of new ions."""
        n, mass = self.number, self.contents.mass
        lines = [self.abundances.lines(ion.formula) for ion in new]
        owner = np.repeat(np.arange(len(new)), [len(masses) for masses, _ in lines])
        places = self.calibration.place(
            np.concatenate([m / ion.charge for ion, (m, _) in zip(new, lines, strict=True)])
        )
        share = np.concatenate([shares for _, shares in lines])
        contents, shifts = np.zeros((len(new), n)), np.zeros((len(new), n))
        missed, absent = np.bincount(owner, share, minlength=len(new)), np.zeros(len(new))
        own = np.zeros(len(new), bool)
        if n:
            near = np.searchsorted(mass, places)[:, None] + np.arange(-2, 2)
            inside = (near >= 0) & (near < n)
            near = np.clip(near, 0, n - 1)
            distance = np.log(places[:, None] / mass[near])
            cost = np.where(inside & (np.abs(distance) < self._window[near]), np.abs(distance), np.inf)
            unseen = ~self.contents.seen[near] & (np.abs(distance) > 0.5 * self.scale.sigma(places)[:, None])
            cost = cost + _UNSEEN * unseen
            best = np.argmin(cost, axis=1)
            line = np.arange(len(places))
            held = np.isfinite(cost[line, best])
            peak, distance = near[line, best], distance[line, best]
            np.add.at(contents, (owner[held], peak[held]), share[held])
            on_peak = held & self.contents.seen[peak]
            np.add.at(shifts, (owner[on_peak], peak[on_peak]), (share * distance)[on_peak])
            # a line beside a peak that it cannot be separated from, of an ion with lines of its own elsewhere: without
            # a word on its place, which is that of the other ion
            seen_distance = np.where(
                inside & self.contents.seen[near], np.abs(np.log(places[:, None] / mass[near])), np.inf
            )
            nearest = np.argmin(seen_distance, axis=1)
            own = np.bincount(owner, on_peak & (share > _OWN_LINE), minlength=len(new)) >= _OWN_LINES
            joined = ~held & (seen_distance[line, nearest] < _JOINED * self.scale.sigma(places))
            beside = near[line, nearest]
            np.add.at(contents, (owner[joined], beside[joined]), share[joined])
            alone = joined & ~own[owner]  # others move the centre of gravity of the peak
            shift = np.log(places / mass[beside])
            np.add.at(shifts, (owner[alone], beside[alone]), (share * shift)[alone])
            missed = np.bincount(owner, share * ~(held | joined), minlength=len(new))
            none = ~(held | joined)
            absent = np.bincount(owner[none], (share / self._noise(places))[none] ** 2, minlength=len(new))
        rows = np.hstack([contents / self.error, shifts / (np.maximum(self.contents.ions, 1) * self.place_error)])
        first = len(self.ions)
        self.ions += new
        self._numbers |= {ion: first + at for at, ion in enumerate(new)}
        self._products = {
            at: np.concatenate([product, rows @ self._rows[at]]) for at, product in self._products.items()
        }
        self._rows = np.vstack([self._rows, rows])
        self.shares = np.vstack([self.shares, contents])
        self.missed, self._own = np.concatenate([self.missed, missed]), np.concatenate([self._own, own])
        self._absent = np.concatenate([self._absent, absent])
        self._hidden = np.concatenate([self._hidden, self._clear_unseen(contents)])
        main = np.argmax(contents, axis=1) if n else np.zeros(len(new), int)
        self.main = np.concatenate([self.main, main])
        self.largest = np.concatenate([self.largest, contents.max(axis=1, initial=0)])
        self._diagonal = np.concatenate([self._diagonal, np.einsum("ij,ij->i", rows, rows) + absent])
        self._projections = np.concatenate([self._projections, rows[:, :n] @ self._target])

    def _clear_unseen(self, contents):
        """Whether the lines of ions without a peak are clearly above zero together."""
        held, square = contents @ (self._unseen * self.contents.ions), contents**2 @ self._unseen
        return held > _HIDDEN * np.sqrt(np.maximum(square, 1e-300))

    def _noise(self, places):
        """Standard deviation of the content of places without a peak [Da]: of counting, and what may be there."""
        bins = np.clip(np.rint(self.scale.bins(places)), 0, self.scale.size - 1).astype(int)
        counts = self.contents.around[bins]
        more = np.maximum(counts - self.contents.background[bins] * (2 * CORE + 1), 0)
        return np.sqrt(counts + 4 + more**2)

    def possible(self, numbers: Rows) -> Booleans:
        """Whether ions have most of their isotopes in the spectrum, and a peak for the most abundant one or for two."""
        if not self.number:
            return np.zeros(len(numbers), bool)
        seen = self.contents.seen[self.main[numbers]] | self._hidden[numbers] | self._own[numbers]
        return (self.missed[numbers] <= MISSED) & (self.largest[numbers] > 0) & seen

    def _product(self, number):
        """Products of a column with all others."""
        if number not in self._products:
            self._products[number] = self._rows @ self._rows[number]
            self._products[number][number] += self._absent[number]
        return self._products[number]

    def products(self, numbers: Rows, chosen: Sequence[int]) -> Floats:
        """Products of columns with those of some ions, shape (numbers, chosen)."""
        if not len(chosen):
            return np.zeros((len(numbers), 0))
        return np.stack([self._product(number)[numbers] for number in chosen], axis=1)

    def solve(self, chosen: Sequence[int]) -> tuple[Floats, float]:
        """Amplitudes of some ions, not below zero, and chi-squared."""
        if not len(chosen):
            return np.zeros(0), self.all_chi2
        rows = np.asarray(chosen, np.int64)
        gram, target = self.products(rows, chosen), self._projections[rows]
        amplitudes = non_negative(gram, target)
        # twice the product less the square: exact also for amplitudes that are not quite the best
        return amplitudes, float(self.all_chi2 - 2 * amplitudes @ target + amplitudes @ gram @ amplitudes)

    def gains(self, numbers: Rows, chosen: Sequence[int], amplitudes: Floats, products: Floats | None = None) -> Floats:
        """By how much chi-squared falls with one more ion, where the amplitudes of the others stay above zero."""
        active = np.flatnonzero(amplitudes > 0)
        rows = np.asarray(chosen, np.int64)[active]
        products = self.products(numbers, rows.tolist()) if products is None else products[:, active]
        residual = self._projections[numbers] - products @ amplitudes[active]
        square = self._diagonal[numbers].copy()
        if len(rows):
            square -= ((products @ inverse_of(self.products(rows, rows.tolist()))) * products).sum(1)
        square = np.maximum(square, 1e-6 * self._diagonal[numbers] + 1e-300)
        return np.where(residual > 0, residual**2 / square, 0.0)

    def losses(self, chosen: Sequence[int], amplitudes: Floats) -> Floats:
        """By how much chi-squared rises without each of some ions, if the others stay above zero."""
        rows = np.asarray(chosen, np.int64)
        inverse = inverse_of(self.products(rows, chosen))
        return amplitudes**2 / np.maximum(np.diag(inverse), 1e-300)

    def explained(self, chosen: Sequence[int], amplitudes: Floats) -> Floats:
        """Ions of each peak by the amplitudes of some ions, shape (n,)."""
        if not len(chosen):
            return np.zeros(self.number)
        return np.asarray(amplitudes) @ self.shares[np.asarray(chosen, np.int64)]


def inverse_of(gram: Floats) -> Floats:
    """Inverse of a matrix of products, also of columns that are almost equal."""
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = gram * scale[:, None] * scale + 1e-8 * np.eye(len(gram))
    return np.linalg.inv(scaled) * scale[:, None] * scale


def non_negative(gram: Floats, target: Floats) -> Floats:
    """Non-negative least squares from the normal equations (Lawson and Hanson, 1974, from all columns)."""
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    gram = gram * scale[:, None] * scale + 1e-9 * np.eye(len(gram))
    target = target * scale
    positive = np.ones(len(target), bool)
    x = np.zeros(len(target))
    for _ in range(3 * len(target) + 10):
        rows = np.flatnonzero(positive)
        trial = np.zeros(len(target))
        if len(rows):
            trial[rows] = np.linalg.solve(gram[np.ix_(rows, rows)], target[rows])
        if (trial[rows] > 0).all():
            x = trial
            slope = np.where(positive, -np.inf, target - gram @ x)
            best = int(np.argmax(slope))
            if not slope[best] > 1e-7 * max(np.abs(target).max(), 1e-300):
                break
            positive[best] = True
            continue
        falling = rows[trial[rows] <= 0]
        if x[falling].min(initial=1.0) <= 0:  # from the start, or a column that came and goes: without it
            positive[falling[x[falling] <= 0]] = False
            continue
        # on the way from the last solution, until the first amplitude is zero
        step = (x[falling] / np.maximum(x[falling] - trial[falling], 1e-300)).min()
        x = np.maximum(x + step * (trial - x), 0)
        positive &= x > 1e-12 * x.max(initial=0)
        x[~positive] = 0
    return x * scale
