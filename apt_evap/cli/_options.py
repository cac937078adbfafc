"""What the commands share on the command line: kinds of arguments, and how they speak."""

import argparse
import json
import re
import sys
from collections.abc import Callable
from math import isfinite
from typing import Any

from apt_evap._common.validation import check_number

INTERRUPTED, TERMINATED = 130, 143  # 128 + SIGINT and SIGTERM, as shells count
SHAPE = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}


# the library speaks of arguments of Python
_SHELL_WORDS = (
    ("partial=True", "--partial"),
    ("resume=True", "--resume"),
    ("overwrite=True", "--force"),
    (r"\bbyte_order=", "--byte-order "),
    (r"\bformat=(?=')", "--format "),
    (r"\bn_threads\b", "--threads"),
    (r"\bn_ions\b", "--ions"),
    ("the overlay of both", "registration.png"),
    ("give a pole, scales or a start where known", "give --registration where it is known"),
)


def say(kind: str, message: object) -> None:
    """One line on stderr: an error, a warning or a note, in words of the shell."""
    text = " ".join(str(message).split())
    for python, shell in _SHELL_WORDS:
        text = re.sub(python, shell, text)
    print(f"apt-evap: {kind}: {text}", file=sys.stderr)


def reading_options() -> argparse.ArgumentParser:
    """Options of a command that reads a FILE."""
    reading = argparse.ArgumentParser(add_help=False)
    reading.add_argument("file", metavar="FILE", help="a run (.h5), measured ions (.epos, ...) or a map (.npz)")
    add_reading_options(reading)
    return reading


def add_reading_options(parser: argparse.ArgumentParser) -> Any:
    """Options that say how the file of ions is read, as a group of their own."""
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


def add_speech(command: argparse.ArgumentParser) -> None:
    """Options of a command that tells what it has done: in sentences, as JSON or not at all."""
    speech = command.add_mutually_exclusive_group()
    speech.add_argument("--quiet", action="store_true", help="say nothing but warnings and errors")
    speech.add_argument("--json", action="store_true", help="say in one line of JSON what was written")


def tell(options: argparse.Namespace, line: str) -> None:
    """Say a line to people, where neither --quiet nor --json is given."""
    if not (options.quiet or options.json):
        print(line, flush=True)


def tell_json(options: argparse.Namespace, told: dict[str, Any]) -> None:
    """Say a dict in one line to programs, where --json is given."""
    if options.json:
        print(json.dumps(told, allow_nan=False), flush=True)


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """A kind of argument: a whole number within bounds."""

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


def _bounds(text):
    """A kind of argument: two bounds, None where one is left out."""
    try:
        low, high = (float(part) if part.strip() else None for part in text.split(","))
        ordered = low is None or high is None or low <= high
        if not ordered or not all(bound is None or isfinite(bound) for bound in (low, high)):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be two numbers in order, such as 27,29.5, got {text!r}") from None
    return low, high


def _circle(text):
    """A kind of argument: radius and centre of a circle."""
    try:
        radius, *centre = (float(part) for part in text.split(","))
        if radius <= 0 or len(centre) not in (0, 2) or not all(map(isfinite, (radius, *centre))):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a radius, or R,X,Y, such as 15,0,-2 [mm], got {text!r}") from None
    return radius, tuple(centre) or (0.0, 0.0)


def _number(unit):
    """A kind of argument: a number of at least 0."""

    def number(text):
        try:
            return check_number(float(text), "it", at_least=0, unit=unit)
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a number [{unit}] of at least 0, got {text!r}") from None

    return number


smoothing = _number("mm")
minutes = _number("min")
