"""`apt-evap info`: summarise a file."""

import argparse
import json

from apt_evap.cli._options import FILE_HELP, add_reading
from apt_evap.cli._output import put


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Summarise a run (RUN.h5.unfinished while it is not finished), a file of ions, a map, or a specimen\n"
        "(LAMMPS, TAPSim, ASE)."
    )
    parser.epilog = (
        "example: apt-evap info ni111.h5\n         apt-evap info R5083.epos --json | jq .columns.voltage\n"
        "         apt-evap info precipitate.lmp --types 1=Al,2=Cu"
    )
    parser.add_argument("file", metavar="FILE", help=FILE_HELP)
    add_reading(parser)
    parser.add_argument(
        "--types", type=_types, metavar="1=Al,2=Cu", help="elements of the types of a specimen that have no names"
    )
    parser.add_argument("--json", action="store_true", help="as JSON, for programs; units as in the text output")


def _types(text: str) -> list[tuple[str, str]]:
    pairs = [(part.partition("=")[0], part.partition("=")[2]) for part in text.split(",")]
    if not all(key and name for key, name in pairs):
        raise argparse.ArgumentTypeError(f"must be types with their elements, such as 1=Al,2=Cu, got {text!r:.80}")
    return pairs


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap.cli._summary_of_file import summary_lines, summary_of_file

    summary = {"file": options.file} | summary_of_file(options)
    if options.json:
        put(json.dumps(summary, indent=2, allow_nan=False))
    else:
        put("\n".join(summary_lines(summary)))
    return 0
