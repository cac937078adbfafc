"""Figures and colour bars of all plots."""

import importlib
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial, wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

from apt_evap._common.types import Floats, Integers

P = ParamSpec("P")
T = TypeVar("T")

if TYPE_CHECKING:

    class DrawnAxes(Axes):
        """Axes of a picture, whose figure is complete: ``ax.figure.savefig`` writes it."""

        figure: Figure

else:
    DrawnAxes = Axes

# settings that are no style: backends and windows
_NO_STYLE = ("backend", "interactive", "toolbar", "timezone", "webagg", "tk.", "savefig.directory", "date.epoch")
_NO_STYLE += ("figure.raise_window", "figure.max_open_warning", "figure.hooks")


def _of_matplotlibrc():
    """Settings that the matplotlibrc of the user has changed."""
    default, original = matplotlib.rcParamsDefault, matplotlib.rcParamsOrig
    names = (name for name in original if not name.startswith(_NO_STYLE))
    return {name: original[name] for name in names if original[name] != default.get(name)}


_CHANGED = _of_matplotlibrc()
if _CHANGED and os.environ.get("APT_EVAP_DEFAULT_STYLE"):  # of a command: the settings of the user may need LaTeX
    matplotlib.rcdefaults()


def default_settings() -> Any:
    """Context of the default settings of matplotlib, whatever the matplotlibrc of the user: it may need LaTeX.

    What a program has set since, such as a style, stays.
    """
    here = {name: value for name, value in _CHANGED.items() if matplotlib.rcParams[name] == value}
    if not here:
        return nullcontext()
    return matplotlib.rc_context({name: matplotlib.rcParamsDefault[name] for name in here})


def with_default_settings(function: Callable[P, T]) -> Callable[P, T]:
    """The function, which draws in the context of `default_settings`."""

    @wraps(function)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> T:
        with default_settings():
            return function(*args, **kwargs)

    return drawn


OUTSIDE = "0.88"
"""Colour outside the detector."""
_LOG_STEPS = ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7))  # ticks per decade: the first of them with three ticks is used


def add_colorbar(
    images: Sequence[AxesImage], ax: Axes | Sequence[Axes], label: str = "hits per area / mean"
) -> Colorbar:
    """Add a colour bar for images with a common scale; arrows mark ends with values beyond the scale."""
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


def set_caption(ax: Axes, text: str) -> None:
    """Write a caption above the axes, as the label of an axis there: a title of any time comes above it."""
    above = ax.secondary_xaxis("top")
    above.set_xlabel(text, fontsize="small", color="0.35", labelpad=5, parse_math=False)
    above.set_xticks([])
    above.spines["top"].set_visible(False)


def ion_label(element: str, charge: int, mass_number: int | None = None) -> str:
    """Return the label of an ion with its charge, such as Ni with a raised 2+, and of an isotope with its number."""
    isotope = "" if mass_number is None else f"$^{{{mass_number}}}$"
    return isotope + element.replace("$", r"\$") + raised_charge(charge)


def raised_charge(charge: int) -> str:
    """Return a charge such as 2+ as a superscript; braces instead of a space, as of a sum."""
    return f"$^{{{'' if charge == 1 else charge}{{+}}}}$"


def set_log_ticks(axis: Axis, least_range: float = 1.0) -> None:
    """Set the ticks of a logarithmic axis to round numbers, at least three."""
    low, high = axis.get_view_interval()
    wider = np.sqrt(least_range * low / high)
    if wider > 1:
        low, high = low / wider, high * wider
        axis.set_view_interval(low, high, ignore=True)
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.log10(high))
    locator: Any = MaxNLocator(4)
    for steps in _LOG_STEPS:
        ticks = np.outer(powers, steps).ravel()
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        if len(ticks) > 2:
            locator = FixedLocator(ticks, nbins=8)
            break
    axis.set_major_locator(locator)
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(NullLocator())


class _Layout(ConstrainedLayoutEngine):
    """Constrained layout, again while it changes the ticks: those of maps with equal scales depend on their size."""

    def execute(self, fig: Figure) -> None:
        ticks = _ticks(fig)
        for _ in range(3):
            super().execute(fig)
            before, ticks = ticks, _ticks(fig)
            if ticks == before:  # a second pass moves axes by less than a pixel
                break


def _ticks(figure):
    """Places of the ticks of all axes."""
    return [tuple(axis.get_majorticklocs()) for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)]


class _Figure(Figure):
    """A figure that is drawn and saved with the settings that it was made with: ticks are made when it is drawn."""

    def draw(self, renderer: Any) -> None:
        with default_settings():
            layout = self.get_layout_engine()
            if self.canvas.is_saving() and isinstance(layout, _Layout):
                layout.execute(self)  # Matplotlib draws once for it, and once more for the file
            else:
                super().draw(renderer)

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        with default_settings():
            super().savefig(*args, **kwargs)


@with_default_settings
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
    make = _Figure if pyplot is None else partial(pyplot.figure, FigureClass=_Figure)
    return make(figsize=size, layout=_Layout(compress=True, h_pad=0.08, w_pad=0.06), dpi=150)


def interval_of_fraction(fraction: Floats, number: Floats | Integers) -> tuple[Floats, Floats]:
    """Ends of the interval of 68 % for a fraction of a number of ions: Wilson, J. Am. Stat. Assoc. 22, 209 (1927)."""
    middle = (fraction * number + 0.5) / (number + 1)
    half = np.sqrt(fraction * (1 - fraction) * number + 0.25) / (number + 1)
    # a rounding error below zero would be refused as the length of a bar
    return np.minimum(middle - half, fraction), np.maximum(middle + half, fraction)
