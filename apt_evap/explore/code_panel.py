"""Panel of the code: a command line and Python lines that give the same maps, or select the ions of a rectangle."""

from collections.abc import Sequence
from typing import Any

from bokeh.events import SelectionGeometry
from bokeh.layouts import row
from bokeh.models import BoxSelectTool, PreText

from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.mouse_tools import MouseTool
from apt_evap.explore.widgets import copy_button

_NO_COMMAND = "(no command for this rectangle: the measured map has no ions)"


class CodePanel:
    """Texts and the buttons that copy them."""

    def __init__(self, explorer: Explorer, maps: ExplorerMaps, figures: Sequence[Any]) -> None:
        self._explorer, self._maps = explorer, maps
        self.shell, self.python = (PreText(sizing_mode="stretch_width") for _ in range(2))
        buttons = [
            copy_button(f"copy as {name}", text) for name, text in (("command", self.shell), ("Python", self.python))
        ]
        self.widgets: list[Any] = [row(*buttons), self.shell, self.python]
        drags = [BoxSelectTool() for _ in figures]
        self.tool = MouseTool(drags)
        for fig, drag in zip(figures, drags, strict=True):
            fig.add_tools(drag)
            fig.on_event(SelectionGeometry, self._selected)

    def put(self, maps: ExplorerMaps) -> None:
        """Show the code of maps, unless they are a preview."""
        self._maps = maps
        if not maps.preview:
            self._put(*self._explorer.commands(maps.settings))

    def put_python(self, python: str) -> None:
        """Show Python lines without a command."""
        self._put("", python)

    def _selected(self, event):
        """Show the code that selects the ions of a rectangle."""
        box = event.geometry
        if event.final and box.get("type") == "rect":
            bounds = (box["x0"], box["x1"]), (box["y0"], box["y1"])
            shell, python = self._explorer.selection(self._maps.settings, *bounds)
            self._put(shell or _NO_COMMAND, python)

    def _put(self, shell, python):
        self.shell.text, self.python.text = shell, python
