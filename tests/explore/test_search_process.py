"""The process of a search: its results, its errors, and its end, of which the page is told."""

import importlib
import multiprocessing
import operator
import os
import signal
import threading
import time

import numpy as np
import pytest

import apt_evap as ae

pytest.importorskip("bokeh")

from bokeh.document import Document
from bokeh.plotting import figure

from apt_evap.explore import background_run, index_panel
from apt_evap.explore.explorer import Explorer
from apt_evap.explore.index_panel import IndexPanel
from apt_evap.explore.page import Page
from apt_evap.explore.run_panel import RunPanel
from apt_evap.explore.run_progress import ServerState
from apt_evap.explore.search_process import ProcessEnded, SearchProcess

SECONDS = 120  # until a test gives up: the machine may be busy


class Later:
    """Functions that wait for the thread of the page."""

    def __init__(self):
        self.waiting = []

    def __call__(self, function, delay):
        self.waiting.append(function)

    def settle(self, what):
        end = time.monotonic() + SECONDS
        while not (what() and not self.waiting):
            while self.waiting:
                self.waiting.pop(0)()
            assert time.monotonic() < end, "the page does not settle"
            time.sleep(0.01)


def kill_the_child():
    """Kill the process that is started next, as the system does when memory is short."""
    before = {child.pid for child in multiprocessing.active_children()}

    def kill():
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            for child in multiprocessing.active_children():
                if child.pid not in before:
                    os.kill(child.pid, signal.SIGKILL)
                    return
            time.sleep(0.005)

    threading.Thread(target=kill).start()


@pytest.fixture
def measured():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-20, 20, (2, 500))
    return ae.Hits(x=x, y=y).map(32)


def test_a_process_computes_fails_and_ends():
    with SearchProcess() as process:
        assert process.call(sorted, ([3, 1, 2],), {"reverse": True}) == [3, 2, 1]
        with pytest.raises(ValueError, match="ZeroDivisionError"):
            process.call(operator.truediv, (1, 0))
        with pytest.raises(ValueError, match="invalid literal"):
            process.call(int, ("x",))
        assert process.call(abs, (-1,)) == 1  # it goes on
        kill_later = threading.Timer(0.2, lambda: os.kill(process._process.pid, signal.SIGKILL))
        kill_later.start()
        with pytest.raises(ProcessEnded, match="killed"):
            process.call(time.sleep, (SECONDS,))
        with pytest.raises(ProcessEnded):
            process.call(abs, (-1,))


_TOLD = """
def told(result, progress):
    for part in (0.0, 0.5):
        progress(part)
    return result
"""


def test_a_search_tells_its_progress_and_is_cancelled(measured, tmp_path, monkeypatch):
    (tmp_path / "function_of_a_search.py").write_text(_TOLD)
    monkeypatch.syspath_prepend(tmp_path)  # the process that is started finds it there, too
    function = importlib.import_module("function_of_a_search").told
    with SearchProcess() as process:
        told = []
        assert process.call(function, (3,), {}, told.append) == 3 and told == [0.0, 0.5]
    later = Later()
    panel = IndexPanel([figure()], lambda: measured, "Ni", later, lambda text: None)
    panel._search(panel.search)
    assert panel.cancel.visible and 'value="0"' in panel.text.text
    later.settle(lambda: panel._process is not None)
    panel._cancel()
    later.settle(lambda: not panel.search.disabled)
    assert "cancelled" in panel.text.text and not panel.cancel.visible


_WARNS = """
from apt_evap.warnings import DataWarning, warn
def warns():
    warn("odd data", DataWarning)
    return 3
"""


def test_warnings_of_the_process_are_sentences_not_on_the_terminal(tmp_path, monkeypatch, capfd):
    (tmp_path / "function_that_warns.py").write_text(_WARNS)
    monkeypatch.syspath_prepend(tmp_path)
    with SearchProcess() as process:
        assert process.call(importlib.import_module("function_that_warns").warns, ()) == 3
        assert process.notes == ["odd data"]
        assert process.call(abs, (-1,)) == 1 and process.notes == []
    assert "odd data" not in capfd.readouterr().err


def test_a_search_whose_process_is_killed_is_over(measured):
    later = Later()
    panel = IndexPanel([figure()], lambda: measured, "Ni", later, lambda text: None)
    kill_the_child()
    panel._search(panel.search)
    assert panel.search.disabled and panel.refine.disabled
    later.settle(lambda: not panel.search.disabled)
    assert not panel.refine.disabled and panel.search.label == "search" and "killed" in panel.text.text


def test_a_flight_length_bounds_the_scale_of_a_search_unless_one_is_typed(measured, monkeypatch):
    """In the explorer as in the command."""
    called = []

    class Process:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def call(self, function, arguments, options, progress):
            called.append(options)
            raise ValueError("enough")

    monkeypatch.setattr(index_panel, "SearchProcess", Process)
    later = Later()
    panel = IndexPanel([figure()], lambda: measured, "Ni", later, lambda text: None, distance=lambda: 305.0)
    for scale, expected in ((None, {"distance": 305.0}), (50.0, {"scales": (47.5, 52.5)})):
        panel.scale.value = scale
        panel._search(panel.search)
        later.settle(lambda: not panel.search.disabled)
        assert called.pop() == {"poles": [], "lines": []} | expected


def test_any_error_of_a_search_is_told(measured, monkeypatch):
    later = Later()
    panel = IndexPanel([figure()], lambda: measured, "Ni", later, lambda text: None)
    monkeypatch.setattr(index_panel, "index", operator.neg)  # takes other arguments
    panel._search(panel.search)
    later.settle(lambda: not panel.search.disabled)
    assert "TypeError" in panel.text.text


@pytest.mark.slow
def test_a_registration_whose_process_is_killed_is_over(small_tip, measured):
    later = Later()
    run = ae.Simulation(small_tip, seed=1).run(300, progress=False)
    page = Page(Explorer(run, measured, preview=100), Document(), later=later)
    try:
        later.settle(lambda: True)
        kill_the_child()
        page.registration.search()
        later.settle(lambda: "killed" in page.summary.notes.text)
        assert page.registration._progress is None and not page.explorer.registered
    finally:
        page.close()


@pytest.mark.parametrize(
    "error", [TypeError("odd"), RuntimeError("odd"), KeyError("odd"), MemoryError(), OSError("odd")]
)
def test_any_error_of_the_settings_is_told(error, tmp_path):
    def settings(minutes, threads):
        raise error

    later = Later()
    panel = RunPanel(settings, str(tmp_path / "a.toml"), ServerState(), later, lambda text: None)
    panel._write()
    later.settle(lambda: not panel.write.disabled)
    assert "odd" in panel.text.text or "MemoryError" in panel.text.text


@pytest.mark.parametrize(
    "name", ["~nosuchuser/x.toml", "x" * 300 + ".toml", "\0.toml", "\ud800.toml", "/", "no/x.toml"]
)
def test_odd_names_of_a_settings_file_are_told(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    panel = RunPanel(lambda minutes, threads: None, name, ServerState(), Later(), lambda text: None)
    for action in (panel._write, panel._start_or_stop):
        panel.text.text = ""
        action()
        assert panel.text.text and panel._state.run is None
        if name == "no/x.toml":
            break


def test_any_error_of_a_run_is_its_message(monkeypatch, tmp_path):
    """Not only the errors of wrong input; the others were said to be a kill."""

    def fail(path):
        raise RuntimeError("odd")

    monkeypatch.setattr(background_run, "read_config", fail)
    ours, theirs = multiprocessing.Pipe()
    before = signal.getsignal(signal.SIGINT)
    try:
        background_run._simulate(tmp_path / "a.toml", tmp_path / "a.h5", theirs)
    finally:
        signal.signal(signal.SIGINT, before)
    assert "odd" in ours.recv()
