"""The start page of the explorer: files of the folder, files that were opened last, an example, and a dropped file."""

import time
from asyncio import sleep
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest

import apt_evap as ae

pytest.importorskip("bokeh")

from bokeh.document import Document
from bokeh.events import ButtonClick
from bokeh.util.token import generate_session_id
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest

from apt_evap.cli._explorer_of_files import explorer_and_view, with_file
from apt_evap.cli.parser import make_parser
from apt_evap.explore.explorer import Explorer
from apt_evap.explore.page import Page
from apt_evap.explore.recent_files import recent_files, remember_file
from apt_evap.explore.run_progress import ServerState
from apt_evap.explore.server import serve
from apt_evap.explore.start_page import EXAMPLE, StartPage, measurement_of, ranges_near, write_example


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.epos", "b.raw", "run.h5", "notes.txt", "w.toml"):
        (tmp_path / name).write_bytes(b"12345")
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "ni.toml").write_text('[tip]\nmaterial = "Ni"\n[simulation]\nions = 10\n')
    (tmp_path / "study.toml").write_text("[study]\n[tip]\n")
    (tmp_path / "inside" / "c.npz").write_bytes(b"1")
    (tmp_path / "folder.epos").mkdir()
    return tmp_path


def test_the_files_of_the_folder_are_opened(folder):
    asked = []
    remember_file("b.raw")
    remember_file("gone.raw")
    start = StartPage(asked.append, ServerState(), lambda function, delay: None)
    names = ["a.epos", "b.raw", "inside/c.npz", "run.h5", "inside/ni.toml", str(folder / "b.raw"), EXAMPLE]
    assert [Path(name) for name in start.buttons] == [Path(name) for name in names]
    names = [name for name in start.buttons if not name.endswith(".toml")]
    for name in names:
        start.buttons[name]._trigger_event(ButtonClick(start.buttons[name]))
    assert asked == names
    page = Page(None, Document(), opened=lambda path, document: lambda: None)
    assert set(page.start.buttons) == set(start.buttons)
    page.document.validate()
    page.close()


def test_the_start_page_is_a_click_away(folder):
    """Files that were open are closed: the next one is shown alone."""
    write_example()
    options = make_parser().parse_args(["explore", EXAMPLE, "--element", "Ni"])
    explorer, _ = explorer_and_view(options)
    asked, done = [], []

    def opened(path, document):
        asked.append(path)
        return lambda: done.append(with_file(options, path))

    page = Page(explorer, Document(), opened=opened, later=lambda function, delay: function())
    assert page.back.visible and not Page(None, Document(), opened=opened).back.visible
    page.back._trigger_event(ButtonClick(page.back))
    end = time.monotonic() + 60
    while not done and time.monotonic() < end:
        time.sleep(0.01)
    assert asked == [None] and done == [(None, None)] and options.run is None and options.file is None
    again, _ = with_file(options, EXAMPLE)
    assert again.run is None and again.names[1] == EXAMPLE


def test_settings_of_the_folder_are_run(folder, monkeypatch):
    """A click starts the run of a settings file; its run is opened at its end, another one waits until then."""
    runs, calls, asked = [], [], []

    class Run:
        def __init__(self, settings, output):
            self.active, self.finished, self.message, self.ions, self.n_ions = True, False, "", 5, 10
            self.seconds_left, self.output = None, output
            runs.append((settings, output))

    monkeypatch.setattr("apt_evap.explore.run_progress.BackgroundRun", Run)
    state = ServerState()
    state.doubt = "not decided"  # of an earlier run of other settings
    start = StartPage(asked.append, state, lambda function, delay: calls.append(function))
    (button,) = (button for path, button in start.buttons.items() if path.endswith(".toml"))
    for _ in range(2):
        button._trigger_event(ButtonClick(button))
    assert runs == [(folder / "inside" / "ni.toml", folder / "inside" / "ni.h5")]
    assert "active" in start.text.text and start.stop.visible
    calls.pop()()
    assert "5 of 10 ions" in start.text.text and "not decided" not in start.text.text
    state.run.active, state.run.finished = False, True
    calls.pop()()
    assert asked == [str(folder / "inside" / "ni.h5")] and not start.stop.visible


@pytest.mark.parametrize("page_of", [lambda **more: None, lambda **more: Explorer(None, ae.Hits(**more))])
def test_a_file_can_be_dropped_on_every_page(folder, page_of):
    asked = []
    explorer = page_of(x=np.arange(9.0), y=np.arange(9.0) ** 2)
    page = Page(explorer, Document(), opened=lambda path, document: asked.append(path) or (lambda: None))
    page.document.get_model_by_name("dropped").value = "d.epos"
    for _ in range(100):
        if asked:
            break
        time.sleep(0.05)
    assert asked == ["d.epos"]
    assert page.document.get_model_by_name("told of a dropped file") is not None
    page.close()


def test_ranges_are_shown_with_their_measurement(folder):
    (folder / "a.rrng").write_text("ranges")
    (folder / "z.RNG").write_text("ranges")
    start = StartPage(lambda path: None, ServerState(), lambda function, delay: None)
    assert {"a.rrng", "z.RNG"} <= set(start.buttons)
    assert measurement_of("a.rrng") == "a.epos" and ranges_near("z.epos") == ["z.RNG", "a.rrng"]
    (folder / "b.pos").write_bytes(b"")
    with pytest.raises(ValueError, match="first"):
        measurement_of("z.RNG")


def test_files_that_were_opened_last(folder, state_folder):
    for number in range(10):
        remember_file(f"{number}.epos")
    remember_file("8.epos")
    remember_file("two\nlines.epos")
    names = [Path(path).name for path in recent_files()]
    assert names == ["8.epos", "9.epos", *(f"{number}.epos" for number in range(7, 1, -1))]
    assert all(Path(path).parent == folder for path in recent_files())
    (state_folder / "apt_evap" / "recent_files.txt").write_bytes(b"\xff\xfe\x00")
    assert recent_files() == []
    (state_folder / "apt_evap" / "recent_files.txt").unlink()
    (state_folder / "apt_evap").rmdir()
    (state_folder / "apt_evap").write_text("a file")
    remember_file("a.epos")  # cannot be written
    assert recent_files() == []


def test_the_example_is_a_map(folder):
    write_example()
    counts = ae.io.read_map(EXAMPLE)
    assert not counts.mask.all() and counts.is_counts and abs(counts.values.sum() - 80_000) < 1_500
    (folder / EXAMPLE).write_text("mine")
    write_example()
    assert (folder / EXAMPLE).read_text() == "mine"


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_a_dropped_file_is_put_into_the_folder(folder):
    """Only by the holder of the address, only what can be opened, nowhere else, and in the place of no other file."""
    server, url = serve(None, with_file=lambda path: (None, None))
    base, session = url.split("/?bokeh-session-id=")
    forged = generate_session_id(b"k" * 32, signed=True)
    answers = []

    async def send(name, content=b"abcdefg", session=session):
        query = urlencode({"bokeh-session-id": session, "name": name})
        request = HTTPRequest(f"{base}/upload?{query}", method="POST", body=content)
        try:
            answer = await AsyncHTTPClient().fetch(request)
        except HTTPClientError as error:
            answer = error.response
        answers.append((answer.code, answer.body.decode()))

    async def visit():
        await send("new.epos", b"x" * 3_000_000)
        await send("a.epos", b"12345")
        for other in (b"54321", b"1234567", b"1234"):
            await send("a.epos", other)
        for name in ("../up.epos", "/tmp/up.epos", "..", "inside/up.epos", "c\\up.epos", "notes.md", ""):
            await send(name)
        await send("forged.epos", session=forged)
        await send("stranger.epos", session="")

    before = {path.name for path in folder.iterdir()}
    try:
        server.io_loop.run_sync(visit)
    finally:
        server.stop()
    assert answers[0] == (200, "new.epos") and (folder / "new.epos").read_bytes() == b"x" * 3_000_000
    assert answers[1] == (200, "a.epos") and (folder / "a.epos").read_bytes() == b"12345"
    assert all(code == 409 and "another content" in text for code, text in answers[2:5])
    assert [code for code, _ in answers[5:12]] == [409] * 7 and all("must" in text for _, text in answers[5:12])
    assert [code for code, _ in answers[12:]] == [403, 403]
    assert {path.name for path in folder.iterdir()} == before | {"new.epos"}
    assert not (folder.parent / "up.epos").exists() and not (folder / "inside" / "up.epos").exists()


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_a_dropped_file_replaces_none_that_appears_meanwhile(folder):
    """Nor the one of a second drop of this name; names that no file can have, or that a link has, are refused."""
    server, url = serve(None, with_file=lambda path: (None, None))
    base, session = url.split("/?bokeh-session-id=")
    (folder / "link.epos").symlink_to(folder / "nowhere.epos")
    answers = []

    async def send(name, between=None):
        async def body(write):
            await write(b"A" * 220)
            if between is not None:
                await between()
            await write(b"A" * 220)

        query = urlencode({"bokeh-session-id": session, "name": name})
        headers = {"Content-Length": "440"}
        request = HTTPRequest(f"{base}/upload?{query}", method="POST", body_producer=body, headers=headers)
        try:
            answer = await AsyncHTTPClient().fetch(request)
        except HTTPClientError as error:
            answer = error.response
        answers.append((answer.code, answer.body.decode()))

    async def appear():
        await sleep(0.2)  # the first half has arrived
        (folder / "mine.epos").write_bytes(b"MINE")

    async def visit():
        await send("mine.epos", appear)
        await send("twice.epos", lambda: send("twice.epos"))
        for name in ("a" * 300 + ".epos", "ä" * 130 + ".epos", "a\nb.epos", "a\0b.epos", "link.epos"):
            await send(name)

    try:
        server.io_loop.run_sync(visit)
    finally:
        server.stop()
    assert answers[0][0] == 409 and "exists" in answers[0][1] and (folder / "mine.epos").read_bytes() == b"MINE"
    assert [code for code, _ in answers[1:3]] == [200, 409] and (folder / "twice.epos").read_bytes() == b"A" * 440
    assert [code for code, _ in answers[3:]] == [409] * 5
    assert all(text and "Traceback" not in text and len(text.splitlines()) == 1 for _, text in answers[3:])
    assert not (folder / "nowhere.epos").exists()
    assert not [path.name for path in folder.iterdir() if path.name.endswith(".part")]
