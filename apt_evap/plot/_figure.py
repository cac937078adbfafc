"""Figures and colour bars of all plots."""

import importlib
import re
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine

OUTSIDE = "0.88"
"""Colour outside the detector."""


def add_colorbar(
    images: Sequence[AxesImage], ax: Axes | Sequence[Axes], label: str = "hits per area / mean"
) -> Colorbar:
    """Add a colour bar for images with a common scale; arrows mark ends with values beyond the scale.

    Parameters
    ----------
    images : sequence of matplotlib.image.AxesImage
        Images with the colours.
    ax : matplotlib.axes.Axes or list of them
        Axes that give space to the bar.
    label : str
        Quantity of the colours, with its unit.

    Returns
    -------
    matplotlib.colorbar.Colorbar
    """
    low, high = images[0].get_clim()
    below = min(np.nanmin(image.get_array()) for image in images) < low
    above = max(np.nanmax(image.get_array()) for image in images) > high
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    figure = images[0].axes.figure
    return figure.colorbar(images[0], ax=ax, label=label, extend=extend, fraction=0.05, pad=0.02)


def set_title(ax: Axes, title: str | None, **options: Any) -> None:
    """Set a title without math syntax: a file name may contain dollar signs, and bytes that are not text."""
    if title:
        ax.set_title(re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", title), parse_math=False, **options)


class _Layout(ConstrainedLayoutEngine):
    """Repeated constrained layout: ticks and labels of maps with equal scales in x and y depend on their size."""

    def execute(self, fig: Figure) -> None:
        for _ in range(3):
            super().execute(fig)


def new_figure(size: tuple[float, float]) -> Figure:
    """Make a figure of (width, height) `size` [inch].

    In a notebook, or if pyplot is imported, the figure is made by pyplot and displayed. Otherwise, as in a batch job,
    it needs no display.

    Parameters
    ----------
    size : tuple of float
        Width and height [inch].

    Returns
    -------
    matplotlib.figure.Figure
    """
    if "ipykernel" in sys.modules:
        importlib.import_module("matplotlib.pyplot")  # with the backend that displays figures below their cells
    pyplot = sys.modules.get("matplotlib.pyplot")
    make = Figure if pyplot is None else pyplot.figure
    return make(figsize=size, layout=_Layout(compress=True, h_pad=0.08, w_pad=0.06), dpi=150)
