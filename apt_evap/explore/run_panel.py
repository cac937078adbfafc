"""Group of the page that writes the settings of a simulation of the measured specimen, and runs it."""

import itertools
import os
from collections.abc import Callable
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import Button, Div, NumericInput, TextInput

from apt_evap._common.files import check_path
from apt_evap._common.threads import thread_count
from apt_evap._common.validation import short_text
from apt_evap.explore.run_progress import RunProgress, ServerState
from apt_evap.explore.search_process import guarded, start_thread
from apt_evap.explore.widgets import LEFT, group
from apt_evap.fit.start_settings import StartSettings

_SIMULATE = "simulate this specimen"


class RunPanel:
    """Widgets that write the settings file, and start and stop its run."""

    def __init__(
        self,
        settings: Callable[[float, int], StartSettings],
        name: str,
        state: ServerState,
        later: Callable[[Callable[[], None], int], Any],
        put_code: Callable[[str], None],
        open_run: Callable[[str], None] | None = None,
        search_before: Callable[[Callable[[], None]], None] | None = None,
    ) -> None:
        self._settings, self._state, self._later = settings, state, later
        self._put_code = put_code
        self._search_before = search_before or (lambda then: then())
        self._confirmed = ""  # the file whose replacement was asked for
        self._doubtful: Path | None = None  # settings of a map that is not decided
        half = (LEFT - 20) // 2
        self.file = TextInput(title="settings file", value=name, width=half)
        self.minutes = NumericInput(title="minutes of the run", value=10.0, mode="float", low=0.1, width=half)
        self.write = Button(label="write settings", width=half)
        self.start = Button(label="start the run", width=half)
        self.simulate = Button(label=_SIMULATE, button_type="primary", width=LEFT - 10)
        self.simulate.on_click(self._simulate_or_stop)
        self.text = Div(width=LEFT - 10, text="as the chosen candidate says; without one, it is searched first")
        self.file.on_change("value", lambda attr, old, new: self._forget_confirmation())
        self.write.on_click(self._write)
        self.start.on_click(self._start_or_stop)
        further = group("more", [row(self.file, self.minutes), row(self.write, self.start)], active=False)
        self.column = column(self.simulate, self.text, further)
        labels = {self.start: "start the run", self.simulate: _SIMULATE}
        self._progress = RunProgress(state, self.text, labels, later, open_run)

    def close(self) -> None:
        """Show the run no longer; it goes on."""
        self._progress.close()

    @property
    def path(self) -> Path:
        """Settings file; ValueError if no file can have this name."""
        name = self.file.value.strip() or "specimen.toml"
        try:
            path = Path(name).expanduser().absolute()
            os.fsencode(path)
        except (RuntimeError, ValueError) as error:  # no such user, no such character
            raise ValueError(f"the settings file must have the name of a file, got {short_text(name)}") from error
        return check_path(path)

    def _forget_confirmation(self):
        self._confirmed = ""
        self.write.label = "write settings"

    def _show(self, text):
        self.text.text = escape(text)

    def _write(self):
        guarded(self._write_settings, self._show)()

    def _write_settings(self):
        path = self.path
        if path.suffix.lower() != ".toml":
            self._show(f"a settings file ends in .toml, got {short_text(self.file.value)}")
            return
        if path.exists() and self._confirmed != str(path):
            self._confirmed, self.write.label = str(path), f"replace {path.name}"
            self._show(f"{path} exists: click again to replace it, or give another name")
            return
        self._forget_confirmation()
        self.write.disabled = True
        self._show("making the settings")
        minutes = self.minutes.value or 10.0

        def work():
            made = self._settings(minutes, thread_count())
            made.save(path)
            self._later(partial(self._written, f"wrote {path}: {made.cost}", made), 0)

        start_thread(work, lambda sentence: self._later(partial(self._written, sentence), 0))

    def _written(self, text, made=None):
        self.write.disabled = False
        self._show(text)
        if made is not None:
            self._put_code(made.text)

    def _simulate_or_stop(self):
        guarded(self._simulate_specimen, self._show)()

    def _simulate_specimen(self):
        """Write settings to a new file and start their run, or stop the run."""
        if self._progress.stop():
            return
        path = self.path.with_suffix(".toml")
        self.simulate.disabled = True
        self._show("searching for the orientation")
        self._search_before(partial(self._make_and_start, path))

    def _make_and_start(self, path):
        self._show("making the settings")
        minutes = self.minutes.value or 10.0

        def work():
            made = self._settings(minutes, thread_count())
            free = _free_path(path, made.text)
            made.save(free)
            self._later(partial(self._made, made, free), 0)

        start_thread(work, lambda sentence: self._later(partial(self._not_made, sentence), 0))

    def _not_made(self, sentence):
        self.simulate.disabled = False
        self._show(sentence)

    def _made(self, made, path):
        self.simulate.disabled = False
        self.file.value = str(path)
        self._written(f"wrote {path}: {made.cost}", made)
        self._doubtful = None if made.indexing.decided else path
        self._start_or_stop()

    def _start_or_stop(self):
        guarded(self._start_or_stop_run, self._show)()

    def _start_or_stop_run(self):
        if self._progress.stop():
            return
        path = self.path
        if not path.is_file():
            self._show(f"{path} does not exist yet: write the settings first")
            return
        self._progress.start(path, "not decided: this is the first candidate; " if path == self._doubtful else "")


def _free_path(path: Path, text: str) -> Path:
    """The path, with a number if it, or its run, exists and is not of these settings."""
    for number in itertools.count(2):
        if path.is_file() and path.read_bytes() == text.encode():
            return path
        if not any(path.with_suffix(suffix).exists() for suffix in (".toml", ".h5", ".h5.unfinished")):
            return path
        path = path.with_stem(f"{path.stem.removesuffix(f'_{number - 1}')}_{number}")
    raise AssertionError("unreachable")
