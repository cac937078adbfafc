"""Panel of the files: a field that opens a run or a measurement."""

from collections.abc import Callable
from functools import partial
from typing import Any

from bokeh.models import AutocompleteInput, TextInput

from apt_evap.explore.dropped_file import DROPPED
from apt_evap.explore.search_process import start_thread
from apt_evap.explore.start_page import files_to_open
from apt_evap.explore.widgets import LEFT

_MOST_FILES = 300  # that are proposed


class FilePanel:
    """Field for the path of a file."""

    def __init__(
        self,
        read: Callable[[str | None], Callable[[], None]] | None,
        close: Callable[[], None],
        note: Callable[[str], None],
        later: Callable[[Callable[[], None], int], Any],
    ) -> None:
        self._read, self._close, self._note, self._later = read, close, note, later
        self.field = AutocompleteInput(
            placeholder="open a file: a run or a measurement",
            completions=[] if read is None else files_to_open()[:_MOST_FILES],
            restrict=False,
            case_sensitive=False,
            search_strategy="includes",
            min_characters=1,
            width=LEFT - 10,
            visible=read is not None,
        )
        self.field.on_change("value", lambda attr, old, new: self._named())
        self.dropped = TextInput(visible=False, name=DROPPED)
        self.dropped.on_change("value", lambda attr, old, new: self._open_dropped(new))

    def close_all(self) -> None:
        """Go back to the page without a file."""
        self._open(None)

    def open(self, path: str) -> None:
        """Read a file in a thread, and make the page again; only what cannot be read leaves the page."""
        self._note(f"reading {path}")
        self._open(path)

    def _open(self, path):
        assert self._read is not None
        read = self._read

        def work():
            make_page = read(path)

            def make_again():
                self._close()
                make_page()

            self._later(make_again, 0)

        start_thread(work, lambda sentence: self._later(partial(self._note, sentence), 0))

    def _open_dropped(self, path):
        if path:  # "" comes before the same path again
            self.open(path)

    def _named(self):
        if self._read is not None and (path := self.field.value.strip()):
            self.open(path)
