"""Ions of the ranges of a file: their numbers from all ranges together, without the background."""

from typing import NamedTuple

import numpy as np

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind
from apt_evap.spectra.ion_names import Abundances, Ion, formula_of_atoms
from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.spectra.peak_contents import Contents, PeakContents

_BELOW, _ABOVE = 0.006, 0.002  # of m/n, by which an isotope may lie outside its range
_HIGHEST = 4  # charge
_LARGE, _PLACE, _MOST_POINTS = 0.1, 3e-4, 60  # abundance over the largest, and error of a place of the calibration
_SHAPE = 0.01  # relative error of the ions of a range: its bounds and the shape
_BACKGROUND = 0.1  # relative error of the background
_UNLIKE = 0.2  # part of the ions of a range that its ions do not explain, from which it is named
_ELSEWHERE = 0.3  # part of the ions of a range in peaks where its ions have no isotope, from which it is named
_CLEAR, _FEWEST = 5.0, 100.0  # in errors of counting, and ions


class RangeMisfit(NamedTuple):
    """A range whose ions do not have these numbers."""

    name: str
    low: float
    high: float
    ions: float
    """Ions above the background."""
    expected: float
    """Ions by the isotopes of all ions of the ranges, at their places."""

    def __str__(self) -> str:
        return (
            f"{self.name} at {self.low:.2f} to {self.high:.2f} Da has {self.ions:,.0f} ions, "
            f"its isotopes give {self.expected:,.0f}"
        )


class RangedIons:
    """Ions of ranges: isotopes decide where ranges of several ions overlap.

    Parameters
    ----------
    peaks : PeakContents
        The spectrum.
    contents : Contents
        Its peaks.
    ranges : Ranges
        Ranges with the atoms of their ions.
    abundances : Abundances
        Isotopes.

    Raises
    ------
    ValueError
        If no range has ions with known elements and an isotope in it.
    """

    def __init__(self, peaks: PeakContents, contents: Contents, ranges: Ranges, abundances: Abundances) -> None:
        check_kind(ranges, "ranges", Ranges, "Ranges, such as those of read_ranges")
        self._peaks, self._contents, self.ranges, self._abundances = peaks, contents, ranges, abundances
        shape = (contents.shapes * contents.ions[:, None]).sum(0)
        self._shape = shape / max(float(shape.sum()), 1e-300)
        self.ions, self.rows = self._find()
        if not self.ions:
            raise ValueError(f"ranges must contain isotopes of their ions, got {ranges!r}")
        self.calibration = self._calibrated()
        self._columns = np.array([self._column(ion) for ion in self.ions]).T
        below = np.pad(np.cumsum(contents.background), (1, 0))
        places = peaks.scale.bins(np.concatenate([ranges.low, ranges.high])) + 0.5
        sums = np.interp(places, np.arange(len(below)), below)
        self._background = sums[len(ranges) :] - sums[: len(ranges)]
        self._total = float(peaks.counts.sum())

    def _find(self):
        """Ions whose most abundant isotope is in a range of their atoms, and these ranges."""
        found: dict[Ion, list[int]] = {}
        for row, atoms in enumerate(self.ranges.composition or ()):
            if not atoms:
                continue
            try:
                formula = formula_of_atoms(atoms)
                masses, shares = self._abundances.lines(formula)
            except ValueError:
                continue  # of a name that is not of elements
            for charge in range(1, _HIGHEST + 1):
                inside = self._inside(masses / charge, row)
                if inside.any():
                    found.setdefault(Ion(formula, charge), []).append(row)
        main = {}
        for ion, rows in found.items():
            masses, shares = self._abundances.lines(ion.formula)
            most = masses[int(np.argmax(shares))] / ion.charge
            if any(self._inside(np.array([most]), row).any() for row in rows):
                main[ion] = rows
        return list(main), list(main.values())

    def _inside(self, masses, row):
        return (masses > self.ranges.low[row] * (1 - _BELOW)) & (masses < self.ranges.high[row] * (1 + _ABOVE))

    def _calibrated(self):
        """The calibration by the peaks in ranges that are where an isotope of their ions should be."""
        seen, points = self._peaks.seen_at, []
        for ion, rows in zip(self.ions, self.rows, strict=True):
            masses, shares = self._abundances.lines(ion.formula)
            for mass in masses[shares > _LARGE * shares.max()] / ion.charge:
                row = next((row for row in rows if self._inside(np.array([mass]), row)[0]), None)
                if row is None:
                    continue
                near = seen[(seen >= self.ranges.low[row]) & (seen < self.ranges.high[row])]
                shift = near / mass - 1
                if len(near) and np.abs(shift).min() < _BELOW:
                    points.append((float(mass), float(shift[np.argmin(np.abs(shift))]), _PLACE))
        calibration = MassCalibration()
        calibration.learn(points[:_MOST_POINTS])
        return calibration

    def _column(self, ion):
        """Part of an ion in each range, with the tails of its peaks."""
        masses, shares = self._abundances.lines(ion.formula)
        scale = self._peaks.scale
        bounds = scale.bins(np.stack([self.ranges.low, self.ranges.high]))
        column = np.zeros(len(self.ranges))
        for place, share in zip(self.calibration.place(masses / ion.charge), shares, strict=True):
            column += share * self._peaks.between(self._shape, bounds - scale.bins(place))
        return column

    def amounts(self, mass: Floats) -> tuple[Floats, Floats]:
        """Numbers of ions and their covariance among some ions [Da]."""
        from scipy.optimize import nnls

        counts, below = self._counts(mass)
        net = counts - below
        error = np.sqrt(counts + (_BACKGROUND * below) ** 2 + (_SHAPE * net) ** 2 + 1)
        system = self._columns / error[:, None]
        return nnls(system, net / error)[0], np.linalg.pinv(system.T @ system)

    def _counts(self, mass):
        """Ions of each range, and those of the background."""
        ordered = np.sort(mass)
        counts = np.searchsorted(ordered, self.ranges.high) - np.searchsorted(ordered, self.ranges.low)
        return counts.astype(float), self._background * (len(mass) / max(self._total, 1.0))

    def misfits(self, mass: Floats, ions: Floats) -> tuple[list[RangeMisfit], float]:
        """Ranges that their ions do not explain, and the part of the ions in ranges that is wrong by this."""
        counts, below = self._counts(mass)
        net, expected = counts - below, self._columns @ ions
        elsewhere = self._elsewhere(ions)
        wrong = np.abs(net - expected) > np.maximum(np.maximum(_UNLIKE * net, _CLEAR * np.sqrt(counts + 1)), _FEWEST)
        misplaced = elsewhere > np.maximum(_ELSEWHERE * net, _FEWEST)
        expected = np.where(misplaced, np.minimum(expected, net - elsewhere), expected)
        named = np.flatnonzero(wrong | misplaced)
        low, high, names = self.ranges.low.tolist(), self.ranges.high.tolist(), self.ranges.names
        misfits = [
            RangeMisfit(names[row], low[row], high[row], float(net[row]), max(float(expected[row]), 0.0))
            for row in named.tolist()
        ]
        part = float(np.abs(net - expected)[named].sum() / max(float(np.maximum(net, 0).sum()), 1.0))
        return sorted(misfits, key=lambda misfit: -abs(misfit.ions - misfit.expected)), part

    def _elsewhere(self, ions):
        """Ions of the peaks in each range that are not where its isotopes are."""
        contents = self._contents
        expected = np.zeros(len(contents.mass))
        for ion, number in zip(self.ions, ions, strict=True):
            masses, shares = self._abundances.lines(ion.formula)
            distance = np.abs(np.log(masses[:, None] / ion.charge / contents.mass))
            near = np.argmin(distance, axis=1)
            close = distance[np.arange(len(masses)), near] < _BELOW
            np.add.at(expected, near[close], (number * shares)[close])
        rest = np.where(contents.seen, np.maximum(contents.ions - expected, 0), 0.0)
        inside = (contents.mass >= self.ranges.low[:, None]) & (contents.mass < self.ranges.high[:, None])
        return inside @ rest

    def outside(self) -> list[tuple[float, float]]:
        """Place [Da] and ions of the peaks in no range."""
        contents, ranges = self._contents, self.ranges
        inside = ((contents.mass[:, None] >= ranges.low) & (contents.mass[:, None] < ranges.high)).any(1)
        clear = ~inside & contents.seen & (contents.ions > np.maximum(_CLEAR * np.sqrt(contents.variance), 30))
        return [(float(contents.mass[at]), float(contents.ions[at])) for at in np.flatnonzero(clear)]
