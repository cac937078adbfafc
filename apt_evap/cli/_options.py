"""Options of several commands, and the types of their values."""

import argparse
from collections.abc import Callable
from math import inf, isfinite
from typing import Any

SHAPE: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
"""Options of every parser: texts as they are written, no abbreviations."""
MAX_BINS = 16384
"""That of `detection.binning`. Help must be fast, and modules of the physics import NumPy."""
FILE_HELP = "a run (.h5), measured ions (.epos, ...) or a map (.npz)"
"""Help of an argument for any file."""
MATERIAL_HELP = "Ni, or a material of your own, as a table {name = ...} or a file .toml with a table [material]"
"""Help of an argument for a material."""


def add_reading(parser: argparse.ArgumentParser) -> Any:
    """Add options for reading a file and selecting ions; return the first group.

    `apt-evap info --help` describes them, the help of other commands names them.
    """
    group = parser.add_argument_group("reading of files")
    group.add_argument("--format", metavar="SUFFIX", help="read ions in this format, such as .pos")
    group.add_argument("--partial", action="store_true", default=None, help="read a truncated file to its last ion")
    group.add_argument("--byte-order", choices=("big", "little"), help="byte order of .pos and .epos files")
    group.add_argument("--arrays", metavar="V,X,Y[,MASK]", help="names in an .npz: values, edges in x and y, mask")
    group.add_argument("--unit", metavar="UNIT", help="unit on the detector in an .npz, .epos or .raw: mm, cm, m or um")
    group.add_argument("--voltage-unit", choices=("V", "kV"), help="unit of the voltages in an .epos")
    group.add_argument(
        "--undistort", metavar="GRID.csv", help="calibration grid of the instrument, such as a reflectron"
    )
    group.add_argument(
        "--exchange-axes",
        action="store_true",
        default=None,
        help="exchange detectorX and detectorY of the grid, for programs whose x is the y of the hits",
    )
    selection = parser.add_argument_group("selection of ions", "LOW <= value < HIGH; LOW or HIGH may be omitted: 27,")
    selection.add_argument("--mass", type=bounds_type, metavar="LOW,HIGH", help="mass-to-charge ratio [Da]")
    selection.add_argument("--voltage", type=bounds_type, metavar="LOW,HIGH", help="DC voltage [V]")
    selection.add_argument(
        "--ions", type=bounds_type, metavar="FIRST,LAST", help="in the order of the file, from 0; LAST is not included"
    )
    selection.add_argument("--circle", type=_circle, metavar="R[,X,Y]", help="radius and centre on the detector [mm]")
    selection.add_argument("--box", type=_box, metavar="X0,X1,Y0,Y1", help="rectangle on the detector [mm]")
    selection.add_argument("--ranges", metavar="FILE.rrng", help="or .rng, .env, .xrng: ranges of mass, for --species")
    selection.add_argument(
        "--species", metavar="NAME[,NAME]", help="ions of these names, such as Si: in --ranges, or of a run"
    )
    if not parser.prog.endswith(" info"):
        for each in (group, selection):
            parser.common.append((each, tuple(each._group_actions)))  # type: ignore[attr-defined]
    return group


def add_indexing(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add options of the crystal on a measured map."""
    group = parser.add_argument_group("crystal")
    group.add_argument("--element", metavar="NAME", required=required, help=f"the crystal: {MATERIAL_HELP}")
    add_flight(group)
    group.add_argument(
        "--all-ions",
        action="store_true",
        help="use all ions; default: those in the peaks of the crystal, if there is no --mass or --species",
    )
    group.add_argument(
        "--scales",
        type=numbers_type,
        metavar="LOW,HIGH",
        help="bounds of the scale of the map [mm/rad], if it is known",
    )
    group.add_argument(
        "--pole", type=_mark(2), action="append", metavar="X,Y[,H,K,L]", help="a pole that you see [mm]; repeat it"
    )
    group.add_argument(
        "--line",
        type=_mark(4),
        action="append",
        metavar="X,Y,X,Y[,U,V,W]",
        help="two points of a zone line that you see [mm], and its zone axis if you know it; repeat it",
    )


def add_peaks(parser: Any) -> None:
    """Add options of the ions in the peaks of an element."""
    parser.add_argument(
        "--element", metavar="NAME", help=f"use the ions in the peaks of a crystal, such as {MATERIAL_HELP}"
    )
    parser.add_argument("--all-ions", action="store_true", help="use all ions, also with --element")


def add_flight(parser: Any) -> None:
    """Add options of the flight, from which masses follow."""
    parser.add_argument("--distance", type=number_type("mm"), metavar="MM", help="flight length of the instrument")
    add_time_zero(parser)


def add_time_zero(parser: Any) -> None:
    """Add the option of the time zero of the times of flight."""
    parser.add_argument(
        "--t0",
        dest="time_zero",
        type=_time,
        default=0.0,
        metavar="NS",
        help="time that is subtracted from the times of flight; default: 0",
    )


def add_specimen(parser: argparse.ArgumentParser) -> Any:
    """Add options of the simulated specimen; return their group."""
    group = parser.add_argument_group("specimen")
    group.add_argument(
        "--minutes",
        type=float,
        default=10.0,
        metavar="N",
        help="time of all that twin does, or of the simulation that start writes; default: 10",
    )
    group.add_argument("--field-factor", type=float, metavar="KF", help="for the radius from the voltage; default: 3.3")
    group.add_argument("--lens", metavar="L", help="microscope that gives the field factor, as for apt-evap export")
    group.add_argument("--threads", type=integer_type(1), metavar="N", help="default: all processors")
    return group


def add_real_units(parser: argparse.ArgumentParser) -> None:
    """Add the option for real units."""
    parser.add_argument(
        "--real-units",
        nargs="?",
        const="cap",
        choices=("cap", "site"),
        metavar="REFERENCE",
        help="true V, eV and ns: the evaporation field is reached by the mean of the cap (cap, the default) or by the "
        "evaporating atom (site)",
    )
    parser.add_argument(
        "--lens",
        metavar="L",
        help="microscope around the specimen: local-electrode or plane-electrode, with changed fields of "
        "LocalElectrode such as local-electrode:shank_angle=7,distance=60e3 [degrees, nm]; for a run in real units",
    )


def add_speech(parser: argparse.ArgumentParser) -> None:
    """Add options for the messages of a parser: text, JSON or none."""
    speech = parser.add_mutually_exclusive_group()
    speech.add_argument("--quiet", action="store_true", help="only warnings and errors")
    speech.add_argument("--json", action="store_true", help="one line of JSON that names the written files")


def integer_type(least: int, largest: int | None = None) -> Callable[[str], int]:
    """Integer within bounds."""

    def integer(text):
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least or (largest is not None and number > largest):
            bounds = f">= {least}" if largest is None else f"from {least} to {largest}"
            raise argparse.ArgumentTypeError(f"must be an integer {bounds}, got {text!r:.80}")
        return number

    return integer


def number_type(unit: str) -> Callable[[str], float]:
    """Finite number >= 0."""

    def number(text):
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not 0 <= value < inf:
            raise argparse.ArgumentTypeError(f"must be a number [{unit}] >= 0, got {text!r:.80}")
        return value

    return number


def _time(text: str) -> float:
    """Finite number."""
    try:
        value = float(text)
    except ValueError:
        value = inf
    if not isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a number [ns], got {text!r:.80}")
    return value


def numbers_type(text: str) -> tuple[float, ...]:
    """Numbers separated by commas."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers separated by commas, got {text!r:.80}") from None


def bounds_type(text: str) -> tuple[float | None, float | None]:
    """Two bounds, None for an omitted one."""
    try:
        low, high = (float(part) if part.strip() else None for part in text.split(","))
        ordered = low is None or high is None or low <= high
        if not ordered or not all(bound is None or isfinite(bound) for bound in (low, high)):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be two increasing numbers, such as 27,29.5, got {text!r:.80}") from None
    return low, high


def _circle(text: str) -> tuple[float, tuple[float, ...]]:
    """Radius and centre of a circle."""
    try:
        radius, *centre = (float(part) for part in text.split(","))
        if radius <= 0 or len(centre) not in (0, 2) or not all(map(isfinite, (radius, *centre))):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a radius or R,X,Y such as 15,0,-2 [mm], got {text!r:.80}") from None
    return radius, tuple(centre) or (0.0, 0.0)


def _box(text: str) -> tuple[float, ...]:
    """Bounds of a rectangle in x and in y."""
    try:
        left, right, lower, upper = (float(part) for part in text.split(","))
        if not (left < right and lower < upper and all(map(isfinite, (left, right, lower, upper)))):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be X0,X1,Y0,Y1, such as -5,5,0,8 [mm], got {text!r:.80}") from None
    return left, right, lower, upper


def _mark(n: int) -> Callable[[str], tuple[Any, ...]]:
    """`n` coordinates, and perhaps three or four indices after them."""

    def mark(text):
        numbers = numbers_type(text)
        indices = numbers[n:]
        is_whole = all(index.is_integer() for index in indices)  # no infinity, no NaN
        if len(numbers) < n or len(indices) not in (0, 3, 4) or not is_whole:
            raise argparse.ArgumentTypeError(f"must be {n} coordinates [mm], perhaps with indices, got {text!r:.80}")
        return (*numbers[:n], tuple(int(index) for index in indices)) if indices else numbers

    return mark
