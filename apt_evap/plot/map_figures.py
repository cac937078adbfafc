"""Detector maps, single or side by side."""

from collections.abc import Sequence
from math import ceil, sqrt
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

from apt_evap._common.validation import check_kind
from apt_evap.detection.binning import bins_for, shown_bins
from apt_evap.detection.color_limits import color_limits
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.ion_blocks import IonBlocks
from apt_evap.maps.crystallography.directions import label as plane_label
from apt_evap.maps.crystallography.directions import plain_label
from apt_evap.plot._figure import (
    OUTSIDE,
    DrawnAxes,
    add_colorbar,
    new_figure,
    set_caption,
    set_title,
    with_default_settings,
)
from apt_evap.simulation.run import Run

RIM = "0.45"
"""Colour of the circle of a round field of view."""
_ROUND = 0.03
"""Largest part of the area of a field of view that is not common with a circle, for it to be drawn as one."""


@with_default_settings
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
    """Draw a detector map: its density relative to the mean. A round field of view is marked by a circle.

    Parameters
    ----------
    map : DetectorMap or Hits
        The map. Ions are counted and smoothed over areas that suit their number, see `binned`.
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
    if (circle := _circle(map)) is not None:
        ax.add_patch(Circle(*circle, fill=False, edgecolor=RIM, linewidth=0.8))
    if title:
        set_title(ax, wrapped(title, 36), pad=8)
    if caption:
        set_caption(ax, wrapped(describe(map), 54))  # fits above a map of `detector_maps`
    if colorbar:
        add_colorbar([image], ax)
    return ax


@with_default_settings
def detector_maps(
    maps: Sequence[DetectorMap | Hits],
    titles: Sequence[str] | None = None,
    *,
    limits: tuple[float, float] | None = None,
    colormap: str = "inferno",
    columns: int | None = None,
    title: str | None = None,
    label: str = "hits per area / mean",
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
    title : str, optional
        Title of the figure, such as `specimen_title`.
    label : str
        Quantity of the colours.

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
        ranges = np.array([color_limits(map) for map in drawn])
        limits = ranges[:, 0].min(), ranges[:, 1].max()
    figure = new_figure((4.1 * columns + 0.9, 4.3 * rows))
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, map, map_title in zip(axes, drawn, titles, strict=False):
        detector_map(map, ax, title=map_title, limits=limits, colormap=colormap, colorbar=False)
    for ax in axes[len(drawn) :]:
        ax.remove()
    axes = axes[: len(drawn)]
    add_colorbar([ax.images[0] for ax in axes], list(axes), label)
    if title:
        figure.suptitle(title, fontsize="large")
    return axes


def specimen_title(run: Run) -> str:
    """Title of maps of a run: the crystal, its direction along the axis, and the radius.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100, progress=False)
    >>> from apt_evap.plot.map_figures import specimen_title
    >>> specimen_title(run)
    'Ni, axis [111], R = 2.0 nm'
    """
    tip = check_kind(run, "run", Run, "a Run").settings["tip"]
    parts = [", ".join(dict.fromkeys(run.elements)).replace("$", r"\$")]
    if "axis" in tip:  # not of a specimen from positions
        axis = tip["axis"]
        if all(index in range(10) for index in axis):
            indices = plain_label(axis)  # the first text with math of Matplotlib takes 0.06 s
        elif all(index == round(index) for index in axis):
            indices = plane_label(axis)
        else:
            indices = " ".join(f"{index:.2f}" for index in axis)
        parts.append(f"axis [{indices}]")
    if "apex_radius" in tip:
        parts.append(f"R = {tip['apex_radius']:.1f} nm")
    return ", ".join(parts)


def binned(hits: Hits, bins: int | None = None, smoothing: float | None = None) -> DetectorMap:
    """Count ions for a picture, and smooth the map.

    Parameters
    ----------
    hits : Hits
        The ions.
    bins : int, optional
        Bins along the longer side; by default 256 or fewer for fewer ions, at least 128.
    smoothing : float, optional
        Standard deviation of the Gaussian [mm]. By default one bin; without `bins` a bin of about one ion, if that is
        larger, but at most 1/32 of the longer side: few ions are in smaller bins, not smoothed less.

    Examples
    --------
    >>> places = np.random.default_rng(1).uniform(-20, 20, (2, 3000))  # mm
    >>> from apt_evap.plot.map_figures import binned
    >>> binned(ae.Hits(x=places[0], y=places[1]))
    <DetectorMap: 3,000 ions, 128 x 128 bins of 0.3124 x 0.3124 mm, smoothed by 0.624811 mm>
    """
    ions = int(np.count_nonzero(check_kind(hits, "hits", Hits, "Hits").detected))
    counts = hits.map(shown_bins(ions) if bins is None else bins)
    return _smoothed(counts, ions, bins, smoothing)


def binned_blocks(ions: IonBlocks, bins: int | None = None, smoothing: float | None = None) -> DetectorMap:
    """The same map of ions that are read block by block; arguments as for `binned`."""
    counts = DetectorMap.from_blocks(ions, bins)
    assert counts.detected is not None
    return _smoothed(counts, counts.detected, bins, smoothing)


def _smoothed(counts, ions, bins, smoothing):
    """A map of a number of ions, smoothed as for `binned`."""
    if smoothing is None:
        smoothing = default_smoothing(counts, ions if bins is None else None)
    return counts.smoothed(smoothing)


def default_smoothing(map: DetectorMap, ions: int | None = None) -> float:
    """Smoothing of a picture [mm]: one bin, or for a number of ions the bin that suits it if that is larger."""
    width, height = map.bin_size
    if ions is None:
        return max(width, height)
    x0, x1, y0, y1 = map.extent
    return max(width, height, max(x1 - x0, y1 - y0) / bins_for(ions))


def _map_of(map: DetectorMap | Hits, name: str) -> DetectorMap:
    """A map; of ions as `apt-evap map` makes it."""
    if isinstance(map, Hits):
        return binned(map)
    return check_kind(map, name, DetectorMap, "a DetectorMap or Hits, such as run.hits(perturbation)")


def _circle(map):
    """Centre and radius [mm] of a round field of view, None for another one."""
    inside = map.mask
    if inside.all():
        return None
    x, y = np.meshgrid(*map.centres)
    width, height = map.bin_size
    centre = float(x[inside].mean()), float(y[inside].mean())
    radius = float(np.sqrt(np.count_nonzero(inside) * width * height / np.pi))
    different = np.count_nonzero((np.hypot(x - centre[0], y - centre[1]) < radius) != inside)
    return (centre, radius) if different < _ROUND * np.count_nonzero(inside) else None


def describe(map: DetectorMap) -> str:
    """Caption of a map: its number of ions, the size of its bins and its smoothing."""
    width, height = map.bin_size
    square = abs(width / height - 1) < 1e-3
    size = f"{width:.3g} mm bins" if square else f"{width:.3g} × {height:.3g} mm bins"
    parts = [map.shown_ions, size] if map.ions is not None else [size]
    if map.smoothing:
        parts.append(f"smoothed by {map.smoothing:.3g} mm")
    return ", ".join(parts)


def wrapped(text: str, width: int) -> str:
    """Break text into lines, at commas if possible."""
    unbroken = text.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")
    lines = "\n".join(
        fill(line, width, break_long_words=False, break_on_hyphens=False) for line in unbroken.splitlines()
    )
    return "\n".join(
        fill(line.replace("\N{NO-BREAK SPACE}", " "), width, break_on_hyphens=False) for line in lines.splitlines()
    )
