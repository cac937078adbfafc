"""`apt-evap composition`: at.% of measured ions, with errors, and what is unexplained."""

import argparse

from apt_evap.cli._options import add_speech
from apt_evap.cli._output import tell, tell_json
from apt_evap.cli._spectrum_of_file import add_spectrum, say_losses, spectrum_of


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Print the composition of measured ions in at.%: molecular ions taken apart, without the background, with\n"
        "errors of counting and the span over other names of the peaks. What no ion explains comes first; there is no\n"
        "composition where this is more than 10 %. With --ranges, only the ions of a file of ranges are counted;\n"
        "overlaps are resolved by their isotopes, and ranges that their ions do not explain are named."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap composition R5083.epos\n"
        "  apt-evap composition R5083.epos --element Ni,Al,Cr,H --json\n"
        "  apt-evap composition R5083.epos --ranges R5083.rrng\n"
        "  apt-evap composition R5083.epos --isotope Si=28:0.5,30:0.5"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, .pos, .raw, ...)")
    add_spectrum(parser)
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap.io.formats import read_ranges

    result = spectrum_of(options, None if options.ranges is None else read_ranges(options.ranges))
    if not result.ions and not result.unexplained:
        raise ValueError(f"a composition needs peaks, {options.file!r} has none above the background: {result.hits!r}")
    tell(options, f"{result}")
    say_losses(options, result)
    tell_json(options, result.composition.plain())
    return 0
