"""Maps as figures of a paper: of the width of a column, with panel letters and a scale bar, without titles."""

import string
from collections.abc import Sequence
from math import ceil, floor, log10

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from apt_evap._common.validation import check_number
from apt_evap.detection.color_limits import common_limits
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.plot._figure import add_colorbar, new_figure, with_default_settings
from apt_evap.plot.map_figures import detector_map

_INCH = 25.4  # mm
FONT = 7.0
"""Size of all text [points]."""
_PANEL = 38.0  # mm: narrower panels are put below each other
_BAR = 0.3  # of the width of a map: the longest scale bar
_SHADOW = (withStroke(linewidth=1.5, foreground="black"),)
WIDTHS = 20.0, 400.0
"""Narrowest and widest figure [mm]."""


@with_default_settings
def paper_maps(
    maps: Sequence[DetectorMap], width: float = 85.0, *, colormap: str = "inferno", label: str = "hits per area / mean"
) -> NDArray[np.object_]:
    """Draw maps for a paper.

    Parameters
    ----------
    maps : sequence of DetectorMap
        The maps, with a common colour scale; several of them have letters.
    width : float
        Width of the figure [mm].
    colormap : str
        Name of a colour map of matplotlib.
    label : str
        Quantity of the colours.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (n,); ``axes[0].figure.savefig`` writes a file of this width.

    Raises
    ------
    ValueError
        If there is no map, or the width is not one from 20 to 400 mm.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100, progress=False)
    >>> maps = [run.hits(emission).map(bins=32) for emission in (ae.Unperturbed(), ae.RollUp(0.2))]
    >>> axes = ae.plot.paper_maps(maps, width=85)
    >>> print(f"{25.4 * axes[0].figure.get_size_inches()[0]:.0f} mm")
    85 mm
    """
    width = check_number(width, "width", at_least=WIDTHS[0], at_most=WIDTHS[1], unit="mm")
    if not maps:
        raise ValueError("maps must contain at least one map, got none")
    columns = min(len(maps), max(1, floor(width / _PANEL)))
    rows = ceil(len(maps) / columns)
    x0, x1, y0, y1 = maps[0].extent
    panel = (width - 14) / columns  # the rest is for the colour bar
    figure = new_figure((width / _INCH, (rows * (panel * (y1 - y0) / (x1 - x0) + 1) + 2) / _INCH))
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(maps) :]:
        ax.remove()
    axes = axes[: len(maps)]
    limits = common_limits(maps)
    letters = string.ascii_lowercase if 1 < len(maps) <= len(string.ascii_lowercase) else [""] * len(maps)
    for letter, ax, panel_map in zip(letters, axes, maps, strict=False):
        detector_map(panel_map, ax, limits=limits, colormap=colormap, colorbar=False, caption=False)
        ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
        if letter:
            _text(ax, 0.03, 0.97, letter, va="top", weight="bold")
        add_scale_bar(ax)
    bar = add_colorbar([ax.images[0] for ax in axes], list(axes), label)
    bar.ax.tick_params(labelsize=FONT, length=2)
    bar.set_label(label, size=FONT)
    return axes


@with_default_settings
def add_scale_bar(ax: Axes) -> float:
    """Draw a scale bar in the lower left corner of a map [mm]; return its length, 1, 2 or 5 times a power of ten."""
    low, high = ax.get_xlim()
    longest = _BAR * abs(high - low)
    power = 10.0 ** floor(log10(longest))
    length = max(step * power for step in (1, 2, 5) if step * power <= longest)
    left, bottom = low + 0.05 * (high - low), ax.get_ylim()[0] + 0.06 * np.diff(ax.get_ylim())[0]
    ax.plot([left, left + length], [bottom, bottom], color="white", lw=1.5, path_effects=_SHADOW, solid_capstyle="butt")
    _text(ax, 0.05, 0.085, f"{length:g} mm", ha="left", va="bottom")
    return length


def _text(ax, x, y, text, **options):
    ax.text(x, y, text, transform=ax.transAxes, color="white", size=FONT, path_effects=_SHADOW, **options)
