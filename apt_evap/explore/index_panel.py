"""Index mode of the page: poles and zone lines that are clicked on the measured map, and the orientations that fit."""

import cmath
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    CheckboxGroup,
    ColumnDataSource,
    CustomJS,
    Div,
    LabelSet,
    NumericInput,
    PointDrawTool,
    Select,
)

from apt_evap._common.codec import to_python
from apt_evap._common.validation import digest
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.projection import Projection
from apt_evap.explore.marks import Marks, overlay
from apt_evap.explore.mouse_tools import MouseTool
from apt_evap.explore.newest_task import NewestTaskRunner
from apt_evap.explore.pole_panel import ZONE_LINE, draw_poles, sparse_labels, with_gaps
from apt_evap.explore.search_process import SearchProcess, guarded, start_thread
from apt_evap.explore.widgets import LEFT, progress_text
from apt_evap.fit.measured_map import measured_map
from apt_evap.fit.start_settings import StartSettings, settings_of
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.index_map import Indexing, index
from apt_evap.specimen.materials import MATERIALS

HINT = "mode “pole”: click a pole whose family you choose here; drag a mark to move it"
MOVED = "moved by hand"
_LEGEND = (
    f'<span style="color: {ZONE_LINE}">—</span> zone lines, ○ poles, as the candidate predicts them; in the mode “pole”'
    " the orange dots shift (left), turn and scale it (right)"
)
_OTHER_IONS = "the ions have changed: search again"
_REACH = 0.3  # distance between both handles, as a fraction of the width of the map
# Rotation, scale and centre of the handles move the overlay. Python computes it when the mouse is released.
_FOLLOW = """
const {x, y} = handles.data, [cx, cy, hx, hy] = handles.tags
if (x.length != 2) return
const [lastx, lasty] = x.last ?? [cx, cy]
x[1] += x[0] - lastx
y[1] += y[0] - lasty
x.last = [x[0], y[0]]
const square = (hx - cx) ** 2 + (hy - cy) ** 2, dx = x[1] - x[0], dy = y[1] - y[0]
const c = (dx * (hx - cx) + dy * (hy - cy)) / square, s = (dy * (hx - cx) - dx * (hy - cy)) / square
for (const source of [lines, poles]) {
  const {x0, y0} = source.data
  source.data.x = x0.map((_, k) => x[0] + c * (x0[k] - cx) - s * (y0[k] - cy))
  source.data.y = x0.map((_, k) => y[0] + s * (x0[k] - cx) + c * (y0[k] - cy))
  source.change.emit()
}
"""


class IndexPanel:
    """Widgets and drawings of the index mode.

    Parameters
    ----------
    figures : sequence of bokeh.plotting.figure
        The maps; the measured one is the last.
    measured : callable
        Returns the measured ions or map.
    material : str
        The crystal at the start.
    later : callable
        As for `Page`.
    put_code : callable
        Shows Python lines.
    kept : dict, optional
        Crystal, marks and candidates; what an earlier page of this measurement left there is shown again, candidates of
        a search only for the same ions.
    distance : callable, optional
        Returns the flight length [mm], which bounds the scale of a search; None if it is not known.
    """

    def __init__(
        self,
        figures: Sequence[Any],
        measured: Callable[[], Hits | DetectorMap],
        material: str,
        later: Callable[[Callable[[], None], int], Any],
        put_code: Callable[[str], None],
        kept: dict[str, Any] | None = None,
        distance: Callable[[], float | None] = lambda: None,
    ) -> None:
        self._kept: dict[str, Any] = {} if kept is None else kept
        self._after_search: Callable[[], None] | None = None
        self._measured, self._later, self._put_code = measured, later, put_code
        self._distance = distance
        self._tasks = NewestTaskRunner()
        self.candidates: list[tuple[Orientation, Projection, str]] = []
        self._indexing: Indexing | None = None  # of the search that gave the candidates
        self._process: SearchProcess | None = None
        self._awaited: Any = None  # the fit or search whose candidates will be shown, unless others come first
        self._make_widgets(self._kept.get("material") or material)
        self._make_drawings(figures[-1])
        number = len(figures) - 1
        drags = [None] * number + [self.tool]
        self.tools = {
            name: MouseTool(drags, partial(self._clicked, number, name == "zone line"))
            for name in ("pole", "zone line")
        }
        marks, candidates = self._kept.get("marks"), self._kept.get("candidates")
        self._material_changed()
        if marks is not None:
            self.marks.data = marks
        if candidates:
            rows, text, searched = candidates
            indexing, content = searched or (None, None)
            if indexing is None or content == self._content():
                self._put(rows, text, indexing)
            else:
                self._put([], _OTHER_IONS)

    def close(self) -> None:
        """End the fits and the search."""
        self._cancel()
        self._tasks.close()

    def _make_widgets(self, material):
        half = (LEFT - 20) // 2
        options = [("", "choose it"), *((name, name) for name in dict.fromkeys([*MATERIALS, material]) if name)]
        self.material = Select(title="crystal", options=options, value=material, width=half)
        self.family = Select(title="family of the pole", width=half, options=[])
        self.scale = NumericInput(title="scale [mm/rad]", placeholder="fitted", mode="float", low=1e-3, width=half)
        self.centre = [
            NumericInput(title=f"{name} of the axis [mm]", value=0.0, mode="float", width=half) for name in "xy"
        ]
        self.options = CheckboxGroup(labels=["mirrored"], width=half)
        self.undo, self.new_line, self.clear = (
            Button(label=label, width=62) for label in ("undo", "next line", "clear")
        )
        self.search = Button(label="search", width=68)
        self.search.on_click(lambda: self._search(self.search))
        self.refine = Button(label="fit from here", width=100, visible=False)
        self.refine.on_click(lambda: self._search(self.refine, self.candidates[int(self.choice.value or 0)][:2]))
        self.cancel = Button(label="cancel", width=LEFT - 10, visible=False)
        self.cancel.on_click(self._cancel)
        self.choice = Select(title="candidates", options=[], width=LEFT - 10, visible=False)
        self.text = Div(text=HINT, width=LEFT - 10, styles={"color": "var(--faint)"})
        self.material.on_change("value", lambda attr, old, new: self._material_changed())
        for field in (self.scale, *self.centre):
            field.on_change("value", lambda attr, old, new: self.fit())
        self.options.on_change("active", lambda attr, old, new: self.fit())
        self.choice.on_change("value", lambda attr, old, new: self._show_candidate())
        self.undo.on_click(self._undo)
        self.clear.on_click(self._clear)
        self.new_line.on_click(self._next_line)
        self.column = column(
            row(self.material, self.family),
            row(self.undo, self.new_line, self.clear, self.search),
            self.text,
            self.cancel,
            self.choice,
            self.refine,
            row(self.scale, self.options),
            row(*self.centre),
        )

    def _make_drawings(self, fig):
        self.lines = ColumnDataSource({"x": [], "y": [], "x0": [], "y0": []})
        self.poles = ColumnDataSource({"x": [], "y": [], "x0": [], "y0": [], "label": []})
        self.handles = ColumnDataSource({"x": [], "y": []})
        self.marks = ColumnDataSource({"x": [], "y": [], "family": [], "line": []})
        self._drawings = draw_poles(fig, self.lines, self.poles)
        drawn = fig.scatter("x", "y", source=self.marks, size=13, marker="cross", line_color="lime", line_width=3)
        fig.add_layout(
            LabelSet(
                x="x",
                y="y",
                text="family",
                source=self.marks,
                x_offset=8,
                y_offset=-14,
                text_color="lime",
                text_font_size="13px",
                text_font_style="bold",
            )
        )
        held = fig.scatter("x", "y", source=self.handles, size=14, line_color="black", fill_color="orange")
        between = fig.line("x", "y", source=self.handles, line_color="orange", line_dash="dotted")
        follow = {"handles": self.handles, "lines": self.lines, "poles": self.poles}
        self.handles.js_on_change("change", CustomJS(args=follow, code=_FOLLOW))
        self.handles.on_change("data", lambda attr, old, new: self._dragged())
        self.tool = PointDrawTool(renderers=[drawn, held], add=False)
        fig.add_tools(self.tool)
        self._handles = [held, between]
        self.marks.on_change("data", lambda attr, old, new: self.fit())
        self._line = 1

    def show_overlay(self, shown: bool, handles: bool) -> None:
        """Show or hide the candidate on the map, and the handles that move it; the marks stay."""
        for drawing in self._drawings:
            drawing.visible = shown
        for drawing in self._handles:
            drawing.visible = shown and handles

    # ---- marks -----------------------------------------------------------------------------------------------------

    def add(self, x: float, y: float, of_line: bool) -> None:
        """Add a mark of the chosen family: a pole, or a point on a zone line from the first pole to such a pole."""
        new = {"x": x, "y": y, "family": self.family.value, "line": self._line if of_line else 0}
        self.marks.data = {name: [*values, new[name]] for name, values in self.marks.data.items()}

    def ions_changed(self) -> None:
        """Forget the candidates of a search, also of one that goes on: they are those of other ions. Marks stay."""
        if self._indexing is not None or self.search.disabled:
            self._put([], _OTHER_IONS)

    def _content(self):
        measured = self._measured()
        if isinstance(measured, DetectorMap):
            return digest(measured.values, measured.mask, measured.x_edges, measured.y_edges)
        return digest(measured.x, measured.y)

    def propose(self, name: str) -> None:
        """Choose the crystal, if none is chosen."""
        if not self.material.value and name in MATERIALS:
            self.material.value = name

    def _clicked(self, number, of_line, figure, x, y):
        if figure == number:
            self.add(x, y, of_line)

    def _undo(self):
        self.marks.data = {name: list(values)[:-1] for name, values in self.marks.data.items()}

    def _clear(self):
        self._line = 1
        self.marks.data = {name: [] for name in self.marks.data}

    def _next_line(self):
        self._line = max([0, *self.marks.data["line"]]) + 1

    def _material_changed(self):
        self._kept["material"] = self.material.value
        if not self.material.value:
            self.family.update(options=[], value="")
            self._clear()
            return
        families = list(Marks(self.material.value).families)
        self.family.update(options=families, value=families[0])
        self._clear()

    def read(self) -> Marks:
        """The marks on the map."""
        if not self.material.value:
            raise ValueError("choose the crystal first")
        marks = Marks(self.material.value)
        lines: dict[int, tuple[int, list[tuple[float, float]]]] = {}
        for x, y, family, line in zip(*(self.marks.data[name] for name in ("x", "y", "family", "line")), strict=True):
            number = marks.families.index(family)
            if line:
                lines.setdefault(line, (number, []))[1].append((x, y))
            else:
                marks.poles.append((number, (x, y)))
        marks.lines = list(lines.values())
        return marks

    # ---- fits ------------------------------------------------------------------------------------------------------

    def fit(self) -> None:
        """Fit the marks; the candidates come later."""
        self._kept["marks"] = {name: list(values) for name, values in self.marks.data.items()}
        if not self.material.value:
            self._put([], "choose the crystal first")
            return
        marks = self.read()
        if len(marks.poles) < 2 and not (marks.poles and marks.lines and self.scale.value):
            self._put([], self._missing(marks))
            return
        options = {
            "scale": self.scale.value,
            "centre": tuple(field.value or 0.0 for field in self.centre),
            "mirror": bool(self.options.active),
        }
        self._awaited = inputs = marks, options
        self._tasks.submit(guarded(partial(self._fit, inputs), partial(self._later_put, inputs, [])))

    def _search(self, button, start=None):
        """Search over all orientations by `index`, or refine one, in another process; marks narrow it."""
        if not self.material.value:
            self._put([], "choose the crystal first")
            return
        marks = self.read()
        options: dict[str, Any] = {
            "poles": [(*place, marks.planes[number]) for number, place in marks.poles],
            "lines": [(*points[0], *points[-1]) for _, points in marks.lines if len(points) > 1],
        }
        if start is not None:
            options["start"] = start
        elif self.scale.value:
            options["scales"] = (0.95 * self.scale.value, 1.05 * self.scale.value)
        else:
            options["distance"] = self._distance()
        measured = self._measured()
        if isinstance(measured, Hits):
            measured = measured[measured.detected]  # without strays, which the other process would look for again
        arguments = measured, self.material.value
        label = button.label
        for search_button in (self.search, self.refine):
            search_button.disabled = True
        button.label = doing = "searching" if start is None else "fitting"
        self.cancel.visible = True
        began = time.monotonic()

        self._awaited = inputs = arguments, options
        self.text.text = progress_text(0, 0, doing)

        def progress(part):
            self._later(partial(told, part, time.monotonic() - began), 0)

        def told(part, seconds):
            if self._awaited is inputs:
                self.text.text = progress_text(part, seconds, doing)

        def put(indexing, text):
            for search_button in (self.search, self.refine):
                search_button.disabled = False
            button.label = label
            self.cancel.visible, self._process = False, None
            if self._awaited is inputs:  # no mark, fit or handle has changed
                self._put_searched(indexing, text)
            after, self._after_search = self._after_search, None
            if after is not None:
                after()

        def work():
            with SearchProcess() as process:
                self._process = process
                indexing = process.call(index, arguments, options, progress)
                notes = process.notes
            self._later(partial(put, indexing, "; ".join([f"{indexing.verdict}: {indexing.reason}", *notes])), 0)

        start_thread(work, lambda sentence: self._later(partial(put, None, sentence), 0))

    def _cancel(self):
        """End a search, of which the page is then told."""
        if self._process is not None:
            self._process.end()

    def _put_searched(self, indexing, text):
        rows = [] if indexing is None else [
            (candidate.orientation, candidate.projection, "less likely" if indexing.decided and n else indexing.verdict)
            for n, candidate in enumerate(indexing.candidates)
        ]  # fmt: skip
        self._put(rows, text, indexing)

    def search_before(self, then: Callable[[], None]) -> None:
        """Call a function with candidates: at once if there are some, or else after a search."""
        if self.candidates:
            then()
            return
        self._after_search = then
        if self.material.value:
            self._search(self.search)
        else:
            self._after_search = None
            then()

    def settings(self, minutes: float, threads: int) -> StartSettings:
        """Settings of a simulation of the chosen candidate, as ``apt-evap start`` makes them; in any thread."""
        if not self.candidates:
            if not self.material.value:
                raise ValueError("choose the crystal first")
            raise ValueError("index the map first: click poles, or search")
        number, measured = int(self.choice.value or 0), self._measured()
        indexing = self._indexing
        if indexing is None:  # poles that were clicked
            indexing = index(measured, self.candidates[number][0].material, start=self.candidates[number][:2])
        elif number:
            first = indexing.candidates[number]
            others = tuple(candidate for candidate in indexing.candidates if candidate is not first)
            reason = "chosen by hand; another orientation explains the map better"
            indexing = replace(indexing, candidates=(first, *others), decided=False, reason=reason)
        hits = measured if isinstance(measured, Hits) else None
        return settings_of(indexing, hits, minutes=minutes, threads=threads)

    def _missing(self, marks):
        if marks.poles and marks.lines:
            return "type a scale, or mark a second pole"
        return "mark a second pole, or points of a zone line through the first one" if marks.poles else HINT

    def _fit(self, inputs):
        marks, options = inputs
        rows = [(fit.orientation, fit.projection, f"RMS {fit.rms:.2f} mm") for fit in marks.fits(**options)]
        exact = len(marks.poles) == 2 and not marks.lines and options["scale"] is None
        self._later_put(inputs, rows, "two poles fit exactly: a third one decides" if exact else "")

    def _later_put(self, inputs, rows, hint):
        """Show the candidates of a fit, in the thread of the page."""

        def put():
            if self._awaited is inputs:  # the marks are still these
                self._put(rows, hint)

        self._later(put, 0)

    def _put(self, candidates, text, indexing=None):
        """Show candidates; those of a search, with the digest of the measurement in which they were found."""
        self.candidates, self._indexing, self._awaited = candidates, indexing, None
        searched = None if indexing is None else (indexing, self._content())
        self._hint, self._kept["candidates"] = text, (candidates, text, searched)
        options = []
        for number, (orientation, _, quality) in enumerate(candidates):
            axis = " ".join(f"{component:.2f}" for component in orientation.axis)
            options.append((str(number), f"{number + 1}: [{axis}], {quality}"))
        self.choice.update(options=options, visible=bool(options))
        self.refine.visible = bool(options)
        if self.choice.value != "0" and options:
            self.choice.value = "0"  # draws it
        else:
            self._show_candidate()

    def _show_candidate(self):
        if not self.candidates:
            for source in (self.lines, self.poles, self.handles):
                source.data = {name: [] for name in source.data}
            self.text.text = self._hint
            return
        orientation, projection, quality = self.candidates[int(self.choice.value or 0)]
        counts = measured_map(self._measured())
        drawn = overlay(orientation, projection, counts)
        self.lines.data = _twice(with_gaps(drawn.lines))
        self.poles.data = _twice(drawn.places) | {"label": sparse_labels(drawn, counts)}
        self._put_handles(projection)
        axis = ", ".join(f"{component:.3f}" for component in orientation.axis)
        self.text.text = (
            f"<b>{quality}</b>, scale {projection.scale:.1f} mm/rad<br>axis [{axis}], rotation "
            f"{orientation.rotation:.2f}°<br>{self._hint}<br>{_LEGEND}"
        )
        self._put_code(
            f"import apt_evap as ae\n\norientation = {to_python(orientation)}\nprojection = ae.detection.{projection!r}"
        )

    # ---- handles ---------------------------------------------------------------------------------------------------

    def _put_handles(self, projection):
        """A handle at the centre, and one whose angle is the rotation and whose distance is the scale."""
        x, y = projection.centre
        left, right, _, _ = measured_map(self._measured()).extent
        reach = _REACH * (right - left)
        self.handles.tags = [x, y, x + reach, y]
        self.handles.data = {"x": [x, x + reach], "y": [y, y]}

    def _dragged(self):
        """Make the candidate that the handles show."""
        places = [complex(*place) for place in zip(self.handles.data["x"], self.handles.data["y"], strict=True)]
        x, y, *end = self.handles.tags or (0.0, 0.0)
        if not self.candidates or places == [complex(x, y), complex(*end)]:
            return
        number = int(self.choice.value or 0)
        orientation, projection, quality = self.candidates[number]
        if len(places) != 2 or places[0] == places[1]:  # one was deleted
            self._put_handles(projection)
            return
        ratio = (places[1] - places[0]) / (complex(*end) - complex(x, y))
        angle = cmath.phase(ratio) * (-1 if projection.mirror else 1)
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        moved = (
            Orientation.from_matrix(orientation.material, turn @ orientation.matrix),
            replace(projection, scale=projection.scale * abs(ratio), centre=(places[0].real, places[0].imag)),
            MOVED,
        )
        others = [candidate for k, candidate in enumerate(self.candidates) if k != number or quality != MOVED]
        self._put([moved, *others], "the fit starts from here")


def _twice(points):
    """Places, and the same for the handles, which move the first ones."""
    return {"x": points[:, 0], "y": points[:, 1], "x0": points[:, 0], "y0": points[:, 1]}
