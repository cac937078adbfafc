"""Figures of the simulated and of the measured map: side by side, as their difference, or in turn at the same place."""

from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    HoverTool,
    LinearColorMapper,
    PanTool,
    RadioButtonGroup,
    Toggle,
    WheelZoomTool,
)
from bokeh.palettes import Inferno256, interp_palette

from apt_evap.detection.color_limits import color_limits, common_limits
from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.style import STYLES, VEIL
from apt_evap.explore.widgets import LEFT, color_bar, show_extent, square

MODES = ("side by side", "difference", "blink")
"""What the page shows beside the simulated map, if there is a measured one."""
BLINK = 600
"""Time that each map is visible in the mode "blink" [ms]."""
_DIFFERENCES = interp_palette(("#053061", "#4393c3", "#f7f7f7", "#d6604d", "#67001f"), 255)
_OUTSIDE = "#00000000"


class MapFigures:
    """Figures of the maps, and the widgets that choose what they show."""

    def __init__(self, explorer: Explorer, maps: ExplorerMaps, document: Document) -> None:
        self._explorer, self._maps, self._document = explorer, maps, document
        self._style = STYLES[0]
        self._blinking: Any = None
        both = explorer.is_comparison
        contents = ("simulated", explorer.run), ("measured", explorer.measured)
        self.names = [name for name, content in contents if content is not None]
        drawn = enumerate(self._drawn(maps))
        self.sources = [ColumnDataSource(_image(picture, self._densities(maps, k))) for k, picture in drawn]
        self.colors = [LinearColorMapper(palette=Inferno256, nan_color=_OUTSIDE) for _ in self.sources]
        self.bars: list[ColorBar] = []
        self.figures: list[Any] = []
        for name, source, colors in zip(self.names, self.sources, self.colors, strict=True):
            self._add_figure(name, source, colors)
        if both:
            self._add_comparison()
        self.mode = RadioButtonGroup(labels=list(MODES), active=0, visible=both, width=LEFT - 10, name="mode")
        self.mode.on_change("active", lambda attr, old, new: self._mode_changed())
        self.same_scale = Toggle(label="same scale", visible=both, width=100)
        self.same_scale.on_change("active", lambda attr, old, new: self._put_scales())

    def _add_figure(self, title, source, colors):
        first = self.figures[0] if self.figures else None
        linked = {} if first is None else {"x_range": first.x_range, "y_range": first.y_range}
        wheel = WheelZoomTool()
        fig = square(
            title, self._maps.pictures[0].extent, [PanTool(), wheel], active_scroll=wheel,
            x_axis_label="x [mm]", y_axis_label="y [mm]", **linked,
        )  # fmt: skip
        image = _draw(fig, source, colors)
        fig.add_tools(HoverTool(renderers=[image], tooltips=[("x, y [mm]", "$x{0.0}, $y{0.0}"), ("density", "@image")]))
        self.bars.append(color_bar(colors, "hits per area / mean"))
        fig.add_layout(self.bars[-1], "below")
        self.figures.append(fig)

    def _add_comparison(self):
        """Add the veil and the difference to the measured map, and the measured map to the simulated one."""
        first, last = self.figures
        self.veil = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        last.image_rgba("image", "x", "y", "dw", "dh", source=self.veil, level="image")
        self.difference_colors = LinearColorMapper(palette=_DIFFERENCES, nan_color=_OUTSIDE, low=-1, high=1)
        self.difference_bar = color_bar(self.difference_colors, "simulated less / more", visible=False)
        last.add_layout(self.difference_bar, "below")
        self.difference = ColumnDataSource(_image(self._maps.pictures[0]))
        self.difference_image = _draw(last, self.difference, self.difference_colors, visible=False)
        self.blink_image = _draw(first, self.sources[1], self.colors[1], visible=False)

    def put(self, maps: ExplorerMaps) -> None:
        """Show maps.

        A preview keeps the colours of the last complete map, and a map that stays the same is not sent again: the
        browser paints every figure that changes.
        """
        before, self._maps = self._maps, maps
        if not maps.preview:
            self._put_scales()
            self._put_veil()
        drawn = zip(self.sources, self._drawn(before), self._drawn(maps), strict=True)
        for number, (source, old, new) in enumerate(drawn):
            if new is not old or before.whole is not maps.whole:
                source.data = _image(new, self._densities(maps, number))
        if MODES[self.mode.active] == "difference":
            self._put_difference()
        if not maps.preview:
            show_extent(self.figures[0], self._drawn(maps)[-1].extent)

    def reset(self) -> None:
        """Show both maps side by side, each with its own scale."""
        self.mode.active, self.same_scale.active = 0, False

    def set_style(self, style: str) -> None:
        """Follow one of `STYLES`."""
        self._style = style
        self._put_veil()

    def show_whole(self) -> None:
        """Undo zoom and shift."""
        for axis in (self.figures[0].x_range, self.figures[0].y_range):
            axis.update(start=axis.reset_start, end=axis.reset_end)

    def _drawn(self, maps):
        """Maps that are drawn: the measured one is the whole."""
        if maps.whole is None:
            return maps.pictures
        return (*maps.pictures[: self._explorer.run is not None], maps.whole)

    def _densities(self, maps, number):
        """Densities of a map, relative to their mean where both are compared."""
        picture = self._drawn(maps)[number]
        if picture is not maps.whole or not self._explorer.is_comparison:
            return picture.density
        mean = float(picture.density[maps.measured.mask].mean())
        return picture.density / mean if mean > 0 else picture.density

    def _put_scales(self):
        pictures = self._maps.pictures
        same = self.same_scale.active
        limits = [common_limits(pictures)] * 2 if same else [color_limits(picture) for picture in pictures]
        for colors, (low, high) in zip(self.colors, limits, strict=False):
            colors.update(low=low, high=high)

    def _put_veil(self):
        """Dim the part of the measured map that is not compared."""
        if not self._explorer.is_comparison:
            return
        whole, measured = self._maps.whole, self._maps.measured
        left, right, lower, upper = whole.extent
        outside = whole.mask & ~measured.mask if self._explorer.registered else np.zeros_like(whole.mask)
        image = np.zeros((*outside.shape, 4), np.uint8)
        image[outside] = VEIL[self._style]
        self.veil.data = {
            "image": [image.view(np.uint32)[..., 0]], "x": [left], "y": [lower],
            "dw": [right - left], "dh": [upper - lower],
        }  # fmt: skip

    def _put_difference(self):
        first, second = self._maps.pictures
        difference = first.density - second.density
        largest = float(np.nanpercentile(np.abs(difference), 99.5)) or 1.0
        self.difference_colors.update(low=-largest, high=largest)
        self.difference.data = _image(first, difference)

    def _mode_changed(self):
        mode = MODES[self.mode.active]
        if self._blinking is not None:
            self._document.remove_periodic_callback(self._blinking)
            self._blinking = None
        self._blink(False)
        if mode == "difference":
            self._put_difference()
        self.difference_image.visible = self.difference_bar.visible = mode == "difference"
        self.bars[1].visible = mode != "difference"
        self.figures[1].title.text = "simulated - measured" if mode == "difference" else "measured"
        if mode == "blink":
            self._blinking = self._document.add_periodic_callback(self._blink_next, BLINK)

    def _blink_next(self):
        self._blink(not self.blink_image.visible)

    def _blink(self, measured):
        self.blink_image.visible = measured
        self.figures[0].title.text = "measured" if measured else "simulated"


def _draw(fig, source, mapper, **options):
    return fig.image(
        image="image", x="x", y="y", dw="dw", dh="dh", source=source, color_mapper=mapper, level="image", **options
    )


def _image(picture, densities=None):
    """Data of an image: density relative to the mean, NaN outside the detector."""
    left, right, lower, upper = picture.extent
    densities = picture.density if densities is None else densities
    size = {"dw": [right - left], "dh": [upper - lower]}
    return {"image": [densities.astype(np.float32)], "x": [left], "y": [lower], **size}
