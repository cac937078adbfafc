"""Panel of the registration: its search in another process, a typed one, and the verdict on both maps."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from bokeh.layouts import row
from bokeh.models import Button, Div, TextInput

from apt_evap.emission.perturbations import Perturbation
from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.search_process import SearchProcess, start_thread
from apt_evap.explore.widgets import LEFT, progress_text
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.registration.verdict import Likeness


class _SearchStoppedError(Exception):
    """Error that ends a search whose result is no longer needed."""


class RegistrationPanel:
    """Widgets of the registration."""

    def __init__(
        self,
        explorer: Explorer,
        perturbation: Callable[[], Perturbation],
        registration_of: Callable[[str], Registration] | None,
        request: Callable[[bool], None],
        note: Callable[[str], None],
        later: Callable[[Callable[[], None], int], Any],
        judged: Callable[[ExplorerMaps, Likeness], None],
    ) -> None:
        self._explorer, self._registration_of = explorer, registration_of
        self._request, self._note, self._later, self._judged = request, note, later, judged
        self._process: SearchProcess | None = None
        self._number = 0  # of the search whose result is awaited
        self._progress: tuple[float, float] | None = None  # part that is done, and seconds
        self._maps: ExplorerMaps | None = None
        self.likeness: Any = None
        """The last verdict."""
        self.status = Div()
        self.cancel = Button(label="cancel", width=70, visible=False)
        self.cancel.on_click(self._cancelled)
        half = (LEFT - 20) // 2
        one = Button(label="with this emission", width=half)
        one.on_click(lambda: self.search([perturbation()]))
        several = Button(label="search again", width=half)
        several.on_click(lambda: self.search())
        self.text = TextInput(
            title="degrees, scale, x, y [mm], mirror",
            placeholder="30,0.5,1,-2",
            visible=registration_of is not None,
            width=LEFT - 10,
        )
        self.text.on_change("value", lambda attr, old, new: self._typed())
        self.widgets: list[Any] = [row(several, one), self.text]

    def put(self, maps: ExplorerMaps) -> None:
        """Show the registration of maps, unless they are a preview."""
        self._maps = maps
        if not maps.preview:
            self._put_status()
            if self.text.value != self._current_text():
                self.text.value = self._current_text()

    # ---- the search ------------------------------------------------------------------------------------------------

    def search(self, perturbations: Sequence[Perturbation] | None = None) -> None:
        """Search in another process, which leaves this one to the page; it ends an earlier one."""
        self.close()
        number, start = self._number, time.monotonic()

        def progress(done, of):
            if number != self._number:
                raise _SearchStoppedError
            self._later(partial(self._put_progress, number, start, done, of), 0)

        def work():
            with SearchProcess() as process:
                self._process = process
                with suppress(_SearchStoppedError):
                    self._explorer.register(perturbations, progress, process.call)
            self._later(partial(self._ended, number), 0)

        start_thread(work, lambda sentence: self._later(partial(self._ended, number, sentence), 0))

    def close(self) -> None:
        """End the search."""
        self._number += 1
        if self._process is not None:
            self._process.end()
            self._process = None
        self._progress = None

    def _put_progress(self, number, start, done, of):
        if number != self._number:  # another one has begun
            return
        self._progress = done / of, time.monotonic() - start
        if done >= 1:
            self._request(False)  # the best so far
        self._put_status()

    def _cancelled(self):
        self.close()
        self._put_status()

    def _ended(self, number, sentence=""):
        if number != self._number:  # another one has begun
            return
        self._progress = None
        if sentence:
            self._put_status()
            self._note(sentence)
        else:
            self._request(False)

    # ---- a typed registration --------------------------------------------------------------------------------------

    def _typed(self):
        if self._registration_of is None or self.text.value == self._current_text():
            return
        try:
            registration = self._registration_of(self.text.value)
        except (ValueError, OSError) as error:
            self._note(str(error))
            return
        self.close()
        self._explorer.set_registration(registration)
        self._request(False)

    def _current_text(self):
        registration = self._explorer.registration
        return registration.to_text() if registration is not None and self._explorer.registered else ""

    # ---- the verdict -----------------------------------------------------------------------------------------------

    def compare(self, maps: ExplorerMaps) -> None:
        """Compute the verdict in any thread; it is shown if the maps are still these, and no search goes on."""
        likeness = self._explorer.poles.likeness(maps, self._explorer.registration)
        self._later(partial(self._put_likeness, maps, likeness), 0)

    def _put_likeness(self, maps, likeness):
        if maps is self._maps and self._progress is None:  # the first emission of a search seldom fits
            self.likeness = likeness
            self._judged(maps, likeness)

    def _put_status(self):
        """Show the state of the search."""
        parts = []
        if self._progress is not None:
            parts.append(progress_text(*self._progress, "registering"))
        elif not self._explorer.registered:
            parts.append("<small>not registered</small>")
        self.status.text = " ".join(parts)
        self.cancel.visible = self._progress is not None
