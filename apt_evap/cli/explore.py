"""`apt-evap explore`: maps in the browser, of a run for any emission, of a measurement, or of both."""

import argparse
import contextlib
import os
import re
import sys
import tempfile
import webbrowser
from collections.abc import Iterator
from functools import partial
from html import escape

from apt_evap.cli._options import (
    MAX_BINS,
    add_flight,
    add_peaks,
    add_reading,
    add_real_units,
    bounds_type,
    integer_type,
    number_type,
)
from apt_evap.cli._output import put, say


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Show the map of a run in the browser, with sliders for the emission, a measured map, or both.\n"
        "Files can also be opened on the page. Needs the extra of the package: pip install 'apt_evap[explore]'. The\n"
        "page is served to this machine only, under an address that is printed. Ctrl-C ends the explorer. On it,\n"
        "buttons copy a command or Python lines that give the same maps."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap explore\n"
        "  apt-evap explore W_tap.raw\n"
        "  apt-evap explore ni111.h5\n"
        "  apt-evap explore ni111.h5 R5083.epos --mass 27,29 --registration R5083_study/study.json"
    )
    parser.add_argument("run", metavar="RUN.h5", nargs="?", help="a run; with responses for any emission")
    parser.add_argument("file", metavar="MEASURED", nargs="?", help="measured ions (.epos, ...) or a map (.npz)")
    parser.add_argument(
        "--registration",
        metavar="R",
        help="a JSON file (such as study.json) or ROTATION,SCALE,DX,DY[,mirror] in degrees and mm; default: search",
    )
    parser.add_argument("--perturbation", metavar="P", help="at the start, as for map; default: RollUp:0.155,0.155")
    parser.add_argument("--bins", type=integer_type(11, MAX_BINS), metavar="N", help="bins along the longer side")
    parser.add_argument("--smooth", type=number_type("mm"), metavar="MM", help="sigma of a Gaussian; default: one bin")
    parser.add_argument("--flatten", type=number_type("mm"), metavar="MM", help="sigma for flattening; default: none")
    parser.add_argument("--simulated", type=bounds_type, metavar="FIRST,LAST", help="ions of the run; default: all")
    add_flight(parser)
    add_peaks(parser)
    parser.add_argument("--port", type=integer_type(0, 65535), default=0, metavar="N", help="default: a free one")
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")
    parser.add_argument(
        "--allow-origin",
        type=_origin,
        action="append",
        default=[],
        metavar="HOST:PORT",
        help="address under which the browser sees the page, if it is another one, as behind a proxy; repeatable",
    )
    add_real_units(parser)
    add_reading(parser)


def _origin(text):
    """Host and port of an address; a browser leaves the usual port of the protocol out, and Bokeh then takes 80."""
    match = re.fullmatch(r"([A-Za-z0-9._-]+)(:\d{1,5})?", text)
    if match is None or int((match[2] or ":80")[1:]) > 65535:
        raise argparse.ArgumentTypeError(f"must be HOST or HOST:PORT, such as hub.example.org, got {text!r:.80}")
    return text.lower()


def execute(options: argparse.Namespace) -> int:
    """Run the command: serve the page until Ctrl-C."""
    from apt_evap._common.optional_imports import optional_import
    from apt_evap.cli._explorer_of_files import explorer_and_view, with_file
    from apt_evap.cli._files import read_registration

    try:
        optional_import("bokeh.server.server", "explore")
    except ImportError as error:
        raise ValueError("explore needs bokeh, which is not installed: pip install 'apt_evap[explore]'") from error
    from apt_evap.explore.server import serve  # needs Bokeh

    explorer, view = explorer_and_view(options)
    server, url = serve(
        explorer,
        view,
        port=options.port,
        registration_of=read_registration,
        with_file=partial(with_file, options),
        origins=options.allow_origin,
    )
    put(url)
    say("note", "open this address in a browser on this machine; Ctrl-C ends the explorer")
    with _opened(url) if options.browser else contextlib.nullcontext(), contextlib.suppress(KeyboardInterrupt):
        server.io_loop.start()
    return 0


@contextlib.contextmanager
def _opened(url: str) -> Iterator[None]:
    """Open the page in a graphical browser, if there is one.

    The browser gets a file that leads to the page. The address itself would be in the list of processes, where other
    users of this machine could read it.
    """
    if sys.platform != "darwin" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        yield
        return
    with tempfile.NamedTemporaryFile("w", suffix=".html") as file:  # readable by its owner only
        file.write(f'<meta charset="utf-8"><meta http-equiv="refresh" content="0; url={escape(url)}">')
        file.flush()
        webbrowser.open(f"file://{file.name}")
        yield
