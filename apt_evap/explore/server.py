"""The server that shows the page of the explorer to this user on this machine."""

import logging
import secrets
import socket
from collections.abc import Callable

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from bokeh.util.token import generate_session_id

from apt_evap.explore.explorer import Explorer, View
from apt_evap.explore.page import Page
from apt_evap.explore.run_panel import Workbench
from apt_evap.registration.register import Registration

_ADDRESS = "127.0.0.1"


class _WithoutStrangers(logging.Filter):
    """Leaves out the tracebacks of connections that end before they belong to a session, as of other web pages."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith("Uncaught exception GET /ws ")


_WITHOUT_STRANGERS = _WithoutStrangers()  # one object: a logger takes it once


def serve(
    explorer: Explorer | None,
    view: View | None = None,
    *,
    port: int = 0,
    registration_of: Callable[[str], Registration] | None = None,
    with_file: Callable[[str], tuple[Explorer | None, View | None]] | None = None,
) -> tuple[Server, str]:
    """Make the server of a page that only the holder of its address can open, from this machine.

    Parameters
    ----------
    explorer : Explorer or None
        Computes all numbers; None to open files on the page.
    view : View, optional
        What is shown first.
    port : int
        Port on 127.0.0.1; 0 for a free one.
    registration_of : callable, optional
        As for `Page`.
    with_file : callable, optional
        Reads one more file, from its path, and returns the explorer and the view that show it.

    Returns
    -------
    server : bokeh.server.server.Server
        Its ``io_loop.start()`` serves the page.
    url : str
        Address with a signed session.

    Raises
    ------
    OSError
        If the port is in use.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((_ADDRESS, port))
        port = probe.getsockname()[1]
    bench = Workbench()
    shown = explorer, view  # also after the page is loaded again

    def make(document: Document) -> None:
        page = Page(shown[0], document, shown[1], registration_of, None if with_file is None else opened, bench=bench)
        document.on_session_destroyed(lambda _: page.close())

    def opened(path: str, document: Document) -> Callable[[], None]:
        """Read a file, in any thread; the function that is returned makes the page again, in that of the document."""
        nonlocal shown
        assert with_file is not None
        shown = with_file(path)
        if shown[0] is not None:
            shown[0].near = bench.near.get(path, {})

        def again():
            document.clear()
            make(document)

        return again

    logging.getLogger("tornado.application").addFilter(_WITHOUT_STRANGERS)
    key = secrets.token_bytes(32)  # other users of this machine reach 127.0.0.1, too
    server = Server(
        {"/": Application(FunctionHandler(make))},
        port=port,
        address=_ADDRESS,
        secret_key=key,
        sign_sessions=True,
        generate_session_ids=False,
        allow_websocket_origin=[f"{_ADDRESS}:{port}", f"localhost:{port}"],
    )
    server.start()
    return server, f"http://{_ADDRESS}:{port}/?bokeh-session-id={generate_session_id(key, signed=True)}"
