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
from typing import Any

from apt_evap._common.codec import to_python
from apt_evap._common.optional_imports import optional_import
from apt_evap.cli._files import in_real_units, ions_of_map, lens_of, read, read_registration
from apt_evap.cli._options import add_reading, add_real_units, bounds_type, integer_type, number_type
from apt_evap.cli._output import put, say
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.explore.controls import values_of
from apt_evap.explore.explorer import Explorer, View
from apt_evap.io.formats import read as read_file
from apt_evap.simulation.run import Run, load


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
    parser.add_argument("run", metavar="RUN.h5", nargs="?", help="a run with responses")
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
        with_file=partial(_with_file, options),
        origins=options.allow_origin,
    )
    put(url)
    say("note", "open this address in a browser on this machine; Ctrl-C ends the explorer")
    with _opened(url) if options.browser else contextlib.nullcontext(), contextlib.suppress(KeyboardInterrupt):
        server.io_loop.start()
    return 0


def _with_file(options, path):
    """Explorer and view with one more file: a run replaces the run, anything else the measurement."""
    changes: dict[str, Any] = {"registration": None, "simulated": None}
    if _run_in(path) is not None:
        changes["run"] = path
    else:
        changes |= dict.fromkeys((*_READING, *_SELECTION, *_OTHERS)) | {"file": path}
    fresh = argparse.Namespace(**(vars(options) | changes))
    found = explorer_and_view(fresh)
    vars(options).update(vars(fresh))  # only if both files are good
    return found


def _run_in(path):
    """The run of a file, None if it contains something else."""
    if path.endswith(".unfinished"):
        return load(path)
    content = read_file(path) if path.lower().endswith(".h5") else None
    return content if isinstance(content, Run) else None


def explorer_and_view(options: argparse.Namespace) -> tuple[Explorer | None, View | None]:
    """Explorer of the files of the command, and the view of its options; None without a file.

    Parameters
    ----------
    options : argparse.Namespace
        Parsed arguments.

    Returns
    -------
    explorer : Explorer
    view : View

    Raises
    ------
    ValueError
        If an option or a file is invalid.
    """
    run = None if options.run is None else _run_in(options.run)
    if options.run is not None and run is None:
        if options.file is not None:
            raise ValueError(f"RUN must be a run, {options.run!r} contains something else")
        options.run, options.file = None, options.run
    if run is not None:
        run.require_responses(repr(options.run))
        run = in_real_units(run, options)
    measured = None if options.file is None else _measured(options)
    registration = None
    if options.registration is not None:
        if measured is None or run is None:
            raise ValueError("--registration needs RUN and MEASURED")
        registration = read_registration(options.registration)
    perturbation = None if options.perturbation is None else read_perturbation(options.perturbation)
    if perturbation is not None:
        values_of(perturbation)
    if run is None and measured is None:
        return None, None
    explorer = Explorer(
        run,
        measured,
        registration,
        run_code="None" if run is None else _run_code(options),
        measured_code="None" if options.file is None else _measured_code(options),
        run_arguments=[] if run is None else _run_arguments(options),
        measured_arguments=[] if options.file is None else _measured_arguments(options),
    )
    start = explorer.start
    bins = options.bins or start.bins
    view = View(
        perturbation=perturbation or start.perturbation,
        bins=bins,
        smoothing=explorer.smoothing_for(bins) if options.smooth is None else options.smooth,
        flattening=options.flatten or 0.0,
        ions=_ions(options, explorer),
    )
    return explorer, view


def _ions(options, explorer):
    """First and last ion of `--simulated` within those of the run, None for all."""
    if options.simulated is None or explorer.run is None:
        return None
    every = explorer.first_and_last
    first, last = (end if bound is None else int(bound) for bound, end in zip(options.simulated, every, strict=True))
    first, last = max(first, every[0]), min(last, every[1])
    if first >= last:
        raise ValueError(f"--simulated selects none of the ions {every[0]} to {every[1]} of {options.run!r}")
    return first, last


def _measured(options):
    content = read(options)
    if isinstance(content, Run):
        raise ValueError(f"MEASURED must be measured ions or a map, {options.file!r} is a run")
    if isinstance(content, DetectorMap):
        return content
    return ions_of_map(content, options)


# ---- the same in text ----------------------------------------------------------------------------------------------


def _run_arguments(options):
    """Arguments that name RUN and its units."""
    arguments = [options.run]
    if options.lens is not None:
        arguments.append(f"--lens={options.lens}")
    if options.real_units is not None:
        arguments.append(f"--real-units={options.real_units}")
    return arguments


def _run_code(options):
    """Python expression that reads RUN."""
    arguments = [] if options.lens is None else [to_python(lens_of(options))]
    if options.real_units is not None:
        arguments.append(f"field_reference={options.real_units!r}")
    return f"ae.load({options.run!r})" + (f".at_evaporation_field({', '.join(arguments)})" if arguments else "")


_READING = ("format", "byte_order", "voltage_unit", "arrays", "unit")
_OTHERS = ("ranges", "species", "partial", "circle", "box", "undistort")
_SELECTION = {"ions": "ion", "mass": "mass_to_charge", "voltage": "voltage"}


def _measured_arguments(options):
    """Arguments that name MEASURED, its reading and the selection of its ions."""
    arguments = [options.file]
    for name in (*_READING, "ranges", "species"):
        if (value := getattr(options, name)) is not None:
            arguments += [f"--{name.replace('_', '-')}={value}"]
    if options.partial:
        arguments += ["--partial"]
    for name in _SELECTION:
        if (value := getattr(options, name)) is not None:
            arguments += [f"--{name}={','.join('' if bound is None else repr(bound) for bound in value)}"]
    if options.circle is not None:
        radius, centre = options.circle
        arguments += [f"--circle={','.join(map(repr, (radius, *centre)))}"]
    if options.box is not None:
        arguments += [f"--box={','.join(map(repr, options.box))}"]
    return arguments


def _measured_code(options):
    """Python expression that reads MEASURED."""
    if options.file.lower().endswith(".npz") or (options.format or "").lstrip(".").lower() == "npz":
        names = zip(("values", "x_edges", "y_edges", "mask"), (options.arrays or "").split(","), strict=False)
        parameters = {name: value for name, value in names if value} | ({"unit": options.unit} if options.unit else {})
        return f"ae.read_map({_call(options.file, parameters)})"
    parameters = {
        name: value for name in ("format", "partial", "byte_order", "voltage_unit") if (value := getattr(options, name))
    } | ({"detector_unit": options.unit} if options.unit else {})
    code = f"ae.read({_call(options.file, parameters)})"
    for name, column in _SELECTION.items():
        if (bounds := getattr(options, name)) is not None:
            code += f".window({column}={bounds!r})"
    if options.circle is not None:
        code += f".within_circle({options.circle[0]!r}, {options.circle[1]!r})"
    if options.box is not None:
        code += f".window(x={options.box[:2]!r}, y={options.box[2:]!r})"
    if options.species is not None:
        names = ", ".join(map(repr, options.species.split(",")))
        code = f"ae.io.read_ranges({options.ranges!r}).select({code}, {names})"
    return code


def _call(path, parameters):
    return ", ".join([repr(path), *(f"{name}={value!r}" for name, value in parameters.items())])


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
