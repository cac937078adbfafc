"""The page of the explorer, and the server that shows it to this user on this machine. Only this module needs Bokeh."""

import logging
import math
import secrets
import socket
from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import numpy as np
from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document
from bokeh.events import SelectionGeometry, Tap
from bokeh.layouts import column, row
from bokeh.models import (
    BoxSelectTool,
    Button,
    ColorBar,
    ColumnDataSource,
    CustomJS,
    Div,
    FreehandDrawTool,
    HoverTool,
    LinearColorMapper,
    PreText,
    RadioButtonGroup,
    Range1d,
    RangeSlider,
    Select,
    Slider,
    TextInput,
)
from bokeh.palettes import Inferno256, Viridis256, interp_palette
from bokeh.plotting import figure
from bokeh.server.server import Server
from bokeh.util.token import generate_session_id

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.explore.controls import CONTROLS, MECHANISMS, perturbation_of, values_of
from apt_evap.explore.explorer import Commands, Explorer, Shown, View
from apt_evap.explore.latest import Latest
from apt_evap.explore.surface_image import COLORED_BY, SIDES, specimen_image
from apt_evap.maps.zone_line import fit_zone_line
from apt_evap.plot.maps import common_limits
from apt_evap.registration.register import Registration
from apt_evap.warnings import AptWarning

MODES = ("side by side", "difference", "blink")
"""What the page shows beside the simulated map, if there is a measured one."""
BLINK = 600
"""Time that each map is visible in the mode "blink" [ms]."""
READOUT_DELAY = 60
"""Delay of the numbers of a preview [ms]: a text changes the layout, which takes as long as to paint a map (50 ms)."""
_ADDRESS = "127.0.0.1"
_SIDE = 380  # pixels of a map
_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"
_MOST_BINS = 512
_MOST_ATOMS = 500  # atoms highlighted in the view of the specimen
_DIFFERENCES = interp_palette(("#053061", "#4393c3", "#f7f7f7", "#d6604d", "#67001f"), 255)
_OUTSIDE = "#e0e0e0"


class Page:
    """One page of the explorer in a document of Bokeh.

    Parameters
    ----------
    explorer : Explorer
        Computes all numbers.
    document : bokeh.document.Document
        Gets the page.
    view : View, optional
        What is shown first; by default `Explorer.start`.
    registration_of : callable, optional
        Makes a `Registration` from the text of a user; without it, the registration cannot be typed.
    later : callable, optional
        Calls a function in the thread of the document, after a delay [ms]; by default the document itself does.
    """

    def __init__(
        self,
        explorer: Explorer,
        document: Document,
        view: View | None = None,
        registration_of: Callable[[str], Registration] | None = None,
        later: Callable[[Callable[[], None], int], Any] | None = None,
    ) -> None:
        self.explorer, self.document = explorer, document
        self._later = self._call_later if later is None else later
        self._registration_of = registration_of
        self._blinking: Any = None
        self._readout_waits = False
        self.shown = explorer.show(explorer.start if view is None else view)
        self.latest = Latest(lambda wish: wish())
        self._make_controls(self.shown.view)
        self._make_maps()
        self._make_profile()
        self._make_specimen()
        self._make_text()
        self.put(self.shown)
        self._put_specimen()
        document.title = "apt-evap explore"
        document.add_root(self._layout())
        self.latest.ask(partial(self._rings_of, self.shown))

    # ---- widgets ---------------------------------------------------------------------------------------------------

    def _make_controls(self, view):
        mechanism, values = values_of(view.perturbation)
        self.mechanism = RadioButtonGroup(labels=list(MECHANISMS), active=list(MECHANISMS).index(mechanism))
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
        like = self.explorer.bins_like(view.bins)
        longer = max(like.extent[1] - like.extent[0], like.extent[3] - like.extent[2])
        size = max(like.bin_size)
        most = max(like.values.shape) if isinstance(self.explorer.measured, DetectorMap) else _MOST_BINS
        first, last = self.explorer.first_and_last
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
        )
        for each in (*self.sliders.values(), self.smoothing, self.flattening, self.bins, self.ions):
            each.on_change("value", lambda attr, old, new: self.ask(preview=True))
            each.on_change("value_throttled", lambda attr, old, new: self.ask(preview=False))
        self.mode = RadioButtonGroup(labels=list(MODES), active=0, visible=self.explorer.measured is not None)
        self.mode.on_change("active", lambda attr, old, new: self._mode_changed())
        self.width = Slider(
            title="width of a profile [mm]", width=_SIDE // 2, start=0.0, end=longer / 2, step=size, value=longer / 6
        )
        self.width.on_change("value_throttled", lambda attr, old, new: self._put_profiles())
        self.radius = Slider(
            title="radius of a click [mm]", width=_SIDE // 2, start=0.0, end=longer / 10, step=size / 4, value=2 * size
        )
        self.color = Select(title="atoms coloured by", value="order", options=[*COLORED_BY.items()])
        self.side = Select(title="seen from", value="above", options=[*SIDES])
        for each in (self.color, self.side):
            each.on_change("value", lambda attr, old, new: self._put_specimen())
        has_map = self.explorer.measured is not None
        self.register = Button(label="register with this emission", visible=has_map)
        self.register.on_click(self._register)
        self.registration = TextInput(
            title="registration: degrees, scale, x, y [mm], mirror",
            visible=has_map and self._registration_of is not None,
        )
        self.registration.on_change("value", lambda attr, old, new: self._registration_typed())
        self._show_sliders()

    def _make_maps(self):
        self.sources = [ColumnDataSource(_image(each)) for each in self.shown.pictures]
        self.colors = LinearColorMapper(palette=Inferno256, nan_color=_OUTSIDE)
        self.bars: list[ColorBar] = []
        self.maps = [self._map("simulated", self.sources[0], **_ranges(self.shown.simulated.extent))]
        if len(self.sources) > 1:
            self.maps.append(
                self._map("measured", self.sources[1], x_range=self.maps[0].x_range, y_range=self.maps[0].y_range)
            )
            self.difference_colors = LinearColorMapper(palette=_DIFFERENCES, nan_color=_OUTSIDE, low=-1, high=1)
            self.difference_bar = ColorBar(
                color_mapper=self.difference_colors, width=10, title="simulated less / more", visible=False
            )
            self.maps[1].add_layout(self.difference_bar, "right")
            self.difference = ColumnDataSource(_image(self.shown.pictures[0]))
            self.difference_image = self._draw(self.maps[1], self.difference, self.difference_colors, visible=False)
            self.blink_image = self._draw(self.maps[0], self.sources[1], self.colors, visible=False)
        self.line = ColumnDataSource({"xs": [], "ys": []})
        self.rectangle = ColumnDataSource({"x": [], "y": []})
        self.click = ColumnDataSource({"x": [], "y": [], "radius": []})
        for each in self.maps:
            drawn = each.multi_line("xs", "ys", source=self.line, line_color="cyan", line_width=2)
            each.patch("x", "y", source=self.rectangle, fill_alpha=0.0, line_color="cyan", line_dash="dashed")
            each.circle("x", "y", radius="radius", source=self.click, fill_alpha=0.0, line_color="lime", line_width=2)
            tool = FreehandDrawTool(renderers=[drawn], num_objects=1, description="line for a profile")
            each.add_tools(tool, BoxSelectTool(description="rectangle of ions"))
            each.on_event(Tap, self._clicked)
            each.on_event(SelectionGeometry, self._selected)
        self.line.on_change("data", lambda attr, old, new: self._line_drawn())

    def _map(self, title, source, **ranges):
        fig = _square(title, x_axis_label="x [mm]", y_axis_label="y [mm]", **ranges)
        image = self._draw(fig, source, self.colors)
        fig.add_tools(HoverTool(renderers=[image], tooltips=[("x, y [mm]", "$x{0.0}, $y{0.0}"), ("density", "@image")]))
        self.bars.append(ColorBar(color_mapper=self.colors, width=10, title="hits per area / mean"))
        fig.add_layout(self.bars[-1], "right")
        return fig

    @staticmethod
    def _draw(fig, source, mapper, **options):
        return fig.image(
            image="image", x="x", y="y", dw="dw", dh="dh", source=source, color_mapper=mapper, level="image", **options
        )

    def _make_profile(self):
        self.profile = figure(
            title="profile: draw a line on a map",
            frame_width=_SIDE,
            frame_height=_SIDE // 2,
            tools=_TOOLS,
            x_axis_label="distance from the line [mm]",
            y_axis_label="density",
        )
        self.curves = [ColumnDataSource({"x": [], "y": []}) for _ in self.sources]
        for source, name, dash in zip(self.curves, ("simulated", "measured"), ("solid", "dashed"), strict=False):
            self.profile.line("x", "y", source=source, legend_label=name, line_dash=dash, line_color="black")

    def _make_specimen(self):
        self.specimen = _square("specimen: click on a map", **_ranges((0.0, 1.0, 0.0, 1.0)))
        self.specimen_colors = LinearColorMapper(palette=Viridis256, nan_color="white")
        self.specimen_source = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self._draw(self.specimen, self.specimen_source, self.specimen_colors)
        self.specimen.add_layout(ColorBar(color_mapper=self.specimen_colors, width=10), "right")
        self.atoms = ColumnDataSource({"x": [], "y": []})
        self.specimen.scatter("x", "y", source=self.atoms, size=9, fill_alpha=0.0, line_color="red", line_width=2)

    def _make_text(self):
        self.readout, self.rings, self.notes = Div(width=300), Div(width=300), Div(width=300)
        self.shell, self.python = (PreText(width=1000, styles={"overflow-x": "auto"}) for _ in range(2))
        self.copy = [Button(label=f"copy as {name}", width=150) for name in ("command", "Python")]
        for button, text in zip(self.copy, (self.shell, self.python), strict=True):
            button.js_on_click(CustomJS(args={"text": text}, code="navigator.clipboard.writeText(text.text)"))

    def _layout(self):
        emission = [self.mechanism, *self.sliders.values()]
        maps = [self.smoothing, self.flattening, self.bins, self.ions, self.mode]
        left = column(
            *emission, *maps, self.readout, self.rings, self.notes, self.register, self.registration, width=320
        )
        below = row(
            column(self.profile, row(self.width, self.radius)), column(self.specimen, row(self.color, self.side))
        )
        text = column(row(*self.copy), self.shell, self.python)
        return row(left, column(row(*self.maps), below, text))

    # ---- from the widgets ------------------------------------------------------------------------------------------

    def _controls(self):
        """Controls of all mechanisms, each once, in their order."""
        of_name = {each.name: each for name in MECHANISMS for each in self.explorer.controls(name)}
        return [of_name[each.name] for each in CONTROLS if each.name in of_name]

    def view(self) -> View:
        """View of the current positions of the widgets."""
        mechanism = list(MECHANISMS)[self.mechanism.active]
        first, last = (int(end) for end in self.ions.value)
        every = self.explorer.first_and_last
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
        self.latest.ask(partial(self._compute, self.view(), preview))

    def _call_later(self, function, delay):
        if delay:
            self.document.add_timeout_callback(function, delay)
        else:
            self.document.add_next_tick_callback(function)  # the only one that other threads may call

    def _compute(self, view, preview):
        """Compute a view in the worker thread; what is overtaken is not put on the page."""
        try:
            shown = self.explorer.show(view, preview)
        except ValueError as error:
            self._later(partial(self._put_notes, [str(error)]), 0)
            return
        self._later(partial(self.put, shown), 0)
        if not preview:
            self._rings_of(shown)

    def _rings_of(self, shown):
        if self.latest.overtaken:
            return
        try:
            rings = self.explorer.rings(shown)
        except ValueError as error:
            text = f"rings: {escape(str(error))}"
        else:
            text = self._rings_text(rings)
        self._later(partial(self._put_rings, shown, text), 0)

    def _mechanism_changed(self):
        self._show_sliders()
        self.ask(preview=False)

    def _show_sliders(self):
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

    def _register(self):
        self._put_notes(["registering: up to some minutes"])
        self.latest.ask(partial(self._find_registration, self.view()))

    def _find_registration(self, view):
        try:
            self.explorer.register([view.perturbation])
        except ValueError as error:
            self._later(partial(self._put_notes, [str(error)]), 0)
            return
        self._compute(view, False)

    def _registration_typed(self):
        if self._registration_of is None or self.registration.value == self._registration_text():
            return
        try:
            registration = self._registration_of(self.registration.value)
        except (ValueError, OSError) as error:
            self._put_notes([str(error)])
            return
        self.explorer.set_registration(registration)
        self.ask(preview=False)

    def _registration_text(self):
        registration = self.explorer.registration
        return "" if registration is None else registration.to_text()

    def _clicked(self, event):
        """Highlight the atoms whose ions land near a click."""
        radius = self.radius.value
        if radius <= 0 or event.x is None or event.y is None:
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
                low, high = common_limits(shown.pictures)
                self.colors.update(low=low, high=high)
            for source, old, new in zip(self.sources, before.pictures, shown.pictures, strict=True):
                if new is not old:
                    source.data = _image(new)
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
                if self.registration.value != self._registration_text():
                    self.registration.value = self._registration_text()
                if not same_ions:
                    self._put_specimen()
                self._put_atoms()
        finally:
            self.document.unhold()

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
        lines = []
        if shown.similarity is not None:
            lines.append(f"similarity <b>{shown.similarity.value:.3f}</b>")
            if shown.ceiling is not None:
                lines.append(f"of two halves of the measurement {shown.ceiling.value:.3f}")
        ions = shown.simulated.shown_ions
        lines.append(f"{ions}{', preview' if shown.preview else ''}, {1e3 * shown.seconds:.0f} ms")
        self.readout.text = f'<div style="color: {_gray(shown.preview)}">{"<br>".join(lines)}</div>'
        if shown.preview:
            self.rings.styles = {"color": _gray(True)}

    def _put_rings(self, shown, text):
        if shown is self.shown:
            self.rings.styles = {"color": _gray(False)}
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
        about = _plain(pole.label)
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
        self.profile.title.text = "; ".join(lines)

    def _put_specimen(self):
        image = specimen_image(self.explorer.run, self.color.value, self.side.value, self.shown.view.ions)
        left, right, lower, upper = image.extent
        values = image.values[np.isfinite(image.values)]
        low, high = (float(end) for end in np.percentile(values, [1, 99]))
        self.specimen_colors.update(low=low, high=high if high > low else low + 1)
        self.specimen_source.data = {
            "image": [image.values], "x": [left], "y": [lower], "dw": [right - left], "dh": [upper - lower],
        }  # fmt: skip
        for name, new in _ranges(image.extent).items():
            getattr(self.specimen, name).update(start=new.start, end=new.end, reset_start=new.start, reset_end=new.end)
        self.specimen.xaxis.axis_label = "x [nm]"
        self.specimen.yaxis.axis_label = "y [nm]" if self.side.value == "above" else "z [nm]"
        self._put_atoms()

    def _put_atoms(self):
        if not self.click.data["x"]:
            return
        x, y, radius = (self.click.data[name][0] for name in ("x", "y", "radius"))
        atoms = self.explorer.atoms_at(self.shown.view, x, y, radius)
        assert atoms.positions is not None
        places = atoms.positions[:, SIDES[self.side.value][:2]]
        few = slice(None, None, max(1, math.ceil(len(atoms) / _MOST_ATOMS)))
        self.atoms.data = {"x": places[few, 0], "y": places[few, 1]}
        self.specimen.title.text = f"{len(atoms):,} atoms land within {radius:.2g} mm of ({x:.1f}, {y:.1f}) mm"

    def _put_commands(self, commands: Commands, what):
        self.shell.text = commands.shell or f"(no command for this {what}: the measured map has no ions)"
        self.python.text = commands.python


def _square(title, **options):
    """Figure for an image, with equal scales along both axes."""
    fig = figure(
        title=title, frame_width=_SIDE, frame_height=_SIDE, tools=_TOOLS, active_scroll="wheel_zoom", **options
    )
    fig.grid.visible = False
    return fig


def _ranges(extent):
    """Ranges of equal length about an area."""
    half = 0.5 * max(extent[1] - extent[0], extent[3] - extent[2])
    middles = {"x_range": 0.5 * (extent[0] + extent[1]), "y_range": 0.5 * (extent[2] + extent[3])}
    return {name: Range1d(middle - half, middle + half) for name, middle in middles.items()}


def _image(picture, values=None):
    """Data of an image: density relative to the mean, NaN outside the detector."""
    left, right, lower, upper = picture.extent
    values = picture.density if values is None else values
    size = {"dw": [right - left], "dh": [upper - lower]}
    return {"image": [values.astype(np.float32)], "x": [left], "y": [lower], **size}


def _gray(preview):
    return "#a0a0a0" if preview else "#000000"


def _plain(label):
    """Label of a pole without the math syntax of matplotlib."""
    for math_text, text in (("$", ""), (r"\bar{", "-"), ("}", ""), (r"\,", " ")):
        label = label.replace(math_text, text)
    return label


class _WithoutStrangers(logging.Filter):
    """Leaves out the tracebacks of connections that end before they belong to a session, as of other web pages."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith("Uncaught exception GET /ws ")


_WITHOUT_STRANGERS = _WithoutStrangers()  # one object: a logger takes it once


def serve(
    explorer: Explorer,
    view: View | None = None,
    *,
    port: int = 0,
    registration_of: Callable[[str], Registration] | None = None,
) -> tuple[Server, str]:
    """Make the server of a page that only the holder of its address can open, from this machine.

    Parameters
    ----------
    explorer : Explorer
        Computes all numbers.
    view : View, optional
        What is shown first.
    port : int
        Port on 127.0.0.1; 0 for a free one.
    registration_of : callable, optional
        As for `Page`.

    Returns
    -------
    server : bokeh.server.server.Server
        Its ``io_loop.start()`` serves the page.
    url : str
        Address with a signed session.

    Raises
    ------
    OSError
        If the port is in use.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((_ADDRESS, port))
        port = probe.getsockname()[1]

    def make(document: Document) -> None:
        page = Page(explorer, document, view, registration_of)
        document.on_session_destroyed(lambda _: page.latest.close())

    logging.getLogger("tornado.application").addFilter(_WITHOUT_STRANGERS)
    key = secrets.token_bytes(32)  # other users of this machine reach 127.0.0.1, too
    server = Server(
        {"/": Application(FunctionHandler(make))},
        port=port,
        address=_ADDRESS,
        secret_key=key,
        sign_sessions=True,
        generate_session_ids=False,
        allow_websocket_origin=[f"{_ADDRESS}:{port}", f"localhost:{port}"],
    )
    server.start()
    return server, f"http://{_ADDRESS}:{port}/?bokeh-session-id={generate_session_id(key, signed=True)}"
