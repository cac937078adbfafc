"""Pictures of maps on one place, switched by a press or a key."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from apt_evap import plot
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.plot._figure import OUTSIDE
from apt_evap.plot.report.html_page import Page, escape, switched

_LEFT, _RIGHT, _BELOW, _ABOVE = 0.7, 1.05, 0.55, 0.35  # margins [inch]: labels, colour bar, labels, title


def blinking_pictures(
    page: Page,
    maps: Mapping[str, DetectorMap],
    width: float = 5.4,
    crystal: tuple[Orientation, Any] | None = None,
) -> str:
    """Maps of the same bins side by side, which a press or a key puts on one place, as HTML.

    The region is the mask of the first one, `width` that of a picture [inch]. With a crystal, its orientation and
    projection, poles are drawn on all maps.
    """
    first = next(iter(maps.values()))
    rows, columns = (np.flatnonzero(first.mask.any(axis=axis)) for axis in (1, 0))
    (left, right), (bottom, top) = (
        (edges[max(index[0] - 2, 0)], edges[min(index[-1] + 3, len(edges) - 1)])
        for edges, index in ((first.x_edges, columns), (first.y_edges, rows))
    )
    side = width - _LEFT - _RIGHT
    up = side * (top - bottom) / (right - left)
    height = up + _BELOW + _ABOVE
    pictures, marks = [], {}
    for title, map in maps.items():
        # fixed places of axes and colour bar: both pictures agree to the pixel
        figure = Figure(figsize=(width, height))
        ax = figure.add_axes((_LEFT / width, _BELOW / height, side / width, up / height))
        density = map.density[map.mask]
        low, high = np.percentile(density, [2, 99.5])  # below 2 percent may be a dark rim
        limits = (float(low), float(high)) if high > low else (0.0, 2.0)
        plot.detector_map(map, ax, limits=limits, colorbar=False, caption=False)
        if crystal is not None:
            plot.poles(ax, *crystal, region=first)
            marks |= {label: line for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        ax.set(xlim=(left, right), ylim=(bottom, top), facecolor=OUTSIDE)
        ax.set_title(title, fontsize="medium", parse_math=False)
        bar = figure.add_axes(((_LEFT + side + 0.15) / width, _BELOW / height, 0.15 / width, up / height))
        figure.colorbar(ax.images[0], cax=bar, label="hits per area / mean")
        pictures.append(page.picture(figure, alt=title))
    return "\n".join([switched(pictures, beside=True), *([_legend(marks)] if marks else [])])


def _legend(marks):
    """Names of the poles and zone lines on the pictures, as HTML."""
    names = []
    for label, mark in marks.items():
        if isinstance(mark, Line2D):
            names.append(f'<span style="color: {mark.get_color()}">&#9644;</span> {escape(label.replace("$", ""))}')
        else:
            names.append(f"&#9675; {escape(label)}, larger for a larger spacing of the planes")
    return f'<p class="note">Of the simulated crystal, on both maps: {"; ".join(names)}.</p>'
