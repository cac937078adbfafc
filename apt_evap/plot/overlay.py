"""A simulated map drawn over a measured one, as they are registered."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from apt_evap.alignment import BROAD, View
from apt_evap.hits import Hits
from apt_evap.maps import DetectorMap
from apt_evap.plot.maps import detector_map
from apt_evap.register import Registration

BRIGHT, DARK, RIM = "cyan", "lime", "white"
_SMOOTHING = 0.015
"""Of the contours [diameters of the measured field of view]."""


def overlay(
    simulated: DetectorMap | Hits,
    measured: DetectorMap | Hits,
    registration: Registration,
    ax: Axes | None = None,
    *,
    title: str | None = None,
    colormap: str = "inferno",
    colorbar: bool = True,
) -> Axes:
    """Draw a measured map with contours of the simulated one moved onto it.

    Contours are those of the flattened simulated map, half a standard deviation above its mean (what is bright) and
    below it (dark); a dashed line is the simulated field of view.

    Parameters
    ----------
    simulated, measured : DetectorMap or Hits
        The maps.
    registration : Registration
        What moves the simulated map onto the measured one.
    ax : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    title : str, optional
        Title above the map.
    colormap : str
        Name of a colour map of matplotlib, for the measured map.
    colorbar : bool
        Whether to draw a colour bar.

    Returns
    -------
    matplotlib.axes.Axes
        Its ``figure.savefig`` writes the picture.
    """
    simulated, measured = (m if isinstance(m, DetectorMap) else DetectorMap.from_hits(m) for m in (simulated, measured))
    ax = detector_map(measured, ax, title=title, colormap=colormap, colorbar=colorbar, caption=False)
    inside, seen = View(simulated), View(measured)
    scale = registration.scale
    image = inside.flatten(_SMOOTHING * seen.diameter / scale, BROAD * seen.diameter / scale)
    low_x, high_x, low_y, high_y = measured.extent
    x, y = np.meshgrid(np.linspace(low_x, high_x, 400), np.linspace(low_y, high_y, 400))
    back_x, back_y = registration.inverse.points(x, y)
    values, shown = image.sample(back_x + 1j * back_y)
    spread = values[shown].std() if shown.any() else 0.0
    legend = []
    if spread > 0:
        field = np.ma.masked_array(values, ~shown)
        for sign, color, label in ((1, BRIGHT, "simulated, bright"), (-1, DARK, "simulated, dark")):
            ax.contour(x, y, field, levels=[sign * spread / 2], colors=color, linewidths=0.9, linestyles="solid")
            legend.append(Line2D([], [], color=color, label=label))
    if not shown.all():
        ax.contour(x, y, shown.astype(float), levels=[0.5], colors=RIM, linewidths=1.2, linestyles="dashed")
        legend.append(Line2D([], [], color="0.4", linestyle="dashed", label="simulated field of view"))
    ax.legend(handles=legend, loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=3, fontsize="small", frameon=False)
    ax.annotate(
        _caption(registration), (0.5, 1), xytext=(0, 5), xycoords="axes fraction", textcoords="offset points",
        ha="center", fontsize="small", color="0.35",
    )  # fmt: skip
    if title:
        ax.set_title(title, pad=34)
    return ax


def _caption(registration):
    """The transform and how well it fits, in two lines."""
    if np.isfinite(registration.score):
        quality = f"correlation {registration.score:.2f}, {registration.overlap:.0%} of the field of view shared"
    elif np.isfinite(registration.residual):
        quality = f"from points, {registration.residual:.2g} mm off (RMS)"
    else:
        quality = "as given"
    return f"{registration}\n{quality}"
