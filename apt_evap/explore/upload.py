"""Files that a browser sends: they are put into the current folder, and replace nothing."""

import os
from functools import partial
from pathlib import Path
from typing import Any

from bokeh.util.token import check_session_id_signature
from tornado.web import HTTPError, RequestHandler, stream_request_body

from apt_evap._common.files import new_file, open_regular
from apt_evap._common.validation import short_text
from apt_evap.explore.start_page import MEASUREMENTS, RANGES, RUNS

_LARGEST = 64 << 30  # bytes
_LONGEST = 200  # bytes of a name: file systems have 255, and the temporary name is longer


class _StoppedError(Exception):
    """Error that ends a file before it is complete."""


@stream_request_body
class UploadHandler(RequestHandler):
    """Handler of ``POST upload?bokeh-session-id=...&name=...``; the answer is the path of the file.

    A file of this name in the folder stays: it is opened if its content is the same, and the request is refused if not.
    """

    def initialize(self, key: bytes) -> None:
        """Take the key of the sessions, which only the holder of the address of the page has."""
        self._key = key
        self._file: Any = None
        self._writing: Any = None
        self._present: Any = None  # a file of this name in the folder, with which the content is compared
        self._refused = ""

    def prepare(self) -> None:
        """Check the request before its content arrives."""
        session = self.get_query_argument("bokeh-session-id", "")
        if not check_session_id_signature(session, secret_key=self._key, signed=True):
            raise HTTPError(403)
        connection: Any = self.request.connection
        connection.set_max_body_size(_LARGEST)
        # as it was sent: Tornado would take control characters and spaces out of it
        name = self.request.query_arguments.get("name", [b""])[-1].decode(errors="replace")
        self._path = Path(name)
        is_plain = name == self._path.name and name not in ("", ".", "..") and "\\" not in name and name.isprintable()
        if not is_plain or len(os.fsencode(name)) > _LONGEST:
            self._refused = f"a dropped file must have a plain name of at most {_LONGEST} bytes, got {short_text(name)}"
        elif self._path.suffix.lower() not in (*RUNS, *MEASUREMENTS, *RANGES):
            known = ", ".join((*MEASUREMENTS, *RUNS, *RANGES))
            self._refused = f"a dropped file must be one of {known}, got {short_text(name)}"
        elif os.path.lexists(self._path):
            self._guarded(self._open_present)
        else:
            self._guarded(self._begin)

    def data_received(self, chunk: bytes) -> None:
        """Write a part of the file."""
        if self._file is not None:
            self._guarded(partial(self._file.write, chunk))
        elif self._present is not None:
            self._guarded(partial(self._compare, chunk))

    def post(self) -> None:
        """Answer when the file is complete."""
        if self._writing is not None:
            self._guarded(partial(self._end, None))
        if self._present is not None:
            self._guarded(partial(self._compare, b""))
        if self._refused:
            self.set_status(409)
            self.finish(self._refused)
            return
        self.finish(str(self._path))

    def on_connection_close(self) -> None:
        """Remove a file that is not complete."""
        self._close_present()
        if self._writing is not None:
            self._guarded(partial(self._end, _StoppedError("the browser has gone")))

    def on_finish(self) -> None:
        """Close what was compared."""
        self._close_present()

    def _open_present(self):
        self._present = open(open_regular(self._path, os.O_RDONLY | getattr(os, "O_BINARY", 0)), "rb")

    def _compare(self, chunk):
        """Refuse a chunk that is not the next one of the file in the folder; an empty one is its end."""
        if self._present.read(len(chunk) or 1) != chunk:
            self._close_present()
            self._refused = (
                f"{short_text(self._path.name)} exists in this folder with another content: rename one of them"
            )

    def _close_present(self):
        present, self._present = self._present, None
        if present is not None:
            present.close()

    def _begin(self):
        self._writing = new_file(self._path)
        self._file = self._writing.__enter__()

    def _end(self, error):
        writing, self._writing, self._file = self._writing, None, None
        writing.__exit__(None if error is None else type(error), error, None)

    def _guarded(self, work):
        """Do a part of the work; after an error nothing is written."""
        try:
            work()
        except (OSError, ValueError, _StoppedError) as error:
            self._refused, self._file = str(error), None
            if self._writing is not None:
                self._guarded(partial(self._end, _StoppedError()))
