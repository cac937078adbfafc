"""Panel of profiles across a line that is drawn on the maps."""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Div, FreehandDrawTool, Slider
from bokeh.plotting import figure

from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.mouse_tools import MouseTool
from apt_evap.explore.widgets import slider_with_number
from apt_evap.maps.zone_line import fit_zone_line
from apt_evap.warnings import AptWarning

_HINT = "Draw a line on a map with the mouse tool “line”: the profile across it."
_COLORS = {"simulated": "#4aa3ff", "measured": "#ffb04a"}


class ProfilePanel:
    """Figure of the profiles, and their line on the maps."""

    def __init__(
        self,
        explorer: Explorer,
        maps: ExplorerMaps,
        figures: Sequence[Any],
        names: Sequence[str],
        note: Callable[[str], None],
    ) -> None:
        self._explorer, self._maps, self._note, self._names = explorer, maps, note, names
        self.line = ColumnDataSource({"xs": [], "ys": []})
        self.rectangle = ColumnDataSource({"x": [], "y": []})
        drags = []
        for fig in figures:
            line = fig.multi_line("xs", "ys", source=self.line, line_color="cyan", line_width=2)
            fig.patch("x", "y", source=self.rectangle, fill_alpha=0.0, line_color="cyan", line_dash="dashed")
            drags.append(FreehandDrawTool(renderers=[line], num_objects=1))
            fig.add_tools(drags[-1])
        self.tool = MouseTool(drags)
        self.line.on_change("data", lambda attr, old, new: self._line_drawn())
        longer = maps.width
        self.width = Slider(
            title="width of a profile [mm]", start=0.0, end=longer / 2, step=maps.bin_size, value=longer / 6
        )
        self.width.on_change("value", lambda attr, old, new: self._put_profiles())
        self.text = Div(text=_HINT, sizing_mode="stretch_width")
        self.figure: Any = figure(
            sizing_mode="stretch_width",
            height=260,
            tools="pan,wheel_zoom",
            toolbar_location=None,
            x_axis_label="distance from the line [mm]",
            y_axis_label="density",
            visible=False,
        )
        self.curves = [ColumnDataSource({"x": [], "y": []}) for _ in names]
        for source, name in zip(self.curves, names, strict=True):
            self.figure.line("x", "y", source=source, line_width=2, line_color=_COLORS[name])
        self.widgets: list[Any] = [self.text, self.figure, slider_with_number(self.width)]

    def put(self, maps: ExplorerMaps) -> None:
        """Show the profiles of maps, unless they are a preview."""
        self._maps = maps
        if not maps.preview:
            self._put_profiles()

    def _line_drawn(self):
        """Make a drawn curve straight, and show the profiles across it."""
        if not self.line.data["xs"]:
            return
        x, y = (np.asarray(self.line.data[name][-1], float)[[0, -1]].tolist() for name in ("xs", "ys"))
        if len(self.line.data["xs"][0]) > 2 or len(self.line.data["xs"]) > 1:
            self.line.data = {"xs": [x], "ys": [y]}  # comes back here
        else:
            self._put_profiles()

    def _put_profiles(self):
        if not self.line.data["xs"] or self.width.value <= 0:
            return
        ends = np.transpose([self.line.data["xs"][0], self.line.data["ys"][0]])
        try:
            rectangle, profiles = self._explorer.profiles(self._maps, ends, self.width.value)
        except ValueError as error:
            self._note(str(error))
            return
        corners = rectangle.corners
        self.rectangle.data = {"x": corners[:, 0], "y": corners[:, 1]}
        self.figure.visible = True
        lines = []
        for name, source, profile in zip(self._names, self.curves, profiles, strict=True):
            source.data = {"x": profile.position, "y": profile.density}
            try:
                told = str(fit_zone_line(profile))
            except (ValueError, AptWarning):
                told = "no line"
            lines.append(f'<b style="color: {_COLORS[name]}">{name}</b> {escape(told)}')
        self.text.text = "<br>".join(lines)
