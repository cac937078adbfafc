"""The run of a settings file in the background, as the pages of a server show it: progress, a stop, the end."""

from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import Any

from bokeh.models import Button, Div

from apt_evap.explore.background_run import BackgroundRun
from apt_evap.explore.widgets import duration

INTERVAL = 500
"""Time between two updates of the state of the run [ms]."""


class ServerState:
    """State of all pages of a server, which outlives a page that is loaded again."""

    def __init__(self) -> None:
        self.run: BackgroundRun | None = None
        """The run in the background."""
        self.doubt = ""
        """What is not sure about the settings of the run, for the page."""
        self.indexed: dict[str, dict[str, Any]] = {}
        """What `IndexPanel` keeps, for the files of measurements."""


class RunProgress:
    """Shows the run of all pages."""

    def __init__(
        self,
        state: ServerState,
        text: Div,
        buttons: Mapping[Button, str],
        later: Callable[[Callable[[], None], int], Any],
        open_run: Callable[[str], None] | None = None,
    ) -> None:
        self._state, self._text, self._buttons, self._later, self._open_run = state, text, buttons, later, open_run
        self._closed = False
        if state.run is not None:
            self._update()

    def close(self) -> None:
        """Show the run no longer; it goes on."""
        self._closed = True

    @property
    def active(self) -> bool:
        """Whether a run is active."""
        return self._state.run is not None and self._state.run.active

    def stop(self) -> bool:
        """Stop the run; whether there was one (bool)."""
        if not self.active:
            return False
        self._state.run.stop()  # type: ignore[union-attr]
        return True

    def start(self, settings: Path, doubt: str = "") -> None:
        """Start the run of a settings file; its file is beside it; `doubt` is what is not sure about them."""
        self._state.run, self._state.doubt = BackgroundRun(settings, settings.with_suffix(".h5")), doubt
        self._update()

    def _update(self):
        """Show the state of the run, again and again until it ends."""
        run = self._state.run
        if self._closed or run is None:
            return
        active = run.active  # set by another thread
        for button, label in self._buttons.items():
            button.update(label="stop the run" if active else label, visible=active or bool(label))
        if active:
            left = "" if run.seconds_left is None else f", {duration(run.seconds_left)} left"
            state = run.message or f"{run.ions:,} of {run.n_ions:,} ions{left}"
            self._text.text = (
                f'<progress value="{run.ions}" max="{run.n_ions or 1}" style="width: 100%"></progress><br>'
                f"{self._state.doubt}{escape(state)}; {escape(str(run.output))}, opened here at its end"
            )
            self._later(self._update, INTERVAL)
        elif not run.finished:
            self._text.text = escape(run.message)
        else:
            self._state.run = None
            self._text.text = escape(f"{run.output} has all ions: apt-evap explore {run.output}")
            if self._open_run is not None:
                self._open_run(str(run.output))
