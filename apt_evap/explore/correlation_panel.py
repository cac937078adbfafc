"""Panel of the correlation: pairs of ions of one pulse by their masses, and the lines of ions that break in flight."""

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import numpy as np
from bokeh.layouts import row
from bokeh.models import Button, ColumnDataSource, Div, HoverTool, LogColorMapper, PanTool, WheelZoomTool
from bokeh.palettes import Viridis256

from apt_evap.detection.correlation import Correlation, dissociation_line
from apt_evap.explore.measured_ions import MeasuredIons
from apt_evap.explore.search_process import start_thread
from apt_evap.explore.widgets import color_bar, show_extent, square
from apt_evap.spectra.mass_spectrum import Spectrum

_BINS = 250
_COLORS = ("#ff6b6b", "#ffb04a", "#4ad8d8", "#ff8fd0", "#d8d84a", "#c08bff")


class CorrelationPanel:
    """Histogram of the pairs of a spectrum; it is computed when it is asked for."""

    def __init__(self, ions: MeasuredIons, later: Callable[[Callable[[], None], int], Any]) -> None:
        self._later = later
        self.has_pulses = ions.all.pulse_id is not None
        """Whether the file says which ions are of one pulse."""
        self._named: Spectrum | None = None
        self.button = Button(label="correlate the ions of one pulse", width=230, disabled=True)
        self.button.on_click(self._compute)
        self.text = Div(text="the masses come first", sizing_mode="stretch_width")
        wheel = WheelZoomTool()
        self.figure: Any = square(
            "pairs of ions of one pulse", (0, 1, 0, 1), [PanTool(), wheel], active_scroll=wheel,
            x_axis_label="m/n of one ion [Da]", y_axis_label="m/n of the other [Da]", visible=False,
        )  # fmt: skip
        self.pairs = ColumnDataSource({name: [] for name in ("image", "x", "y", "dw", "dh")})
        self.lines = ColumnDataSource({name: [] for name in ("xs", "ys", "name", "color")})
        colors = LogColorMapper(palette=Viridis256, low=1, nan_color="#00000000")
        self.figure.image("image", "x", "y", "dw", "dh", source=self.pairs, color_mapper=colors, level="image")
        drawn = self.figure.multi_line("xs", "ys", source=self.lines, line_color="color", line_width=1.5)
        self.figure.add_tools(HoverTool(renderers=[drawn], tooltips="@name"))
        self.figure.add_layout(color_bar(colors, "pairs"), "below")
        self._colors = colors
        self.widgets: list[Any] = [row(self.button), self.text, self.figure]

    def put(self, named: Spectrum) -> None:
        """Take a spectrum; what is drawn of an earlier one goes."""
        self._named = named
        self.button.disabled = not self.has_pulses
        self.text.text = "Pairs on a curved line are the fragments of an ion that broke on its way."
        self.figure.visible = False

    def _compute(self):
        """Count the pairs in a thread."""
        named = self._named
        assert named is not None
        self.text.text = "counting pairs"

        def work():
            pairs = named.hits.correlation()
            last = max([1.1 * high for ion in named.ions for _, high in ion.intervals], default=None)
            limits = None if last is None else (0.0, last)
            histogram = pairs.histogram(_BINS, limits) if len(pairs) else None
            self._later(partial(self._draw, named, pairs, histogram), 0)

        start_thread(work, lambda sentence: self._later(partial(setattr, self.text, "text", escape(sentence)), 0))

    def _draw(self, named: Spectrum, pairs: Correlation, histogram: Any) -> None:
        if named is not self._named:
            return
        self.text.text = escape(str(pairs)).replace("\n", "; ")
        if histogram is None:
            return
        counts, edges = histogram
        first, last = float(edges[0]), float(edges[-1])
        self._colors.high = max(int(counts.max()), 2)
        image = np.where(counts > 0, counts, np.nan).T.astype(np.float32)
        size = last - first
        self.pairs.data = {"image": [image], "x": [first], "y": [first], "dw": [size], "dh": [size]}
        lines: dict[str, list[Any]] = {name: [] for name in self.lines.data}
        for number, (name, masses) in enumerate(named.dissociations()):
            one, other = dissociation_line(*masses)
            for x, y in ((one, other), (other, one)):
                new = {"xs": x, "ys": y, "name": name, "color": _COLORS[number % len(_COLORS)]}
                lines = {key: [*values, new[key]] for key, values in lines.items()}
        self.lines.data = lines
        show_extent(self.figure, (first, last, first, last))
        self.figure.visible = True
