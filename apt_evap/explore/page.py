"""The page of the explorer. The numbers of this room need no Bokeh: see explorer."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, SelectionGeometry, Tap
from bokeh.layouts import column, row
from bokeh.models import (
    AutocompleteInput,
    BoxSelectTool,
    Button,
    ColorBar,
    ColumnDataSource,
    CustomJS,
    Div,
    FreehandDrawTool,
    GlobalInlineStyleSheet,
    HoverTool,
    LinearColorMapper,
    PanTool,
    PreText,
    RadioButtonGroup,
    RangeSlider,
    Select,
    Slider,
    TextInput,
    Toggle,
    WheelZoomTool,
    Widget,
)
from bokeh.palettes import Inferno256, interp_palette
from bokeh.plotting import figure

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.explore.controls import CONTROLS, MECHANISMS, perturbation_of, values_of
from apt_evap.explore.explorer import Commands, Explorer, Shown, View
from apt_evap.explore.index_panel import IndexPanel
from apt_evap.explore.latest import Latest
from apt_evap.explore.marks import plain
from apt_evap.explore.run_panel import RunPanel, Workbench
from apt_evap.explore.search_process import SearchProcess, guarded, start_thread
from apt_evap.explore.specimen_surface import COLORED_BY, surface_atoms
from apt_evap.explore.specimen_view import SIDES, SpecimenView
from apt_evap.explore.style import STYLES, VEIL, WIDGETS, page_styles, theme
from apt_evap.explore.widgets import (
    LEFT,
    color_bar,
    copy_button,
    grid,
    group,
    number,
    save_button,
    show_extent,
    square,
)
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.zone_line import fit_zone_line
from apt_evap.plot.limits import color_limits, common_limits
from apt_evap.specimen.materials import MATERIALS
from apt_evap.warnings import AptWarning

MODES = ("side by side", "difference", "blink")
"""What the page shows beside the simulated map, if there is a measured one."""
TOOLS = ("move", "atoms", "line", "box", "pole", "zone line")
"""What the mouse does on a map."""
BLINK = 600
"""Time that each map is visible in the mode "blink" [ms]."""
FIRST_MAP = 1000
"""Time that the browser has for the first maps before the registration begins [ms]: it keeps a processor busy."""
READOUT_DELAY = 60
"""Delay of the numbers of a preview [ms]: a text changes the layout, which takes as long as to paint a map (50 ms)."""
_MOST_BINS = 512
_MOST_ATOMS = 500  # atoms highlighted in the view of the specimen
_MOST_FILES = 300  # that are proposed
_SUFFIXES = (".h5", ".epos", ".pos", ".apt", ".raw", ".nxs", ".npz")
_DIFFERENCES = interp_palette(("#053061", "#4393c3", "#f7f7f7", "#d6604d", "#67001f"), 255)
_OUTSIDE = "#00000000"
_CHIPS = {"alike": "#2e7d4f", "doubtful": "#a8741a", "not alike": "#a93a3a"}
_KEY_B = """
document.addEventListener("keydown", event => {
  const inside = event.composedPath()[0]
  if (event.key == "b" && !["INPUT", "TEXTAREA", "SELECT"].includes(inside.tagName))
    mode.active = mode.active == 2 ? 0 : 2
})
"""


class _Overtaken(Exception):
    """A registration that is not wanted any more."""


class Page:
    """One page of the explorer in a document of Bokeh.

    Parameters
    ----------
    explorer : Explorer or None
        Computes all numbers; None for a page on which files are opened.
    document : bokeh.document.Document
        Gets the page.
    view : View, optional
        What is shown first; by default `Explorer.start`.
    registration_of : callable, optional
        Makes a `Registration` from the text of a user; without it, the registration cannot be typed.
    opened : callable, optional
        Reads a file, from its path and the document; the function that it returns makes the page again.
    later : callable, optional
        Calls a function in the thread of the document, after a delay [ms]; by default the document itself does.
    bench : Workbench, optional
        What outlives the page.
    """

    def __init__(
        self,
        explorer: Explorer | None,
        document: Document,
        view: View | None = None,
        registration_of: Callable[[str], Registration] | None = None,
        opened: Callable[[str, Document], Callable[[], None]] | None = None,
        later: Callable[[Callable[[], None], int], Any] | None = None,
        bench: Workbench | None = None,
    ) -> None:
        self._bench = Workbench() if bench is None else bench
        self.explorer: Any = explorer
        self.document = document
        self._later = self._call_later if later is None else later
        self._registration_of, self._opened = registration_of, opened
        self._blinking: Any = None
        self._readout_waits = False
        self._search: Any = None  # a process
        self._searches = 0
        self._progress: tuple[int, int] | None = None
        self._progress_text = ""
        self._verdict: Any = None
        self.index: IndexPanel | None = None
        self.latest = Latest(lambda wish: wish())
        document.title = "apt-evap explore"
        document.theme = theme(STYLES[0])
        self._make_head()
        if explorer is None:
            root = column(self.head, self.notes, sizing_mode="stretch_width")
        else:
            self.shown = explorer.show(explorer.start if view is None else view)
            self._make_controls(self.shown.view)
            self._make_maps()
            self._make_profile()
            self.specimen = SpecimenView()
            self._make_text()
            self.put(self.shown)
            self._put_specimen()
            root = self._layout()
        for each in root.select({"type": Widget}):
            each.stylesheets = [*each.stylesheets, WIDGETS]
        root.styles = page_styles(STYLES[0])
        root.stylesheets = [GlobalInlineStyleSheet(css="body { margin: 0; }")]
        self.root = root
        document.add_root(root)
        if explorer is not None:
            self.latest.ask(guarded(partial(self._judge, self.shown), self._note_later))
            if self.both and not explorer.registered and later is None:
                self._call_later(partial(self._register, None), FIRST_MAP)

    def close(self) -> None:
        """End what runs in the background."""
        self._stop_search()
        self.latest.close()
        if self.index is not None:
            self.index.latest.close()
            self.simulate.close()

    @property
    def both(self) -> bool:
        """Whether there are a run and a measurement."""
        return self.explorer.run is not None and self.explorer.measured is not None

    # ---- widgets ---------------------------------------------------------------------------------------------------

    def _make_head(self):
        """Line above everything: files and their facts, the verdict, the similarity; a field that opens files."""
        self.facts = Div(text="<b>apt-evap explore</b>", sizing_mode="stretch_width")
        self.chip, self.readout = Div(), Div(width=330)
        self.notes = Div(sizing_mode="stretch_width", styles={"color": "#d9822b"})
        self.file = AutocompleteInput(
            placeholder="open a file: a run or a measurement",
            completions=_files() if self._opened else [],
            restrict=False,
            case_sensitive=False,
            search_strategy="includes",
            min_characters=1,
            width=LEFT - 10,
            visible=self._opened is not None,
        )
        self.file.on_change("value", lambda attr, old, new: self._file_named())
        self.style = Button(label="light", width=56)
        self.style.on_click(self._next_style)
        self.head = row(
            self.file, self.facts, self.chip, self.readout, self.style,
            sizing_mode="stretch_width", styles={"align-items": "center", "gap": "8px"},
        )  # fmt: skip

    def _make_controls(self, view):
        explorer = self.explorer
        mechanism, values = values_of(view.perturbation)
        self._start = view
        self.mechanism = RadioButtonGroup(
            labels=list(MECHANISMS), active=list(MECHANISMS).index(mechanism), width=LEFT - 10
        )
        self.mechanism.on_change("active", lambda attr, old, new: self._mechanism_changed())
        self.sliders = {
            each.name: Slider(
                title=each.title,
                start=each.low,
                end=max(each.high, values.get(each.name, 0.0)),
                step=each.step,
                value=values.get(each.name, each.value),
                format="0[.]000",
            )
            for each in self._controls()
        }
        like = explorer.bins_like(view.bins)
        longer = max(like.extent[1] - like.extent[0], like.extent[3] - like.extent[2])
        size = max(like.bin_size)
        most = max(like.values.shape) if isinstance(explorer.measured, DetectorMap) else _MOST_BINS
        first, last = (0, 1) if explorer.run is None else explorer.first_and_last
        millimetres = {"start": 0.0, "step": float(f"{size / 10:.1g}"), "format": "0[.]00"}
        self.smoothing = Slider(
            title="smoothing [mm]", value=view.smoothing, end=max(10 * size, view.smoothing), **millimetres
        )
        self.flattening = Slider(
            title="flattening [mm], 0 for none", value=view.flattening, end=longer / 2, **millimetres
        )
        self.bins = Slider(title="bins", start=min(16, view.bins), end=max(most, view.bins), step=1, value=view.bins)
        self.ions = RangeSlider(
            title="ions from - to",
            start=first,
            end=last,
            step=max(1, (last - first) // 200),
            value=view.ions or (first, last),
            format="0,0",
            width=LEFT - 20,
        )
        for each in (*self.sliders.values(), self.smoothing, self.flattening, self.bins, self.ions):
            each.on_change("value", lambda attr, old, new: self.ask(preview=True))
            each.on_change("value_throttled", lambda attr, old, new: self.ask(preview=False))
        self.mode = RadioButtonGroup(labels=list(MODES), active=0, visible=self.both, width=LEFT - 10)
        self.mode.on_change("active", lambda attr, old, new: self._mode_changed())
        self.same_scale = Toggle(label="same scale", visible=self.both, width=100)
        self.same_scale.on_change("active", lambda attr, old, new: self._put_scales())
        self.width = Slider(title="width of a profile [mm]", start=0.0, end=longer / 2, step=size, value=longer / 6)
        self.width.on_change("value", lambda attr, old, new: self._put_profiles())
        self.radius = Slider(title="radius of a click [mm]", start=0.0, end=longer / 10, step=size / 4, value=2 * size)
        colors = {name: title for name, title in COLORED_BY.items() if name != "phase" or self._has_phases()}
        self.color = Select(title="atoms coloured by", value="order", options=[*colors.items()], width=190)
        self.color.on_change("value", lambda attr, old, new: self._put_specimen())
        self.side = RadioButtonGroup(labels=[*SIDES], active=None)
        self.side.on_change("active", lambda attr, old, new: self._side_changed())
        self.register = Button(label="with this emission", width=(LEFT - 20) // 2)
        self.register.on_click(lambda: self._register([self.view().perturbation]))
        self.register_all = Button(label="search again", width=(LEFT - 20) // 2)
        self.register_all.on_click(lambda: self._register(None))
        self.registration = TextInput(
            title="degrees, scale, x, y [mm], mirror",
            placeholder="30,0.5,1,-2",
            visible=self._registration_of is not None,
            width=LEFT - 10,
        )
        self.registration.on_change("value", lambda attr, old, new: self._registration_typed())
        self._show_sliders()

    def _make_maps(self):
        explorer, shown = self.explorer, self.shown
        self.names = [name for name, each in (("simulated", explorer.run), ("measured", explorer.measured)) if each]
        drawn = enumerate(self._drawn(shown))
        self.sources = [ColumnDataSource(_image(each, self._values(shown, k))) for k, each in drawn]
        self.colors = [LinearColorMapper(palette=Inferno256, nan_color=_OUTSIDE) for _ in self.sources]
        self.bars: list[ColorBar] = []
        self.maps: list[Any] = []
        self._drags: list[dict[str, Any]] = []
        self.line = ColumnDataSource({"xs": [], "ys": []})
        self.rectangle = ColumnDataSource({"x": [], "y": []})
        self.click = ColumnDataSource({"x": [], "y": [], "radius": []})
        for name, source, colors in zip(self.names, self.sources, self.colors, strict=True):
            linked = {"x_range": self.maps[0].x_range, "y_range": self.maps[0].y_range} if self.maps else {}
            self.maps.append(self._map(name, source, colors, **linked))
        if self.both:
            last = self.maps[1]
            self.veil = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
            last.image_rgba("image", "x", "y", "dw", "dh", source=self.veil, level="image")
            self.difference_colors = LinearColorMapper(palette=_DIFFERENCES, nan_color=_OUTSIDE, low=-1, high=1)
            self.difference_bar = color_bar(self.difference_colors, "simulated less / more", visible=False)
            last.add_layout(self.difference_bar, "below")
            self.difference = ColumnDataSource(_image(shown.pictures[0]))
            self.difference_image = self._draw(last, self.difference, self.difference_colors, visible=False)
            self.blink_image = self._draw(self.maps[0], self.sources[1], self.colors[1], visible=False)
        for each, drags in zip(self.maps, self._drags, strict=True):
            drawn = each.multi_line("xs", "ys", source=self.line, line_color="cyan", line_width=2)
            each.patch("x", "y", source=self.rectangle, fill_alpha=0.0, line_color="cyan", line_dash="dashed")
            each.circle("x", "y", radius="radius", source=self.click, fill_alpha=0.0, line_color="lime", line_width=2)
            drags["line"] = FreehandDrawTool(renderers=[drawn], num_objects=1)
            drags["box"] = BoxSelectTool()
            each.add_tools(drags["line"], drags["box"])
            each.on_event(Tap, partial(self._clicked, each))
            each.on_event(SelectionGeometry, self._selected)
        self.line.on_change("data", lambda attr, old, new: self._line_drawn())
        if explorer.measured is not None:
            self.index = IndexPanel(
                self.maps[-1], lambda: explorer.measured, self._material(), self._later, self._put_python
            )
            self.simulate = RunPanel(
                self.index.settings, f"{Path(explorer.names[1]).stem}.toml", self._bench, self._later,
                self._put_python, self._open if self._opened else None,
            )  # fmt: skip
            for name in ("pole", "zone line"):
                self._drags[-1][name] = self.index.tool
        tools = [each for each in TOOLS if self._is_served(each)]
        self.tool = RadioButtonGroup(labels=tools, active=tools.index("atoms") if "atoms" in tools else 0)
        self.tool.on_change("active", lambda attr, old, new: self._tool_changed())
        self._tool_changed()

    def _is_served(self, tool):
        if tool == "atoms":
            return self.explorer.run is not None
        return tool not in ("pole", "zone line") or self.index is not None

    def _material(self):
        """Name of the crystal of the run, if it is one of the table."""
        if self.explorer.run is not None:
            material = self.explorer.run.settings["tip"].get("material", {})
            if material.get("name") in MATERIALS:
                return material["name"]
        return "W"

    def _map(self, title, source, colors, **ranges):
        pan, wheel = PanTool(), WheelZoomTool()
        fig = square(
            title, self.shown.pictures[0].extent, [pan, wheel], active_scroll=wheel,
            x_axis_label="x [mm]", y_axis_label="y [mm]", **ranges,
        )  # fmt: skip
        image = self._draw(fig, source, colors)
        fig.add_tools(HoverTool(renderers=[image], tooltips=[("x, y [mm]", "$x{0.0}, $y{0.0}"), ("density", "@image")]))
        self.bars.append(color_bar(colors, "hits per area / mean"))
        fig.add_layout(self.bars[-1], "below")
        self._drags.append({"move": pan})
        return fig

    @staticmethod
    def _draw(fig, source, mapper, **options):
        return fig.image(
            image="image", x="x", y="y", dw="dw", dh="dh", source=source, color_mapper=mapper, level="image", **options
        )

    def _make_profile(self):
        self.profile = figure(
            title="profile: draw a line on a map (mode “line”)",
            sizing_mode="stretch_width",
            height=230,
            tools="pan,wheel_zoom",
            toolbar_location=None,
            x_axis_label="distance from the line [mm]",
            y_axis_label="density",
        )
        self.curves = [ColumnDataSource({"x": [], "y": []}) for _ in self.sources]
        for source, name in zip(self.curves, self.names, strict=True):
            color = "#4aa3ff" if name == "simulated" else "#ffb04a"
            self.profile.line("x", "y", source=source, legend_label=name, line_width=2, line_color=color)

    def _make_text(self):
        self.rings = Div(width=LEFT - 10, text="rings about the pole: computed from all ions")
        self.shell, self.python = (PreText(sizing_mode="stretch_width") for _ in range(2))
        self.copy = [
            copy_button(f"copy as {name}", text) for name, text in (("command", self.shell), ("Python", self.python))
        ]

    def _layout(self):
        explorer = self.explorer
        emission = [self.mechanism, *map(number, self.sliders.values())]
        display = [self.mode, row(self.same_scale, save_button(self.maps))]
        display += map(number, (self.smoothing, self.flattening, self.bins, self.width))
        groups = []
        if explorer.run is not None:
            groups.append(group("emission", emission, self._reset_emission))
        groups.append(group("display", display, self._reset_display))
        if explorer.run is not None:
            groups.append(group("ions", [self.ions, number(self.radius)], self._reset_ions))
        if self.index is not None:
            groups.append(group("index", [self.index.column], active=explorer.run is None))
            groups.append(group("simulate", [self.simulate.column], active=explorer.run is None))
        if self.both:
            groups.append(
                group("registration", [row(self.register_all, self.register), self.registration], active=False)
            )
        if explorer.run is not None:
            groups.append(group("rings", [self.rings], active=False))
        left = column(*groups, width=LEFT)
        whole = Button(label="whole map", width=90)
        whole.on_click(self._whole_map)
        bar = row(self.tool, whole, sizing_mode="stretch_width")
        parts: list[Any] = [column(each, sizing_mode="stretch_width") for each in self.maps]
        if explorer.run is None:
            parts.append(self.profile)
        else:
            parts.append(
                column(self.specimen.figure, row(self.color, self.side), self.profile, sizing_mode="stretch_width")
            )
        code = group("code", [row(*self.copy), self.shell, self.python], active=False)
        right = column(bar, grid(parts), code, sizing_mode="stretch_width")
        if self.both:
            self.document.js_on_event(DocumentReady, CustomJS(args={"mode": self.mode}, code=_KEY_B))
        body = row(left, right, sizing_mode="stretch_width")
        return column(self.head, self.notes, body, sizing_mode="stretch_width")

    # ---- from the widgets ------------------------------------------------------------------------------------------

    def _controls(self):
        """Controls of all mechanisms, each once, in their order."""
        if self.explorer.run is None:
            return []
        of_name = {each.name: each for name in MECHANISMS for each in self.explorer.controls(name)}
        return [of_name[each.name] for each in CONTROLS if each.name in of_name]

    def view(self) -> View:
        """View of the current positions of the widgets."""
        mechanism = list(MECHANISMS)[self.mechanism.active]
        first, last = (int(end) for end in self.ions.value)
        every = (first, last) if self.explorer.run is None else self.explorer.first_and_last
        defaults = {each.name: each.value for each in CONTROLS}
        return View(
            perturbation=perturbation_of(
                mechanism, defaults | {name: each.value for name, each in self.sliders.items()}
            ),
            bins=int(self.bins.value),
            smoothing=self.smoothing.value,
            flattening=self.flattening.value,
            ions=None if (first, last) == every else (first, max(last, first + 1)),
        )

    def ask(self, preview: bool) -> None:
        """Ask for the maps of the current view; they come later."""
        self.latest.ask(guarded(partial(self._compute, self.view(), preview), self._note_later))

    def _note_later(self, sentence):
        """Show an error, from any thread."""
        self._later(partial(self._put_notes, [sentence]), 0)

    def _call_later(self, function, delay):
        if delay:
            self.document.add_timeout_callback(function, delay)
        else:
            self.document.add_next_tick_callback(function)  # the only one that other threads may call

    def _compute(self, view, preview):
        """Compute a view in the worker thread; what is overtaken is not put on the page."""
        shown = self.explorer.show(view, preview)
        self._later(partial(self.put, shown), 0)
        if not preview:
            self._judge(shown)

    def _judge(self, shown):
        """Verdict and rings of maps of all ions."""
        if self.latest.overtaken or self.explorer.run is None:
            return
        if self.explorer.registered:
            self._later(partial(self._put_verdict, shown, self.explorer.likeness(shown)), 0)
        elif self.both:
            return  # rings need the place of the pole on the measured map
        try:
            rings = self.explorer.rings(shown)
        except ValueError as error:
            text = escape(f"not here: {str(error).split(' on <')[0]}")
        else:
            text = self._rings_text(rings)
        self._later(partial(self._put_rings, shown, text), 0)

    def _mechanism_changed(self):
        self._show_sliders()
        self.ask(preview=False)

    def _show_sliders(self):
        if self.explorer.run is None:
            return
        names = {each.name for each in self.explorer.controls(list(MECHANISMS)[self.mechanism.active])}
        for name, slider in self.sliders.items():
            slider.visible = name in names

    def _mode_changed(self):
        mode = MODES[self.mode.active]
        if self._blinking is not None:
            self.document.remove_periodic_callback(self._blinking)
            self._blinking = None
        self._blink(False)
        if mode == "difference":
            self._put_difference()
        self.difference_image.visible = self.difference_bar.visible = mode == "difference"
        self.bars[1].visible = mode != "difference"
        self.maps[1].title.text = "simulated - measured" if mode == "difference" else "measured"
        if mode == "blink":
            self._blinking = self.document.add_periodic_callback(self._next_blink, BLINK)

    def _next_blink(self):
        self._blink(not self.blink_image.visible)

    def _blink(self, measured):
        self.blink_image.visible = measured
        self.maps[0].title.text = "measured" if measured else "simulated"

    def _tool_changed(self):
        """Give the mouse to the chosen tool; a map without it is moved."""
        name = self.tool.labels[self.tool.active]
        for each, drags in zip(self.maps, self._drags, strict=True):
            each.toolbar.active_drag = drags.get(name, drags["move"])

    def _whole_map(self):
        for name in ("x_range", "y_range"):
            each = getattr(self.maps[0], name)
            each.update(start=each.reset_start, end=each.reset_end)

    def _reset_emission(self):
        mechanism, values = values_of(self._start.perturbation)
        for each in self._controls():
            self.sliders[each.name].value = values.get(each.name, each.value)
        self.mechanism.active = list(MECHANISMS).index(mechanism)
        self.ask(preview=False)

    def _reset_display(self):
        for name in ("smoothing", "flattening", "bins"):
            getattr(self, name).value = getattr(self._start, name)
        self.mode.active, self.same_scale.active = 0, False
        self.ask(preview=False)

    def _reset_ions(self):
        self.ions.value = self.explorer.first_and_last
        self.ask(preview=False)

    def _next_style(self):
        style, self.style.label = self.style.label, "dark" if self.style.label == "light" else "light"
        self.root.styles = page_styles(style)
        self.document.theme = theme(style)
        if self.explorer is not None:
            self._put_veil()

    # ---- files and the registration, in the background -------------------------------------------------------------

    def _file_named(self):
        if self._opened is not None and (path := self.file.value.strip()):
            self._open(path)

    def _open(self, path):
        """Read a file in a thread, and make the page again."""
        self._put_notes([f"reading {path}"])

        def work():
            again = self._opened(path, self.document)

            def show():
                self.close()
                again()

            self._later(show, 0)

        start_thread(work, self._note_later)

    def _stop_search(self):
        self._searches += 1
        if self._search is not None:
            self._search.end()
            self._search = None
        self._progress = None

    def _register(self, perturbations):
        """Find the registration in another process, which leaves this one to the page."""
        self._stop_search()
        search = self._searches
        started = time.monotonic()

        def progress(done, number):
            if search != self._searches:
                raise _Overtaken
            self._later(partial(self._put_progress, search, started, done, number), 0)

        def work():
            with SearchProcess() as process:
                self._search = process
                with suppress(_Overtaken):
                    self.explorer.register(perturbations, progress, process.call)
            self._later(partial(self._search_ended, search), 0)

        start_thread(work, lambda sentence: self._later(partial(self._search_ended, search, sentence), 0))

    def _put_progress(self, search, started, done, number):
        if search != self._searches:
            return
        self._progress = done, number
        self._put_chip(None)
        if done:
            seconds = time.monotonic() - started
            self._progress_text = f"about {seconds / done * (number - done):.0f} s left"
            self.ask(preview=False)  # the best until now
        else:
            self._progress_text = "half a minute each"
        self._put_chip(None)

    def _search_ended(self, search, sentence=""):
        if search != self._searches:  # it was stopped
            return
        self._progress = None
        if sentence:
            self._put_chip(None)
            self._put_notes([sentence])
        else:
            self.ask(preview=False)

    def _registration_typed(self):
        if self._registration_of is None or self.registration.value == self._registration_text():
            return
        try:
            registration = self._registration_of(self.registration.value)
        except (ValueError, OSError) as error:
            self._put_notes([str(error)])
            return
        self._stop_search()
        self.explorer.set_registration(registration)
        self.ask(preview=False)

    def _registration_text(self):
        registration = self.explorer.registration
        return registration.to_text() if self.explorer.registered else ""

    def _clicked(self, fig, event):
        """Mark a pole or a line on the measured map, or highlight the atoms whose ions land near a click."""
        radius, tool = self.radius.value, self.tool.labels[self.tool.active]
        if event.x is None or event.y is None:
            return
        if tool in ("pole", "zone line"):
            if fig is self.maps[-1]:
                self.index.add(event.x, event.y, of_line=tool == "zone line")
            return
        if tool != "atoms" or radius <= 0:
            return
        self.click.data = {"x": [event.x], "y": [event.y], "radius": [radius]}
        self._put_atoms()

    def _selected(self, event):
        """Give the commands that select the ions of a rectangle."""
        box = event.geometry
        if event.final and box.get("type") == "rect":
            self._put_commands(
                self.explorer.selection(self.shown.view, (box["x0"], box["x1"]), (box["y0"], box["y1"])), "rectangle"
            )

    def _line_drawn(self):
        """Make a drawn curve straight, and show the profiles across it."""
        if not self.line.data["xs"]:
            return
        x, y = (np.asarray(self.line.data[name][-1], float)[[0, -1]].tolist() for name in ("xs", "ys"))
        if len(self.line.data["xs"][0]) > 2 or len(self.line.data["xs"]) > 1:
            self.line.data = {"xs": [x], "ys": [y]}  # comes back here
        else:
            self._put_profiles()

    # ---- to the page -----------------------------------------------------------------------------------------------

    def put(self, shown: Shown) -> None:
        """Put maps and their numbers on the page.

        A preview keeps the colours of the last complete map, and a map that stays the same is not sent again: the
        browser paints every figure that changes.
        """
        before, self.shown = self.shown, shown
        same_ions = shown.view.ions == before.view.ions
        self.document.hold("combine")
        try:
            if not shown.preview:
                self._put_scales()
                self._put_veil()
            drawn = zip(self.sources, self._drawn(before), self._drawn(shown), strict=True)
            for number, (source, old, new) in enumerate(drawn):
                if new is not old or before.whole is not shown.whole:
                    source.data = _image(new, self._values(shown, number))
            if MODES[self.mode.active] == "difference":
                self._put_difference()
            if shown.preview and not self._readout_waits:
                self._readout_waits = True
                self._later(self._put_preview_readout, READOUT_DELAY)
            if not shown.preview:
                self._put_readout()
                self._put_notes(shown.notes)
                self._put_profiles()
                self._put_commands(self.explorer.commands(shown.view), "maps")
                show_extent(self.maps[0], self._drawn(shown)[-1].extent)
                if self.registration.value != self._registration_text():
                    self.registration.value = self._registration_text()
                if not same_ions:
                    self._put_specimen()
                self._put_atoms()
        finally:
            self.document.unhold()

    def _drawn(self, shown):
        """Maps that are drawn: the measured one is the whole."""
        return (
            shown.pictures if shown.whole is None else (*shown.pictures[: self.explorer.run is not None], shown.whole)
        )

    def _values(self, shown, number):
        """Densities of a map, relative to their mean where both are compared."""
        drawn = self._drawn(shown)[number]
        if shown.whole is None or drawn is not shown.whole or not self.both:
            return drawn.density
        mean = float(drawn.density[shown.measured.mask].mean())
        return drawn.density / mean if mean > 0 else drawn.density

    def _put_scales(self):
        pictures = self.shown.pictures
        limits = [common_limits(pictures)] * 2 if self.same_scale.active else [color_limits(each) for each in pictures]
        for colors, (low, high) in zip(self.colors, limits, strict=False):
            colors.update(low=low, high=high)

    def _put_veil(self):
        """Dim the part of the measured map that is not compared."""
        if not self.both:
            return
        shown = self.shown
        left, right, lower, upper = shown.whole.extent
        outside = (
            shown.whole.mask & ~shown.measured.mask if self.explorer.registered else np.zeros_like(shown.whole.mask)
        )
        style = next(each for each in STYLES if each != self.style.label)
        image = np.zeros((*outside.shape, 4), np.uint8)
        image[outside] = VEIL[style]
        self.veil.data = {
            "image": [image.view(np.uint32)[..., 0]], "x": [left], "y": [lower],
            "dw": [right - left], "dh": [upper - lower],
        }  # fmt: skip

    def _put_difference(self):
        first, second = self.shown.pictures
        difference = first.density - second.density
        largest = float(np.nanpercentile(np.abs(difference), 99.5)) or 1.0
        self.difference_colors.update(low=-largest, high=largest)
        self.difference.data = _image(first, difference)

    def _put_preview_readout(self):
        self._readout_waits = False
        if self.shown.preview:
            self._put_readout()
            self._put_notes(self.shown.notes)

    def _put_readout(self):
        shown = self.shown
        number = ""
        if shown.similarity is not None:
            halves = "" if shown.ceiling is None else f"; of two halves of the measurement {shown.ceiling.value:.3f}"
            number = f'<span style="font-size: 26px">{shown.similarity.value:.3f}</span> similarity{halves}<br>'
        ions = "" if shown.simulated is None else f"{shown.simulated.shown_ions} on the map"
        if shown.preview:
            ions += ", preview"
        tone = "var(--faint)" if shown.preview else "var(--ink)"
        self.readout.text = f'<div style="color: {tone}">{number}<small>{ions}</small></div>'
        self.facts.text = " &nbsp; ".join(_facts(self.explorer))
        if not shown.preview:
            self._put_chip(None)

    def _put_verdict(self, shown, likeness):
        if shown is self.shown:
            self._put_chip(likeness)

    def _put_chip(self, likeness):
        """State of the registration, or the verdict on both maps."""
        if likeness is not None:
            self._verdict = likeness
        if not self.both:
            return
        parts = []
        if self._progress is not None:
            done, number = self._progress
            parts.append(
                f'<progress value="{done}" max="{number}" style="width: 120px"></progress><br>'
                f"<small>registering, {self._progress_text}</small>"
            )
        if self.explorer.registered and self._verdict is not None:
            text, color = self._verdict.verdict, _CHIPS[self._verdict.verdict]
            score = "" if math.isnan(self._verdict.symmetry) else f" ({self._verdict.symmetry:.2f})"
            reason = self._verdict.reason
            if self.explorer.registration.doubtful:
                reason += f"; the correlation of the registered maps is only {self.explorer.registration.score:.2f}"
            parts.append(
                f'<span title="{escape(reason)}" style="background: {color}; color: white; border-radius: 10px;'
                f' padding: 3px 10px; white-space: nowrap">{text}{score}</span>'
            )
        elif self._progress is None and not self.explorer.registered:
            parts.append("<small>not registered</small>")
        self.chip.text = "<br>".join(parts)

    def _put_rings(self, shown, text):
        if shown is self.shown:
            self.rings.text = text

    def _rings_text(self, rings):
        pole = self.explorer.pole
        head = "".join(f"<th>{ring.inner:g}-{ring.outer:g}°</th>" for ring in rings[0])
        lines = []
        for name, each in zip(("simulated", "measured"), rings, strict=False):
            cells = []
            for ring in each:
                error = "" if math.isnan(ring.error) else f" ± {ring.error:.2f}"
                cells.append(f"<td>{ring.contrast:.2f}{error}<br>{ring.minimum:.2f} to {ring.maximum:.2f}</td>")
            lines.append(f"<tr><td>{name}</td>{''.join(cells)}</tr>")
        about = plain(pole.label)
        return (
            f"rings about {about}: contrast, lowest and highest density"
            f'<table cellpadding="3"><tr><td></td>{head}</tr>{"".join(lines)}</table>'
        )

    def _put_notes(self, notes):
        self.notes.text = "<br>".join(escape(each) for each in notes)

    def _put_profiles(self):
        if not self.line.data["xs"] or self.width.value <= 0:
            return
        ends = np.transpose([self.line.data["xs"][0], self.line.data["ys"][0]])
        try:
            rectangle, profiles = self.explorer.profiles(self.shown, ends, self.width.value)
        except ValueError as error:
            self._put_notes([str(error)])
            return
        corners = rectangle.corners
        self.rectangle.data = {"x": corners[:, 0], "y": corners[:, 1]}
        lines = []
        for source, profile in zip(self.curves, profiles, strict=True):
            source.data = {"x": profile.position, "y": profile.density}
            try:
                lines.append(str(fit_zone_line(profile)))
            except (ValueError, AptWarning):
                lines.append("no line")
        self.profile.title.text = "\n".join(lines)

    def _put_specimen(self):
        if self.explorer.run is None:
            return
        atoms = surface_atoms(self.explorer.run, self.color.value, self.shown.view.ions)
        self.specimen.put(atoms, self.color.value)
        self._put_atoms()

    def _side_changed(self):
        if self.side.active is not None:
            self.specimen.look_from(self.side.labels[self.side.active])
            self.side.active = None  # the same side again after a turn

    def _has_phases(self):
        return self.explorer.run is not None and len(self.explorer.run.phase_names) > 1

    def _put_atoms(self):
        if not self.click.data["x"]:
            return
        x, y, radius = (self.click.data[name][0] for name in ("x", "y", "radius"))
        atoms = self.explorer.atoms_at(self.shown.view, x, y, radius)
        assert atoms.positions is not None
        self.specimen.mark(atoms.positions[:: max(1, math.ceil(len(atoms) / _MOST_ATOMS))])
        self.specimen.figure.title.text = f"{len(atoms):,} atoms land within {radius:.2g} mm of ({x:.1f}, {y:.1f}) mm"

    def _put_commands(self, commands: Commands, what):
        self.shell.text = commands.shell or f"(no command for this {what}: the measured map has no ions)"
        self.python.text = commands.python

    def _put_python(self, python):
        self.shell.text, self.python.text = "", python


def _image(picture, values=None):
    """Data of an image: density relative to the mean, NaN outside the detector."""
    left, right, lower, upper = picture.extent
    values = picture.density if values is None else values
    size = {"dw": [right - left], "dh": [upper - lower]}
    return {"image": [values.astype(np.float32)], "x": [left], "y": [lower], **size}


def _files():
    """Files of the current folder and the folders in it that can be opened."""
    paths = [path for pattern in ("*", "*/*") for path in sorted(Path().glob(pattern))]
    return [str(path) for path in paths if path.suffix.lower() in _SUFFIXES][:_MOST_FILES]


def _facts(explorer):
    """What is on the page: files, numbers of ions, axis, radius and voltage."""
    first, second = (escape(Path(name).name) for name in explorer.names)
    facts = []
    if explorer.run is not None:
        run = explorer.run
        tip = run.settings["tip"]
        parts = [f"{len(run):,} ions of {', '.join(run.elements)}"]
        if "axis" in tip:
            parts.append(f"[{' '.join(f'{each:g}' for each in tip['axis'])}]")
        if tip.get("apex_radius"):
            parts.append(f"R = {tip['apex_radius']:.3g} nm")
        parts.append(_voltages(run.voltages))
        facts.append(f"<b>{first}</b> {escape(', '.join(parts))}")
    if explorer.measured is not None:
        measured = explorer.measured
        if isinstance(measured, DetectorMap):
            text = f"{measured.values.shape[1]} × {measured.values.shape[0]} bins"
        else:
            text = f"{len(measured):,} ions"
            if measured.voltage is not None and np.ptp(measured.voltage) > 0:
                text += f", {_voltages(measured.voltage)}"
        facts.append(f"<b>{second}</b> {text}")
    return facts


def _voltages(values):
    low, high = float(np.min(values)), float(np.max(values))
    texts = [f"{each:,.0f}" for each in (low, high)]
    return f"{' to '.join(dict.fromkeys(texts))} V"
