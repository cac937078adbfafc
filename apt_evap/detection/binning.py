"""Binning of detector coordinates: quantisation step, edges of bins, counts, field of view."""

from typing import Any, NamedTuple

import numpy as np
import scipy
import skimage

from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_number, short_text

MAX_BINS = 16384
"""Largest number of bins along a side: 2 GB of counts."""
_CHUNK = 1 << 16

FEWEST_SHOWN = 128
"""Least number of bins along a side of a picture."""
_PART = 0.05  # of the hits of the largest part of a field of view: a part with fewer is stray
MAX_BY_CHANCE = 32  # fewer different values may look quantised by chance: eight of a normal distribution did


class Quantisation(NamedTuple):
    """Quantised coordinates: values ``origin + k * spacing`` [mm] with integer k."""

    spacing: float
    origin: float


def find_quantisation(values: Floats) -> Quantisation | None:
    """Find the quantisation of coordinates along one axis [mm], if there is one.

    About 100,000 coordinates, evenly spaced, are looked at. The gaps between the sorted distinct values, divided by the
    smallest gaps and rounded, give the integer k of each value. A straight line of value against k gives spacing and
    origin. None if few values repeat, if the RMS deviation from the line exceeds a tenth of the spacing, or if the
    spacing is only the rounding of the floating point type.
    """
    values = values[:: max(1, len(values) // 100_000)]
    levels = np.unique(values)
    rounding = float(np.spacing(np.abs(levels).max())) if len(levels) else 0.0
    levels = levels.astype(np.float64)
    if len(levels) < MAX_BY_CHANCE or len(levels) > 0.9 * len(values):
        return None
    # equal values may differ in their last bits
    levels = levels[np.diff(levels, prepend=-np.inf) > 8 * rounding]
    gaps = np.diff(levels)
    if len(gaps) < MAX_BY_CHANCE - 1:
        return None
    low = np.percentile(gaps, 2)
    number = np.concatenate([[0], np.cumsum(np.rint(gaps / np.median(gaps[gaps < 1.5 * low])))])
    spacing, origin = np.polyfit(number, levels, 1)
    deviation = np.std(levels - (origin + spacing * number))
    if deviation > 0.1 * spacing or spacing < 16 * rounding:
        return None
    return Quantisation(float(spacing), float(origin))


def find_quantisations(x: Floats, y: Floats, position_step: Any = "auto") -> tuple[Quantisation, ...] | None:
    """Quantisation of both coordinates, found in the data or with known steps.

    Parameters
    ----------
    x, y : ndarray
        Detector coordinates [mm], shape (n,).
    position_step : {"auto", None} or tuple of float
        Quantisation step in x and y [mm]; "auto" to find it, None for continuous coordinates.

    Returns
    -------
    tuple of Quantisation or None
        None unless both coordinates are quantised.

    Raises
    ------
    ValueError
        If `position_step` is none of these.
    """
    if position_step is None:
        return None
    if isinstance(position_step, str):
        if position_step != "auto":
            raise ValueError(
                f"position_step must be 'auto', None or two spacings [mm], got {short_text(position_step)}"
            )
        first, second = find_quantisation(x), find_quantisation(y)
        return None if first is None or second is None else (first, second)
    spacings = check_array(position_step, "position_step", (2,))
    quantisations = []
    for values, spacing in zip((x, y), spacings, strict=True):
        check_number(float(spacing), "position_step", above=0, unit="mm")
        phase = np.exp(2j * np.pi / spacing * values.astype(np.float64)).mean()
        quantisations.append(Quantisation(float(spacing), float(np.angle(phase) * spacing / (2 * np.pi))))
    return tuple(quantisations)


def bin_edges(
    x: Floats,
    y: Floats,
    bins: int,
    extent: tuple[float, float, float, float] | None = None,
    quantisations: tuple[Quantisation, ...] | None = None,
) -> tuple[Floats, Floats]:
    """Edges in x and y [mm] of bins of equal size, about `bins` along the longer side of the extent.

    `extent` is x_min, x_max, y_min, y_max [mm], by default that of the coordinates. Bins of quantised coordinates are
    multiples of the steps, with edges half way between the levels.
    """
    bins = check_count(bins, "bins", at_least=1, at_most=MAX_BINS)
    if extent is None:
        extent = (x.min(), x.max(), y.min(), y.max())
        if extent[0] == extent[1] and extent[2] == extent[3]:
            ions = "the only ion lies" if len(x) == 1 else f"all {len(x):,} ions lie"
            raise ValueError(
                f"{ions} at ({x[0]:g}, {y[0]:g}) mm: a map needs ions at different positions; select more ions or give "
                "extent=(x_min, x_max, y_min, y_max) [mm]"
            )
    low_x, high_x, low_y, high_y = (float(value) for value in check_array(extent, "extent", (4,)))
    longer = max(high_x - low_x, high_y - low_y)
    if high_x < low_x or high_y < low_y or longer == 0:
        raise ValueError(
            f"extent must be x_min, x_max, y_min, y_max [mm] with a non-zero size, got {low_x:g}, {high_x:g}, "
            f"{low_y:g}, {high_y:g}"
        )
    size = longer / bins
    if quantisations is None:
        return _cover(low_x, high_x, size), _cover(low_y, high_y, size)
    edges = []
    sizes = _multiples(size, quantisations)
    for quantisation, step, low, high in zip(quantisations, sizes, (low_x, low_y), (high_x, high_y), strict=True):
        first = np.floor((low - quantisation.origin) / quantisation.spacing + 0.5)
        edges.append(_cover(quantisation.origin + (first - 0.5) * quantisation.spacing, high, step))
    return tuple(edges)


def bins_for(ions: int) -> int:
    """Bins along a side: the power of 2 from 32 to 256 that is closest to one ion per bin."""
    return int(2 ** np.clip(np.rint(np.log2(max(ions, 1)) / 2), 5, 8))


def shown_bins(ions: int) -> int:
    """Bins along a side of a picture: those of `bins_for`, but so many that few ions are not shown as squares."""
    return max(bins_for(ions), FEWEST_SHOWN)


def _cover(low, high, size):
    number = max(1, int(np.ceil((high - low) / size - 1e-9)))
    edges = low + size * np.arange(number + 1)
    # the last hit must not be outside by rounding
    edges[-1] = max(edges[-1], high)
    return edges


def _multiples(size, quantisations):
    """Multiples of two spacings that make the bins as square and as close to `size` as possible."""
    candidates = []
    for quantisation in quantisations:
        nearest = size / quantisation.spacing
        candidates.append({max(1, int(nearest) + step) * quantisation.spacing for step in (-1, 0, 1, 2)})
    choices = [(width, height) for width in candidates[0] for height in candidates[1]]
    return min(choices, key=lambda c: (np.log(c[0] / c[1]) ** 2 + np.log(np.sqrt(c[0] * c[1]) / size) ** 2, c))


def count(x: Floats, y: Floats, x_edges: Floats, y_edges: Floats) -> Integers:
    """Hits per evenly spaced bin, int64 (ny, nx); hits outside are ignored, the last edges belong to the last bins."""
    nx, ny = len(x_edges) - 1, len(y_edges) - 1
    x_scale, y_scale = nx / (x_edges[-1] - x_edges[0]), ny / (y_edges[-1] - y_edges[0])
    total = np.zeros(nx * ny, np.int64)
    cells = np.empty(min(len(x), max(_CHUNK, nx * ny)), np.int64)
    # chunks keep the coordinates in the cache; bincount takes several chunks at once because it returns a complete map
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


def _on_a_line(region):
    """Whether all bins of a region lie on one straight line, so that they have no hull."""
    rows, columns = (places - places[0] for places in np.nonzero(region))
    far = np.argmax(rows**2 + columns**2)
    return not (rows * columns[far] - columns * rows[far]).any()


def field_of_view(counts: Integers) -> Booleans:
    """Convex outline of the region where the density, averaged over 20 hits, exceeds a tenth of its median.

    Dark zone lines may divide the region: all parts count that have 5 % of the hits of the largest one.

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
    fraction = len(occupied) / counts.size
    side = int(np.ceil(np.sqrt(20 / (occupied.mean() * max(fraction, 0.2)))))
    side = min(side | 1, max(1, min(counts.shape) // 8 | 1))
    smooth = scipy.ndimage.uniform_filter(counts.astype(float), side, mode="constant")
    region = smooth > 0.1 * np.median(smooth[smooth > 0])
    labels, number = scipy.ndimage.label(region)
    if number > 1:
        hits = scipy.ndimage.sum_labels(counts, labels, np.arange(1, number + 1))
        region = np.isin(labels, 1 + np.flatnonzero(hits >= _PART * hits.max()))
        if _on_a_line(region):
            region = labels == 1 + np.argmax(hits)
    region &= scipy.ndimage.uniform_filter((counts > 0).astype(float), side, mode="constant") > 0
    if min(np.ptp(axis) for axis in np.nonzero(region)) == 0:  # one row or column has no hull
        return region
    # of the centres of the bins, with those on its border
    return skimage.morphology.convex_hull_image(region, offset_coordinates=False)
