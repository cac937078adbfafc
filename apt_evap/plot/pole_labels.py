"""Poles and zone lines over a detector map."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from apt_evap._common.label_places import place_labels
from apt_evap._common.validation import check_kind
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.directions import ZONES, zones
from apt_evap.maps.crystallography.directions import label as indices_label
from apt_evap.maps.crystallography.directions import poles as poles_of
from apt_evap.maps.crystallography.orientation import FittedOrientation, Orientation
from apt_evap.plot._figure import DrawnAxes, with_default_settings
from apt_evap.plot._labels import Placement, box_of, place_text, sizes_of
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.run import Run

_COLORS = ("#35b6ff", "#ff9d3b", "#7be07b", "#e58cff")
_GAP = 1.5  # between the circle of a pole and its label [points]
_AZIMUTHS = np.radians(np.arange(0.0, 360.5, 0.5))


@with_default_settings
def poles(
    ax: Axes,
    orientation: Orientation | FittedOrientation | Run,
    projection: Projection | None = None,
    *,
    families: int = 6,
    zone_families: Sequence[Any] | None = None,
    labels: bool = True,
    region: DetectorMap | None = None,
    size: float = 9,
) -> DrawnAxes:
    """Draw the poles and zone lines of a specimen over a map.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
        Axes of a map in mm, such as `detector_map` returns; only points within their limits are drawn.
    orientation : Orientation or FittedOrientation or Run
        Orientation of the crystal; a fit and a run have theirs.
    projection : Projection, optional
        Projection of directions onto the map; by default that of the fit, or of the run by `image_compression`.
    families : int
        Number of families of poles, see `poles.poles`; 0 for none.
    zone_families : sequence, optional
        Families of zone axes whose lines are drawn, by default those of `poles.ZONES`; () for none.
    labels : bool
        Whether to label the poles. Of overlapping labels only that of the larger spacing is drawn.
    region : DetectorMap, optional
        The map, to draw only inside its detector.
    size : float
        Font size of the labels [points].

    Returns
    -------
    matplotlib.axes.Axes
    """
    check_kind(ax, "ax", Axes, "axes of a map, such as detector_map(map)")
    orientation, projection = _oriented(orientation, projection)
    x_limits, y_limits = sorted(ax.get_xlim()), sorted(ax.get_ylim())
    material = orientation.material

    def is_visible(places):
        with np.errstate(invalid="ignore"):
            inside = (places[:, 0] > x_limits[0]) & (places[:, 0] < x_limits[1])
            inside &= (places[:, 1] > y_limits[0]) & (places[:, 1] < y_limits[1])
        return inside if region is None else inside & region.contains(*places.T)

    if zone_families is None or len(zone_families):
        axes = zones(material, zone_families)
        named = dict(enumerate(ZONES[material.structure] if zone_families is None else zone_families))
        for axis, family in zip(orientation.directions(axes.directions), axes.families.tolist(), strict=True):
            first, second = np.linalg.svd(axis[None])[2][1:]
            circle = np.cos(_AZIMUTHS)[:, None] * first + np.sin(_AZIMUTHS)[:, None] * second
            places = projection.places(circle)
            places[~is_visible(places)] = np.nan
            name = None
            if family in named and not np.isnan(places).all():  # the first line of its family
                name = f"zone lines of ⟨{indices_label(named.pop(family))}⟩"
            ax.plot(*places.T, color=_COLORS[family % len(_COLORS)], linewidth=0.8, alpha=0.9, zorder=2.5, label=name)
    if families:
        crystal_poles = poles_of(material, families)
        places = projection.places(orientation.directions(crystal_poles.normals))
        selection = np.flatnonzero(is_visible(places))
        areas = 60 * (crystal_poles.spacings[selection] / crystal_poles.spacings.max()) ** 2
        outline = [withStroke(linewidth=2, foreground="black")]
        ax.scatter(*places[selection].T, s=areas, facecolors="none", edgecolors="white", linewidths=1.2, zorder=3,
                   path_effects=outline, label="poles" if len(selection) else None)  # fmt: skip
        texts = [
            ax.annotate(crystal_poles.labels[index], places[index], xytext=(0, 0), textcoords="offset pixels",
                        size=size, ha="left", va="bottom", color="white", path_effects=outline, clip_on=True)
            for index in (selection if labels else ())
        ]  # fmt: skip
        ax.add_artist(Placement(partial(_place_labels, ax, texts, np.sqrt(areas / np.pi))))
    ax.set(xlim=x_limits, ylim=y_limits)
    return ax


def _place_labels(ax, texts, radii, renderer):
    """Place labels beside their poles, those of the largest spacings first."""
    point = ax.figure.dpi / 72
    options, circles = [], []
    for text, radius, (width, height) in zip(texts, radii * point, sizes_of(texts, renderer), strict=True):
        x, y = ax.transData.transform(text.xy)
        circles.append((x - radius, y - radius, x + radius, y + radius))
        radius += _GAP * point
        beside = x + radius, x - radius - width
        above = y + 0.5 * (radius - height), y - 0.5 * (radius + height)
        options.append([[(left, low, left + width, low + height)] for low in above for left in beside])
    for text, boxes in zip(texts, place_labels(options, box_of(ax, renderer), circles), strict=True):
        place_text(text, boxes)


def _oriented(orientation, projection):
    """Orientation of the crystal and projection onto the map."""
    if isinstance(orientation, FittedOrientation):
        return orientation.orientation, projection or orientation.projection
    if isinstance(orientation, Run):
        projection = projection or image_compression(orientation).projection
        return Orientation.from_settings(orientation.settings["tip"]), projection
    check_kind(orientation, "orientation", Orientation, "an Orientation, the result of fit_orientation, or a Run")
    return orientation, check_kind(projection, "projection", "places", "a Projection")
