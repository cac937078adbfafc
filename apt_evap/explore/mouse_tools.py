"""Panel of the mouse: what a drag and a click do on the maps."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from bokeh.events import Tap
from bokeh.layouts import row
from bokeh.models import Button, PanTool, RadioButtonGroup


class MouseTool(NamedTuple):
    """What the mouse does on the maps."""

    drags: Sequence[Any] = ()
    """Tool of Bokeh for a drag on each figure; None or no tool where a drag moves the map."""
    click: Callable[[int, float, float], None] | None = None
    """Function of a click: number of the figure, x and y [mm]."""


class MouseTools:
    """Widgets that choose a tool."""

    def __init__(self, figures: Sequence[Any], tools: Mapping[str, MouseTool], show_whole: Callable[[], None]) -> None:
        self._figures = figures
        self._tools = {"move": MouseTool(), **tools}
        self._pans = [next(tool for tool in fig.tools if isinstance(tool, PanTool)) for fig in figures]
        names = list(self._tools)
        self.choice = RadioButtonGroup(labels=names, active=names.index("atoms") if "atoms" in names else 0)
        self.choice.on_change("active", lambda attr, old, new: self._tool_changed())
        whole = Button(label="whole map", width=90)
        whole.on_click(show_whole)
        self.row = row(self.choice, whole, sizing_mode="stretch_width")
        for number, fig in enumerate(figures):
            fig.on_event(Tap, partial(self._clicked, number))
        self._tool_changed()

    @property
    def _tool(self):
        return self._tools[self.choice.labels[self.choice.active]]

    def _tool_changed(self):
        """Give the drags to the chosen tool."""
        drags = self._tool.drags or [None] * len(self._figures)
        for fig, pan, drag in zip(self._figures, self._pans, drags, strict=True):
            fig.toolbar.active_drag = pan if drag is None else drag

    def _clicked(self, number, event):
        if self._tool.click is not None and event.x is not None and event.y is not None:
            self._tool.click(number, event.x, event.y)
