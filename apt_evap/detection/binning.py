"""Binning of detector coordinates: the comb they lie on, edges that respect it, counts, field of view."""

from typing import Any, NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_number, shown
from apt_evap.detection.limits import MAX_BINS

_CHUNK = 1 << 16

MAX_BY_CHANCE = 32  # so few different values may lie on a comb by chance: eight of a normal distribution did


class Comb(NamedTuple):
    """Teeth at ``origin + k * spacing`` [mm] for whole k."""

    spacing: float
    origin: float


def find_comb(values: Floats, sample: int = 100_000) -> Comb | None:
    """Find the comb that coordinates lie on, if they do.

    The gaps between the sorted different values, each divided by the smallest ones and rounded, number the
    teeth; a straight line through value against number gives spacing and origin.

    Parameters
    ----------
    values : ndarray
        Coordinates along one axis [mm], shape (n,).
    sample : int
        Number of values looked at, spread evenly over all.

    Returns
    -------
    Comb or None
        None if values hardly repeat, stray from the line by more than a tenth of the spacing (RMS), or have
        a spacing that is only the rounding of their floating point type.
    """
    values = values[:: max(1, len(values) // sample)]
    teeth = np.unique(values)
    rounding = float(np.spacing(np.abs(teeth).max())) if len(teeth) else 0.0
    teeth = teeth.astype(np.float64)
    if len(teeth) < MAX_BY_CHANCE or len(teeth) > 0.9 * len(values):
        return None
    # values of one tooth may differ in their last bits
    teeth = teeth[np.diff(teeth, prepend=-np.inf) > 8 * rounding]
    gaps = np.diff(teeth)
    if len(gaps) < MAX_BY_CHANCE - 1:
        return None
    low = np.percentile(gaps, 2)
    number = np.concatenate([[0], np.cumsum(np.rint(gaps / np.median(gaps[gaps < 1.5 * low])))])
    spacing, origin = np.polyfit(number, teeth, 1)
    stray = np.std(teeth - (origin + spacing * number))
    if stray > 0.1 * spacing or spacing < 16 * rounding:
        return None
    return Comb(float(spacing), float(origin))


def find_combs(x: Floats, y: Floats, quantum: Any = "auto") -> tuple[Comb, ...] | None:
    """Find or place the combs of both coordinates.

    Parameters
    ----------
    x, y : ndarray
        Detector coordinates [mm], shape (n,).
    quantum : {"auto", None} or tuple of float
        Spacing in x and y [mm], "auto" to find it, None for continuous coordinates.

    Returns
    -------
    tuple of Comb or None
        None unless both coordinates lie on a comb.

    Raises
    ------
    ValueError
        If `quantum` is anything else.
    """
    if quantum is None:
        return None
    if isinstance(quantum, str):
        if quantum != "auto":
            raise ValueError(f"quantum must be 'auto', None or two spacings [mm], got {shown(quantum)}")
        first, second = find_comb(x), find_comb(y)
        return None if first is None or second is None else (first, second)
    spacings = check_array(quantum, "quantum", (2,))
    combs = []
    for values, spacing in zip((x, y), spacings, strict=True):
        check_number(float(spacing), "quantum", above=0, unit="mm")
        turn = np.exp(2j * np.pi / spacing * values.astype(np.float64)).mean()
        combs.append(Comb(float(spacing), float(np.angle(turn) * spacing / (2 * np.pi))))
    return tuple(combs)


def bin_edges(
    x: Floats,
    y: Floats,
    bins: int,
    extent: tuple[float, float, float, float] | None = None,
    combs: tuple[Comb, ...] | None = None,
) -> tuple[Floats, Floats]:
    """Edges of bins of one size that cover the extent.

    Parameters
    ----------
    x, y : ndarray
        Detector coordinates [mm], shape (n,).
    bins : int
        Number of bins along the longer side, approximately if there are combs.
    extent : tuple of float, optional
        x_min, x_max, y_min, y_max [mm]; that of the coordinates by default.
    combs : tuple of Comb, optional
        Make bins multiples of the spacings, with edges half way between teeth.

    Returns
    -------
    x_edges, y_edges : ndarray
        Edges [mm].

    Raises
    ------
    ValueError
        If `bins` or `extent` make no sense.
    """
    bins = check_count(bins, "bins", at_least=1, at_most=MAX_BINS)
    if extent is None:
        extent = (x.min(), x.max(), y.min(), y.max())
        if extent[0] == extent[1] and extent[2] == extent[3]:
            ions = "the only ion lies" if len(x) == 1 else f"all {len(x):,} ions lie"
            raise ValueError(
                f"{ions} at ({x[0]:g}, {y[0]:g}) mm: a map needs ions at different places, select more of them or give "
                "extent=(x_min, x_max, y_min, y_max) [mm]"
            )
    low_x, high_x, low_y, high_y = (float(value) for value in check_array(extent, "extent", (4,)))
    longer = max(high_x - low_x, high_y - low_y)
    if high_x < low_x or high_y < low_y or longer == 0:
        raise ValueError(
            f"extent must be x_min, x_max, y_min, y_max [mm] and not a point, got {low_x:g}, {high_x:g}, "
            f"{low_y:g}, {high_y:g}"
        )
    size = longer / bins
    if combs is None:
        return _cover(low_x, high_x, size), _cover(low_y, high_y, size)
    edges = []
    sizes = _multiples(size, combs)
    for comb, step, low, high in zip(combs, sizes, (low_x, low_y), (high_x, high_y), strict=True):
        tooth = np.floor((low - comb.origin) / comb.spacing + 0.5)
        edges.append(_cover(comb.origin + (tooth - 0.5) * comb.spacing, high, step))
    return tuple(edges)


def _cover(low, high, size):
    number = max(1, int(np.ceil((high - low) / size - 1e-9)))
    edges = low + size * np.arange(number + 1)
    # rounding must not leave the last hit outside
    edges[-1] = max(edges[-1], high)
    return edges


def _multiples(size, combs):
    """Multiples of two spacings that make the bin as square and as close to `size` as can be."""
    tried = []
    for comb in combs:
        nearest = size / comb.spacing
        tried.append({max(1, int(nearest) + step) * comb.spacing for step in (-1, 0, 1, 2)})
    choices = [(width, height) for width in tried[0] for height in tried[1]]
    return min(choices, key=lambda c: (np.log(c[0] / c[1]) ** 2 + np.log(np.sqrt(c[0] * c[1]) / size) ** 2, c))


def count(x: Floats, y: Floats, x_edges: Floats, y_edges: Floats) -> Integers:
    """Count hits in evenly spaced bins; hits outside are not counted, the last edges belong to the last bins.

    Parameters
    ----------
    x, y : ndarray
        Finite detector coordinates [mm], shape (n,).
    x_edges, y_edges : ndarray
        Edges [mm], shapes (nx + 1,) and (ny + 1,).

    Returns
    -------
    ndarray
        Hits per bin, int64 of shape (ny, nx).
    """
    nx, ny = len(x_edges) - 1, len(y_edges) - 1
    x_scale, y_scale = nx / (x_edges[-1] - x_edges[0]), ny / (y_edges[-1] - y_edges[0])
    total = np.zeros(nx * ny, np.int64)
    cells = np.empty(min(len(x), max(_CHUNK, nx * ny)), np.int64)
    # chunks keep the coordinates in the cache, bincount works on more at a time since it returns a whole map
    filled = 0
    for start in range(0, len(x), _CHUNK):
        column = (x[start : start + _CHUNK].astype(np.float64) - x_edges[0]) * x_scale
        row = (y[start : start + _CHUNK].astype(np.float64) - y_edges[0]) * y_scale
        inside = (column > -1e-9) & (column < nx + 1e-9) & (row > -1e-9) & (row < ny + 1e-9)
        if not inside.all():
            column, row = column[inside], row[inside]
        if filled + len(row) > len(cells):
            total += np.bincount(cells[:filled], minlength=nx * ny)
            filled = 0
        row, column = row.astype(np.int64), column.astype(np.int64)
        np.minimum(row, ny - 1, out=row)
        np.minimum(column, nx - 1, out=column)
        row *= nx
        np.add(row, column, out=cells[filled : filled + len(row)])
        filled += len(row)
    total += np.bincount(cells[:filled], minlength=nx * ny)
    return total.reshape(ny, nx)


def field_of_view(counts: Integers) -> Booleans:
    """Convex outline of the region where the density, averaged over 20 hits, exceeds a tenth of its median.

    Parameters
    ----------
    counts : ndarray
        Hits per bin, shape (ny, nx), not all zero.

    Returns
    -------
    ndarray
        Mask of the bins inside, bool of shape (ny, nx).
    """
    occupied = counts[counts > 0]
    share = len(occupied) / counts.size
    side = int(np.ceil(np.sqrt(20 / (occupied.mean() * max(share, 0.2)))))
    side = min(side | 1, max(1, min(counts.shape) // 8 | 1))
    smooth = scipy.ndimage.uniform_filter(counts.astype(float), side, mode="constant")
    region = smooth > 0.1 * np.median(smooth[smooth > 0])
    labels, number = scipy.ndimage.label(region)
    if number > 1:
        region = labels == 1 + np.argmax(scipy.ndimage.sum_labels(counts, labels, np.arange(1, number + 1)))
    region &= scipy.ndimage.uniform_filter((counts > 0).astype(float), side, mode="constant") > 0
    if min(np.ptp(axis) for axis in np.nonzero(region)) == 0:
        return region
    return convex_hull(region)


def convex_hull(region: Booleans) -> Booleans:
    """Bins whose centres lie within the convex hull of the centres of a region, or on its border.

    Parameters
    ----------
    region : ndarray
        bool of shape (ny, nx), not all False.

    Returns
    -------
    ndarray
        bool of shape (ny, nx).
    """
    nx = region.shape[1]
    rows = np.flatnonzero(region.any(axis=1))
    left, right = region[rows].argmax(axis=1), nx - 1 - region[rows, ::-1].argmax(axis=1)
    inner = np.arange(rows[0], rows[-1] + 1)
    columns = np.arange(nx)
    hull = np.zeros_like(region)
    hull[inner] = (-_upper_hull(rows, -left, inner)[:, None] <= columns) & (
        columns <= _upper_hull(rows, right, inner)[:, None]
    )
    return hull


def _upper_hull(x, y, at):
    """Whole part of the least concave function through or above integer points, at integers, in exact arithmetic."""
    corners = []
    for point in zip(x.tolist(), y.tolist(), strict=True):
        while len(corners) > 1 and not _turns_right(*corners[-2:], point):
            corners.pop()
        corners.append(point)
    x, y = np.array(corners + corners[-1:]).T
    step = np.minimum(np.searchsorted(x, at, side="right"), len(x) - 1) - 1
    return y[step] + (y[step + 1] - y[step]) * (at - x[step]) // np.maximum(x[step + 1] - x[step], 1)


def _turns_right(a, b, c):
    return (b[0] - a[0]) * (c[1] - a[1]) < (b[1] - a[1]) * (c[0] - a[0])
