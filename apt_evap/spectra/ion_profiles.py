"""Spectra of single ions: their intervals of m/n, and their numbers in a part of the ions."""

from collections.abc import Sequence

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.spectra.peak_contents import CORE, Contents, PeakContents

_OWN = 0.5  # part of a peak that an ion has, for a range there
_FOOT = 0.003  # of the height of a peak, below which no range goes, whatever the background
_CLEAR = 3.0  # errors of counting by which such a part is above zero
_FEWEST = 5.0  # ions of such a part
_ITERATIONS, _PRECISION = 300, 1e-5  # of the likelihood fit, and relative change at which it ends


class IonProfiles:
    """Spectrum of each ion on the scale of the peaks.

    Parameters
    ----------
    peaks : PeakContents
        The spectrum.
    contents : Contents
        Its peaks.
    shares : ndarray
        Part of each ion in each peak, shape (ions, peaks).
    ions : ndarray
        Number of ions, shape (ions,).
    """

    def __init__(self, peaks: PeakContents, contents: Contents, shares: Floats, ions: Floats) -> None:
        self.peaks, self.contents, self.shares, self.ions = peaks, contents, shares, ions
        self._columns = peaks.columns(
            np.clip(peaks.scale.bins(contents.mass), 0, peaks.scale.size - 1), contents.shapes
        )

    def amounts(self, mass: Floats) -> tuple[Floats, Floats]:
        """Number of ions of each kind among some ions [Da], and the covariance: by their Poisson likelihood.

        Shapes and places of the peaks, and the shape of the background, are those of the whole spectrum.
        """
        return self._amounts(self.peaks.scale.counts(mass))

    def amounts_of_all(self) -> tuple[Floats, Floats]:
        """The same of the whole spectrum."""
        return self._amounts(self.peaks.counts)

    def _amounts(self, counts):
        from scipy.sparse import csc_matrix, hstack

        background = self.contents.background / max(float(self.contents.background.sum()), 1e-300)
        model = hstack([self._columns @ csc_matrix(self.shares.T), csc_matrix(background[:, None])]).tocsr()
        norm = np.maximum(np.asarray(model.sum(0)).ravel(), 1e-12)
        held = np.flatnonzero(counts)
        part, counts = model[held], counts[held]
        numbers = np.append(self.ions, self.contents.background.sum())
        numbers = np.maximum(numbers * (counts.sum() / max(float(numbers.sum()), 1e-300)), 1e-3)
        for _ in range(_ITERATIONS):
            before = numbers
            numbers = numbers * (part.T @ (counts / (part @ numbers + 1e-12))) / norm
            if np.abs(numbers - before).max() < _PRECISION * max(float(counts.sum()), 1.0):
                break
        expected = np.maximum(model @ numbers, 1e-9)
        information = (model.T @ model.multiply(1 / expected[:, None]).tocsr()).toarray()
        return numbers[:-1], np.linalg.pinv(information)[:-1, :-1]

    def left_over(self, ions: Floats, peaks: Floats) -> Floats:
        """Ions in the cores of peaks at some m/n [Da] that numbers of ions and the background do not explain."""
        scale, shape, left = self.peaks.scale, self.peaks.shape, self.peaks.left
        expected = self._columns @ (self.shares.T @ ions) + self.contents.background
        rest = np.pad(np.cumsum(self.peaks.counts - expected), (1, 0))
        middle = np.rint(scale.bins(peaks)).astype(int)
        low, high = np.clip(middle - CORE, 0, scale.size), np.clip(middle + CORE + 1, 0, scale.size)
        return (rest[high] - rest[low]) / float(shape[left - CORE : left + CORE + 1].sum())

    def intervals(self) -> list[list[tuple[float, float]]]:
        """Bounds of the peaks of each ion [Da]: as far as its ions are more than those of all others.

        Of all intervals these have the smallest sum of lost ions and of others in them. Touching ones are joined.
        """
        scale, contents = self.peaks.scale, self.contents
        parts = self.shares * self.ions[:, None]
        total = parts.sum(0)
        intervals: list[list[tuple[float, float]]] = [[] for _ in self.ions]
        model = self._columns @ np.maximum(total, contents.ions)
        for number, part in enumerate(parts):
            bounds: list[list[int]] = []
            density = None
            for peak in np.flatnonzero((part > _OWN * np.maximum(total, contents.ions)) & (part > _FEWEST)):
                if part[peak] < _CLEAR * np.sqrt(contents.variance[peak]):
                    continue
                if density is None:
                    density = self._columns @ part
                    above = density > np.maximum(model - density, 0) + contents.background
                top = int(np.clip(np.rint(scale.bins(contents.mass[peak])), 0, scale.size - 1))
                if not above[top]:
                    continue
                inside = above & (density > _FOOT * density[top])
                low = top - _run(inside[top::-1])
                high = top + _run(inside[top:])
                if bounds and low <= bounds[-1][1] + 1:
                    bounds[-1][1] = max(high, bounds[-1][1])
                else:
                    bounds.append([low, high])
            for low, high in bounds:
                first, last = scale.mass(np.array([low - 0.5, high + 0.5])).tolist()
                intervals[number].append((first, last))
        return intervals


def _run(above: Sequence[bool]) -> int:
    """Number of true values after the first one, before one that is false."""
    stops = np.flatnonzero(~np.asarray(above))
    return int(stops[0]) - 1 if len(stops) else len(above) - 1
