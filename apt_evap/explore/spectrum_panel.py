"""Panel of the measured ions: their mass spectrum, and the masses and the part of the sequence that the maps show."""

import re
from collections.abc import Callable
from functools import partial
from html import escape
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.events import SelectionGeometry, Tap
from bokeh.layouts import row
from bokeh.models import (
    BoxSelectTool,
    Button,
    ColumnDataSource,
    Div,
    LabelSet,
    NumericInput,
    Range1d,
    RangeSlider,
    Select,
    TextInput,
    WheelZoomTool,
)
from bokeh.plotting import figure

from apt_evap._common.label_places import end_of_line, outline, place_above
from apt_evap.explore.measured_ions import IonSelection, MeasuredIons
from apt_evap.explore.search_process import start_thread
from apt_evap.explore.start_page import ranges_near
from apt_evap.explore.widgets import LEFT
from apt_evap.io.formats import read_ranges
from apt_evap.io.rrng import write_rrng
from apt_evap.spectra.composition import Composition
from apt_evap.spectra.isotope_comb import in_intervals
from apt_evap.spectra.mass_spectrum import Spectrum

_BINS = 2000
_LEAST = 0.5  # ions, of the lowest line of a logarithmic scale
_BEYOND = 1.1  # times the mass of the last peak, at the end of the axis
_HEADROOM = 20.0  # times the highest peak, for two rows of labels
_INNER = {"inner_width": 280.0, "inner_height": 200.0}  # px of the frame, before the browser has told them
_LINE = 17.0  # px, height of a label of 13 px
_LABEL_DELAY = 100  # ms, in which a wheel turns on
_REACH = 0.01  # of the shown masses, from the mouse to a peak: 3 to 8 pixels
_COLORS = ("#4aa3ff", "#ff6b6b", "#6bd06b", "#c08bff", "#ffb04a", "#c98a6b", "#ff8fd0", "#d8d84a", "#4ad8d8")
_CURVE = "#8298b0"  # seen in both styles
_UNEXPLAINED = "#ff4040"
_ALL = "all ions"
_OF_MASS = "ions of a range"


class SpectrumPanel:
    """Spectrum, and the widgets that select ions."""

    def __init__(
        self,
        ions: MeasuredIons,
        name: str,
        selected: Callable[[], None],
        crystal: Callable[[str], None],
        later: Callable[[Callable[[], None], int], Any],
    ) -> None:
        self._ions, self._selected, self._crystal, self._later = ions, selected, crystal, later
        self._path = Path(f"{Path(name).stem or 'ions'}.rrng")
        self._confirmed = False
        self.shown: list[Callable[[Spectrum], None]] = []
        """Called with each spectrum that is shown."""
        self.named: Spectrum | None = None
        """The spectrum that is shown."""
        number = ions.number
        window = tuple(
            end if bound is None else int(bound)
            for bound, end in zip(ions.selection.ions or (None, None), (0, number), strict=True)
        )
        self.slider = RangeSlider(
            title="ions from - to", start=0, end=number, step=max(1, number // 200), value=window, format="0,0",
            width=LEFT - 20,
        )  # fmt: skip
        self.slider.on_change("value_throttled", lambda attr, old, new: self._select())
        self._pending: IonSelection | None = None  # the one that is being selected
        self.choice = Select(title="masses", options=[_ALL], value=_ALL, width=LEFT - 10)
        self.choice.on_change("value", lambda attr, old, new: self._select())
        self.told = Div(width=LEFT - 10)
        self.controls: list[Any] = [self.choice, self.slider, self.told]
        self._make_spectrum(name)
        self._tell()
        if ions.has_masses:
            self._name_peaks()

    def _make_spectrum(self, name):
        wheel, drag = WheelZoomTool(dimensions="width"), BoxSelectTool(dimensions="width")
        self.figure: Any = figure(
            sizing_mode="stretch_width", height=300, y_axis_type="log", tools=[wheel, drag], toolbar_location=None,
            x_axis_label="m/n [Da]", y_axis_label="ions", active_scroll=wheel, active_drag=drag, visible=False,
            x_range=Range1d(0.0, 1.0), y_range=Range1d(_LEAST, 10.0),
        )  # fmt: skip
        self._inner, self._labels_wait = dict(_INNER), False
        for name in ("start", "end"):
            self.figure.x_range.on_change(name, lambda attr, old, new: self._label_later())
        for name in self._inner:
            self.figure.on_change(name, lambda attr, old, new: self._resized(attr, new))
        self.ranges = ColumnDataSource({name: [] for name in ("left", "right", "top", "bottom", "color")})
        self.counts = ColumnDataSource({"x": [], "y": []})
        self.background = ColumnDataSource({"x": [], "y": []})
        self.labels = ColumnDataSource({name: [] for name in ("x", "y", "label", "color", "peak_x", "peak_y", "end_x")})
        self.figure.quad("left", "right", "top", "bottom", source=self.ranges, fill_color="color", fill_alpha=0.2,
                         line_color="color", line_alpha=0.2)  # fmt: skip
        self.figure.step("x", "y", source=self.counts, mode="after", line_color=_CURVE)
        self.figure.line("x", "y", source=self.background, line_color=_CURVE, line_dash="dashed")
        self.figure.add_layout(
            LabelSet(x="x", y="y", text="label", text_color="color", source=self.labels, text_font_size="13px",
                     text_align="left", text_baseline="bottom")
        )  # fmt: skip
        self.figure.segment("peak_x", "peak_y", "end_x", "y", source=self.labels, line_color="color", line_alpha=0.6)
        self.unexplained = ColumnDataSource({"x": [], "y": []})
        self.figure.scatter("x", "y", source=self.unexplained, marker="inverted_triangle", size=9, color=_UNEXPLAINED)
        self.figure.on_event(SelectionGeometry, self._dragged)
        self.figure.on_event(Tap, self._clicked)
        self.elements = TextInput(title="ions to name", placeholder="such as W, CrO", width=145)
        self.elements.on_change("value", lambda attr, old, new: self._name_peaks())
        self.distance = NumericInput(
            title="flight length [mm]", value=self._ions.distance, mode="float", low=1.0, width=105,
            visible=self._ions.all.mass_to_charge is None and not self._ions.lacks_times,
        )  # fmt: skip
        self.distance.on_change("value", lambda attr, old, new: self._distance_changed())
        self.use = Button(label="use", visible=False, margin=(23, 5, 5, 5))
        self.use.on_click(self._use_fitted)
        files = ranges_near(name) if self._ions.file.species is None else []
        if self._ions.ranges is not None:
            files = list(dict.fromkeys([self._ions.ranges, *files]))
        self.file = Select(
            title="ranges", options=[("", "by isotopes"), *((path, Path(path).name) for path in files)],
            value=self._ions.ranges or "", width=130, visible=bool(files),
        )  # fmt: skip
        self.file.on_change("value", lambda attr, old, new: self._ranges_changed())
        self.save = Button(label="save ranges", width=100, margin=(23, 5, 5, 5), disabled=True)
        self.save.on_click(self._save)
        why = "reading the masses" if self._ions.has_masses else "no masses: the file has no m/n"
        if self._ions.lacks_distance:
            why = "Masses follow from the times of flight: type the flight length of the instrument."
        self.text = Div(text=why, sizing_mode="stretch_width", min_width=330)
        self.composition = Div(width=270)
        self.peak = Div(sizing_mode="stretch_width")
        self.widgets: list[Any] = [
            row(self.elements, self.file, self.distance, self.use, self.save, styles={"flex-wrap": "wrap"}),
            self.figure, self.peak,
            row(self.composition, self.text, sizing_mode="stretch_width", styles={"flex-wrap": "wrap"}),
        ]  # fmt: skip

    # ---- the spectrum ----------------------------------------------------------------------------------------------

    def _distance_changed(self):
        if self.distance.value:
            self._ions.distance = self.distance.value
            self._name_peaks()

    def _use_fitted(self):
        """Take the fitted flight in place of the typed one."""
        if self._ions.flight is not None:
            distance, self._ions.time_zero = self._ions.flight
            self.distance.value = distance

    def _ranges_changed(self):
        self._ions.ranges = self.file.value or None
        self.choice.value = _ALL
        self._name_peaks()

    def _name_peaks(self):
        """Compute the spectrum in a thread."""
        elements = [name for name in re.split(r"[,\s]+", self.elements.value) if name] or None
        self.text.text = "naming the peaks"

        def work():
            named = self._ions.spectrum(elements)
            self._later(partial(self._put, named, named.dead_time_note(), elements is None), 0)

        start_thread(work, lambda sentence: self._later(partial(setattr, self.text, "text", escape(sentence)), 0))

    def _put(self, named, losses, by_itself):
        self.named = named
        fitted = self._ions.flight
        self.use.visible = fitted is not None and fitted[0] != self.distance.value
        if fitted is not None:
            self.use.label = f"use fitted {fitted[0]:g}"
        self._draw()
        for show in self.shown:
            show(named)
        composed = len(str(named.composition).splitlines()) - 1
        unexplained, *parts = (escape(line) for line in str(named).splitlines()[:-composed])
        mark = f'<span style="color: {_UNEXPLAINED}">▼</span>'
        self.composition.text = (
            f"{mark} {unexplained}<br>{_composition_table(named.composition)}<small>{escape(losses)}</small>"
        )
        self.text.text = "<br>".join(parts)
        self.peak.text = "Click a peak to see which ions it may be; drag over peaks to see the map of their ions."
        formulas = list(dict.fromkeys(ion.formula for ion in named.ions if ion.intervals))
        if self._ions.ranges is not None:
            formulas = list(read_ranges(self._ions.ranges).species_names)
        main = named.main_element
        chosen = self._ions.selection
        options = [_ALL, *(f"ions of {formula}" for formula in formulas)]
        if chosen.element is not None and f"ions of {chosen.element}" not in options:
            options.append(f"ions of {chosen.element}")
        if chosen.mass is not None:
            options.append(_OF_MASS)
        self.choice.options = options
        self.save.disabled = not formulas
        if chosen.element is not None or chosen.mass is not None:
            self.choice.value = _OF_MASS if chosen.mass is not None else f"ions of {chosen.element}"
        if main is not None and by_itself:
            self._crystal(main)
            if chosen.element is None and chosen.mass is None:
                self.choice.value = f"ions of {main}"  # the default masses

    def _draw(self):
        mass = self.named.hits.mass_to_charge
        mass = mass[np.isfinite(mass) & (mass > 0)]
        intervals = [interval for ion in self.named.ions for interval in ion.intervals]
        ends = [high for _, high in intervals] + [peak.mass for peak in self.named.unexplained]
        last = _BEYOND * max(ends, default=float(np.percentile(mass, 99)))
        count, edges = np.histogram(mass, np.linspace(0.0, last, _BINS + 1))
        self.counts.data = {"x": edges[:-1], "y": np.maximum(count, _LEAST)}
        coarse = edges[::20]
        below = np.maximum(self.named.background(coarse) / 20, _LEAST)
        self.background.data = {"x": (coarse[1:] + coarse[:-1]) / 2, "y": below}
        top = _HEADROOM * float(max(count.max(), 10))
        self.figure.y_range.update(start=_LEAST, end=top)
        self.figure.x_range.update(start=0.0, end=last)
        self._colors = dict(zip(dict.fromkeys(ion.formula for ion in self.named.ions), cycle(_COLORS), strict=False))
        drawn: dict[str, list[Any]] = {name: [] for name in self.ranges.data}
        for ion in self.named.ions:
            for low, high in ion.intervals:
                new = {"left": low, "right": high, "top": top, "bottom": _LEAST, "color": self._colors[ion.formula]}
                drawn = {name: [*values, new[name]] for name, values in drawn.items()}
        self.ranges.data = drawn
        places = np.array([peak.mass for peak in self.named.unexplained])
        heights = count[np.clip(np.searchsorted(edges, places) - 1, 0, len(count) - 1)]
        self.unexplained.data = {"x": places, "y": 1.6 * np.maximum(heights, 1)}
        self.figure.visible = True
        self._put_labels()

    def _resized(self, side, pixels):
        if pixels:
            self._inner[side] = pixels
            self._label_later()

    def _label_later(self):
        if not self._labels_wait and self.named is not None:
            self._labels_wait = True
            self._later(self._put_labels, _LABEL_DELAY)

    def _put_labels(self):
        """Write the names above the peaks between the masses that are shown, those of the largest first."""
        self._labels_wait = False
        fig, x, y = self.figure, np.asarray(self.counts.data["x"]), np.asarray(self.counts.data["y"])
        wide, high = self._inner.values()
        low, last = fig.x_range.start, fig.x_range.end
        per_decade = high / np.log10(fig.y_range.end / fig.y_range.start)
        across, up = (x - low) * wide / (last - low), per_decade * np.log10(y / fig.y_range.start)
        peaks = []
        for ion in self.named.ions:
            inside = np.zeros(len(x), bool)
            for start, end in ion.intervals:
                inside |= (x + x[1] > max(start, low)) & (x < min(end, last))
            if inside.any():
                peak = np.flatnonzero(inside)[np.argmax(y[inside])]
                peaks.append((y[peak], across[peak], up[peak], x[peak], ion.name, self._colors[ion.formula]))
        peaks.sort(reverse=True)
        half = 6.0  # px, of a mark
        marks = [
            ((at - low) * wide / (last - low), per_decade * np.log10(top / fig.y_range.start))
            for at, top in zip(self.unexplained.data["x"], self.unexplained.data["y"], strict=True)
        ]
        placed = place_above(
            np.array([peak[1:3] for peak in peaks]).reshape(-1, 2),
            np.array([(_width_of(peak[4]), _LINE) for peak in peaks]).reshape(-1, 2),
            (0.0, 0.0, wide, high),
            outline(np.append(across, wide), up),
            [(a - half, b - half, a + half, b + half) for a, b in marks],
        )
        rows = [
            (low + boxes[0][0] * (last - low) / wide, fig.y_range.start * 10 ** (boxes[0][1] / per_decade),
             peak[4], peak[5], peak[3], peak[0], low + end_of_line(peak[1:3], boxes[0])[0] * (last - low) / wide)
            for peak, boxes in zip(peaks, placed, strict=True) if boxes is not None
        ]  # fmt: skip
        self.labels.data = {name: [row[k] for row in rows] for k, name in enumerate(self.labels.data)}

    # ---- the selection ---------------------------------------------------------------------------------------------

    def _clicked(self, event):
        """Say which ions the highest peak may be that is a few pixels from the mouse."""
        if self.named is None or not event.x > 0:
            return
        shown, edges = self.figure.x_range, self.counts.data["x"]
        reach = _REACH * (shown.end - shown.start)
        near = np.flatnonzero(np.abs(edges - event.x) <= max(reach, edges[1]))
        if not len(near):
            return
        top = near[np.argmax(self.counts.data["y"][near])]
        mass = self.named.hits.mass_to_charge
        inside = mass[(mass >= edges[max(top - 1, 0)]) & (mass < edges[top] + 2 * edges[1])]
        place = float(np.median(inside)) if len(inside) else event.x
        names = self.named.candidates(place)
        self.peak.text = f"{place:.5g} Da: {escape(', '.join(names) or 'no ion')}"

    def _dragged(self, event):
        box = event.geometry
        if event.final and box.get("type") == "rect":
            mass = float(f"{max(box['x0'], 0.0):.5g}"), float(f"{box['x1']:.5g}")
            self._select(mass)

    def _select(self, mass=None):
        """Select ions by the widgets, in a thread."""
        element = None
        if mass is not None:
            if _OF_MASS not in self.choice.options:
                self.choice.options = [*self.choice.options, _OF_MASS]
        elif self.choice.value == _OF_MASS:
            mass = self._ions.selection.mass
        elif self.choice.value != _ALL:
            element = self.choice.value.removeprefix("ions of ")
        first, last = (int(end) for end in self.slider.value)
        ions = None if (first, last) == (0, self._ions.number) else (first, max(last, first + 1))
        selection = IonSelection(element, mass, ions, None if element is None else self._ions.ranges)
        if selection == (self._pending or self._ions.selection):
            return
        self._pending = selection
        self.told.text = "selecting ions"
        self._show_at_once(selection)

        def work():
            self._ions.select(selection)
            self._later(partial(self._put_selection, selection), 0)

        def failed(sentence):
            self._later(partial(self._not_selected, selection, escape(sentence)), 0)

        start_thread(work, failed)

    def _show_at_once(self, selection):
        """Show the ions by the intervals of the spectrum, until those of the selection are known."""
        if self.named is None:
            return
        hits = self.named.hits
        low, high = selection.ions or (0, self._ions.number)
        ions = hits.ion if hits.ion is not None else np.arange(len(hits))
        inside = (ions >= low) & (ions < high)
        intervals = [selection.mass] if selection.mass is not None else self._intervals(selection.element)
        if intervals:
            inside &= in_intervals(hits.mass_to_charge, intervals)
        elif selection.element is not None:
            return
        if inside.any():
            self._ions.show(hits[inside])
            self._selected()

    def _not_selected(self, selection, sentence):
        if self._pending == selection:
            self._pending = None
            self._ions.select(self._ions.selection)
            self._selected()
            self.told.text = sentence

    def _put_selection(self, selection):
        if self._pending != selection:  # a newer one is being selected
            return
        self._pending = None
        if self._ions.selection.mass is not None:
            self.choice.value = _OF_MASS
        self._tell()
        self._selected()

    def _tell(self):
        selection = self._ions.selection
        number, of = (int(np.count_nonzero(hits.detected)) for hits in (self._ions.hits, self._ions.all))
        intervals = self._intervals(selection.element)
        if selection.mass is not None:
            intervals = [selection.mass]
        where = ", ".join(f"{low or 0:.4g} to {high or np.inf:.4g}" for low, high in intervals)
        self.told.text = f"{number:,} of {of:,} ions" + (f", {where} Da" if where else "")

    def _intervals(self, element):
        """Bounds of the peaks of an element, or of the ranges of a species [Da]."""
        if element is None or self.named is None:
            return []
        if self._ions.ranges is not None:
            ranges = read_ranges(self._ions.ranges)
            rows = zip(ranges.names, ranges.low.tolist(), ranges.high.tolist(), strict=True)
            return [(low, high) for name, low, high in rows if name == element]
        return [interval for ion in self.named.ions if ion.formula == element for interval in ion.intervals]

    def _save(self):
        """Save the ranges of the named peaks; a file that exists is replaced only by a second click."""
        if self.named is None:
            return
        path = self._path.absolute()
        if path.exists() and not self._confirmed:
            self._confirmed, self.save.label = True, f"replace {path.name}"
            return
        self._confirmed, self.save.label = False, "save ranges"
        try:
            write_rrng(path, self.named.ranges())
            self.text.text = f"wrote {escape(str(path))}"
        except (ValueError, OSError) as error:
            self.text.text = escape(str(error))


def _width_of(name: str) -> float:
    """Width of the name of an ion [px], of letters and of digits and charges above and below the line."""
    return sum(10.0 if sign.isupper() else 7.0 if sign.isalpha() else 5.2 for sign in name)


def _composition_table(composition: Composition) -> str:
    """Elements with at.%, errors and the span over other names, as HTML."""
    if composition.refused:
        return f"<b>no composition</b><br>{escape(composition.refused)}"
    rows = [
        f"<tr><td><b>{escape(name)}</b></td><td style='text-align: right'>{value or 0}</td>"
        f"<td>± {error}</td><td>{f'<small>{span}</small>' if span else ''}</td></tr>"
        for name, value, error, span in composition.rows()
    ]
    head = "<tr><td colspan=4><b>composition [at.%]</b></td></tr>"
    return f"<table style='white-space: nowrap'>{head}{''.join(rows)}</table>"
