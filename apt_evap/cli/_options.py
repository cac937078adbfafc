"""What the commands share on the command line: kinds of arguments, and how files are read."""

import argparse
import sys

from apt_evap._arrays import check_number

INTERRUPTED = 130  # 128 + SIGINT, as shells count
SHAPE = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}


def say(kind, message):
    """One line on stderr: an error, a warning or a note."""
    print(f"apt-evap: {kind}: {' '.join(str(message).split())}", file=sys.stderr)


def reading_options():
    """Options of a command that reads a FILE."""
    reading = argparse.ArgumentParser(add_help=False)
    reading.add_argument("file", metavar="FILE", help="a run (.h5) or measured ions (.epos, ...)")
    add_reading_options(reading)
    return reading


def add_reading_options(parser):
    """Options that say how the file of ions is read, as a group of their own."""
    group = parser.add_argument_group("reading of files")
    group.add_argument("--format", metavar="SUFFIX", help="read ions as this format, such as .pos")
    group.add_argument("--partial", action="store_true", default=None, help="read the whole ions of a truncated file")
    group.add_argument("--byte-order", choices=("big", "little"), help="of .pos and .epos files")
    return group


def whole(least, most=None):
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


def _number(unit):
    def number(text):
        try:
            return check_number(float(text), "it", at_least=0, unit=unit)
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a number [{unit}] of at least 0, got {text!r}") from None

    return number


smoothing = _number("mm")
minutes = _number("min")
