"""The page of the explorer: it puts the panels together. The numbers need no Bokeh: see explorer."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.layouts import column, row
from bokeh.models import Button, CustomJS, GlobalInlineStyleSheet, Widget

from apt_evap.explore.code_panel import CodePanel
from apt_evap.explore.correlation_panel import CorrelationPanel
from apt_evap.explore.display_panel import DisplayPanel
from apt_evap.explore.dropped_file import DROP, TOLD
from apt_evap.explore.emission_panel import EmissionPanel
from apt_evap.explore.explorer import Explorer, ExplorerMaps, ExplorerSettings
from apt_evap.explore.file_panel import FilePanel
from apt_evap.explore.index_panel import IndexPanel
from apt_evap.explore.ion_panel import IonPanel
from apt_evap.explore.map_views import MapFigures
from apt_evap.explore.measured_ions import MeasuredIons
from apt_evap.explore.mouse_tools import MouseTools
from apt_evap.explore.newest_task import NewestTaskRunner
from apt_evap.explore.pole_panel import PolePanel
from apt_evap.explore.profile_panel import ProfilePanel
from apt_evap.explore.reconstruction_panel import ReconstructionPanel
from apt_evap.explore.registration_panel import RegistrationPanel
from apt_evap.explore.rings_panel import RingsPanel
from apt_evap.explore.run_panel import RunPanel
from apt_evap.explore.run_progress import ServerState
from apt_evap.explore.search_process import guarded
from apt_evap.explore.specimen_panel import SpecimenPanel
from apt_evap.explore.spectrum_panel import SpectrumPanel
from apt_evap.explore.start_page import StartPage
from apt_evap.explore.style import STYLES, WIDGETS, page_styles, theme
from apt_evap.explore.summary_panel import SummaryPanel
from apt_evap.explore.widgets import LEFT, Tabs, group, maps_and_tabs, save_button
from apt_evap.maps.registration.register import Registration
from apt_evap.specimen.materials import MATERIALS

FIRST_MAP = 1000
"""Time that the browser has for the first maps before the registration begins [ms]: it keeps a processor busy."""
_KEY_B = """
if (window.apt_evap_key) return
window.apt_evap_key = true
document.addEventListener("keydown", event => {
  const inside = event.composedPath()[0]
  const mode = [...Bokeh.documents[0].all_models].filter(model => model.name == "mode").at(-1)
  if (mode?.visible && event.key == "b" && !["INPUT", "TEXTAREA", "SELECT"].includes(inside.tagName))
    mode.active = mode.active == 2 ? 0 : 2
})
"""


class Page:
    """One page of the explorer in a document of Bokeh.

    A panel is None if what it needs is not open.

    Parameters
    ----------
    later : callable, optional
        Calls a function in the thread of the document, after a delay [ms]; by default the document itself does.
    """

    def __init__(
        self,
        explorer: Explorer | None,
        document: Document,
        settings: ExplorerSettings | None = None,
        registration_of: Callable[[str], Registration] | None = None,
        opened: Callable[[str | None, Document], Callable[[], None]] | None = None,
        later: Callable[[Callable[[], None], int], Any] | None = None,
        state: ServerState | None = None,
    ) -> None:
        self.explorer: Any = explorer
        self.document = document
        self._later = self._call_later if later is None else later
        self._tasks = NewestTaskRunner()
        self.summary = SummaryPanel(explorer, self._later)
        read = None if opened is None else lambda path: opened(path, document)
        self.files = FilePanel(read, self.close, self.summary.note, self._later)
        self.back = Button(label="start page", width=90, visible=opened is not None and explorer is not None)
        self.back.on_click(self.files.close_all)
        self.style = Button(label=STYLES[1], width=56)
        self.style.on_click(self._next_style)
        self.registration: RegistrationPanel | None = None
        self.simulation: RunPanel | None = None
        self.index: IndexPanel | None = None
        state = ServerState() if state is None else state
        self.start: StartPage | None = None
        if explorer is None:
            if opened is not None:
                self.start = StartPage(self.files.open, state, self._later)
            body = [] if self.start is None else [self.start.column]
        else:
            self.maps = explorer.show(explorer.start if settings is None else settings)
            self._make_panels(registration_of, state, read is not None)
            self.put(self.maps)
            body = [row(self._left(), self._right(), sizing_mode="stretch_width")]
        self.root = column(self._head(), self.summary.notes, *body, sizing_mode="stretch_width")
        self._add_root()
        if explorer is not None:
            self._tasks.submit(guarded(partial(self._compare, self.maps), self._note_later))
            if self.registration is not None and not explorer.registered and later is None:
                self._call_later(self.registration.search, FIRST_MAP)

    def close(self) -> None:
        """End what runs in the background."""
        self._tasks.close()
        for panel in (self.registration, self.index, self.simulation, self.start):
            if panel is not None:
                panel.close()

    # ---- panels ----------------------------------------------------------------------------------------------------

    def _make_panels(self, registration_of, state, is_opening):
        explorer, maps, request, note = self.explorer, self.maps, self.request, self.summary.note
        self.figures = MapFigures(explorer, maps, self.document)
        figures = self.figures.figures
        self.display = DisplayPanel(explorer, maps, request)
        self.profile = ProfilePanel(explorer, maps, figures, self.figures.names, note)
        self.code = CodePanel(explorer, maps, figures)
        self._panels: list[Any] = [self.figures, self.summary, self.profile, self.code]
        self.emission: EmissionPanel | None = None
        self.ions: IonPanel | None = None
        self.specimen: SpecimenPanel | None = None
        self.poles: PolePanel | None = None
        self.rings: RingsPanel | None = None
        tools = {"line": self.profile.tool, "box": self.code.tool}
        if explorer.run is not None:
            if explorer.has_sliders:
                self.emission = EmissionPanel(explorer, maps.settings.perturbation, request)
            self.ions = IonPanel(explorer, maps.settings.ions, request)
            self.specimen = SpecimenPanel(explorer, maps, figures)
            self.rings = RingsPanel(explorer, self._later)
            self.poles = PolePanel(explorer, maps, figures)
            tools = {"atoms": self.specimen.tool} | tools
            self._panels += [self.specimen, self.rings, self.poles]
        self.spectrum: SpectrumPanel | None = None
        self.correlation: CorrelationPanel | None = None
        if explorer.measured is not None:
            self.index = IndexPanel(
                figures, lambda: explorer.measured, self._material(), self._later, self.code.put_python,
                state.indexed.setdefault(explorer.names[1], {}), lambda: explorer.distance,
            )  # fmt: skip
            self.simulation = RunPanel(
                self.index.settings, f"{Path(explorer.names[1]).stem}.toml", state, self._later,
                self.code.put_python, self.files.open if is_opening else None, self.index.search_before,
            )  # fmt: skip
            tools |= self.index.tools
            if isinstance(explorer.ions_of_file, MeasuredIons):
                self.spectrum = SpectrumPanel(
                    explorer.ions_of_file, explorer.names[1], self._ions_selected, self._element_named, self._later
                )
                self.correlation = CorrelationPanel(explorer.ions_of_file, self._later)
                self.spectrum.shown.append(self.correlation.put)
        if explorer.is_comparison:
            self.registration = RegistrationPanel(
                explorer,
                lambda: self.settings().perturbation,
                registration_of,
                request,
                note,
                self._later,
                self.summary.judge,
            )
            self._panels.append(self.registration)
        spectrum = self.spectrum
        self.reconstruction = ReconstructionPanel(
            explorer, lambda: self.settings().perturbation,
            (lambda: spectrum.named) if spectrum is not None else None, self._material, self._later,
        )  # fmt: skip
        self.tools = MouseTools(figures, tools, self.figures.show_whole)
        if self.index is not None:
            self.tools.choice.on_change("active", lambda attr, old, new: self._show_candidate())
            self._show_candidate()

    def _ions_selected(self):
        """Show other measured ions; they lie where those before lay."""
        self.explorer.selection_changed()
        self.index.ions_changed()
        self.summary.put_facts()
        self.request(False)

    def _element_named(self, name):
        """Propose the element of most ions as the crystal, and name it beside a verdict."""
        self.explorer.crystal_of_ions = name
        self.index.propose(name)
        self.summary.put_verdict()

    def _show_candidate(self):
        """Poles of the candidate, beside a run only while the map is indexed: else those of the run are shown."""
        indexed = self.tools.choice.labels[self.tools.choice.active] in self.index.tools
        self.index.show_overlay(indexed or self.poles is None, handles=indexed)
        if self.poles is not None:
            self.poles.hide_on_last(indexed)

    def _material(self):
        """Name of the crystal of the run or of the command, if it is one of the table."""
        if self.index is not None and self.index.material.value:
            return self.index.material.value
        if self.explorer.run is not None:
            material = self.explorer.run.settings["tip"].get("material", {})
            if material.get("name") in MATERIALS:
                return material["name"]
        return self.explorer.crystal

    # ---- layout ----------------------------------------------------------------------------------------------------

    def _head(self):
        return row(
            self.files.field, self.files.dropped, self.back, self.summary.facts, self.style,
            sizing_mode="stretch_width", styles={"align-items": "center", "gap": "12px"},
        )  # fmt: skip

    def _left(self):
        figures = self.figures
        has_run, more = self.explorer.run is not None, group("more", self.display.further, active=False)
        display = [figures.mode, row(figures.same_scale, save_button(figures.figures))]
        display += [*self.display.widgets, more]
        groups = []
        if self.emission is not None:
            groups.append(group("emission", self.emission.widgets, self.emission.reset))
        if self.spectrum is not None:
            groups.append(group("measured ions", self.spectrum.controls, active=not has_run))
        if self.index is not None and self.simulation is not None:
            groups.append(group("crystal", [self.index.column], active=not has_run))
            groups.append(group("simulate", [self.simulation.column], active=not has_run))
        if self.ions is not None:
            groups.append(group("ions of the run", [self.ions.slider], self.ions.reset))
        groups.append(group("display", display, self._reset_display))
        if self.registration is not None:
            groups.append(group("registration", self.registration.widgets, active=False))
        if self.rings is not None:
            groups.append(group("rings", [self.rings.text], active=False))
        return column(*groups, width=LEFT)

    def _right(self):
        contents: dict[str, Any] = {} if self.specimen is None else {"specimen": self.specimen.widgets}
        if self.spectrum is not None:
            contents["spectrum"] = self.spectrum.widgets
        if self.correlation is not None and self.correlation.has_pulses:
            contents["correlation"] = self.correlation.widgets
        if self.reconstruction.has_ions:
            contents["reconstruction"] = self.reconstruction.widgets
        contents |= {"profile": self.profile.widgets, "code": self.code.widgets}
        tools = [self.tools.row] if self.poles is None else [self.tools.row, self.poles.button]
        self.tabs = Tabs(contents)
        verdict = []
        if self.registration is not None:
            verdict = [
                row(
                    self.registration.status,
                    self.registration.cancel,
                    self.summary.readout,
                    sizing_mode="stretch_width",
                )
            ]
        elif self.explorer.run is not None:
            verdict = [self.summary.readout]
        return column(
            row(*tools, sizing_mode="stretch_width"), *verdict,
            maps_and_tabs(self.figures.figures, self.tabs.column), sizing_mode="stretch_width",
        )  # fmt: skip

    def _add_root(self):
        """Style the page, and add it to the document."""
        self.document.title = "apt-evap explore"
        self.document.theme = theme(STYLES[0])
        for widget in self.root.select({"type": Widget}):
            widget.stylesheets = [*widget.stylesheets, WIDGETS]
        self.root.styles = page_styles(STYLES[0])
        self.root.stylesheets = [GlobalInlineStyleSheet(css="body { margin: 0; }")]
        self.document.js_on_event(DocumentReady, CustomJS(code=_KEY_B))  # of the first page of a document
        if self.files.field.visible:
            if self.start is None:
                self.summary.notes.name = TOLD
            self.document.js_on_event(DocumentReady, DROP)
        self.document.add_root(self.root)

    def _next_style(self):
        style, self.style.label = self.style.label, next(name for name in STYLES if name != self.style.label)
        self.root.styles = page_styles(style)
        self.document.theme = theme(style)
        if self.explorer is not None:
            self.figures.set_style(style)

    def _reset_display(self):
        self.figures.reset()
        self.display.reset()

    # ---- maps ------------------------------------------------------------------------------------------------------

    def settings(self) -> ExplorerSettings:
        """Settings of the current positions of the widgets."""
        first, display = self.maps.settings, self.display
        return ExplorerSettings(
            perturbation=first.perturbation if self.emission is None else self.emission.perturbation,
            bins=int(display.bins.value),
            smoothing=display.smoothing.value,
            flattening=display.flattening.value,
            ions=first.ions if self.ions is None else self.ions.ions,
        )

    def request(self, preview: bool) -> None:
        """Request the maps of the current settings; they come later."""
        self._tasks.submit(guarded(partial(self._compute, self.settings(), preview), self._note_later))

    def put(self, maps: ExplorerMaps) -> None:
        """Put maps and their numbers on the page."""
        self.maps = maps
        self.document.hold("combine")
        try:
            for panel in self._panels:
                panel.put(maps)
        finally:
            self.document.unhold()

    def _compute(self, settings, preview):
        """Compute maps in the worker thread."""
        maps = self.explorer.show(settings, preview)
        self._later(partial(self.put, maps), 0)
        if not preview:
            self._compare(maps)

    def _compare(self, maps):
        """Compute verdict and rings of all ions in the worker thread, unless newer maps are requested."""
        if self._tasks.has_newer or self.rings is None:
            return
        if self.registration is not None:
            if not self.explorer.registered:
                return  # rings need the place of the pole on the measured map
            self.registration.compare(maps)
        self.rings.measure(maps)

    # ---- threads ---------------------------------------------------------------------------------------------------

    def _note_later(self, sentence):
        """Show an error, from any thread."""
        self._later(partial(self.summary.note, sentence), 0)

    def _call_later(self, function, delay):
        if delay:
            self.document.add_timeout_callback(function, delay)
        else:
            self.document.add_next_tick_callback(function)  # the only one that other threads may call
