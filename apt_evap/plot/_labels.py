"""Labels that find their places when a picture is drawn: these depend on its size."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.text import Text
from matplotlib.transforms import IdentityTransform

from apt_evap._common.label_places import Box, end_of_line, outline, place_above
from apt_evap._common.types import Floats

_WITHOUT_LINE = 8.0  # pixels between a peak and its label


class Placement(Artist):
    """Calls a function before the texts of the axes are drawn."""

    def __init__(self, place: Callable[[Any], None]) -> None:
        super().__init__()
        self._place = place
        self.set(zorder=-100, in_layout=False)

    def draw(self, renderer: Any) -> None:
        """Place what is drawn next."""
        self._place(renderer)


def place_text(text: Any, boxes: Sequence[Box] | None) -> None:
    """Move an annotation with an offset in pixels into its box; hide it if it has none."""
    text.set_visible(boxes is not None)
    if boxes is not None:
        x, y = text.axes.transData.transform(text.xy)
        text.xyann = boxes[0][0] - x, boxes[0][1] - y


def sizes_of(texts: Sequence[Any], renderer: Any) -> Floats:
    """Width and height of each text [pixels]."""
    for text in texts:
        text.set_visible(True)
    return np.array([Text.get_window_extent(text, renderer).size for text in texts]).reshape(-1, 2)


def box_of(artist: Any, renderer: Any) -> Box:
    """Box of what is drawn [pixels]."""
    return artist.get_window_extent(renderer).extents


def legend_below(axes: Sequence[Axes]) -> None:
    """Draw one legend of all that has a label on several maps, below them."""
    handles: dict[str, Any] = {}
    for ax in axes:
        handles |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if handles:
        options = {"facecolor": "0.2", "edgecolor": "none", "framealpha": 1, "labelcolor": "white"}  # as on a map
        columns = min(len(handles), 4) if len(axes) > 1 else 1
        axes[0].figure.legend(handles.values(), handles, loc="outside lower center", ncols=columns, **options)


def label_peaks(
    ax: Axes,
    labels: Sequence[tuple[str, tuple[float, float], Any]],
    edges: Floats,
    heights: Floats,
    **style: Any,
) -> None:
    """Write labels (text, top, colour) above the peaks of a histogram, the first ones first, as many as fit."""
    texts = [
        ax.annotate(text, peak, xytext=(0, 0), textcoords="offset pixels", ha="left", va="bottom", color=color, **style)
        for text, peak, color in labels
    ]
    for text in texts:
        text.set_in_layout(False)
    lines = LineCollection([], colors=[color for *_, color in labels], linewidths=0.6, alpha=0.6, zorder=2.5)
    lines.set_transform(IdentityTransform())
    lines.set_in_layout(False)
    ax.add_collection(lines, autolim=False)

    def place(renderer):
        to_pixels = ax.transData.transform
        sides = to_pixels(np.column_stack([edges, np.full(len(edges), heights[0])]))[:, 0]
        tops = to_pixels(np.column_stack([edges[:-1], heights]))[:, 1]
        peaks = to_pixels([text.xy for text in texts]).reshape(-1, 2)
        others = [box_of(ax.legend_, renderer)] if ax.legend_ is not None else []
        for line in ax.lines:
            if line.get_marker() not in ("None", "", None):
                half = 0.6 * line.get_markersize() * ax.figure.dpi / 72
                others += [(x - half, y - half, x + half, y + half) for x, y in to_pixels(line.get_xydata())]
        placed = place_above(peaks, sizes_of(texts, renderer), box_of(ax, renderer), outline(sides, tops), others)
        for text, boxes in zip(texts, placed, strict=True):
            place_text(text, boxes)
        lines.set_segments([_line(boxes, peak) for boxes, peak in zip(placed, peaks, strict=True)])

    ax.add_artist(Placement(place))


def _line(boxes, peak):
    """Line from a peak to its label, of no length if this is next to it."""
    near = boxes is None or (boxes[0][1] - peak[1] < _WITHOUT_LINE and boxes[0][0] <= peak[0] <= boxes[0][2])
    return [peak, peak if near else end_of_line(peak, boxes[0])]
