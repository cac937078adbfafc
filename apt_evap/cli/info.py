"""`apt-evap info`: say what is in a file."""

import json
from typing import Any

from apt_evap.analysis.description import UNITS, describe
from apt_evap.cli._files import read, select, selects
from apt_evap.cli._options import SHAPE, reading_options
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.simulation.ending import Ending
from apt_evap.simulation.run import Run


def add_parser(commands: Any) -> None:
    """Describe the command."""
    command = commands.add_parser(
        "info",
        parents=[reading_options()],
        help="say what is in a file",
        description="Say what is in a run (of an unfinished one, give the folder), in a file of ions or a map.",
        epilog="example: apt-evap info ni111.h5\n         apt-evap info R5083.epos --json | jq .columns.voltage",
        **SHAPE,
    )
    command.add_argument(
        "--json", action="store_true", help="as JSON, for programs; numbers are in the units that the text shows"
    )
    command.set_defaults(command=_info)


def _info(options):
    held = read(options)
    told = {"file": options.file}
    if selects(options) and not isinstance(held, DetectorMap):
        ions = held.hits(held.first_perturbation) if isinstance(held, Run) else held
        told["selected_of"], held = len(ions), select(ions, options)
    told |= describe(held)
    if isinstance(held, Run) and held.ended == Ending.UNFINISHED:
        told["kind"] = f"unfinished run of {len(held):,} ions"
        told["ended"] = "not yet: the command that began it, with --resume, goes on"
    if options.json:
        print(json.dumps(told, indent=2, allow_nan=False))
    else:
        print("\n".join(_lines(told)))
    return 0


def _lines(told, indent=0, of_columns=False):
    labels = {key: f"{key.replace('_', ' ')} [{UNITS[key]}]" if key in UNITS else key.replace("_", " ") for key in told}
    width = max(map(len, labels.values()), default=0)
    for key, value in told.items():
        if isinstance(value, dict) and value:
            yield f"{'':{indent}}{labels[key]}"
            yield from _lines(value, indent + 2, key == "columns")
        else:
            between = " to " if of_columns or key in _EXTENTS else " x " if key in _SIZES else "   "
            text = _text(value, between)
            if key == "field_before_leaving":
                text += f" at {told['voltage']:g} V (only its ratio to the evaporation field matters)"
            yield f"{'':{indent}}{labels[key]:{width}}  {text}"


_EXTENTS = ("field_before_leaving", "x", "y", "values")
_SIZES = ("bins", "bin_size", "detector_extent", "detector_quantum")


def _text(value, between="   "):
    if isinstance(value, list | dict):
        return between.join(_text(item) for item in value) or "none"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
