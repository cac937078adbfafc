"""Plots of a study: scores against energies, and the maps side by side."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from apt_evap._common.validation import check_array, check_number
from apt_evap.detection.color_limits import common_limits
from apt_evap.fit.study import PREDICTED, RULE_OF_METAL, Study
from apt_evap.plot._figure import OUTSIDE, add_colorbar, new_figure, with_default_settings
from apt_evap.plot.map_figures import detector_map

_MARK = "#00d0ff"  # visible on all colours of both maps


@with_default_settings
def score_matrix(study: Study, axes: Sequence[Axes] | None = None, *, colormap: str = "viridis") -> NDArray[np.object_]:
    """Draw the score with the measured map against mean and relative standard deviation of the energy.

    A frame marks the best point of the grid. A circle marks the maximum between points, with its
    intervals of 95 %. A new figure has a legend.

    Parameters
    ----------
    study : Study
        Result of `fit_energies`.
    axes : sequence of matplotlib.axes.Axes, optional
        Axes for the plots, one per roll-up fraction and option; by default a new figure with three per row.
    colormap : str
        Name of a colour map of matplotlib.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (n,), one per roll-up fraction and option.

    Raises
    ------
    ValueError
        If the number of axes is wrong.
    """
    grid = study.grid
    *leading, rows, columns = grid.shape
    layers = int(np.prod(leading))
    across = min(layers, 3)
    if axes is None:
        down = -(-layers // across)
        figure = new_figure((0.75 * columns * across + 1.8, (0.62 * rows + 1.0) * down))
        figure.suptitle(f"{grid.name}: {study.settings.score_name} with the measured map", fontsize="medium")
        panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
    elif len(axes) == layers:
        panels = np.array(axes, object)
    else:
        raise ValueError(f"axes must be {layers}, one per roll-up fraction and option, got {len(axes)}")
    limits = {"vmin": study.scores.min(), "vmax": study.scores.max()}
    for ax, values, title in zip(panels, study.scores.reshape(layers, rows, columns), grid.layers, strict=False):
        image = ax.imshow(values, origin="lower", cmap=colormap, aspect="auto", **limits)
        for (row, column), value in np.ndenumerate(values):
            shade = image.cmap(image.norm(value))
            light = np.dot(shade[:3], (0.299, 0.587, 0.114)) > 0.5
            # in a corner, because the circle is usually near a centre; legible across error bars
            text = ax.text(column - 0.4, row + 0.38, f"{value:z.3f}", ha="left", va="top", fontsize=8, zorder=5)
            text.set(color="k" if light else "w", path_effects=[withStroke(linewidth=3, foreground=shade)])
        ax.set_xticks(range(columns), [f"{mean:.4g}" for mean in grid.means])
        ax.set_yticks(range(rows), [f"{relative_spread:.3g}" for relative_spread in grid.relative_spreads])
        ax.set_title(title, fontsize="medium")
    for ax in panels[layers:]:
        ax.remove()
    panels = panels[:layers]
    for number, ax in enumerate(panels):
        if number + across >= layers:
            ax.set_xlabel("mean energy [eV]")
            ax.tick_params(labelbottom=True)
        if number % across == 0:
            ax.set_ylabel("standard deviation / mean")
    marks = _mark_optima(study, panels)
    if axes is None:
        figure.legend(handles=marks, loc="outside lower center", ncols=2, frameon=False, fontsize="small")
    add_colorbar(
        [ax.images[0] for ax in panels],
        list(panels),
        label=f"noise-corrected {study.settings.score_name}" if _is_corrected(study) else study.settings.score_name,
    )
    return panels


def _is_corrected(study):
    """Whether the scores are corrected for noise: that of measured densities is not known."""
    return study.settings.allow_noise and study.measured.is_counts


def _mark_optima(study, axes):
    """Mark the best point by a frame, and the maximum between points by a circle with its interval; return both."""
    grid, refined = study.grid, study.refined
    *leading, row, column = study.best_cell
    ax = axes[int(np.ravel_multi_index(leading, grid.shape[:-2]))]
    frame = Rectangle((column - 0.48, row - 0.48), 0.96, 0.96, fill=False, edgecolor="r", linewidth=2)
    ax.add_patch(frame).set_label("best on the grid")

    def places(values, points):
        return np.interp(values, points, np.arange(len(points)))

    x, y = places(refined.mean, grid.means), places(np.log(refined.relative_spread), np.log(grid.relative_spreads))
    errors = {}
    if refined.intervals:
        across = places(refined.intervals["mean"], grid.means)
        along = places(np.log(refined.intervals["relative_spread"]), np.log(grid.relative_spreads))
        errors = {"xerr": np.abs(across - x)[:, None], "yerr": np.abs(along - y)[:, None]}
    label = "best between its points" + ", interval of 95 %" * bool(errors)
    return frame, ax.errorbar(
        x, y, **errors, fmt="o", color="r", capsize=3, markersize=9, markerfacecolor="none", label=label
    )


@with_default_settings
def side_by_side(
    study: Study,
    *,
    circle: tuple[float, ...] | None = None,
    titles: Sequence[str] | None = None,
    colormap: str = "inferno",
) -> NDArray[np.object_]:
    """Draw the measured map, the unperturbed map and the optimum side by side, and an enlarged part of them.

    The maps are flattened and smoothed as for the comparison, inside the common region. The measured map has a separate
    colour scale, from the 2 to the 99.5 percentile, because its contrast may be much lower. The simulated maps have a
    common scale.

    Parameters
    ----------
    study : Study
        Result of `fit_energies`.
    circle : tuple of float, optional
        x, y and radius [mm] of the enlarged part; by default around the axis of the simulated specimen if this is
        inside the region, otherwise around the centre of the region.
    titles : sequence of str, optional
        Titles of the three maps.
    colormap : str
        Name of a colour map of matplotlib.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Measured, unperturbed, optimum, and enlarged measured and optimum, shape (5,).
    """
    maps = [study.compared(study.measured), *(study.compared(study.maps[name]) for name in ("unperturbed", "optimum"))]
    x, y, radius = _default_circle(study) if circle is None else check_array(circle, "circle", (3,))
    check_number(float(radius), "the radius of circle", above=0, unit="mm")
    best = study.optimum
    if titles is None:
        mechanism = study.grid.name
        if mechanism == "combined":
            mechanism += f", roll-up fraction {best.rollup_fraction:g}"
        mechanism += "".join(f", {name} {value:g}" for name, value in best.options.items())
        energies = f"{best.mean:g} eV, σ/mean {best.relative_spread:g}"
        titles = "measured", "simulated, unperturbed", f"simulated, {mechanism}\n{energies}"
    # below 2 percent may be a dark rim
    low, high = np.percentile(maps[0].density[maps[0].mask], [2, 99.5])
    measured = (float(low), float(high)) if high > low else (0.0, 2.0)
    simulated = common_limits(maps[1:])
    figure = new_figure((13.0, 8.4))
    axes = figure.subplots(2, 3)
    for ax, map, title, limits in zip(axes[0], maps, titles, (measured, simulated, simulated), strict=True):
        detector_map(map, ax, title=title, limits=limits, colormap=colormap, colorbar=False, caption=False)
        _show_inside(ax, map)
    for ax, map, title, limits in (
        (axes[1, 0], maps[0], titles[0], measured),
        (axes[1, 2], maps[2], "simulated", simulated),
    ):
        title = f"{title}, magnified"
        detector_map(map, ax, title=title, limits=limits, colormap=colormap, colorbar=False, caption=False)
        ax.images[0].set_clip_path(Circle((x, y), radius, transform=ax.transData))
        ax.set(xlim=(x - radius, x + radius), ylim=(y - radius, y + radius), facecolor="w")
        ax.add_patch(Circle((x, y), radius, fill=False, edgecolor=_MARK, linewidth=3))
    for ax in (axes[0, 0], axes[0, 2]):
        ax.add_patch(Circle((x, y), radius, fill=False, edgecolor=_MARK, linewidth=2))
    axes[1, 1].axis("off")
    axes[1, 1].text(0.5, 0.5, _scores(study), ha="center", va="center", transform=axes[1, 1].transAxes, linespacing=1.7)
    panels = [*axes[0], axes[1, 0], axes[1, 2]]
    for ax in panels:
        label = "hits per area / mean, flattened" if ax in axes[:, 2] else ""
        add_colorbar([ax.images[0]], ax, label=label)
    return np.array(panels)


def _show_inside(ax, map):
    """Limit the axes to the mask, with a margin of two bins."""
    rows, columns = (np.flatnonzero(map.mask.any(axis=axis)) for axis in (1, 0))
    ends = []
    for edges, index in ((map.x_edges, columns), (map.y_edges, rows)):
        ends.append((edges[max(index[0] - 2, 0)], edges[min(index[-1] + 3, len(edges) - 1)]))
    ax.set(xlim=ends[0], ylim=ends[1], facecolor=OUTSIDE)


def _default_circle(study):
    map = study.measured
    x, y = (grid[map.mask] for grid in np.meshgrid(*map.centres))
    reach = np.sqrt(map.mask.sum() * np.prod(map.bin_size) / np.pi)
    axis = [float(value[0]) for value in study.registration.points(np.zeros(1), np.zeros(1))]
    inside = np.hypot(x - axis[0], y - axis[1]).min() < max(map.bin_size)
    middle = axis if inside else (x.mean(), y.mean())
    return *middle, 0.5 * reach


def _scores(study):
    """Text with the similarities."""
    corrected = _is_corrected(study)
    lines = [
        f"{study.settings.score_name} with the measured map",
        f"in {study.provenance['bins_compared']:,} bins" + ", noise-corrected" * corrected,
    ]
    if study.registration.doubtful:
        lines.insert(0, f"THE REGISTRATION IS DOUBTFUL: correlation {study.registration.score:.2f}\n")
    labels = {RULE_OF_METAL: PREDICTED}
    lines += [f"{labels.get(name, name)}: {score}" for name, score in study.baselines.items()]
    lines.append(f"{study.grid.name}: {study.optimum.score}")
    lines.append(f"gain over unperturbed: {study.gain}")
    if study.ceiling is not None:
        lines += [f"uncorrected: {study.plain['optimum']}"] * corrected
        lines.append(f"two halves of the measured ions: {study.ceiling}")
    if study.structure is not None:
        for name in ("measured", "unperturbed", "optimum"):
            rings = getattr(study.structure, name).rings
            lines.append(f"contrast of rings, {name}: " + ", ".join(f"{ring.contrast:.2f}" for ring in rings))
        lines += [f"RINGS AND {study.settings.score_name.upper()} DISAGREE"] * study.structure.disagrees
    width, height = study.measured.bin_size
    lines.append(f"bins {width:.3g} × {height:.3g} mm, smoothed by {study.settings.smoothing:.3g} mm")
    return "\n".join(lines)
