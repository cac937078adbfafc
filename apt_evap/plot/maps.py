"""Detector maps, single or side by side."""

from collections.abc import Sequence
from math import ceil, sqrt
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from apt_evap._common.validation import check_kind
from apt_evap.detection.binning import bins_for
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.plot._figure import OUTSIDE, DrawnAxes, add_colorbar, new_figure, set_caption, set_title
from apt_evap.plot.limits import color_limits


def detector_map(
    map: DetectorMap | Hits,
    ax: Axes | None = None,
    *,
    title: str | None = None,
    limits: tuple[float, float] | None = None,
    colormap: str = "inferno",
    colorbar: bool = True,
    caption: bool = True,
) -> DrawnAxes:
    """Draw a detector map: its density relative to the mean.

    Parameters
    ----------
    map : DetectorMap or Hits
        The map. Ions are counted in bins that suit their number, and smoothed by one bin.
    ax : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    title : str, optional
        Title above the map.
    limits : tuple of float, optional
        Densities at the ends of the colour scale; by default `color_limits`.
    colormap : str
        Name of a colour map of matplotlib.
    colorbar, caption : bool
        Whether to draw a colour bar; whether to write the number of ions and the bin size above the map.

    Returns
    -------
    matplotlib.axes.Axes
        Its ``figure.savefig`` writes a file.
    """
    map = _map_of(map, "map")
    if ax is None:
        ax = new_figure((5.6, 5.0)).subplots()
    low, high = color_limits(map) if limits is None else limits
    image = ax.imshow(
        map.density,
        origin="lower",
        extent=map.extent,
        cmap=colormap,
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    # bins outside the mask are NaN: the background is visible there
    ax.set(facecolor=OUTSIDE, aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    if title:
        set_title(ax, _wrap(title, 36), pad=8)
    if caption:
        set_caption(ax, _wrap(describe(map), 54))  # fits above a map of `detector_maps`
    if colorbar:
        add_colorbar([image], ax)
    return ax


def detector_maps(
    maps: Sequence[DetectorMap | Hits],
    titles: Sequence[str] | None = None,
    *,
    limits: tuple[float, float] | None = None,
    colormap: str = "inferno",
    columns: int | None = None,
) -> NDArray[np.object_]:
    """Draw several detector maps side by side with a common colour scale.

    Parameters
    ----------
    maps : sequence of DetectorMap or Hits
        The maps, or ions as for `detector_map`.
    titles : sequence of str, optional
        One title per map.
    limits : tuple of float, optional
        Densities at the ends of the colour scale; by default the widest range of `color_limits`.
    colormap : str
        Name of a colour map of matplotlib.
    columns : int, optional
        Maps per row. By default up to three maps are in one row; more maps are arranged in about as many rows as
        columns.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (n,), one per map.

    Raises
    ------
    ValueError
        If there is no map, or the number of titles differs.
    """
    drawn = [_map_of(map, "maps") for map in maps]
    titles = [None] * len(drawn) if titles is None else list(titles)
    if not drawn or len(titles) != len(drawn):
        raise ValueError(f"detector_maps needs maps and one title per map, got {len(drawn)} and {len(titles)}")
    n = len(drawn)
    columns = min(n, columns or (n if n <= 3 else ceil(sqrt(n))))
    rows = -(-len(drawn) // columns)
    if limits is None:
        each = np.array([color_limits(map) for map in drawn])
        limits = each[:, 0].min(), each[:, 1].max()
    figure = new_figure((4.1 * columns + 0.9, 4.3 * rows))
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, map, title in zip(axes, drawn, titles, strict=False):
        detector_map(map, ax, title=title, limits=limits, colormap=colormap, colorbar=False)
    for ax in axes[len(drawn) :]:
        ax.remove()
    axes = axes[: len(drawn)]
    add_colorbar([ax.images[0] for ax in axes], list(axes))
    return axes


def _map_of(map: DetectorMap | Hits, name: str) -> DetectorMap:
    """A map; of ions as `apt-evap map` makes it, in bins that suit their number and smoothed by one bin."""
    if isinstance(map, Hits):
        counts = map.map(bins_for(int(np.count_nonzero(map.detected))))
        return counts.smoothed(max(counts.bin_size))
    return check_kind(map, name, DetectorMap, "a DetectorMap or Hits, such as run.hits(perturbation)")


def describe(map: DetectorMap) -> str:
    """Caption of a map: its number of ions, the size of its bins and its smoothing.

    Parameters
    ----------
    map : DetectorMap
        The map.

    Returns
    -------
    str
    """
    width, height = map.bin_size
    square = abs(width / height - 1) < 1e-3
    size = f"{width:.3g} mm bins" if square else f"{width:.3g} × {height:.3g} mm bins"
    parts = [map.shown_ions, size] if map.ions is not None else [size]
    if map.smoothing:
        parts.append(f"smoothed by {map.smoothing:.3g} mm")
    return ", ".join(parts)


def _wrap(text, width):
    """Break text into lines, at commas if possible."""
    unbroken = text.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")
    lines = "\n".join(
        fill(line, width, break_long_words=False, break_on_hyphens=False) for line in unbroken.splitlines()
    )
    return "\n".join(
        fill(line.replace("\N{NO-BREAK SPACE}", " "), width, break_on_hyphens=False) for line in lines.splitlines()
    )
