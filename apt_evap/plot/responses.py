"""Hits of selected ions for increasing energy of the perturbation."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from numpy.typing import ArrayLike

from apt_evap._common.validation import short_text
from apt_evap.plot._figure import DrawnAxes, new_figure, set_title, with_default_settings
from apt_evap.simulation.response_tracks import lateral_tracks, rollup_tracks
from apt_evap.simulation.run import Run

MECHANISMS = ("lateral velocity", "roll-up")


def ion_colors(n: int) -> list[str]:
    """Colours of selected ions, the same in every plot."""
    return [f"C{index % 10}" for index in range(n)]


@with_default_settings
def response(
    run: Run,
    ions: ArrayLike,
    mechanism: str = "lateral velocity",
    ax: Axes | None = None,
    *,
    energies: ArrayLike | None = None,
    colors: Any = None,
    colormap: str = "viridis",
    colorbar: bool = True,
    zoom: int | None = None,
    title: str | None = None,
) -> DrawnAxes:
    """Draw the hits of selected ions for increasing launch energies.

    For a lateral velocity, all directions along the surface are drawn. For roll-up, a track is drawn: from the hit
    without perturbation (dot), by the roll-up without energy (dashed), through the hits of increasing energy.

    Parameters
    ----------
    run : Run
        A run with responses.
    ions : array_like of int
        Indices of ions of the run, shape (n,).
    mechanism : {"lateral velocity", "roll-up"}
        Mechanism of the perturbation.
    ax : matplotlib.axes.Axes, optional
        Axes for the plot; a new figure by default.
    energies : array_like, optional
        Launch energies [eV], increasing, shape (m,); 0 to 1 eV by default.
    colors : sequence of colors, optional
        Colours of the dots, one for each ion; `ion_colors` by default.
    colormap : str
        Colour map of the energies.
    colorbar : bool
        Whether to draw a colour bar.
    zoom : int, optional
        Index, from 0, of one of the n ions to enlarge in an inset.
    title : str, optional
        Title above the plot.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ValueError
        If the run has no responses, or an argument is invalid.
    """
    if mechanism not in MECHANISMS:
        raise ValueError(f"mechanism must be one of {', '.join(MECHANISMS)}, got {short_text(mechanism)}")
    energies = np.linspace(0, 1, 51) if energies is None else np.asarray(energies, float)
    unperturbed = lateral_tracks(run, ions, [0.0], [0.0])
    dots = np.column_stack([unperturbed.x[:, 0, 0], unperturbed.y[:, 0, 0]])
    if zoom is not None and not 0 <= zoom < len(dots):
        raise ValueError(f"zoom must be an index from 0 to {len(dots) - 1}, got {short_text(zoom)}")
    colors = ion_colors(len(dots)) if colors is None else list(colors)
    if mechanism == MECHANISMS[0]:
        draw, tracks = _directions, lateral_tracks(run, ions, energies, np.arange(0, 360, 2))
    else:
        draw, tracks = _lines, rollup_tracks(run, ions, energies)
    scale = {"norm": Normalize(energies.min(), energies.max()), "cmap": colormap}
    if ax is None:
        ax = new_figure((5.6, 5.0)).subplots()
    draw(ax, tracks, dots, scale, 1.0)
    _dots(ax, dots, colors, 26)
    ax.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    set_title(ax, title)
    ax.autoscale_view()
    ax.set_box_aspect(1)
    ax.set_adjustable("datalim")
    if zoom is not None:
        inset = ax.inset_axes(_emptiest_corner(ax, tracks))
        draw(inset, tracks, dots, scale, 2.2)
        _dots(inset, dots, colors, 60)
        places = np.column_stack([tracks.x[zoom].ravel(), tracks.y[zoom].ravel()])
        low, high = (end([*places, dots[zoom]], axis=0) for end in (np.nanmin, np.nanmax))
        half = 0.58 * max(high - low)
        middle = (low + high) / 2
        inset.set(xlim=middle[0] + [-half, half], ylim=middle[1] + [-half, half], aspect="equal")
        inset.tick_params(labelsize="x-small")
        ax.indicate_inset_zoom(inset, edgecolor="0.3")
    if colorbar:
        mapped = ScalarMappable(**scale)
        mapped.set_array(energies)
        ax.figure.colorbar(mapped, ax=ax, label="launch energy [eV]", fraction=0.05, pad=0.02)
    return ax


def _directions(ax, tracks, dots, scale, size):
    """Draw all directions at every energy, the highest first so that the lowest are visible."""
    n, _, k = tracks.x.shape
    order = np.argsort(-tracks.energies, kind="stable")
    x, y = (np.moveaxis(values[:, order], 1, 0) for values in (tracks.x, tracks.y))
    energies = np.repeat(tracks.energies[order], n * k)
    ax.scatter(x.ravel(), y.ravel(), c=energies, s=3 * size**2, linewidths=0, rasterized=True, **scale)


def _lines(ax, tracks, dots, scale, size):
    for x, y, dot in zip(tracks.x, tracks.y, dots, strict=True):
        ax.plot([dot[0], x[0]], [dot[1], y[0]], color="0.35", linewidth=1.0, linestyle=(0, (3, 2)), zorder=1)
        points = np.column_stack([x, y])
        parts = np.stack([points[:-1], points[1:]], axis=1)
        middle = (tracks.energies[:-1] + tracks.energies[1:]) / 2
        ax.add_collection(LineCollection(parts, array=middle, linewidths=2.4 * size**0.5, capstyle="round", **scale))


def _dots(ax, dots, colors, size):
    ax.scatter(*dots.T, s=size, c=colors, edgecolors="white", linewidths=0.8, zorder=5)


def _emptiest_corner(ax, tracks):
    """Bounds of an inset, in fractions of the axes, in the corner with the fewest points."""
    places = np.column_stack([tracks.x.ravel(), tracks.y.ravel()])
    ax.figure.draw_without_rendering()  # sets the limits of the axes
    places = ax.transAxes.inverted().transform(ax.transData.transform(places[np.isfinite(places).all(axis=1)]))
    side, gap = 0.34, 0.1
    corners = [(x, y) for y in (gap, 1 - side - 0.02) for x in (gap, 1 - side - 0.02)]
    labels = 0.1  # space for the tick labels of the inset
    points_inside = [
        np.sum(np.all((places > np.subtract(corner, labels)) & (places < np.add(corner, side)), axis=1))
        for corner in corners
    ]
    return (*corners[int(np.argmin(points_inside))], side, side)
