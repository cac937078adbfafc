"""The server that shows the page of the explorer to this user on this machine."""

import logging
import secrets
import socket
from collections.abc import Callable, Sequence

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from bokeh.util.token import generate_session_id

from apt_evap.explore.explorer import Explorer, ExplorerSettings
from apt_evap.explore.measured_ions import MeasuredIons
from apt_evap.explore.page import Page
from apt_evap.explore.recent_files import remember_file
from apt_evap.explore.run_progress import ServerState
from apt_evap.explore.start_page import EXAMPLE, RANGES, measurement_of, write_example
from apt_evap.explore.upload import UploadHandler
from apt_evap.maps.registration.register import Registration

_ADDRESS = "127.0.0.1"
_LIFETIME = 30 * 86_400  # s, of the token of a page: without a valid one a page that is loaded again stays empty


class _StrangerFilter(logging.Filter):
    """Filter that drops tracebacks of connections that end before they have a session, as of other web pages."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith("Uncaught exception GET /ws ")


class _OptionFilter(logging.Filter):
    """Filter that names the option of ``apt-evap explore`` for a page under another address, not one of Bokeh."""

    def filter(self, record: logging.LogRecord) -> bool:
        if "--allow-websocket-origin" in str(record.msg) and len(record.args or ()) == 4:
            origin, host, *_ = record.args  # type: ignore[misc]
            record.msg, record.args = "a page under %s is refused; --allow-origin %s permits it", (origin, host)
        return True


# one object of each kind: a logger adds it once
_STRANGER_FILTER, _OPTION_FILTER = _StrangerFilter(), _OptionFilter()
# scripts and styles relative to the address of the page: behind a proxy, it is not at the root of the server
_RELATIVE = """
{% block css_resources %}{{ bokeh_css | replace('"/static/', '"static/') }}{% endblock %}
{% block js_resources %}{{ bokeh_js | replace('"/static/', '"static/') }}{% endblock %}
"""


def serve(
    explorer: Explorer | None,
    settings: ExplorerSettings | None = None,
    *,
    port: int = 0,
    registration_of: Callable[[str], Registration] | None = None,
    with_file: Callable[[str | None], tuple[Explorer | None, ExplorerSettings | None]] | None = None,
    origins: Sequence[str] = (),
) -> tuple[Server, str]:
    """Make the server of a page that only the holder of its address can open, from this machine."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_ADDRESS, port))
        except OSError as error:
            reason = error.strerror
            raise ValueError(f"port {port} of {_ADDRESS} cannot be used ({reason}): --port names another") from error
        port = probe.getsockname()[1]
    state = ServerState()
    shown = explorer, settings  # also after the page is loaded again

    def make(document: Document) -> None:
        document.template = _RELATIVE
        page = Page(shown[0], document, shown[1], registration_of, None if with_file is None else opened, state=state)
        document.on_session_destroyed(lambda _: page.close())

    def opened(path: str | None, document: Document) -> Callable[[], None]:
        """Read a file, in any thread; the function that is returned makes the page again, in that of the document.

        None closes the files.
        """
        nonlocal shown
        assert with_file is not None
        if path == EXAMPLE:
            write_example()
        if path is None:
            shown = with_file(None)
        else:
            show(path)

        def make_again():
            document.clear()
            make(document)

        return make_again

    def show(path):
        nonlocal shown
        before, ranges = shown[0], path if path.lower().endswith(RANGES) else None
        if ranges is None or before is None or not isinstance(before.ions_of_file, MeasuredIons):
            path = path if ranges is None else measurement_of(path)
            shown = with_file(path)
            remember_file(path)
            if before is not None and shown[0] is not None and shown[0].names[1] != path:
                shown[0].keep_ions(before)
        if ranges is not None and shown[0] is not None and isinstance(shown[0].ions_of_file, MeasuredIons):
            shown[0].ions_of_file.ranges = ranges

    logging.getLogger("tornado.application").addFilter(_STRANGER_FILTER)
    logging.getLogger("bokeh.server.views.ws").addFilter(_OPTION_FILTER)
    key = secrets.token_bytes(32)  # other users of this machine reach 127.0.0.1, too
    server = Server(
        {"/": Application(FunctionHandler(make))},
        port=port,
        address=_ADDRESS,
        secret_key=key,
        extra_patterns=[("/upload", UploadHandler, {"key": key})],
        sign_sessions=True,
        generate_session_ids=False,
        session_token_expiration=_LIFETIME,
        allow_websocket_origin=[f"{_ADDRESS}:{port}", f"localhost:{port}", *origins],
    )
    server.start()
    return server, f"http://{_ADDRESS}:{port}/?bokeh-session-id={generate_session_id(key, signed=True)}"
