"""The page of the explorer in a document without a browser."""

import re
import socket
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rough import ROUGH

import apt_evap as ae
from apt_evap.detection.color_limits import color_limits, common_limits
from apt_evap.detection.timing import mass_to_charge
from apt_evap.explore.explorer import Explorer, ExplorerSettings
from apt_evap.explore.specimen_surface import surface_atoms
from apt_evap.simulation.config.simulation_file import read_config

pytest.importorskip("bokeh")

from bokeh.document import Document
from bokeh.models import Slider, Spinner
from bokeh.util.token import generate_jwt_token, generate_session_id, get_token_payload
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from apt_evap.cli._explorer_of_files import explorer_and_view
from apt_evap.cli._files import read_registration
from apt_evap.cli.parser import make_parser
from apt_evap.explore.map_views import MODES
from apt_evap.explore.measured_ions import IonSelection
from apt_evap.explore.page import Page
from apt_evap.explore.run_progress import ServerState
from apt_evap.explore.server import serve
from apt_evap.explore.spectrum_panel import _width_of
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.io.rrng import write_rrng

SECONDS = 60  # until a test gives up: the machine may be busy


@pytest.fixture(scope="session")
def run(small_tip, made_once):
    return made_once(small_tip, 2000, seed=1, **ROUGH)


@pytest.fixture(scope="session")
def measured(run):
    hits = replace(run, seed=2).hits(ae.RollUp(0.2))
    return hits.map(40, extent=(-60, 60, -60, 60))


class Opened:
    """A page whose document does everything at once, or when it is told to."""

    def __init__(self, explorer, **options):
        self.waiting = []
        self.page = Page(explorer, Document(), later=lambda function, delay: self.waiting.append(function), **options)

    def settle(self, what):
        """Do what waits until something is true."""
        end = time.monotonic() + SECONDS
        while not (what() and not self.waiting):
            while self.waiting:
                self.waiting.pop(0)()
            assert time.monotonic() < end, "the page does not settle"
            time.sleep(0.005)

    def shows(self, preview=False):
        """Whether the page shows what its widgets say."""
        return self.page.maps.settings == self.page.settings() and self.page.maps.preview == preview


@pytest.fixture
def opened(run, measured):
    opened = Opened(Explorer(run, measured, ae.Registration(0.0, 1.0, (0.0, 0.0)), preview=500))
    yield opened
    opened.page.close()


@pytest.fixture(scope="session")
def shared(run, measured):
    """Such a page for tests that leave it as it was."""
    opened = Opened(Explorer(run, measured, ae.Registration(0.0, 1.0, (0.0, 0.0)), preview=500))
    yield opened
    opened.page.close()


def _limits(page):
    return [(each.low, each.high) for each in page.figures.colors]


def image(source):
    return source.data["image"][0]


def throttled(slider, value):
    """What a browser sends when a slider is released."""
    slider.value = value
    slider.trigger("value_throttled", None, value)


def click(page, number, x, y):
    """What a browser sends when a map is clicked."""
    page.tools._clicked(number, SimpleNamespace(x=x, y=y))


def test_a_slider_moves_the_map_as_the_core_computes_it(opened):
    page = opened.page
    before = image(page.figures.sources[0]).copy()
    throttled(page.emission.sliders["mean"], 0.33)
    opened.settle(opened.shows)
    shown = page.explorer.show(page.settings())
    assert page.settings().perturbation == ae.RollUp(ae.TruncatedNormal(0.33, 0.33))
    assert not np.array_equal(image(page.figures.sources[0]), before, equal_nan=True)
    assert np.array_equal(image(page.figures.sources[0]), shown.pictures[0].density.astype(np.float32), equal_nan=True)
    # the whole measured map, relative to the mean where both are compared
    inside, whole = shown.measured.mask, shown.whole.density
    expected = (whole / whole[inside].mean()).astype(np.float32)
    assert np.array_equal(image(page.figures.sources[1]), expected, equal_nan=True)
    opened.settle(lambda: page.registration.likeness is not None)
    for verdict in ("alike", "doubtful", "not alike"):  # similarities of unrelated maps say nothing
        page.summary.judge(page.maps, page.registration.likeness._replace(verdict=verdict))
        assert (f"similarity of {shown.similarity.value:.2f}" in page.summary.readout.text) == (verdict == "alike")
        assert f">{verdict}</b>" in page.summary.readout.text
    assert page.code.python.text == page.explorer.commands(page.settings()).python
    assert "RollUp:0.33,0.33" in page.code.shell.text


@pytest.mark.slow
def test_every_widget_moves_something(opened):
    page = opened.page
    page.emission.mechanism.active = 3  # combined, which has all sliders but one
    opened.settle(opened.shows)
    others = page.emission.sliders["others"]
    widgets = [each for each in page.emission.sliders.values() if each is not others]
    widgets += [page.display.smoothing, page.display.flattening, page.display.bins]
    assert all(each.visible for each in widgets) and len(widgets) >= 6 and not others.visible
    for widget in [*widgets, others]:
        if widget is others:
            page.emission.mechanism.active = 2  # roll-up, by now with a probability of 0.6
            opened.settle(opened.shows)
            assert others.visible
        before, text = image(page.figures.sources[0]).copy(), page.code.python.text
        throttled(widget, widget.start + 0.6 * (widget.end - widget.start) if widget is not page.display.bins else 20)
        opened.settle(opened.shows)
        now = image(page.figures.sources[0])
        assert now.shape != before.shape or not np.array_equal(now, before, equal_nan=True), widget.title
        assert page.code.python.text != text, widget.title
    before = image(page.figures.sources[0]).copy()
    throttled(page.ions.slider, (500, 1500))
    opened.settle(opened.shows)
    assert page.settings().ions == (500, 1500) and page.maps.ions == 1000
    assert not np.array_equal(image(page.figures.sources[0]), before, equal_nan=True)
    page.emission.mechanism.active = 0
    opened.settle(opened.shows)
    assert [name for name, slider in page.emission.sliders.items() if slider.visible] == ["height"]
    assert page.settings().perturbation == ae.Unperturbed(page.emission.sliders["height"].value)


@pytest.mark.slow
def test_a_preview_is_grey(opened):
    page = opened.page
    opened.settle(lambda: "rings about 111" in page.rings.text.text or "not here" in page.rings.text.text)
    page.emission.sliders["mean"].value = 0.4  # still moving
    opened.settle(lambda: opened.shows(preview=True))
    assert page.maps.ions == 500 and "preview" in page.summary.readout.text
    gray = "var(--faint)"
    assert gray in page.summary.readout.text
    page.emission.sliders["mean"].trigger("value_throttled", None, 0.4)
    opened.settle(opened.shows)
    assert gray not in page.summary.readout.text and "preview" not in page.summary.readout.text


def test_a_preview_sends_only_what_changes(opened):
    page = opened.page
    opened.settle(opened.shows)
    limits, data = _limits(page), [dict(each.data) for each in (*page.figures.sources, page.figures.difference)]
    page.emission.sliders["mean"].value = 0.4
    opened.settle(lambda: opened.shows(preview=True))
    simulated, measured, difference = (*page.figures.sources, page.figures.difference)
    assert simulated.data["image"][0] is not data[0]["image"][0]
    assert measured.data["image"][0] is data[1]["image"][0] and difference.data["image"][0] is data[2]["image"][0]
    assert _limits(page) == limits
    page.emission.sliders["mean"].trigger("value_throttled", None, 0.4)
    opened.settle(opened.shows)
    assert _limits(page) != limits
    page.display.smoothing.value = 2.0  # changes both maps
    opened.settle(lambda: opened.shows(preview=True))
    assert not np.array_equal(measured.data["image"][0], data[1]["image"][0], equal_nan=True)


def test_only_the_newest_maps_are_computed(opened, monkeypatch):
    page = opened.page
    opened.settle(opened.shows)
    computed = []
    show = page.explorer.show

    def slow(settings, preview=False):
        computed.append(settings)
        time.sleep(0.05)
        return show(settings, preview)

    monkeypatch.setattr(page.explorer, "show", slow)
    for value in np.linspace(0.2, 0.4, 41):
        page.emission.sliders["mean"].value = float(value)
    page.emission.sliders["mean"].trigger("value_throttled", None, 0.4)
    opened.settle(opened.shows)
    assert len(computed) < 10  # of 42
    assert computed[-1] == page.settings() and page.settings().perturbation.energy.mean == 0.4


def test_difference_and_blink(shared):
    page = shared.page
    shared.settle(shared.shows)
    first, second = page.maps.pictures
    page.figures.mode.active = MODES.index("difference")
    assert page.figures.difference_image.visible and page.figures.figures[1].title.text == "simulated - measured"
    expected = (first.density - second.density).astype(np.float32)
    assert np.array_equal(image(page.figures.difference), expected, equal_nan=True)
    assert page.figures.difference_colors.low == -page.figures.difference_colors.high < 0
    # the bar beside the difference is its own
    (bar,) = [each for each in page.figures.figures[1].below if getattr(each, "color_mapper", None) and each.visible]
    assert bar.color_mapper is page.figures.difference_image.glyph.color_mapper and bar.title
    assert page.figures.bars[0].visible
    page.figures.mode.active = MODES.index("blink")
    assert not page.figures.difference_image.visible and page.figures.figures[1].title.text == "measured"
    assert page.figures.bars[1].visible and not page.figures.difference_bar.visible
    (callback,) = page.document.session_callbacks
    titles = []
    for _ in range(4):
        callback.callback()
        titles.append(page.figures.figures[0].title.text)
        assert page.figures.blink_image.visible == (titles[-1] == "measured")
    assert titles == ["measured", "simulated"] * 2
    page.figures.mode.active = 0
    assert page.document.session_callbacks == [] and not page.figures.blink_image.visible


def test_linked_maps(shared):
    first, second = shared.page.figures.figures
    assert first.x_range is second.x_range and first.y_range is second.y_range


def test_a_line_gives_profiles(opened):
    page = opened.page
    curve = np.linspace(-20, 20, 30)
    page.profile.line.data = {"xs": [curve.tolist()], "ys": [(curve + np.sin(curve)).tolist()]}  # as a mouse draws
    ends = [[-20, -20 + np.sin(-20)], [20, 20 + np.sin(20)]]
    assert np.allclose(
        np.transpose([page.profile.line.data["xs"][0], page.profile.line.data["ys"][0]]), ends
    )  # straight
    rectangle, profiles = page.explorer.profiles(page.maps, ends, page.profile.width.value)
    for source, profile in zip(page.profile.curves, profiles, strict=True):
        assert np.array_equal(source.data["y"], profile.density, equal_nan=True) and len(profile.density) > 3
    assert np.allclose(page.profile.rectangle.data["x"], rectangle.corners[:, 0])
    # a new line takes the place of the old one, and follows the map
    page.profile.line.data = {
        "xs": [*page.profile.line.data["xs"], [0.0, 1.0, 10.0]],
        "ys": [*page.profile.line.data["ys"], [0.0, 1.0, 0.0]],
    }
    assert page.profile.line.data == {"xs": [[0.0, 10.0]], "ys": [[0.0, 0.0]]}
    before = np.array(page.profile.curves[0].data["y"])
    throttled(page.emission.sliders["mean"], 0.5)
    opened.settle(opened.shows)
    assert not np.array_equal(page.profile.curves[0].data["y"], before, equal_nan=True)


def test_a_click_shows_atoms(opened):
    page = opened.page
    click(page, 0, x=5.0, y=-3.0)
    atoms = page.explorer.atoms_at(page.maps.settings, 5.0, -3.0, page.specimen.radius.value)
    assert len(atoms) > 0 and f"{len(atoms)} atoms land within" in page.specimen.view.figure.title.text
    view = page.specimen.view
    assert np.array_equal(view.marked.data["px"] + view.centre[0], atoms.positions[:, 0])
    assert page.specimen.click.data == {"x": [5.0], "y": [-3.0], "radius": [page.specimen.radius.value]}
    drawn = surface_atoms(page.explorer.run)
    assert np.allclose(view.points.data["z"] + view.centre[2], drawn.positions[:, 2], atol=1e-5)
    before = view.points.data["color"]
    page.specimen.color.value = "field"
    assert (view.points.data["color"] != before).any() and "phase" not in dict(page.specimen.color.options)
    assert view.colors.high <= page.explorer.run.fields.max()
    for _ in range(2):
        page.specimen.side.active = 0
        assert view.points.tags == [0.0, 90.0] and page.specimen.side.active is None
        view.points.tags = [10.0, 20.0]  # as a mouse turns it


def test_the_specimen_follows_the_ions(opened):
    """Also after previews of the same ions, as those of a slider that moves."""
    page = opened.page
    before = len(page.specimen.view.points.data["z"])
    page.ions.slider.value = (1500, 2000)
    opened.settle(lambda: opened.shows(preview=True))
    throttled(page.ions.slider, (1500, 2000))
    opened.settle(opened.shows)
    view, drawn = page.specimen.view, surface_atoms(page.explorer.run, ions=(1500, 2000))
    assert len(drawn.positions) != before
    assert np.allclose(view.points.data["z"] + view.centre[2], drawn.positions[:, 2], atol=1e-5)


def test_a_rectangle_gives_commands(shared):
    page = shared.page
    box = {"type": "rect", "x0": -10.0, "x1": 5.0, "y0": 0.0, "y1": 8.0}
    page.code._selected(SimpleNamespace(geometry=box, final=False))
    assert "window" not in page.code.python.text
    page.code._selected(SimpleNamespace(geometry=box, final=True))
    expected = page.explorer.selection(page.maps.settings, (-10.0, 5.0), (0.0, 8.0))
    assert page.code.python.text == expected.python and "no ions" in page.code.shell.text


def test_a_registration_is_typed(run, measured):
    registration = ae.Registration(0.0, 1.0, (0.0, 0.0))
    opened = Opened(Explorer(run, measured, registration), registration_of=read_registration)
    page = opened.page
    opened.settle(opened.shows)
    assert page.registration.text.value == "0.0,1.0,0.0,0.0"
    before = image(page.figures.sources[0]).copy()
    page.registration.text.value = "nonsense"
    assert "--registration must be" in page.summary.notes.text and page.explorer.registration == registration
    page.registration.text.value = "30,0.9,1,2,mirror"
    assert page.explorer.registration == ae.Registration(30.0, 0.9, (1.0, 2.0), True)
    opened.settle(lambda: not np.array_equal(image(page.figures.sources[0]), before, equal_nan=True))
    assert "--registration=30.0,0.9,1.0,2.0,mirror" in page.code.shell.text
    page.close()


def test_errors_and_warnings_are_shown(opened):
    page = opened.page
    opened.settle(opened.shows)
    page.emission.sliders["mean"].end = 9.0
    throttled(page.emission.sliders["mean"], 8.0)
    opened.settle(opened.shows)
    assert "launch above the energy limit" in page.summary.notes.text
    page.explorer.set_registration(ae.Registration(0.0, 1.0, (900.0, 0.0)))
    page.request(preview=False)
    opened.settle(lambda: "hits is in x" in page.summary.notes.text)


def test_one_map_without_a_measurement(run):
    opened = Opened(Explorer(run), settings=ExplorerSettings(ae.LateralVelocity(0.2), 32, 4.0))
    page = opened.page
    assert (
        len(page.figures.figures) == 1
        and not page.figures.mode.visible
        and page.tools.choice.labels == ["move", "atoms", "line", "box"]
    )
    assert page.emission.mechanism.active == 1 and page.emission.sliders["relative_spread"].value == 0.0
    throttled(page.emission.sliders["mean"], 0.3)
    opened.settle(opened.shows)
    assert "similarity" not in page.summary.readout.text and page.code.shell.text.startswith("apt-evap map RUN.h5")
    page.document.validate()
    page.close()


def test_a_measurement_alone(measured):
    opened = Opened(Explorer(None, measured, file=MeasuredFile("map.npz")))
    page = opened.page
    assert len(page.figures.figures) == 1 and page.emission is None and "atoms" not in page.tools.choice.labels
    assert np.array_equal(image(page.figures.sources[0]), page.maps.whole.density.astype(np.float32), equal_nan=True)
    throttled(page.display.smoothing, 5.0)
    opened.settle(lambda: page.maps.settings.smoothing == 5.0)
    page.profile.line.data = {"xs": [[-20.0, 20.0]], "ys": [[0.0, 1.0]]}
    assert len(page.profile.curves) == 1 and len(page.profile.curves[0].data["y"]) > 3
    assert "map.npz" in page.summary.facts.text and page.registration is None
    page.document.validate()
    page.close()


def test_each_map_has_its_own_scale(shared):
    page = shared.page
    own = _limits(page)
    assert own == [color_limits(each) for each in page.maps.pictures]
    page.figures.same_scale.active = True
    assert _limits(page) == [common_limits(page.maps.pictures)] * 2
    page._reset_display()
    assert _limits(page) == own


def test_what_is_not_compared_is_dimmed(run, measured):
    opened = Opened(Explorer(run, measured, ae.Registration(0.0, 0.5, (5.0, 0.0)), preview=500))
    page = opened.page
    veil, shown = image(page.figures.veil), page.maps
    assert np.array_equal(veil != 0, shown.whole.mask & ~shown.measured.mask) and 0 < (veil != 0).mean() < 1
    assert np.isfinite(image(page.figures.sources[1]))[shown.whole.mask].all()
    before = veil[veil != 0][0]
    page._next_style()
    assert image(page.figures.veil)[veil != 0][0] != before and page.style.label == "dark"
    page.close()


def test_groups_are_reset(shared):
    page = shared.page
    start = page.settings()
    for slider in (page.emission.sliders["mean"], page.display.smoothing, page.display.bins):
        throttled(slider, slider.start + 0.5 * (slider.end - slider.start) // 1)
    page.emission.mechanism.active, page.ions.slider.value = 1, (300, 900)
    assert page.settings() != start
    for reset in (page.emission.reset, page._reset_display, page.ions.reset):
        reset()
    assert page.settings() == start
    shared.settle(shared.shows)


def test_a_number_is_typed(shared):
    """The field beside a slider moves it, and the slider the field."""
    (field,) = shared.page.document.select({"type": Spinner, "name": "mean energy [eV]"})
    assert field.value == shared.page.emission.sliders["mean"].value
    (callback,) = field.js_property_callbacks["change:value_throttled"]
    assert callback.args["slider"] is shared.page.emission.sliders["mean"]


@pytest.mark.slow
def test_the_registration_arrives(run, measured, monkeypatch):
    """A search in the background shows its progress, and its result; another registration ends it."""
    opened = Opened(Explorer(run, measured, preview=500))
    page, go, ended = opened.page, threading.Semaphore(0), []
    found = [ae.Registration(0.0, 1.0, (0.0, 0.0), score=each, overlap=1.0, method="search") for each in (0.3, 0.9)]

    def register(perturbations, progress, apply):
        for done, each in enumerate(found):
            try:
                progress(done, 2)
            except Exception:
                ended.append(done)
                raise
            go.acquire(timeout=SECONDS)
            page.explorer.set_registration(each)
        progress(2, 2)

    monkeypatch.setattr(page.explorer, "register", register)
    assert "not registered" in page.registration.status.text and "similarity" not in page.summary.readout.text
    page.registration.search()
    opened.settle(
        lambda: "registering" in page.registration.status.text and "<progress" in page.registration.status.text
    )
    throttled(page.emission.sliders["mean"], 0.3)  # the page goes on
    opened.settle(opened.shows)
    go.release()
    opened.settle(lambda: 'value="0.5"' in page.registration.status.text and page.explorer.registered)
    opened.settle(opened.shows)
    assert not re.search(r">(alike|not alike|doubtful)</b>", page.summary.readout.text)  # not of the first emission
    go.release()
    opened.settle(lambda: "progress" not in page.registration.status.text and page.explorer.registration.score == 0.9)
    opened.settle(
        lambda: (
            page.registration.likeness is not None and page.registration.likeness.verdict in page.summary.readout.text
        )
    )
    page.registration.search()
    page.registration.close()
    go.release()
    opened.settle(lambda: ended)
    assert page.registration._progress is None and "<progress" not in page.registration.status.text
    page.close()


@pytest.mark.slow
def test_poles_are_clicked(measured):
    opened = Opened(Explorer(None, measured))
    page, index = opened.page, opened.page.index
    index.material.value = "Ni"
    orientation, projection = ae.Orientation("Ni", axis=(1, 1, 1)), ae.detection.Projection(60.0)
    page.tools.choice.active = page.tools.choice.labels.index("pole")
    assert page.figures.figures[0].toolbar.active_drag is index.tool
    for plane, family in (((1, 1, 1), "111"), ((0, 0, 2), "200"), ((0, 2, 0), "200"), ((1, 1, 3), "311")):
        index.family.value = family
        direction = np.array(plane) / np.linalg.norm(plane)
        ((x, y),) = projection.places(orientation.directions([direction]))
        click(page, 0, x=float(x), y=float(y))
    opened.settle(lambda: len(index.read().poles) == 4 and "scale 60.0" in index.text.text)
    best, fitted, _ = index.candidates[0]
    assert fitted.scale == pytest.approx(60.0, rel=1e-6) and "RMS 0.00" in index.text.text
    assert len(index.poles.data["x"]) > 4 and np.isfinite(index.lines.data["x"]).sum() > 20
    names = {}
    exec(page.code.python.text, names)
    assert np.allclose(names["orientation"].matrix, best.matrix) and names["projection"] == fitted
    index._undo()
    page.tools.choice.active = page.tools.choice.labels.index("zone line")
    click(page, 0, x=1.0, y=2.0)
    marks = index.read()
    assert len(marks.poles) == 3 and marks.lines == [(marks.families.index("311"), [(1.0, 2.0)])]
    index._clear()
    opened.settle(lambda: not index.candidates and len(index.poles.data["x"]) == 0)
    page.close()


def test_a_candidate_is_drawn_inside_the_map_and_its_handles_where_they_can_be_dragged(run):
    x, y = np.meshgrid(*[np.linspace(-39, 39, 40)] * 2)
    edges = np.linspace(-40, 40, 41)
    disc = ae.DetectorMap.from_array(1.0 + 0 * x, edges, edges, mask=np.hypot(x, y) < 30)
    page = Opened(Explorer(None, disc)).page
    index, tools = page.index, page.tools.choice
    index.material.value = "Ni"
    index._put([(ae.Orientation("Ni", axis=(1, 1, 1)), ae.detection.Projection(40.0), "indexed")], "")
    for source in (index.lines, index.poles):
        radii = np.hypot(source.data["x"], source.data["y"])
        assert len(radii) > 3 and np.nanmax(radii) < 30 + 1.5
    assert "zone lines" in index.text.text and "orange dots" in index.text.text
    lines, held = index._drawings[0], index._handles[0]
    assert lines.visible and not held.visible
    tools.active = tools.labels.index("pole")
    assert lines.visible and held.visible
    tools.active = tools.labels.index("line")
    assert lines.visible and not held.visible
    page.close()
    both = Opened(Explorer(run, disc, ae.Registration(0.0, 0.4, (0.0, 0.0)))).page
    assert not both.index._drawings[0].visible  # the poles of the run are shown
    both.close()


@pytest.mark.slow
def test_a_fit_of_earlier_marks_is_not_shown(measured):
    """Marks are faster than fits: what is shown is the fit of all marks, or of none."""
    opened = Opened(Explorer(None, measured))
    index = opened.page.index
    index.material.value = "Ni"
    shown = []
    index.choice.on_change("options", lambda attr, old, new: shown.append(new))
    for x, y in ((0.0, 0.0), (30.0, 0.0), (0.0, 30.0)):
        index.add(x, y, of_line=False)
    index._clear()  # before anything that was fitted can be put
    opened.settle(lambda: not index._tasks._busy)
    assert index.candidates == [] and not any(shown) and len(index.lines.data["x"]) == 0
    for x, y in ((0.0, 0.0), (30.0, 0.0), (0.0, 30.0)):
        index.add(x, y, of_line=False)
    opened.settle(lambda: index.candidates)
    opened.settle(lambda: not index._tasks._busy)
    assert len(shown) == 1 and "two poles" not in index.text.text
    # nor is a search, which takes seconds
    index._search(index.search)
    index._clear()
    opened.settle(lambda: not index.search.disabled)
    assert index.candidates == [] and index.search.label == "search"
    opened.page.close()


@pytest.mark.slow
def test_a_search_keeps_the_families_of_marked_poles(measured, monkeypatch):
    monkeypatch.setattr("apt_evap.explore.index_panel.start_thread", lambda *arguments: None)
    opened = Opened(Explorer(None, measured))
    index = opened.page.index
    index.material.value = "Ni"
    for family, x in (("311", 3.0), ("111", -4.0)):
        index.family.value = family
        index.add(x, 1.0, of_line=False)
    index._search(index.search)
    poles = index._awaited[1]["poles"]
    assert [(x, y, sorted(map(abs, plane))) for x, y, plane in poles] == [(3.0, 1.0, [1, 1, 3]), (-4.0, 1.0, [1, 1, 1])]
    opened.page.close()


@pytest.mark.slow
def test_the_orientation_is_searched():
    """The search is that of the library, in another process; its settings can be copied."""
    pattern = ae.maps.master_patterns("fcc")[0]
    orientation = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    projection = ae.detection.Projection(60.0)
    measured = pattern.map(orientation, projection, width=70.0, ions=30_000, rolled=0.5, seed=1)
    opened = Opened(Explorer(None, measured))
    index = opened.page.index
    index.material.value, index.scale.value = "Ni", 60.0
    index._search(index.search)
    assert index.search.disabled and index.search.label == "searching"
    opened.settle(lambda: not index.search.disabled)
    found = ae.index(measured, "Ni", scales=(57.0, 63.0))
    assert found.reason in index.text.text and found.verdict in index.text.text
    assert len(index.candidates) == len(found.candidates)
    assert np.array_equal(index.candidates[0][0].matrix, found.best.orientation.matrix)
    assert index.settings(10.0, 1).text == ae.fit.settings_of(found).text
    if len(found.candidates) > 1:
        index.choice.value = "1"
        assert np.array_equal(index.settings(10.0, 1).indexing.best.orientation.matrix, index.candidates[1][0].matrix)
    # the handles move it, and the fit starts from there
    (x, y), (orientation, projection, _) = (index.handles.tags[:2], index.candidates[0])
    reach = index.handles.tags[2] - x
    index.choice.value = "0"
    end = complex(x + 1, y) + 1.05 * reach * np.exp(1j * np.radians(4.0))
    index.handles.data = {"x": [x + 1, end.real], "y": [y, end.imag]}
    moved, place, quality = index.candidates[0]
    assert quality == "moved by hand" and len(index.candidates) == len(found.candidates) + 1
    assert place.scale == pytest.approx(1.05 * projection.scale) and place.centre == pytest.approx((x + 1, y))
    assert moved.rotation == pytest.approx(orientation.rotation + 4.0) and moved.axis == pytest.approx(orientation.axis)
    index.handles.data = {"x": [x], "y": [y]}  # one is deleted
    assert len(index.handles.data["x"]) == 2 and index.candidates[0][0] is moved
    index._search(index.refine, index.candidates[0][:2])
    opened.settle(lambda: not index.refine.disabled)
    assert index.candidates[0][0].matrix == pytest.approx(orientation.matrix, abs=0.005)
    assert index.candidates[0][1].scale == pytest.approx(projection.scale, rel=0.01) and len(index.candidates) == 1
    opened.page.close()


@pytest.mark.slow
def test_settings_are_written_and_run(measured, tmp_path, monkeypatch):
    """From poles that are clicked to a run that opens; no file is replaced without a second click."""
    monkeypatch.chdir(tmp_path)
    asked = []
    opened = Opened(Explorer(None, measured), opened=lambda path, document: lambda: asked.append(path))
    page, index, panel = opened.page, opened.page.index, opened.page.simulation
    index.material.value = "Ni"
    panel._write()
    opened.settle(lambda: not panel.write.disabled)
    assert "index the map first" in panel.text.text and not list(tmp_path.iterdir())
    panel._start_or_stop()
    assert "write the settings first" in panel.text.text
    orientation, projection = ae.Orientation("Ni", axis=(1, 1, 1)), ae.detection.Projection(60.0)
    for plane, family in (((1, 1, 1), "111"), ((0, 0, 2), "200"), ((0, 2, 0), "200")):
        index.family.value = family
        ((x, y),) = projection.places(orientation.directions([np.array(plane) / np.linalg.norm(plane)]))
        index.add(float(x), float(y), of_line=False)
    opened.settle(lambda: "scale 60.0" in index.text.text)
    path = tmp_path / "tip.toml"
    path.write_text("mine")
    panel.file.value, panel.minutes.value = "tip.toml", 1.0
    panel._write()
    assert "exists" in panel.text.text and str(path) in panel.text.text and path.read_text() == "mine"
    panel._write()
    opened.settle(lambda: not panel.write.disabled)
    config = read_config(path)
    assert config.tip["material"].name == "Ni" and "not searched" in path.read_text()
    assert page.code.python.text == path.read_text() and str(path) in panel.text.text
    # fewer ions, for the test
    path.write_text(path.read_text().replace(f"ions = {config.n_ions:_}", "ions = 200"))
    panel._start_or_stop()
    assert panel.start.label == "stop the run"
    opened.settle(lambda: "of 200 ions" in panel.text.text or asked)
    opened.settle(lambda: asked)
    assert asked == [str(tmp_path / "tip.h5")] and len(ae.load(tmp_path / "tip.h5")) == 200
    assert panel.start.label == "start the run"


@pytest.mark.slow
def test_one_button_simulates_the_specimen(measured, tmp_path, monkeypatch):
    """From marks to a run that opens with the emission that its settings recommend; marks outlive the page."""
    monkeypatch.chdir(tmp_path)
    np.savez("specimen.npz", counts=measured.values, x_edges_mm=measured.x_edges, y_edges_mm=measured.y_edges)
    asked, state = [], ServerState()
    measured = replace(measured, source="specimen.npz")
    explorer = Explorer(None, measured, file=MeasuredFile("specimen.npz"))
    opened = Opened(explorer, opened=lambda path, document: lambda: asked.append(path), state=state)
    index, panel = opened.page.index, opened.page.simulation
    panel._simulate_or_stop()
    opened.settle(lambda: not panel.simulate.disabled)
    assert "choose the crystal" in panel.text.text and not list(tmp_path.glob("*.toml"))
    index.material.value = "Ni"
    orientation, projection = ae.Orientation("Ni", axis=(1, 1, 1)), ae.detection.Projection(60.0)
    for plane, family in (((1, 1, 1), "111"), ((0, 0, 2), "200"), ((0, 2, 0), "200")):
        index.family.value = family
        ((x, y),) = projection.places(orientation.directions([np.array(plane) / np.linalg.norm(plane)]))
        index.add(float(x), float(y), of_line=False)
    opened.settle(lambda: index.candidates and "scale 60.0" in index.text.text)
    (tmp_path / "specimen.toml").write_text("mine")

    def fewer(minutes, threads):
        made = index.settings(1.0, threads)
        return replace(made, text=re.sub(r"ions = [\d_]+", "ions = 200", made.text))

    monkeypatch.setattr(panel, "_settings", fewer)
    panel._simulate_or_stop()
    opened.settle(lambda: asked)
    run = tmp_path / "specimen_2.h5"  # nothing is replaced
    assert asked == [str(run)] and len(ae.load(run)) == 200 and (tmp_path / "specimen.toml").read_text() == "mine"
    assert panel.simulate.label == "simulate this specimen"
    beside, view = explorer_and_view(make_parser().parse_args(["explore", str(run), "specimen.npz"]))
    start = index.settings(1.0, 1).registration["start"]  # the run is registered from there
    assert beside.search.options["start"].shift == pytest.approx(start.shift, abs=0.1)
    panels = read_config(run.with_suffix(".toml")).maps.panels
    assert view.perturbation == panels[1].perturbation and view.perturbation.energy == 0.35
    again = Opened(Explorer(None, measured, file=MeasuredFile("specimen.npz")), state=state).page
    assert again.index.material.value == "Ni" and len(again.index.read().poles) == 3
    assert np.array_equal(again.index.candidates[0][0].matrix, index.candidates[0][0].matrix)
    assert len(again.index.lines.data["x"]) > 10
    again.close()
    opened.page.close()


@pytest.mark.usefixtures("spectra_once")
def test_candidates_of_a_search_are_those_of_its_ions():
    """Other ions, on the same page or in a file of the same name, have none; marks and their fits are kept."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-20, 20, size=(2, 2_000))
    hits = ae.Hits(x=x, y=y, mass_to_charge=rng.choice([14.0, 63.0], 2_000))
    state, row = ServerState(), (ae.Orientation("Ni", axis=(1, 1, 1)), ae.detection.Projection(60.0), "undecided")

    def page_of(ions):
        return Opened(Explorer(None, ions, file=MeasuredFile("ions.epos")), state=state).page

    first = page_of(hits)
    first.index.material.value = "Ni"
    first.index._put([row], "indexed", object())
    assert page_of(hits).index.candidates == [row]
    assert page_of(hits[::2]).index.candidates == []  # the file was replaced
    first.index._put([row], "indexed", object())
    first.explorer.ions_of_file.select(IonSelection(mass=(60.0, 70.0)))
    first._ions_selected()
    assert first.index.candidates == [] and "search again" in first.index.text.text
    first.index._put([row], "a fit of marks")
    assert page_of(hits[::2]).index.candidates == [row]


def test_ions_of_a_replaced_file_are_not_kept():
    """A run that is opened keeps the selection of the same ions, not the ions of a file that was replaced."""
    hits = ae.Hits(x=np.arange(9.0), y=np.zeros(9), mass_to_charge=np.full(9, 63.0))
    other = replace(hits, y=np.ones(9))
    before = Explorer(None, hits, file=MeasuredFile("ions.epos"))
    before.ions_of_file.select(IonSelection(ions=(0, 4)))
    for ions, n in ((hits, 4), (other, 9)):
        opened = Explorer(None, ions, file=MeasuredFile("ions.epos"))
        opened.keep_ions(before)
        assert len(opened.measured) == n and np.array_equal(opened.measured.y, ions.y[:n])


def test_the_spectrum_selects_ions(tmp_path, monkeypatch):
    """The crystal and its ions are those of the peaks; a range that is dragged, and ranges that are saved."""
    monkeypatch.chdir(tmp_path)
    rng, n = np.random.default_rng(4), 20_000
    mass = rng.choice([62.93, 64.93, 13.988], n, p=[0.5, 0.22, 0.28]) * rng.normal(1.0, 3e-4, n)
    x, y = rng.normal(size=(2, n)) * 8.0
    hits = ae.Hits(x=x, y=y, mass_to_charge=mass, pulse_id=np.arange(n))
    opened = Opened(Explorer(None, hits, file=MeasuredFile("ions.epos")))
    page, panel = opened.page, opened.page.spectrum
    opened.settle(lambda: panel.named is not None)
    opened.settle(lambda: page.explorer.ions_of_file.selection.element == "Cu" and "Da" in panel.told.text)
    assert page.index.material.value == "Cu" and "--element=Cu" in page.explorer.commands(page.settings()).shell
    copper = (mass > 60).sum()
    opened.settle(lambda: page.maps.measured.ions is not None and page.maps.measured.ions <= copper)
    assert f"{len(page.explorer.measured):,} of {n:,} ions" in panel.told.text
    assert len(panel.ranges.data["left"]) >= 2 and "Cu⁺" in panel.labels.data["label"] and panel.figure.visible
    for place in (62.93, 62.5, 63.4):  # a few pixels beside it
        panel._clicked(SimpleNamespace(x=place))
        assert panel.peak.text.startswith("62.93 Da: Cu⁺") or panel.peak.text.startswith("62.929 Da: Cu⁺")
    text = panel.composition.text
    assert text.index("unexplained: ") < text.index("composition")
    assert len(panel.unexplained.data["x"]) == len(panel.named.unexplained)
    box = {"type": "rect", "x0": 13.0, "x1": 15.0, "y0": 1.0, "y1": 9.0}
    panel._dragged(SimpleNamespace(geometry=box, final=True))
    opened.settle(lambda: len(page.explorer.measured) == (mass < 15).sum() and "13 to 15 Da" in panel.told.text)
    assert panel.choice.value == "ions of a range"
    throttled(panel.slider, (0, 1000))
    opened.settle(lambda: len(page.explorer.measured) == (mass[:1000] < 15).sum())
    panel.choice.value = "all ions"
    opened.settle(lambda: len(page.explorer.measured) == 1000)
    panel._save()
    saved = ae.io.read_ranges("ions.rrng")
    assert "Cu" in saved.species_names and len(saved) == len(panel.named.ranges())
    (tmp_path / "ions.rrng").write_text("mine")
    panel._save()
    assert (tmp_path / "ions.rrng").read_text() == "mine" and panel.save.label == "replace ions.rrng"
    panel._save()
    assert len(ae.io.read_ranges("ions.rrng")) == len(saved)
    page.document.validate()
    page.close()


def boxes_of_labels(panel):
    """Box of each label of the spectrum [px], and the frame."""
    fig, data = panel.figure, panel.labels.data
    wide, high = panel._inner.values()
    x = (np.array(data["x"]) - fig.x_range.start) * wide / (fig.x_range.end - fig.x_range.start)
    y = high * np.log(np.array(data["y"]) / fig.y_range.start) / np.log(fig.y_range.end / fig.y_range.start)
    widths = [_width_of(label) for label in data["label"]]
    return dict(zip(data["label"], zip(x, y, x + widths, y + 17.0, strict=True), strict=True)), (wide, high)


@pytest.mark.slow
def test_labels_of_the_spectrum_are_apart_at_any_zoom(tmp_path, monkeypatch):
    """Those of the largest peaks are there; zoomed, there is a place for all."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(7)
    peaks = {1.0078: 9_000, 2.0157: 6_000, 62.930: 30_000, 64.928: 13_400, 31.465: 3_000, 32.464: 1_340}
    peaks |= {15.995: 900, 18.011: 500, 17.003: 300}
    mass = np.concatenate([at * rng.normal(1, 3e-4, n) for at, n in peaks.items()] + [rng.uniform(0.5, 150, 6_000)])
    x, y = rng.normal(size=(2, len(mass))) * 8.0
    hits = ae.Hits(x=x, y=y, mass_to_charge=mass)
    opened = Opened(Explorer(None, hits, file=MeasuredFile("ions.epos")))
    panel = opened.page.spectrum
    opened.settle(lambda: panel.named is not None)
    names = [ion.name for ion in panel.named.ions if ion.intervals]
    assert {"H⁺", "H₂⁺", "Cu⁺", "Cu²⁺", "O⁺", "H₂O⁺"} <= set(names)

    def check():
        boxes, (wide, high) = boxes_of_labels(panel)
        for number, (left, lower, right, upper) in enumerate(boxes.values()):
            assert left > -0.01 and lower > 0 and right < wide + 0.01 and upper < high + 0.01
            for other in list(boxes.values())[:number]:
                assert (
                    left > other[2] - 0.01
                    or other[0] > right - 0.01
                    or lower > other[3] - 0.01
                    or other[1] > upper - 0.01
                )
        return set(boxes)

    assert {"H⁺", "H₂⁺", "Cu⁺", "Cu²⁺"} <= check()
    panel.figure.x_range.update(start=14.5, end=20.0)
    opened.settle(lambda: not panel._labels_wait)
    assert check() == {"O⁺", "OH⁺", "H₂O⁺"}
    panel._resized("inner_width", 900.0)
    panel.figure.x_range.update(start=0.0, end=70.0)
    opened.settle(lambda: not panel._labels_wait)
    assert check() == set(names)
    opened.page.close()


@pytest.mark.slow
def test_strays_are_counted_as_by_the_shell_and_told_on_the_page(tmp_path, monkeypatch, capfd):
    """A misread signal far outside is one of the ions of the file, not of those that are shown, also in a search."""
    monkeypatch.chdir(tmp_path)
    rng, n = np.random.default_rng(8), 20_000
    radius, azimuth = 20 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    x[7], y[7] = -500.0, 500.0
    mass = rng.choice([62.93, 64.93, 13.988], n, p=[0.5, 0.22, 0.28]) * rng.normal(1.0, 3e-4, n)
    mass[7] = 62.93
    ae.write("ions.epos", ae.Hits(x=x, y=y, mass_to_charge=mass, voltage=np.full(n, 5e3), pulse_id=np.arange(n)))
    with pytest.warns(ae.warnings.DataWarning, match="far outside"):
        explorer, _ = explorer_and_view(make_parser().parse_args(["explore", "ions.epos"]))
    opened = Opened(explorer)
    page, panel = opened.page, opened.page.spectrum
    opened.settle(lambda: panel.named is not None and panel._pending is None and "Da" in panel.told.text)
    shown = re.match(r"([\d,]+) of ([\d,]+) ions", panel.told.text)
    copper = np.count_nonzero(mass > 60) - 1
    assert shown[2] == f"{n - 1:,}" and int(shown[1].replace(",", "")) == pytest.approx(copper, abs=20)
    assert f"<b>ions.epos</b> {shown[1]} ions" in page.summary.facts.text
    assert "far outside the field of view" in page.summary.notes.text and page.summary.notes.visible
    # another process gets no stray, and its warnings are not written to the terminal
    measured = []
    monkeypatch.setattr("apt_evap.explore.index_panel.SearchProcess.call", lambda self, _, arguments, *__: (
        measured.append(arguments[0]), (_ for _ in ()).throw(ValueError("enough")))[0])  # fmt: skip
    page.index._search(page.index.search)
    opened.settle(lambda: bool(measured))
    assert len(measured[0]) == int(shown[1].replace(",", "")) and measured[0].x.min() > -100
    page.close()


@pytest.mark.usefixtures("spectra_once")
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_ranges_name_the_peaks_and_typed_numbers_stay(tmp_path, monkeypatch):
    """Species of a file of ranges are selected as its command selects them; a fitted flight length is only offered."""
    monkeypatch.chdir(tmp_path)
    rng, n = np.random.default_rng(5), 8_000
    mass = rng.choice([62.93, 64.93, 13.988], n, p=[0.5, 0.22, 0.28]) * rng.normal(1.0, 3e-4, n)
    x, y = rng.normal(size=(2, n)) * 8.0
    volts = np.full(n, 5000.0)
    time = np.sqrt(mass / mass_to_charge(volts, np.ones(n), x, y, 90.0))
    ranges = ae.spectra.Ranges(["Cu", "Si"], [62.0, 13.5], [66.0, 14.5], composition=[{"Cu": 1}, {"Si": 1}])
    write_rrng("ions.rrng", ranges)
    hits = ae.Hits(x=x, y=y, voltage=volts, time_of_flight=time, pulse_id=np.arange(n) // 2)
    opened = Opened(Explorer(None, hits, file=MeasuredFile("ions.epos", distance=92.0)))
    page, panel = opened.page, opened.page.spectrum
    opened.settle(lambda: panel.text.text != "naming the peaks" and panel._pending is None)
    assert panel.named is not None, panel.text.text
    fitted = page.explorer.ions_of_file.flight
    assert panel.distance.value == page.explorer.distance == 92.0 and fitted[0] == pytest.approx(90.0, abs=0.5)
    assert panel.use.visible and f"{fitted[0]:g}" in panel.use.label
    panel.file.value = "ions.rrng"
    opened.settle(lambda: panel.named.ranged and panel._pending is None)
    panel.choice.value = "ions of Si"
    opened.settle(lambda: panel._pending is None and page.explorer.ions_of_file.selection.element == "Si")
    assert abs(len(page.explorer.measured) - (mass < 20).sum()) < 20
    assert {"--ranges=ions.rrng", "--species=Si"} <= set(page.explorer.ions_of_file.arguments)
    panel.file.value = ""
    opened.settle(lambda: not panel.named.ranged and panel._pending is None)
    assert not [word for word in page.explorer.ions_of_file.arguments if word.startswith("--species")]
    panel._use_fitted()
    opened.settle(lambda: panel.distance.value == fitted[0] == page.explorer.distance)
    page.correlation._compute()
    opened.settle(lambda: page.correlation.figure.visible)
    counted = np.nansum(page.correlation.pairs.data["image"][0])
    assert counted == pytest.approx(n, rel=0.01)  # n / 2 pairs, at both places
    page.close()


def test_pictures_of_atoms_have_a_scale(shared):
    """A bar in nanometres, of the range in which positions are drawn."""
    panels = shared.page.specimen.view, shared.page.reconstruction.view, shared.page.reconstruction.truth
    for view in panels:
        (bar,) = [model for model in view.figure.below + view.figure.center if model.__class__.__name__ == "ScaleBar"]
        assert bar.unit == "nm" and bar.range is view.figure.x_range


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.AptWarning")
def test_ions_are_reconstructed_beside_the_truth(run):
    """The positions are those of `reconstruct`; the true sites turn with them; errors are told."""
    opened = Opened(Explorer(run))
    page, panel = opened.page, opened.page.reconstruction
    panel._compute()
    opened.settle(lambda: not panel.start.disabled)
    assert panel.result is not None, panel.text.text
    real = run.at_evaporation_field()
    hits = real.hits(page.settings().perturbation)
    expected = ae.reconstruct(hits, **ae.reconstruction.run_constants(real))
    assert np.array_equal(panel.result.positions, expected.positions)
    assert f"{expected.errors().lateral_rms:.2f} nm lateral" in panel.text.text
    shown = np.sort(panel.truth.points.data["z"]) + panel.truth.centre[2]
    assert shown == pytest.approx(np.sort(expected.hits.positions[:, 2]), abs=1e-4)
    assert not panel.depth.visible and len(panel.view.points.data["x"]) == len(expected)
    controls, sites = panel.controls, expected.hits.positions
    placed = expected.fitted_positions(fit=("shift", "rotation"))
    assert not controls.text.text and controls.element.options == ["none", *panel.cloud.elements]
    controls.centre.value, controls.size.value, controls.kind.value = "0.5, 0, 2", 1.0, "sphere"
    inside = [np.count_nonzero(np.linalg.norm(part - (0.5, 0, 2), axis=1) <= 1) for part in (placed, sites)]
    assert [len(view.points.data["x"]) for view in (panel.view, panel.truth)] == inside and min(inside) > 10
    assert f"reconstructed: {inside[0]:,} ions" in controls.text.text
    assert f"true sites: {inside[1]:,} ions" in controls.text.text
    controls.kind.value = "layer"
    assert len(panel.truth.points.data["x"]) == np.count_nonzero(np.abs(sites[:, 2] - 2) <= 0.5)
    controls.centre.value = "here"
    assert "centre must be three numbers" in controls.text.text
    controls.kind.value = "all ions"
    controls.element.value = panel.cloud.elements[0]
    assert "isovalue must be within the fractions" in controls.text.text  # one element: it is everywhere
    controls.element.value = "none"
    assert not controls.text.text
    panel.species.active = []
    page.document.validate()
    panel.shape.value = "evolving"
    panel._compute()
    opened.settle(lambda: not panel.start.disabled)  # too few ions: the cap, or the reason
    assert "cap" in panel.text.text or "ions" in panel.text.text
    page.close()


def test_a_page_made_again_shows_the_run(measured, tmp_path):
    """A run outlives its page, which shows it again and stops it."""
    run = SimpleNamespace(
        active=True, finished=False, message="", ions=50, n_ions=200, seconds_left=20.0, output=tmp_path / "a.h5"
    )
    run.stop = lambda: setattr(run, "message", "stopping")
    state = ServerState()
    state.run = run
    opened = Opened(Explorer(None, measured), state=state)
    panel = opened.page.simulation
    assert "50 of 200 ions, 20 s left" in panel.text.text and panel.start.label == "stop the run"
    panel._start_or_stop()
    panel._progress._update()
    assert "stopping" in panel.text.text
    run.active, run.message = False, "stopped with 60 of 200 ions"
    opened.settle(lambda: "stopped with 60" in panel.text.text)
    assert panel.start.label == "start the run"


def test_a_file_is_opened(measured):
    """A page without files opens one; what cannot be read leaves the page."""
    made = []

    def read(path, document):
        if path == "bad":
            raise ValueError("cannot read 'bad'")
        return lambda: made.append(path)

    opened = Opened(None, opened=read)
    page = opened.page
    page.files.field.value = "bad"
    opened.settle(lambda: "cannot read" in page.summary.notes.text)
    page.files.field.value = "good"
    opened.settle(lambda: made == ["good"])


def test_a_slider_of_the_document_runs_the_callback(shared):
    """The widgets are in the document, where a browser finds them."""
    titles = {each.title for each in shared.page.document.select({"type": Slider})}
    assert {"mean energy [eV]", "smoothing [mm]", "bins"} <= titles


def test_connections_of_strangers_print_no_traceback(run, caplog):
    server, url = serve(Explorer(run))
    own = url.split("/?")[0]

    async def connect(origin, token):
        request = HTTPRequest(own.replace("http", "ws") + "/ws", headers={"Origin": origin})
        try:
            connection = await websocket_connect(request, subprotocols=["bokeh", token])
            assert await connection.read_message() is None  # closed
        except HTTPClientError as error:
            assert error.code == 403

    async def strangers():
        forged = generate_jwt_token(generate_session_id(b"k" * 32, signed=True), signed=True, secret_key=b"k" * 32)
        for origin, token in (("http://other.example", "a"), (own, ""), (own, "a" * 40), (own, forged)):
            await connect(origin, token)

    try:
        server.io_loop.run_sync(strangers)
    finally:
        server.stop()
    assert not [record for record in caplog.records if record.exc_info]


def test_a_page_can_be_loaded_again_after_days():
    """Its token, which the page keeps, is valid as long as anybody has it open; that of Bokeh is for five minutes."""
    server, url = serve(None)
    try:
        text = server.io_loop.run_sync(lambda: AsyncHTTPClient().fetch(url)).body.decode()
    finally:
        server.stop()
    token = re.search(r'"token":"([^"]+)"', text)[1]
    assert get_token_payload(token)["session_expiry"] > time.time() + 7 * 86_400


def test_a_page_behind_a_proxy(caplog):
    """Its scripts are relative to its address, and it is opened under the addresses that are named, and no others."""
    server, url = serve(None, origins=["hub.example.org", "other.example:8000"])
    base = url.split("/?")[0]
    answers = []

    async def visit():
        client = AsyncHTTPClient()
        text = (await client.fetch(url)).body.decode()
        scripts = re.findall(r'src="([^"]*)"', text)
        assert scripts and all(script.startswith("static/") for script in scripts) and '"/static' not in text
        assert (await client.fetch(f"{base}/{scripts[0]}")).code == 200
        token = re.search(r'"token":"([^"]+)"', text)[1]
        for origin in ("https://hub.example.org", "http://other.example:8000", "http://other.example:8001"):
            request = HTTPRequest(base.replace("http", "ws") + "/ws", headers={"Origin": origin})
            try:
                connection = await websocket_connect(request, subprotocols=["bokeh", token])
                answers.append(await connection.read_message() is not None)
                connection.close()
            except HTTPClientError as error:
                answers.append(error.code)

    try:
        server.io_loop.run_sync(visit)
    finally:
        server.stop()
    assert answers == [True, True, 403]
    assert "--allow-origin other.example:8001" in caplog.text


def test_a_port_in_use_is_named():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ValueError, match=rf"port {port} of 127\.0\.0\.1 cannot be used .*: --port names"):
            serve(None, port=port)
