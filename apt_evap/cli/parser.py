"""What the commands take on the command line; nothing that computes is imported, so that help comes at once."""

import argparse
from collections.abc import Callable, Iterable
from math import inf, isfinite
from typing import Any, NoReturn

from apt_evap._version import __version__
from apt_evap.cli._output import put
from apt_evap.detection.limits import MAX_BINS
from apt_evap.energy_fit.defaults import MEANS, MECHANISMS, ROLLUP_FRACTIONS, RSDS

EXIT_CODES = """\
exit codes:
  0    done; what was written is said on stdout, warnings on stderr
  1    whoever read the output has left (a closed pipe)
  2    an error, explained in one sentence on stderr; nothing half-written is left behind
  130  interrupted by Ctrl-C; `run` has saved the ions done so far
  143  the same by SIGTERM, as batch systems send it
"""
"""What the exit codes mean, for the help."""

_PATH = """\
from nothing to a map, and to the energies behind a measured one (the first line writes what the others read):
  apt-evap run examples/ni111.toml                   simulate; writes ni111.h5 and maps of it, ni111.png
  apt-evap info ni111.h5                             what the run holds: specimen, ions, outcomes
  apt-evap map ni111.h5 --perturbation RollUp:0.3 -o rolled.png
                                                     the same ions, all rolled up with 0.3 eV, in a second
  apt-evap info R5083.epos --json | jq .ions         measured files too; --json for programs
  apt-evap map R5083.epos --bins 128                 a measured map beside them
  apt-evap compare ni111.h5 R5083.epos -o study      the energies for which the run looks most like the measured map
  apt-evap COMMAND --help                            everything a command takes, with examples
"""

_SHAPE: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line.

    Returns
    -------
    argparse.ArgumentParser
        Its errors are ValueErrors. The options it returns have the name of the command as `command`.
    """
    parser = _Parser(
        prog="apt-evap",
        description="Field evaporation in atom probe tomography: simulate a specimen that evaporates atom by atom,\n"
        "and draw where its ions land under any perturbation of their emission, beside measured ions.",
        epilog=f"{_PATH}\n{EXIT_CODES}",
        **_SHAPE,
    )
    parser.add_argument("--version", action="version", version=f"apt-evap {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for add in (_add_run, _add_map, _add_info, _add_compare):
        add(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see {self.prog} --help)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        # a command's own parser would leave it to the one above to say so, with the wrong help
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

    def _print_message(self, message: str, file: Any = None) -> None:
        put(message.removesuffix("\n"))  # that of argparse does not tell of a full disk

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            hint = _did_you_mean(value, action.choices)
            known = ", ".join(map(str, action.choices))
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}{hint} (choose from {known})")


def _did_you_mean(word: str, known: Iterable[str]) -> str:
    from apt_evap._common.validation import did_you_mean  # with numpy, for those who mistype

    return did_you_mean(word, known)


# ---- commands --------------------------------------------------------------------------------------------------------


def _add_run(commands: Any) -> None:
    command = commands.add_parser(
        "run",
        help="simulate what a TOML file describes",
        description="Simulate what a TOML file describes, save the run and draw its detector maps.\n"
        "Ctrl-C or SIGTERM ends the simulation and saves what is done. While it goes on it is kept in\n"
        "RUN.h5.unfinished; killed, it goes on from there with --resume, and gives the same bits as if it had not.\n"
        "Behind the bar: charges, how far from settled they are (RMS over their mean); shares of the last ions that\n"
        "missed, never left, or are flagged, as their responses are inexact. Without a terminal: a line a minute.",
        epilog="example: apt-evap run examples/ni111.toml -o ni.h5 --ions 5000",
        **_SHAPE,
    )
    command.add_argument("config", metavar="CONFIG.toml")
    command.add_argument("-o", "--output", metavar="RUN.h5", help="default: output of the file, or its name with .h5")
    command.add_argument("--ions", type=_whole(1), metavar="N", help="atoms to evaporate, instead of those of the file")
    command.add_argument("--threads", type=_whole(1), metavar="N", help="default: all processors")
    command.add_argument("--seed", type=_whole(0), metavar="N", help="instead of that of the file")
    command.add_argument("--map", metavar="MAP.png", help="picture of the maps; default: beside the run")
    command.add_argument("--resume", action="store_true", help="go on with an unfinished run, or make one longer")
    command.add_argument(
        "--checkpoint",
        type=_number("min"),
        default=10.0,
        metavar="MINUTES",
        help="time between two checkpoints; default: 10",
    )
    _add_speech(command)
    command.add_argument(
        "--force", action="store_true", help="overwrite unfinished and other runs, and files that apt-evap did not make"
    )


def _add_map(commands: Any) -> None:
    command = commands.add_parser(
        "map",
        help="draw detector maps of a run or of measured ions",
        description="Draw detector maps of a run or of measured ions, or a map.",
        epilog="example:\n"
        "  apt-evap map R5083.epos --bins 128\n"
        "  apt-evap map R5083.epos --ranges R5083.rrng --species Si --voltage 4000, --circle 15 -o silicon.png\n"
        "  apt-evap map ni111.h5 --perturbation Unperturbed --perturbation RollUp:0.3,0.1 -o energies.png\n\n"
        "a perturbation is NAME, NAME:NUMBERS or a TOML table:\n"
        "  Unperturbed              RollUp:0.2 (eV, all ions)    RollUp:0.155,0.155 (mean, standard deviation)\n"
        "  LateralVelocity:0.3,0.1  Combined:0.155,0.155,0.75 (the last number is the share of the roll-up)\n"
        '  \'{name = "RollUp", energy = {name = "Thermal", temperature = 50}}\'',
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help=_FILE_HELP)
    _add_reading(command)
    command.add_argument("-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_map.png, here")
    command.add_argument(
        "--bins", type=_whole(1, MAX_BINS), metavar="N", help="along the longer side; default: about sqrt(ions)"
    )
    command.add_argument("--smooth", type=_number("mm"), metavar="MM", help="sigma of a Gaussian; default: one bin")
    command.add_argument(
        "--perturbation", action="append", metavar="P", help="of the ions of a run; repeat it for maps side by side"
    )
    command.add_argument("--force", action="store_true", help="overwrite a file that apt-evap did not make")
    _add_speech(command)


def _add_info(commands: Any) -> None:
    command = commands.add_parser(
        "info",
        help="say what is in a file",
        description="Say what is in a run (of an unfinished one, give the folder), in a file of ions or a map.",
        epilog="example: apt-evap info ni111.h5\n         apt-evap info R5083.epos --json | jq .columns.voltage",
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help=_FILE_HELP)
    _add_reading(command)
    command.add_argument(
        "--json", action="store_true", help="as JSON, for programs; numbers are in the units that the text shows"
    )


def _add_compare(commands: Any) -> None:
    command = commands.add_parser(
        "compare",
        help="find the emission energies that make a run look most like a measured map",
        description="Find the emission energies that make a run look most like a measured map: the structural\n"
        "similarity for a grid of energies, its maximum, its errors, and what no energy and thermal energies give.",
        epilog="writes to FOLDER:\n"
        "  study.json        results and every setting\n"
        "  ssim.csv          similarity, error and share of the resamples for every energy\n"
        "  ssim.png          the same as a picture\n"
        "  maps.png          measured, unperturbed and best map side by side, and a part of them magnified\n"
        "  registration.png  the simulated map laid over the measured one\n\n"
        "example: apt-evap compare ni111.h5 R5083.epos -o R5083_study --mechanism roll-up",
        **_SHAPE,
    )
    command.add_argument("run", metavar="RUN.h5", help="a run with responses")
    command.add_argument("file", metavar="MEASURED", help="measured ions (.epos, ...), a map (.npz), or a run (.h5)")
    command.add_argument("-o", "--output", metavar="FOLDER", help="default: MEASURED_study, here")
    command.add_argument("--mechanism", choices=MECHANISMS, default="roll-up", help="default: roll-up")
    for name, default, what in (
        ("means", MEANS, "of the energy [eV]"),
        ("rsds", RSDS, "standard deviations over the means"),
        ("rollup-fractions", ROLLUP_FRACTIONS, "for combined"),
    ):
        numbers = ",".join(f"{value:g}" for value in default)
        command.add_argument(f"--{name}", type=_numbers, metavar="N,N,...", help=f"{what}; default: {numbers}")
    command.add_argument(
        "--registration",
        metavar="R",
        help="a JSON file (such as study.json) or ROTATION,SCALE,DX,DY[,mirror] in degrees and mm; found by default",
    )
    command.add_argument("--bins", type=_whole(11, MAX_BINS), metavar="N", help="along the longer side")
    command.add_argument(
        "--smooth", type=_number("mm"), metavar="MM", help="sigma of a Gaussian; default: half a bin, of densities one"
    )
    command.add_argument("--flatten", type=_number("mm"), metavar="MM", help="sigma of a broad Gaussian; 0 for not")
    command.add_argument("--temperature", type=float, default=50.0, metavar="K", help="of the thermal map; default: 50")
    command.add_argument("--plain", action="store_true", help="SSIM as it is, without allowance for noise")
    command.add_argument("--replicas", type=_whole(1), metavar="N", help="draws of every ion; default: 4 to 16")
    command.add_argument("--resamples", type=_whole(0), default=200, metavar="N", help="for the errors; default: 200")
    command.add_argument("--seed", type=_whole(0), default=0, metavar="N", help="of the resamples; default: 0")
    command.add_argument("--threads", type=_whole(1), metavar="N", help="default: all processors")
    command.add_argument("--quiet", action="store_true", help="no progress bar, no summary")
    command.add_argument("--force", action="store_true", help="overwrite files that apt-evap did not make")
    reading = _add_reading(command)
    reading.add_argument("--perturbation", metavar="P", help="of the ions of MEASURED where it is a run")


# ---- what several commands take --------------------------------------------------------------------------------------

_FILE_HELP = "a run (.h5), measured ions (.epos, ...) or a map (.npz)"


def _add_reading(parser: argparse.ArgumentParser) -> Any:
    """Add options that say how the file of ions is read, and which ions; return the group of the first."""
    group = parser.add_argument_group("reading of files")
    group.add_argument("--format", metavar="SUFFIX", help="read ions as this format, such as .pos")
    group.add_argument("--partial", action="store_true", default=None, help="read the whole ions of a truncated file")
    group.add_argument("--byte-order", choices=("big", "little"), help="of .pos and .epos files")
    group.add_argument("--arrays", metavar="V,X,Y[,MASK]", help="names in an .npz: values, edges in x and y, mask")
    group.add_argument("--unit", metavar="UNIT", help="of the edges in an .npz: mm, cm, m or um")
    chosen = parser.add_argument_group("selection of ions", "LOW <= value < HIGH; LOW or HIGH may be left out: 27,")
    chosen.add_argument("--mass", type=_bounds, metavar="LOW,HIGH", help="mass over charge state [Da]")
    chosen.add_argument("--voltage", type=_bounds, metavar="LOW,HIGH", help="standing voltage [V]")
    chosen.add_argument(
        "--ions", type=_bounds, metavar="FIRST,LAST", help="in the order of the file, from 0; LAST is not included"
    )
    chosen.add_argument("--circle", type=_circle, metavar="R[,X,Y]", help="on the detector: radius, and centre [mm]")
    chosen.add_argument("--ranges", metavar="FILE.rrng", help="ranges of mass, for --species")
    chosen.add_argument("--species", metavar="NAME[,NAME]", help="ions in the ranges of this name, such as Si")
    return group


def _add_speech(command: argparse.ArgumentParser) -> None:
    """Add options of a command that tells what it has done: in sentences, as JSON or not at all."""
    speech = command.add_mutually_exclusive_group()
    speech.add_argument("--quiet", action="store_true", help="say nothing but warnings and errors")
    speech.add_argument("--json", action="store_true", help="say in one line of JSON what was written")


# ---- kinds of arguments ----------------------------------------------------------------------------------------------


def _whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """A whole number within bounds."""

    def whole(text):
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least or (most is not None and number > most):
            bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
            raise argparse.ArgumentTypeError(f"must be a whole number {bounds}, got {text!r}")
        return number

    return whole


def _number(unit: str) -> Callable[[str], float]:
    """A finite number of at least 0."""

    def number(text):
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not 0 <= value < inf:
            raise argparse.ArgumentTypeError(f"must be a number [{unit}] of at least 0, got {text!r}")
        return value

    return number


def _numbers(text: str) -> tuple[float, ...]:
    """Numbers with commas between."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers with commas between, got {text!r}") from None


def _bounds(text: str) -> tuple[float | None, float | None]:
    """Two bounds, None where one is left out."""
    try:
        low, high = (float(part) if part.strip() else None for part in text.split(","))
        ordered = low is None or high is None or low <= high
        if not ordered or not all(bound is None or isfinite(bound) for bound in (low, high)):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be two numbers in order, such as 27,29.5, got {text!r}") from None
    return low, high


def _circle(text: str) -> tuple[float, tuple[float, ...]]:
    """Radius and centre of a circle."""
    try:
        radius, *centre = (float(part) for part in text.split(","))
        if radius <= 0 or len(centre) not in (0, 2) or not all(map(isfinite, (radius, *centre))):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a radius, or R,X,Y, such as 15,0,-2 [mm], got {text!r}") from None
    return radius, tuple(centre) or (0.0, 0.0)
