"""Poles and zone lines of the simulated specimen over the maps."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, LabelSet, Toggle

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.marks import Overlay

ZONE_LINE = "#35b6ff"
"""Colour of zone lines."""
_LABEL = (0.08, 0.04)  # width and height of a label, over the width of the map


class PolePanel:
    """Drawings over the maps, and the button that shows them."""

    def __init__(self, explorer: Explorer, maps: ExplorerMaps, figures: Sequence[Any]) -> None:
        self._explorer, self._maps = explorer, maps
        self._drawn: Any = None  # registration of the poles that are drawn
        self.lines = ColumnDataSource({"x": [], "y": []})
        self.poles = ColumnDataSource({"x": [], "y": [], "label": []})
        self.drawings: list[list[Any]] = [draw_poles(fig, self.lines, self.poles) for fig in figures]
        self.button = Toggle(label="poles", active=explorer.is_comparison, width=70)
        self.button.on_change("active", lambda attr, old, new: self._put())

    def put(self, maps: ExplorerMaps) -> None:
        """Draw the poles where the registration puts them, unless the maps are a preview."""
        self._maps = maps
        if not maps.preview and self._explorer.registration is not self._drawn:
            self._put()

    def hide_on_last(self, hidden: bool) -> None:
        """Hide the poles on the last map, on which others are marked."""
        for drawing in self.drawings[-1]:
            drawing.visible = not hidden

    def _put(self):
        self._drawn = self._explorer.registration
        drawn = self._explorer.poles.overlay(self._maps, self._drawn) if self.button.active else None
        if drawn is None or (self._explorer.is_comparison and not self._explorer.registered):
            self.lines.data, self.poles.data = {"x": [], "y": []}, {"x": [], "y": [], "label": []}
            return
        points, labels = with_gaps(drawn.lines), sparse_labels(drawn, self._maps.pictures[-1])
        self.lines.data = {"x": points[:, 0], "y": points[:, 1]}
        self.poles.data = {"x": drawn.places[:, 0], "y": drawn.places[:, 1], "label": labels}


def draw_poles(fig: Any, lines: ColumnDataSource, poles: ColumnDataSource) -> list[Any]:
    """Draw zone lines, and poles with their labels, on a map; return the drawings."""
    labels = LabelSet(
        x="x", y="y", text="label", source=poles, x_offset=4, y_offset=3, text_color="white", text_font_size="12px",
        background_fill_color="black", background_fill_alpha=0.5,
    )  # fmt: skip
    fig.add_layout(labels)
    return [
        fig.line("x", "y", source=lines, line_color=ZONE_LINE, line_width=1, line_alpha=0.8),
        fig.scatter("x", "y", source=poles, size=7, fill_alpha=0, line_color="white"),
        labels,
    ]


def sparse_labels(drawn: Overlay, like: DetectorMap) -> list[str]:
    """Labels of poles, those first that have the largest spacing; "" where another label is near."""
    left, right, _, _ = like.extent
    across, along = _LABEL[0] * (right - left), _LABEL[1] * (right - left)
    labels: list[str] = []
    places: list[Any] = []
    for place, label in zip(drawn.places, drawn.labels, strict=True):
        crowded = any(abs(place[0] - x) < across and abs(place[1] - y) < along for x, y in places)
        labels.append("" if crowded else label)
        if not crowded:
            places.append(place)
    return labels


def with_gaps(lines: Sequence[Any]) -> Any:
    """Points of several lines as those of one, with a gap after each of them, shape (n, 2)."""
    gap = [[np.nan, np.nan]]
    return np.concatenate([points for line in lines for points in (line, gap)] or [gap])
