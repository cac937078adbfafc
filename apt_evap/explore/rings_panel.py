"""Panel of the rings about the pole: contrast, lowest and highest density."""

import math
from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

from bokeh.models import Div

from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.marks import plain
from apt_evap.explore.widgets import LEFT


class RingsPanel:
    """Table of the rings."""

    def __init__(self, explorer: Explorer, later: Callable[[Callable[[], None], int], Any]) -> None:
        self._explorer, self._later = explorer, later
        self._maps: ExplorerMaps | None = None
        self.text = Div(width=LEFT - 10, text="rings about the pole: computed from all ions")

    def put(self, maps: ExplorerMaps) -> None:
        """Set the maps whose rings may be shown."""
        self._maps = maps

    def measure(self, maps: ExplorerMaps) -> None:
        """Compute the rings in any thread; they are shown if the maps are still these."""
        try:
            text = self._table(self._explorer.poles.rings(maps, self._explorer.registration))
        except ValueError as error:
            text = escape(f"not here: {str(error).split(' on <')[0]}")
        self._later(partial(self._put_text, maps, text), 0)

    def _put_text(self, maps, text):
        if maps is self._maps:
            self.text.text = text

    def _table(self, rings):
        head = "".join(f"<th>{ring.inner:g}-{ring.outer:g}°</th>" for ring in rings[0])
        lines = []
        for name, rings_of_map in zip(("simulated", "measured"), rings, strict=False):
            cells = []
            for ring in rings_of_map:
                error = "" if math.isnan(ring.error) else f" ± {ring.error:.2f}"
                cells.append(f"<td>{ring.contrast:.2f}{error}<br>{ring.minimum:.2f} to {ring.maximum:.2f}</td>")
            lines.append(f"<tr><td>{name}</td>{''.join(cells)}</tr>")
        return (
            f"rings about {plain(self._explorer.poles.nearest[0])}: contrast, lowest and highest density"
            f'<table cellpadding="3"><tr><td></td>{head}</tr>{"".join(lines)}</table>'
        )
