"""The page of the explorer in a document without a browser."""

import re
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rough import ROUGH

import apt_evap as ae
from apt_evap.explore.explorer import Explorer, View

pytest.importorskip("bokeh")

from bokeh.document import Document
from bokeh.models import Slider, Spinner
from bokeh.util.token import generate_jwt_token, generate_session_id
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from apt_evap.cli._files import read_registration
from apt_evap.explore.page import MODES, Page
from apt_evap.explore.run_panel import Workbench
from apt_evap.explore.server import serve

SECONDS = 60  # until a test gives up: the machine may be busy


@pytest.fixture(scope="module")
def run(small_tip, made_once):
    return made_once("explored", lambda: ae.Simulation(small_tip, seed=1, **ROUGH).run(2000, progress=False))


@pytest.fixture(scope="module")
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
        return self.page.shown.view == self.page.view() and self.page.shown.preview == preview


@pytest.fixture
def opened(run, measured):
    opened = Opened(Explorer(run, measured, ae.Registration(0.0, 1.0, (0.0, 0.0)), preview=500))
    yield opened
    opened.page.close()


def _limits(page):
    return [(each.low, each.high) for each in page.colors]


def image(source):
    return source.data["image"][0]


def throttled(slider, value):
    """What a browser sends when a slider is released."""
    slider.value = value
    slider.trigger("value_throttled", None, value)


def test_a_slider_moves_the_map_as_the_core_computes_it(opened):
    page = opened.page
    before = image(page.sources[0]).copy()
    throttled(page.sliders["mean"], 0.33)
    opened.settle(opened.shows)
    shown = page.explorer.show(page.view())
    assert page.view().perturbation == ae.RollUp(ae.TruncatedNormal(0.33, 0.33))
    assert not np.array_equal(image(page.sources[0]), before, equal_nan=True)
    assert np.array_equal(image(page.sources[0]), shown.pictures[0].density.astype(np.float32), equal_nan=True)
    # the whole measured map, relative to the mean where both are compared
    inside, whole = shown.measured.mask, shown.whole.density
    expected = (whole / whole[inside].mean()).astype(np.float32)
    assert np.array_equal(image(page.sources[1]), expected, equal_nan=True)
    assert f"{shown.similarity.value:.3f}" in page.readout.text
    assert page.python.text == page.explorer.commands(page.view()).python
    assert "RollUp:0.33,0.33" in page.shell.text


def test_every_widget_moves_something(opened):
    page = opened.page
    page.mechanism.active = 3  # combined, which has all sliders but one
    opened.settle(opened.shows)
    others = page.sliders["others"]
    widgets = [each for each in page.sliders.values() if each is not others]
    widgets += [page.smoothing, page.flattening, page.bins]
    assert all(each.visible for each in widgets) and len(widgets) >= 6 and not others.visible
    for widget in [*widgets, others]:
        if widget is others:
            page.mechanism.active = 2  # roll-up, by now with a probability of 0.6
            opened.settle(opened.shows)
            assert others.visible
        before, text = image(page.sources[0]).copy(), page.python.text
        throttled(widget, widget.start + 0.6 * (widget.end - widget.start) if widget is not page.bins else 20)
        opened.settle(opened.shows)
        now = image(page.sources[0])
        assert now.shape != before.shape or not np.array_equal(now, before, equal_nan=True), widget.title
        assert page.python.text != text, widget.title
    before = image(page.sources[0]).copy()
    throttled(page.ions, (500, 1500))
    opened.settle(opened.shows)
    assert page.view().ions == (500, 1500) and page.shown.ions == 1000
    assert not np.array_equal(image(page.sources[0]), before, equal_nan=True)
    page.mechanism.active = 0
    opened.settle(opened.shows)
    assert not any(each.visible for each in page.sliders.values())
    assert page.view().perturbation == ae.Unperturbed()


def test_a_preview_is_grey(opened):
    page = opened.page
    opened.settle(lambda: "rings about 111" in page.rings.text or "not here" in page.rings.text)
    page.sliders["mean"].value = 0.4  # still moving
    opened.settle(lambda: opened.shows(preview=True))
    assert page.shown.ions == 500 and "preview" in page.readout.text
    gray = "var(--faint)"
    assert gray in page.readout.text
    page.sliders["mean"].trigger("value_throttled", None, 0.4)
    opened.settle(opened.shows)
    assert (gray not in page.readout.text and "2,000 ions" in page.readout.text) or "of" in page.readout.text


def test_a_preview_sends_only_what_changes(opened):
    page = opened.page
    opened.settle(opened.shows)
    limits, data = _limits(page), [dict(each.data) for each in (*page.sources, page.difference)]
    page.sliders["mean"].value = 0.4
    opened.settle(lambda: opened.shows(preview=True))
    simulated, measured, difference = (*page.sources, page.difference)
    assert simulated.data["image"][0] is not data[0]["image"][0]
    assert measured.data["image"][0] is data[1]["image"][0] and difference.data["image"][0] is data[2]["image"][0]
    assert _limits(page) == limits
    page.sliders["mean"].trigger("value_throttled", None, 0.4)
    opened.settle(opened.shows)
    assert _limits(page) != limits
    page.smoothing.value = 2.0  # changes both maps
    opened.settle(lambda: opened.shows(preview=True))
    assert not np.array_equal(measured.data["image"][0], data[1]["image"][0], equal_nan=True)


def test_overtaken_views_are_not_computed(opened, monkeypatch):
    page = opened.page
    opened.settle(opened.shows)
    views = []
    show = page.explorer.show

    def slow(view, preview=False):
        views.append(view)
        time.sleep(0.05)
        return show(view, preview)

    monkeypatch.setattr(page.explorer, "show", slow)
    for value in np.linspace(0.2, 0.4, 41):
        page.sliders["mean"].value = float(value)
    page.sliders["mean"].trigger("value_throttled", None, 0.4)
    opened.settle(opened.shows)
    assert len(views) < 10  # of 42
    assert views[-1] == page.view() and page.view().perturbation.energy.mean == 0.4


def test_difference_and_blink(opened):
    page = opened.page
    opened.settle(opened.shows)
    first, second = page.shown.pictures
    page.mode.active = MODES.index("difference")
    assert page.difference_image.visible and page.maps[1].title.text == "simulated - measured"
    expected = (first.density - second.density).astype(np.float32)
    assert np.array_equal(image(page.difference), expected, equal_nan=True)
    assert page.difference_colors.low == -page.difference_colors.high < 0
    # the bar beside the difference is its own
    (bar,) = [each for each in page.maps[1].below if getattr(each, "color_mapper", None) and each.visible]
    assert bar.color_mapper is page.difference_image.glyph.color_mapper and bar.title
    assert page.bars[0].visible
    page.mode.active = MODES.index("blink")
    assert not page.difference_image.visible and page.maps[1].title.text == "measured"
    assert page.bars[1].visible and not page.difference_bar.visible
    (callback,) = page.document.session_callbacks
    titles = []
    for _ in range(4):
        callback.callback()
        titles.append(page.maps[0].title.text)
        assert page.blink_image.visible == (titles[-1] == "measured")
    assert titles == ["measured", "simulated"] * 2
    page.mode.active = 0
    assert page.document.session_callbacks == [] and not page.blink_image.visible


def test_linked_maps(opened):
    first, second = opened.page.maps
    assert first.x_range is second.x_range and first.y_range is second.y_range


def test_a_line_gives_profiles(opened):
    page = opened.page
    curve = np.linspace(-20, 20, 30)
    page.line.data = {"xs": [curve.tolist()], "ys": [(curve + np.sin(curve)).tolist()]}  # as a mouse draws
    ends = [[-20, -20 + np.sin(-20)], [20, 20 + np.sin(20)]]
    assert np.allclose(np.transpose([page.line.data["xs"][0], page.line.data["ys"][0]]), ends)  # straight
    rectangle, profiles = page.explorer.profiles(page.shown, ends, page.width.value)
    for source, profile in zip(page.curves, profiles, strict=True):
        assert np.array_equal(source.data["y"], profile.density, equal_nan=True) and len(profile.density) > 3
    assert np.allclose(page.rectangle.data["x"], rectangle.corners[:, 0])
    # a new line takes the place of the old one, and follows the map
    page.line.data = {"xs": [*page.line.data["xs"], [0.0, 1.0, 10.0]], "ys": [*page.line.data["ys"], [0.0, 1.0, 0.0]]}
    assert page.line.data == {"xs": [[0.0, 10.0]], "ys": [[0.0, 0.0]]}
    before = np.array(page.curves[0].data["y"])
    throttled(page.sliders["mean"], 0.5)
    opened.settle(opened.shows)
    assert not np.array_equal(page.curves[0].data["y"], before, equal_nan=True)


def test_a_click_shows_atoms(opened):
    page = opened.page
    page._clicked(page.maps[0], SimpleNamespace(x=5.0, y=-3.0))
    atoms = page.explorer.atoms_at(page.shown.view, 5.0, -3.0, page.radius.value)
    assert len(atoms) > 0 and f"{len(atoms)} atoms land within" in page.specimen.figure.title.text
    view = page.specimen
    assert np.array_equal(view.marked.data["px"] + view.centre[0], atoms.positions[:, 0])
    assert page.click.data == {"x": [5.0], "y": [-3.0], "radius": [page.radius.value]}
    drawn = ae.explore.surface_atoms(page.explorer.run)
    assert np.allclose(view.points.data["z"] + view.centre[2], drawn.positions[:, 2], atol=1e-5)
    before = view.points.data["color"]
    page.color.value = "field"
    assert (view.points.data["color"] != before).any() and "phase" not in dict(page.color.options)
    assert view.colors.high <= page.explorer.run.fields.max()
    for _ in range(2):
        page.side.active = 0
        assert view.points.tags == [0.0, 90.0] and page.side.active is None
        view.points.tags = [10.0, 20.0]  # as a mouse turns it


def test_a_rectangle_gives_commands(opened):
    page = opened.page
    box = {"type": "rect", "x0": -10.0, "x1": 5.0, "y0": 0.0, "y1": 8.0}
    page._selected(SimpleNamespace(geometry=box, final=False))
    assert "window" not in page.python.text
    page._selected(SimpleNamespace(geometry=box, final=True))
    expected = page.explorer.selection(page.shown.view, (-10.0, 5.0), (0.0, 8.0))
    assert page.python.text == expected.python and "no ions" in page.shell.text


def test_a_registration_is_typed(run, measured):
    registration = ae.Registration(0.0, 1.0, (0.0, 0.0))
    opened = Opened(Explorer(run, measured, registration), registration_of=read_registration)
    page = opened.page
    opened.settle(opened.shows)
    assert page.registration.value == "0.0,1.0,0.0,0.0"
    before = image(page.sources[0]).copy()
    page.registration.value = "nonsense"
    assert "--registration must be" in page.notes.text and page.explorer.registration == registration
    page.registration.value = "30,0.9,1,2,mirror"
    assert page.explorer.registration == ae.Registration(30.0, 0.9, (1.0, 2.0), True)
    opened.settle(lambda: not np.array_equal(image(page.sources[0]), before, equal_nan=True))
    assert "--registration=30.0,0.9,1.0,2.0,mirror" in page.shell.text
    page.close()


def test_errors_and_warnings_are_shown(opened):
    page = opened.page
    opened.settle(opened.shows)
    page.sliders["mean"].end = 9.0
    throttled(page.sliders["mean"], 8.0)
    opened.settle(opened.shows)
    assert "launch above the energy limit" in page.notes.text
    page.explorer.set_registration(ae.Registration(0.0, 1.0, (900.0, 0.0)))
    page.ask(preview=False)
    opened.settle(lambda: "hits is in x" in page.notes.text)


def test_one_map_without_a_measurement(run):
    opened = Opened(Explorer(run), view=View(ae.LateralVelocity(0.2), 32, 4.0))
    page = opened.page
    assert len(page.maps) == 1 and not page.mode.visible and page.tool.labels == ["move", "atoms", "line", "box"]
    assert page.mechanism.active == 1 and page.sliders["relative_spread"].value == 0.0
    throttled(page.sliders["mean"], 0.3)
    opened.settle(opened.shows)
    assert "similarity" not in page.readout.text and page.shell.text.startswith("apt-evap map RUN.h5")
    page.document.validate()
    page.close()


def test_a_measurement_alone(measured):
    opened = Opened(Explorer(None, measured, measured_arguments=["map.npz"]))
    page = opened.page
    assert len(page.maps) == 1 and not page.sliders and "atoms" not in page.tool.labels
    assert np.array_equal(image(page.sources[0]), page.shown.whole.density.astype(np.float32), equal_nan=True)
    throttled(page.smoothing, 5.0)
    opened.settle(lambda: page.shown.view.smoothing == 5.0)
    page.line.data = {"xs": [[-20.0, 20.0]], "ys": [[0.0, 1.0]]}
    assert len(page.curves) == 1 and len(page.curves[0].data["y"]) > 3
    assert "map.npz" in page.facts.text and page.chip.text == ""
    page.document.validate()
    page.close()


def test_each_map_has_its_own_scale(opened):
    page = opened.page
    own = _limits(page)
    assert own == [ae.plot.color_limits(each) for each in page.shown.pictures]
    page.same_scale.active = True
    assert _limits(page) == [ae.plot.common_limits(page.shown.pictures)] * 2
    page._reset_display()
    assert _limits(page) == own


def test_what_is_not_compared_is_dimmed(run, measured):
    opened = Opened(Explorer(run, measured, ae.Registration(0.0, 0.5, (5.0, 0.0)), preview=500))
    page = opened.page
    veil, shown = image(page.veil), page.shown
    assert np.array_equal(veil != 0, shown.whole.mask & ~shown.measured.mask) and 0 < (veil != 0).mean() < 1
    assert np.isfinite(image(page.sources[1]))[shown.whole.mask].all()
    before = veil[veil != 0][0]
    page._next_style()
    assert image(page.veil)[veil != 0][0] != before and page.style.label == "dark"
    page.close()


def test_groups_are_reset(opened):
    page = opened.page
    start = page.view()
    for slider in (page.sliders["mean"], page.smoothing, page.bins):
        throttled(slider, slider.start + 0.5 * (slider.end - slider.start) // 1)
    page.mechanism.active, page.ions.value = 1, (300, 900)
    assert page.view() != start
    for reset in (page._reset_emission, page._reset_display, page._reset_ions):
        reset()
    assert page.view() == start
    opened.settle(opened.shows)


def test_a_number_is_typed(opened):
    """The field beside a slider moves it, and the slider the field."""
    (field,) = opened.page.document.select({"type": Spinner, "name": "mean energy [eV]"})
    assert field.value == opened.page.sliders["mean"].value
    (callback,) = field.js_property_callbacks["change:value_throttled"]
    assert callback.args["slider"] is opened.page.sliders["mean"]


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
    assert "not registered" in page.chip.text and "similarity" not in page.readout.text
    page._register(None)
    opened.settle(lambda: "registering" in page.chip.text and "<progress" in page.chip.text)
    throttled(page.sliders["mean"], 0.3)  # the page goes on
    opened.settle(opened.shows)
    go.release()
    opened.settle(lambda: "similarity" in page.readout.text and 'value="1"' in page.chip.text)
    go.release()
    opened.settle(lambda: "progress" not in page.chip.text and page.explorer.registration.score == 0.9)
    opened.settle(lambda: page._verdict is not None and page._verdict.verdict in page.chip.text)
    page._register(None)
    page._stop_search()
    go.release()
    opened.settle(lambda: ended)
    assert page._progress is None and "<progress" not in page.chip.text
    page.close()


def test_poles_are_clicked(measured):
    opened = Opened(Explorer(None, measured))
    page, index = opened.page, opened.page.index
    index.material.value = "Ni"
    orientation, projection = ae.Orientation("Ni", axis=(1, 1, 1)), ae.detection.Projection(60.0)
    page.tool.active = page.tool.labels.index("pole")
    assert page.maps[0].toolbar.active_drag is index.tool
    for plane, family in (((1, 1, 1), "111"), ((0, 0, 2), "200"), ((0, 2, 0), "200"), ((1, 1, 3), "311")):
        index.family.value = family
        direction = np.array(plane) / np.linalg.norm(plane)
        ((x, y),) = projection.places(orientation.directions([direction]))
        page._clicked(page.maps[0], SimpleNamespace(x=float(x), y=float(y)))
    opened.settle(lambda: len(index.read().poles) == 4 and "scale 60.0" in index.text.text)
    best, fitted, _ = index.candidates[0]
    assert fitted.scale == pytest.approx(60.0, rel=1e-6) and "RMS 0.00" in index.text.text
    assert len(index.poles.data["x"]) > 4 and np.isfinite(index.lines.data["x"]).sum() > 20
    names = {}
    exec(page.python.text, names)
    assert np.allclose(names["orientation"].matrix, best.matrix) and names["projection"] == fitted
    index._undo()
    page.tool.active = page.tool.labels.index("zone line")
    page._clicked(page.maps[0], SimpleNamespace(x=1.0, y=2.0))
    marks = index.read()
    assert len(marks.poles) == 3 and marks.lines == [(marks.families.index("311"), [(1.0, 2.0)])]
    index._clear()
    opened.settle(lambda: not index.candidates and len(index.poles.data["x"]) == 0)
    page.close()


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
    opened.settle(lambda: not index.latest._busy)
    assert index.candidates == [] and not any(shown) and len(index.lines.data["x"]) == 0
    for x, y in ((0.0, 0.0), (30.0, 0.0), (0.0, 30.0)):
        index.add(x, y, of_line=False)
    opened.settle(lambda: index.candidates)
    opened.settle(lambda: not index.latest._busy)
    assert len(shown) == 1 and "two poles" not in index.text.text
    # nor is a search, which takes seconds
    index._search(index.search)
    index._clear()
    opened.settle(lambda: not index.search.disabled)
    assert index.candidates == [] and index.search.label == "search"
    opened.page.close()


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


def test_settings_are_written_and_run(measured, tmp_path, monkeypatch):
    """From poles that are clicked to a run that opens; no file is replaced without a second click."""
    monkeypatch.chdir(tmp_path)
    asked = []
    opened = Opened(Explorer(None, measured), opened=lambda path, document: lambda: asked.append(path))
    page, index, panel = opened.page, opened.page.index, opened.page.simulate
    panel._write()
    opened.settle(lambda: not panel.write.disabled)
    assert "index the map first" in panel.text.text and not list(tmp_path.iterdir())
    panel._start_or_stop()
    assert "write the settings first" in panel.text.text
    index.material.value = "Ni"
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
    config = ae.config.read_config(path)
    assert config.tip["material"].name == "Ni" and "not searched" in path.read_text()
    assert page.python.text == path.read_text() and str(path) in panel.text.text
    # fewer ions, for the test
    path.write_text(path.read_text().replace(f"ions = {config.n_ions:_}", "ions = 200"))
    panel._start_or_stop()
    assert panel.start.label == "stop the run"
    opened.settle(lambda: "of 200 ions" in panel.text.text or asked)
    opened.settle(lambda: asked)
    assert asked == [str(tmp_path / "tip.h5")] and len(ae.load(tmp_path / "tip.h5")) == 200
    assert page._bench.near[asked[0]]["start"].shift == index.settings(1.0, 1).near["start"].shift
    assert panel.start.label == "start the run"


def test_a_page_made_again_shows_the_run(measured, tmp_path):
    """A run outlives its page, which shows it again and stops it."""
    run = SimpleNamespace(
        active=True, finished=False, message="", ions=50, n_ions=200, seconds_left=20.0, output=tmp_path / "a.h5"
    )
    run.stop = lambda: setattr(run, "message", "stopping")
    bench = Workbench()
    bench.run = run
    opened = Opened(Explorer(None, measured), bench=bench)
    panel = opened.page.simulate
    assert "50 of 200 ions, 20 s left" in panel.text.text and panel.start.label == "stop the run"
    panel._start_or_stop()
    panel._look()
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
    page.file.value = "bad"
    opened.settle(lambda: "cannot read" in page.notes.text)
    page.file.value = "good"
    opened.settle(lambda: made == ["good"])


def test_a_slider_of_the_document_runs_the_callback(opened):
    """The widgets are in the document, where a browser finds them."""
    titles = {each.title for each in opened.page.document.select({"type": Slider})}
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
