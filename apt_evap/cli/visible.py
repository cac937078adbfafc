"""`apt-evap visible`: would a feature of a specimen be found, and how wrong would it come out?"""

import argparse
import math

from apt_evap.cli._options import add_speech, integer_type
from apt_evap.cli._output import tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Simulate a feature of a specimen, such as a precipitate, emulate many twins of it, and apply an\n"
        "analysis to them: the probability that it finds the feature, the number of ions that this needs,\n"
        "bias and scatter of size and composition. The Python file of the analysis is run."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap visible visible                   the shipped example; copies visible.toml and visible_pairs.py\n"
        "  apt-evap visible mine.toml --json"
    )
    parser.add_argument(
        "config",
        metavar="FILE.toml",
        help="settings of a simulation, with a table [visibility], or the name of a shipped example",
    )
    parser.add_argument("--threads", type=integer_type(1), metavar="N", help="default: all processors")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap.cli._shipped import settings_file
    from apt_evap.studies.visibility.visibility_file import visibility_of_file

    result = visibility_of_file(settings_file(options, options.config), n_threads=options.threads)
    probability = result.probability
    tell(options, f"probability to be found: {probability.value:.2f} ± {probability.error:.2f}")
    for name, number in (("N50", result.n50), ("N95", result.n95)):
        if math.isfinite(number.value):
            tell(options, f"{name}: {number.value:.0f} ± {number.error:.0f} recorded ions of the feature")
        elif result.sized is not None and len(result.sized.ions):
            low, high = result.sized.ions.min(), result.sized.ions.max()
            tell(options, f"{name}: not between {low:,} and {high:,} recorded ions of the feature")
    for name, error in result.errors.items():
        unit = "" if name.endswith("composition") else " nm"
        tell(
            options, f"{name}: bias {error.bias:+.3f} ± {error.bias_error:.3f}{unit}, scatter {error.scatter:.3f}{unit}"
        )
    tell_json(options, result.to_dict())
    return 0
