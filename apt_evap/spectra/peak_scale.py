"""Scale of m/n on which all peaks of a spectrum have the same width, and the peaks on it."""

import math

import numpy as np

from apt_evap._common.types import Floats

LOWEST, HIGHEST = 0.5, 500.0
"""m/n [Da] of the ions that a spectrum may contain."""
LIGHT = 3.3
"""m/n [Da] below which peaks may have a width of their own, and ions lie farther from their places: measured, H+ is
three times as broad as Si2+, and H2+ lies 1.2 % beside its mass."""
BINS = 3
"""Bins of a histogram per standard deviation of a peak."""
_STEP = 1e-4  # of ln m/n, of the histogram in which widths are measured
_CHUNK = 1 << 18  # ions whose places are computed at a time, for little memory
_STRONGEST = 30  # peaks whose widths are measured
_FEWEST = 60  # ions of one half of such a peak
_WIDTHS = (1e-4, 5e-3)  # of ln m/n; standard deviations are between these
_MIRRORED = 0.3  # mean logarithm of the left width over the right one, from which tails are at low masses
_SHARPER, _BROADER = 0.25, 0.2  # quantile of ln width that is of single isotopes, and how much more these may be
_NOMINAL = 5e-4  # width without a peak
_OWN = 1.5
"""Times the common width, from which light peaks have their own. Where it is one: up to 1.45 in the 200 random
specimens that it was chosen on; of 200 others 99 % have less than 1.43, and one has 1.54."""
_FARTHEST = 500
"""Steps to the half height of one. Of 96 made peaks of hydrogen, two to eight times as broad as the others, 95 % have
errors below 3.5 %, and below 8 % with 250 steps (seed 202706)."""
_SURE = 3.0  # standard errors by which it must be more
_PROMINENCE = 5.0  # of a peak, in standard deviations of counting
APART = 2.0
"""Standard deviations between two peaks; of nearer ones the higher is kept."""


class PeakScale:
    """Coordinate of m/n in units of the standard deviation of a peak, sigma(ln m) = width m^power.

    Peaks of hydrogen, below `LIGHT`, are broader by a factor where they show it.

    Parameters
    ----------
    mass : ndarray
        m/n of the ions [Da], between `LOWEST` and `HIGHEST`.

    Attributes
    ----------
    mirrored : bool
        Whether peaks have their tails at low masses, as where ions fly longer than the voltage says.
    light : float
        Width of the peaks below `LIGHT`, over that of the others.
    """

    def __init__(self, mass: Floats) -> None:
        self.width, self.power, self.mirrored, self.light = _widths(mass)
        self._first = float(self._coordinate(LOWEST))
        self.size = int((float(self._coordinate(HIGHEST)) - self._first) * BINS) + 1
        self.centres = self.mass(np.arange(self.size, dtype=float))
        """m/n at the middle of the bins [Da]."""

    def sigma(self, mass: Floats | float) -> Floats:
        """Standard deviation of ln m/n of a peak."""
        mass = np.asarray(mass, float)
        return self.width * mass**self.power * np.where(mass < LIGHT, self.light, 1.0)

    def _coordinate(self, mass):
        place = self._common(mass)
        if self.light > 1:
            edge = self._common(LIGHT)
            place = np.where(place < edge, edge + (place - edge) / self.light, place)
        return place

    def _common(self, mass):
        """The coordinate if all peaks had the common width."""
        mass = np.asarray(mass, float)
        if abs(self.power) < 1e-9:
            return np.log(mass) / self.width
        return mass**-self.power / (-self.power * self.width)

    def bins(self, mass: Floats) -> Floats:
        """Place of m/n in bins, whole numbers at their middles."""
        return (self._coordinate(mass) - self._first) * BINS - 0.5

    def mass(self, bins: Floats) -> Floats:
        """The inverse of `bins` [Da]."""
        place = self._first + (np.asarray(bins, float) + 0.5) / BINS
        if self.light > 1:
            edge = self._common(LIGHT)
            place = np.where(place < edge, edge + (place - edge) * self.light, place)
        if abs(self.power) < 1e-9:
            return np.exp(place * self.width)
        return (-place * self.power * self.width) ** (-1 / self.power)

    def counts(self, mass: Floats) -> Floats:
        """Number of ions in each bin, shape (size,)."""
        return _counted(
            mass, lambda part: np.clip(np.rint(self.bins(part)).astype(np.int64), 0, self.size - 1), self.size
        )


def _counted(mass, place, size):
    """Number of ions at each place, by a function that gives the places of some of them."""
    counts = np.zeros(size, np.int64)
    for start in range(0, len(mass), _CHUNK):
        found = np.bincount(place(mass[start : start + _CHUNK].astype(np.float64)), minlength=size)
        counts = found + np.pad(counts, (0, len(found) - len(counts)))
    return counts.astype(float)


def _widths(mass):
    """Width and power of the standard deviation of ln m/n, whether tails are at low masses, and `PeakScale.light`."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import find_peaks

    edges = np.arange(math.log(LOWEST), math.log(HIGHEST), _STEP)
    counts = _counted(mass, lambda part: ((np.log(part) - edges[0]) / _STEP).astype(int), len(edges))
    smooth = gaussian_filter1d(counts, 1.5)
    # the square root of counts has the same noise everywhere; 5.3 bins are effectively in the filter
    tops, found = find_peaks(2 * np.sqrt(5.3 * smooth + 0.375), prominence=12, distance=20)
    tops = tops[np.argsort(-found["prominences"])[:_STRONGEST]].tolist()
    left, right = ([_half_width(smooth, counts, top, step) for top in tops] for step in (-1, 1))
    both = [(math.log(low / high), smooth[top]) for low, high, top in zip(left, right, tops, strict=True) if low * high]
    mirrored = bool(both) and sum(ratio * math.sqrt(height) for ratio, height in both) > _MIRRORED * sum(
        math.sqrt(height) for _, height in both
    )
    sides = zip(right if mirrored else left, tops, strict=True)
    rows = [(width, edges[top], min(math.sqrt(smooth[top]), 50.0)) for width, top in sides if width]
    if not rows:
        return _NOMINAL, 0.0, False, 1.0
    heavy = [row for row in rows if row[1] > math.log(LIGHT)]
    if heavy:
        width, power = _common_width(heavy)
        if (light := _light_width(counts[: int(np.searchsorted(edges, math.log(LIGHT)))], width, power)) > 1:
            return width, power, mirrored, light
    return *_common_width(rows), mirrored, 1.0


def _light_width(counts, width, power):
    """Width of the strongest peak below `LIGHT` on its sharper side, over the common one; 1 if it may be the same."""
    from scipy.ndimage import gaussian_filter1d

    edges = math.log(LOWEST) + _STEP * np.arange(len(counts))
    blur = width * np.exp(power * edges[np.argmax(counts)]) / _STEP  # the common width, to see broad peaks of few ions
    smooth = gaussian_filter1d(counts, blur)
    top = int(np.argmax(smooth * np.exp(0.5 * edges)))  # above a background that is constant in time of flight
    sides = [_half_width(smooth, counts, top, step, blur, _FARTHEST) for step in (-1, 1)]
    factor = min(sides) / (blur * _STEP)
    error = math.sqrt(_STEP / max(smooth[top] * sum(sides), 1e-9))
    return factor if factor > 1 and math.log(factor) > max(math.log(_OWN), _SURE * error) else 1.0


def _common_width(rows):
    """Width and power from widths, ln m/n and weights of peaks."""
    logs, at, weight = np.array(rows).T
    logs = np.log(logs)
    if len(logs) < 3:
        return float(np.clip(math.exp(np.median(logs)), *_WIDTHS)), 0.0
    best = math.inf, 0.0, 0.0
    for power in np.arange(-0.6, 0.01, 0.1):  # sqrt(m) for errors of the time, m^0 for those of the energy
        rest = logs - power * at
        order = np.argsort(rest)
        sharp = _quantile(rest[order], weight[order], _SHARPER)
        # peaks that are several isotopes are too broad, and none is too sharp
        cost = (weight * np.where(rest > sharp, _SHARPER, 1 - _SHARPER) * np.abs(rest - sharp)).sum()
        cost = float(2 * cost + 0.02 * abs(power) * weight.sum())
        single = order[rest[order] < sharp + _BROADER]
        middle = _quantile(rest[single], weight[single], 0.5)
        best = min(best, (cost, float(power), float(middle)))
    return float(np.clip(math.exp(best[2]), *_WIDTHS)), best[1]


def _quantile(values, weights, part):
    """Weighted quantile of ordered values."""
    sums = np.cumsum(weights)
    return float(values[np.searchsorted(sums, part * sums[-1])])


def _half_width(smooth, counts, top, step, blur=1.5, farthest=150):
    """Standard deviation of ln m/n of one side of a peak, 0 if it has none."""
    half, at = smooth[top] / 2, top
    last = min(max(top + farthest * step, 0), len(smooth) - 1)
    while at != last and smooth[at] > half:
        at += step
    side = counts[at:top] if step < 0 else counts[top + 1 : at + 1]
    if at == last or side.sum() < _FEWEST:
        return 0.0
    within = (smooth[at - step] - half) / max(smooth[at - step] - smooth[at], 1e-9)
    half_width = (abs(top - at) - 1 + within) * _STEP
    return math.sqrt(max((half_width / math.sqrt(2 * math.log(2))) ** 2 - (blur * _STEP) ** 2, (0.8e-4) ** 2))


def find_places(counts: Floats) -> tuple[Floats, Floats]:
    """Places of the peaks of a histogram in bins, and the histogram smoothed by the width of a peak."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import find_peaks

    smooth = gaussian_filter1d(counts, float(BINS))
    tops, _ = find_peaks(2 * np.sqrt(smooth * 2 * math.sqrt(math.pi) * BINS + 0.375), prominence=_PROMINENCE)
    kept: list[int] = []
    for top in tops.tolist():
        if kept and top - kept[-1] < APART * BINS:
            if smooth[top] > smooth[kept[-1]]:
                kept[-1] = top
            continue
        kept.append(top)
    return np.array([centroid(counts, top) for top in kept]), smooth


def centroid(counts: Floats, top: int) -> float:
    """Centre of gravity of the middle of a peak [bins]."""
    place = float(top)
    for _ in range(4):
        low = max(round(place - 1.2 * BINS), 0)
        high = min(round(place + 1.2 * BINS) + 1, len(counts))
        weights = np.maximum(counts[low:high] - 0.8 * min(counts[low], counts[high - 1]), 0) + 1e-9
        place = float(weights @ np.arange(low, high) / weights.sum())
        if not 0 <= place < len(counts):
            return float(top)
    return place if abs(place - top) < 2 * BINS else float(top)
