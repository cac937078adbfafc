"""`apt-evap info`: say what is in a file."""

import json
from typing import Any

from apt_evap.cli._files import read
from apt_evap.cli._options import SHAPE, reading_options
from apt_evap.info import UNITS, describe


def add_parser(commands: Any) -> None:
    """Describe the command."""
    command = commands.add_parser(
        "info",
        parents=[reading_options()],
        help="say what is in a file",
        description="Say what is in a run or in a file of measured ions.",
        epilog="example: apt-evap info ni111.h5\n         apt-evap info R5083.epos --json | jq .columns.voltage",
        **SHAPE,
    )
    command.add_argument(
        "--json", action="store_true", help="as JSON, for programs; numbers are in the units that the text shows"
    )
    command.set_defaults(command=_info)


def _info(options):
    held = read(options)
    told = {"file": options.file} | describe(held)
    if options.json:
        print(json.dumps(told, indent=2, allow_nan=False))
    else:
        print("\n".join(_lines(told)))
    return 0


def _lines(told, indent=0):
    labels = {key: f"{key.replace('_', ' ')} [{UNITS[key]}]" if key in UNITS else key.replace("_", " ") for key in told}
    width = max(map(len, labels.values()), default=0)
    for key, value in told.items():
        if isinstance(value, dict) and value:
            yield f"{'':{indent}}{labels[key]}"
            yield from _lines(value, indent + 2)
        else:
            yield f"{'':{indent}}{labels[key]:{width}}  {_text(value)}"


def _text(value):
    if isinstance(value, list | dict):
        return "   ".join(_text(item) for item in value) or "none"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
