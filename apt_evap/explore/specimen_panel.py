"""Panel of the specimen: atoms on its surface, and those whose ions land at a click."""

import math
from collections.abc import Sequence
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, RadioButtonGroup, Select, Slider

from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.mouse_tools import MouseTool
from apt_evap.explore.specimen_surface import COLORED_BY, surface_atoms
from apt_evap.explore.specimen_view import SIDES, SpecimenView
from apt_evap.explore.widgets import slider_with_number

_MOST_ATOMS = 500  # highlighted


class SpecimenPanel:
    """View of the specimen and its widgets."""

    def __init__(self, explorer: Explorer, maps: ExplorerMaps, figures: Sequence[Any]) -> None:
        self._explorer, self._maps = explorer, maps
        self.view = SpecimenView()
        self.click = ColumnDataSource({"x": [], "y": [], "radius": []})
        for fig in figures:
            fig.circle("x", "y", radius="radius", source=self.click, fill_alpha=0.0, line_color="lime", line_width=2)
        self.tool = MouseTool(click=self._clicked)
        size = maps.bin_size
        self.radius = Slider(
            title="radius of a click [mm]", start=0.0, end=maps.width / 10, step=size / 4, value=2 * size
        )
        has_phases = len(self._explorer.run.phase_names) > 1
        colors = {name: title for name, title in COLORED_BY.items() if name != "phase" or has_phases}
        self.color = Select(title="atoms coloured by", value="order", options=[*colors.items()], width=190)
        self.color.on_change("value", lambda attr, old, new: self._put_surface())
        self.side = RadioButtonGroup(labels=[*SIDES], active=None)
        self.side.on_change("active", lambda attr, old, new: self._side_changed())
        choices = column(self.color, self.side, slider_with_number(self.radius))
        self.widgets: list[Any] = [
            row(self.view.figure, choices, sizing_mode="stretch_width", styles={"flex-wrap": "wrap", "gap": "12px"})
        ]
        self._put_surface()

    def put(self, maps: ExplorerMaps) -> None:
        """Show the specimen before the first ion of maps, and the atoms at the click, unless they are a preview."""
        self._maps = maps
        if maps.preview:
            return
        if maps.settings.ions != self._ions:
            self._put_surface()
        self._put_atoms()

    def _put_surface(self):
        self._ions = self._maps.settings.ions
        self.view.put(surface_atoms(self._explorer.run, self.color.value, self._ions), self.color.value)
        self._put_atoms()

    def _side_changed(self):
        if self.side.active is not None:
            self.view.set_viewpoint(self.side.labels[self.side.active])
            self.side.active = None  # the same side again after a turn

    def _clicked(self, number, x, y):
        """Highlight the atoms whose ions land near a click on any map."""
        if self.radius.value > 0:
            self.click.data = {"x": [x], "y": [y], "radius": [self.radius.value]}
            self._put_atoms()

    def _put_atoms(self):
        if not self.click.data["x"]:
            return
        x, y, radius = (self.click.data[name][0] for name in ("x", "y", "radius"))
        atoms = self._explorer.atoms_at(self._maps.settings, x, y, radius)
        assert atoms.positions is not None
        self.view.mark(atoms.positions[:: max(1, math.ceil(len(atoms) / _MOST_ATOMS))])
        self.view.figure.title.text = f"{len(atoms):,} atoms land within {radius:.2g} mm of ({x:.1f}, {y:.1f}) mm"
