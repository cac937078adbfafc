"""Overlay of a registered simulated map on a measured one, and the scores that the registration chose from."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from apt_evap._common.validation import check_kind
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.maps.registration.correlation_search import BROAD, View
from apt_evap.maps.registration.register import Registration, ScoreSurface
from apt_evap.plot._figure import (
    OUTSIDE,
    DrawnAxes,
    add_colorbar,
    new_figure,
    set_caption,
    set_title,
    with_default_settings,
)
from apt_evap.plot.map_figures import detector_map

BRIGHT, DARK, RIM = "cyan", "lime", "white"
_SMOOTHING = 0.015
"""Smoothing of the contours [diameters of the measured field of view]."""


@with_default_settings
def overlay(
    simulated: DetectorMap | Hits,
    measured: DetectorMap | Hits,
    registration: Registration,
    ax: Axes | None = None,
    *,
    title: str | None = None,
    colormap: str = "inferno",
    colorbar: bool = True,
) -> DrawnAxes:
    """Draw a measured map with contours of the registered simulated map, and the simulated map beside it.

    The contours enclose the brightest and the darkest eighth of the area of the flattened simulated map. A dashed line
    is the simulated field of view.

    Parameters
    ----------
    simulated, measured : DetectorMap or Hits
        The maps.
    registration : Registration
        Transform of the simulated map to the measured one.
    ax : matplotlib.axes.Axes, optional
        Axes for the measured map only; by default a new figure with both maps.
    title : str, optional
        Title above the map.
    colormap : str
        Name of a colour map of matplotlib, for the measured map.
    colorbar : bool
        Whether to draw a colour bar.

    Returns
    -------
    matplotlib.axes.Axes
        Axes of the measured map; its ``figure.savefig`` writes a file.
    """
    simulated, measured = (m if isinstance(m, DetectorMap) else DetectorMap.from_hits(m) for m in (simulated, measured))
    beside = None
    if ax is None:
        ax, beside = new_figure((10.4, 5.2)).subplots(1, 2)
    detector_map(measured, ax, colormap=colormap, colorbar=colorbar, caption=False)
    view, measured_view = View(simulated), View(measured)
    scale = registration.scale
    image = view.flatten(_SMOOTHING * measured_view.diameter / scale, BROAD * measured_view.diameter / scale)
    low_x, high_x, low_y, high_y = measured.extent
    x, y = np.meshgrid(np.linspace(low_x, high_x, 400), np.linspace(low_y, high_y, 400))
    back_x, back_y = registration.inverse_points(x, y)
    values, covered = image.sample(back_x + 1j * back_y)
    common = measured.contains(x, y) & covered  # contours outside the measured map are meaningless
    legend = []
    if common.any() and np.ptp(values[common]) > 0:
        field = np.ma.masked_array(values, ~common)
        for percent, color, label in ((87.5, BRIGHT, "simulated, bright"), (12.5, DARK, "simulated, dark")):
            level = np.percentile(values[common], percent)
            for panel in (ax,) if beside is None else (ax, beside):
                panel.contour(x, y, field, levels=[level], colors=color, linewidths=0.9, linestyles="solid")
            legend.append(Line2D([], [], color=color, label=label))
    if beside is not None:
        image = beside.imshow(
            np.where(covered, 1 + values, np.nan), origin="lower", extent=measured.extent, cmap=colormap,
            vmin=max(0, 1 + values.min()), vmax=1 + values.max(),
        )  # fmt: skip
        beside.set(facecolor=OUTSIDE, xlabel="x [mm]", ylabel="y [mm]")
        set_caption(beside, "simulated, flattened, as registered")
        if colorbar:
            add_colorbar([image], beside, label="hits per area / mean, flattened")
    if not covered.all():
        ax.contour(x, y, covered.astype(float), levels=[0.5], colors=RIM, linewidths=1.2, linestyles="dashed")
        legend.append(Line2D([], [], color=RIM, linestyle="dashed", label="simulated field of view"))
    options = {"handles": legend, "ncols": 3, "fontsize": "small"}
    options |= {"facecolor": "0.2", "edgecolor": "none", "framealpha": 1, "labelcolor": "white"}  # white lines are seen
    if beside is None:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), **options)
    else:
        ax.figure.legend(loc="outside lower center", **options)
    set_caption(ax, _caption(registration))
    set_title(ax, title, pad=8)
    return ax


def _caption(registration):
    """Text of the transform and its quality, in two lines."""
    if np.isfinite(registration.score):
        quality = f"correlation {registration.score:.2f}, common area {registration.overlap:.0%} of the field of view"
    elif np.isfinite(registration.residual):
        quality = f"from points, residual {registration.residual:.2g} mm (RMS)"
    else:
        quality = "as given"
    return f"{registration}\n{quality}"


@with_default_settings
def score_surface(surface: ScoreSurface, ax: Axes | None = None) -> Axes:
    """Draw the score of a registration against rotation and scale, with its maximum.

    Parameters
    ----------
    surface : ScoreSurface
        Result of `maps.score_surface`, for at least two rotations and two scales.
    ax : matplotlib.axes.Axes, optional
        A new figure by default.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ValueError
        If there are too few rotations or scales, or no score is known.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1)), seed=1).run(400)
    >>> simulated = run.hits(ae.RollUp(0.2)).map(bins=32)
    >>> surface = ae.maps.score_surface(simulated, simulated, rotations=(-60, 60), scales=(0.9, 1.1))
    >>> ae.plot.score_surface(surface).get_title()
    'score 0.99 at 0 degrees and 1.02'
    """
    check_kind(surface, "surface", ScoreSurface, "a ScoreSurface")
    if min(surface.scores.shape) < 2 or not np.isfinite(surface.scores).any():
        raise ValueError(
            f"surface must have two rotations, two scales and a score, got {surface.scores.shape[1]} and "
            f"{surface.scores.shape[0]}"
        )
    ax = new_figure((6.0, 4.0)).add_subplot() if ax is None else ax
    image = ax.pcolormesh(surface.rotations, surface.scales, surface.scores, shading="nearest", cmap="viridis")
    row, column = np.unravel_index(np.nanargmax(surface.scores), surface.scores.shape)
    best = surface.rotations[column], surface.scales[row]
    ax.plot(*best, "o", markersize=11, markerfacecolor="none", markeredgecolor="white", markeredgewidth=1.5)
    ax.set_xlabel("Rotation [degrees]")
    ax.set_ylabel("Scale [measured mm per simulated mm]")
    ax.set_title(
        f"score {surface.scores[row, column]:.2f} at {best[0]:.0f} degrees and {best[1]:.3g}", fontsize="medium"
    )
    ax.figure.colorbar(image, ax=ax, label="score", fraction=0.05, pad=0.02)
    return ax
