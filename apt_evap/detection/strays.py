"""Strays: measured ions with coordinates far outside the field of view, which is found from the density of the ions.

Instruments write such coordinates for misread signals, and numbers such as -90 mm for "no position". A single one of
them would determine the extent of a map.
"""

import weakref
from collections.abc import Sequence

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap.detection.binning import count
from apt_evap.warnings import DataWarning, warn

_BINS = 64  # along the longer side
_FEWEST = 16  # of so few ions, none is far outside
# Chosen with 12 fields of view (disc, half, strip, ring, ramp, two poles, two spots, normal, divided by a line, a rim
# of 1 %) and 11 kinds of strays (1 to 10 %: scattered, halos, ghosts, lines, numbers for "no position") of 200 to
# 6,000 ions with one half of the seeds, 180 normal distributions, which have no edge, and simulated maps with the
# ions of their shank: 3 of 234 fields of view and 16 of the 180 lose an ion or two, 49 of 180 with strays keep some.
# A density of 3e-3 (6e-3) would leave 32 (18) of these, but takes ions of a shank for strays, and of 17 (28) normal
# distributions. Judged with the other half, up to a million ions: 1 of 237, a normal distribution, and 60 of 183.
# What is missed are halos of 5 % between 1.7 and 3 radii (17 of 18; they have 0.8 % of the density, as a sparse rim
# may have) or 2.5 and 5 (15 of 18), of 1 % (8 of 19), and 5 % over an area of 16 times the field of view (18 of 19):
# density cannot tell these from a dim part of it. Nor is a number for "no position" inside the field of view found.
_GAP = 1 / 6  # of the longer side: ions this far from the others are strays
_GAP_OF_FEW = 4.0  # times the mean distance of neighbours if that is more: few ions are farther apart
_DENSITY = 1e-3  # of the median density, averaged over a gap: fewer ions between strays do not join them
_PART = 0.05  # of the different places in the largest part: a part with fewer is stray
_SAMPLE = 50_000
_MOST_STEPS = 64  # strays at 1e30 mm hide those at 1e10 mm: each step finds those of its scale


def find_strays(x: Floats, y: Floats) -> Booleans | None:
    """Which ions are far outside the field of view, by finite detector coordinates [mm], bool (n,); None if none is.

    Ions are counted in bins that cover all of them. Bins where the density, averaged over a gap, is less than a
    thousandth of its median are empty. Parts that a gap of a sixth of the size separates are strays if they have few
    different places, or lie on one point or on a line along x or y. Ions within a gap of the others stay, such as those
    of a sparse rim. The rest is searched again, until nothing changes.
    """
    rows = None
    inner_x, inner_y = x, y
    for _ in range(_MOST_STEPS):
        if len(inner_x) < _FEWEST or (keep := _inside(inner_x, inner_y)) is None:
            break
        rows = np.flatnonzero(keep) if rows is None else rows[keep]
        inner_x, inner_y = inner_x[keep], inner_y[keep]
    if rows is None:
        return None
    strays = np.ones(len(x), bool)
    strays[rows] = False
    return strays


def _inside(x, y):
    """Which ions are in the large parts of a map of all of them; None for all."""
    low_x, high_x, low_y, high_y = (float(bound) for bound in (x.min(), x.max(), y.min(), y.max()))
    longer = max(high_x - low_x, high_y - low_y)
    if longer == 0:
        return None
    x_edges, y_edges = _edges(low_x, high_x, longer), _edges(low_y, high_y, longer)
    counts = count(x, y, x_edges, y_edges)
    gap = _BINS * max(_GAP, _GAP_OF_FEW / np.sqrt(len(x)))
    labels, number = _parts(counts, gap)
    if _is_one(labels, number, counts):
        return None
    columns, rows = _bin(x, x_edges), _bin(y, y_edges)
    part = labels[rows, columns]
    places = np.zeros(number + 1)
    step = max(1, len(x) // _SAMPLE)
    for index in range(1, number + 1):
        part_x, part_y = x[part == index], y[part == index]
        if np.ptp(part_x) == 0 or np.ptp(part_y) == 0:  # less than any part that has an area
            places[index] = 1e-9 * len(part_x)
        else:
            places[index] = len(np.unique(part_x[::step].astype(float) + 1j * part_y[::step]))
    large = np.flatnonzero(places >= _PART * places.max())
    # what is near the large parts may be a sparse rim
    kept = scipy.ndimage.distance_transform_edt(~np.isin(labels, large[large > 0])) <= gap
    inside = kept[rows, columns]
    return None if inside.all() else inside


def _parts(counts, gap):
    """Parts of a map that gaps [bins] separate: label of each bin, 0 where it is empty, and number of parts."""
    side = int(gap) | 1
    near = scipy.ndimage.uniform_filter(counts.astype(float), side, mode="constant") * side**2
    occupied = (counts > 0) & (near >= _DENSITY * _median_of_hits(near, counts) * (1 - 1e-9))
    joined = scipy.ndimage.distance_transform_edt(~occupied) <= gap / 2
    labels, number = scipy.ndimage.label(joined, np.ones((3, 3)))
    labels[~occupied] = 0
    return labels, number


def _is_one(labels, number, counts):
    """Whether all ions are in one part."""
    return number == 1 and (labels[counts > 0] == 1).all()


class StrayCheck:
    """Whether there may be strays among ions that are read block by block: the first step of `find_strays`.

    Parameters
    ----------
    ions : int
        Number of ions with finite coordinates.
    low, high : sequence of float
        Their smallest and largest x and y [mm].
    """

    def __init__(self, ions: int, low: Sequence[float], high: Sequence[float]) -> None:
        (low_x, low_y), (high_x, high_y) = map(float, low), map(float, high)
        longer = max(high_x - low_x, high_y - low_y)
        self._counts: Integers | None = None
        self._edges: tuple[Floats, Floats] | None = None
        self._ions = ions
        if ions >= _FEWEST and longer != 0:
            self._edges = _edges(low_x, high_x, longer), _edges(low_y, high_y, longer)

    def add(self, x: Floats, y: Floats) -> None:
        """Take the next ions, whose coordinates may be NaN."""
        if self._edges is None:
            return
        if not (np.isfinite(x.sum()) and np.isfinite(y.sum())):
            finite = np.isfinite(x) & np.isfinite(y)
            x, y = x[finite], y[finite]
        counts = count(x, y, *self._edges)
        self._counts = counts if self._counts is None else self._counts + counts

    def none(self) -> bool:
        """Whether there are no strays for certain."""
        if self._edges is None:
            return True
        assert self._counts is not None
        labels, number = _parts(self._counts, _BINS * max(_GAP, _GAP_OF_FEW / np.sqrt(self._ions)))
        return bool(_is_one(labels, number, self._counts))


def _edges(low, high, longer):
    number = max(1, int(np.ceil((high - low) / longer * _BINS - 1e-9)))
    edges = low + longer / _BINS * np.arange(number + 1)
    edges[-1] = max(edges[-1], high)  # the last hit must not be outside by rounding
    return edges


def _bin(values, edges):
    """Bin of each value, as in `count`."""
    number = len(edges) - 1
    return np.minimum(((values.astype(float) - edges[0]) * (number / (edges[-1] - edges[0]))).astype(int), number - 1)


def _median_of_hits(values: Floats, counts: Integers) -> float:
    """Median over the hits of a value of their bins."""
    order = np.argsort(values, axis=None)
    below = np.cumsum(counts.ravel()[order])
    return float(values.ravel()[order[np.searchsorted(below, below[-1] / 2)]])


# ---- strays of columns, found and reported once ----------------------------------------------------------------------

_FOUND: dict[int, tuple] = {}


def strays_of(x: Floats, y: Floats, source: str) -> Booleans | None:
    """Strays among measured ions, as `find_strays`; NaN is none. They are found, and reported, once for two columns."""
    known = _FOUND.get(id(x))
    if known is not None and known[0]() is x and known[1]() is y:
        return known[2]
    finite = np.isfinite(x) & np.isfinite(y)
    whole = bool(finite.all())
    strays = find_strays(x, y) if whole else find_strays(x[finite], y[finite])
    if strays is not None:
        if not whole:
            strays = _spread(strays, finite)
        _warn(x, y, strays, finite & ~strays, source)
    keep_strays(x, y, strays)
    return strays


def keep_strays(x: Floats, y: Floats, strays: Booleans | None) -> None:
    """Remember the strays of two columns, such as a selection of those of others, as long as the columns exist."""
    key = id(x)
    _FOUND[key] = (weakref.ref(x, lambda _: _FOUND.pop(key, None)), weakref.ref(y), strays)


def known_strays(x: Floats, y: Floats) -> tuple[bool, Booleans | None]:
    """Whether the strays of two columns were searched, and the strays."""
    known = _FOUND.get(id(x))
    return (True, known[2]) if known is not None and known[0]() is x and known[1]() is y else (False, None)


def _spread(strays, finite):
    spread = np.zeros(len(finite), bool)
    spread[finite] = strays
    return spread


def _warn(x, y, strays, inside, source):
    number = int(np.count_nonzero(strays))
    width, height = (float(np.ptp(values[inside])) for values in (x, y))
    first = np.flatnonzero(strays)[0]
    place = f"({float(x[first]):.4g}, {float(y[first]):.4g}) mm"
    same = bool((x[strays] == x[first]).all() and (y[strays] == y[first]).all())
    verb = "lies" if number == 1 else "lie"
    warn(
        f"{f'{source!r}: ' if source else ''}{number:,} of {len(x):,} ions {verb} far outside the field of view of "
        f"{width:.4g} x {height:.4g} mm, {'' if same else 'one of them '}at {place}: "
        f"{'it is' if number == 1 else 'they are'} left out",
        DataWarning,
    )
