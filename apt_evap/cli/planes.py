"""`apt-evap planes`: spacing and orientation of lattice planes in reconstructed ions."""

import argparse

from apt_evap.cli._options import add_reading, add_speech
from apt_evap.cli._output import tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Spacing and normal of the lattice planes in a cylinder of reconstructed ions, such as at a pole, and how\n"
        "sharp they are, beside what chance makes of ions without planes. The true spacing calibrates the\n"
        "reconstruction: it says what the efficiency, or else the field factor, is to be multiplied by."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap planes R5083.pos\n"
        "  apt-evap planes R5083.pos --at 4,-2.5 --radius 1.5\n"
        "  apt-evap planes R5083.pos --at 4,-2.5 --tilt 20 --spacing 0.234"
    )
    parser.add_argument("file", metavar="FILE", help="ions with positions (.pos, .epos, ...)")
    parser.add_argument("--at", metavar="X,Y", help="centre of the cylinder [nm]; default: the mean of the ions")
    parser.add_argument(
        "--radius", type=float, default=1.0, metavar="R", help="radius of the cylinder [nm]; default: 1"
    )
    parser.add_argument(
        "--tilt",
        type=float,
        default=10.0,
        metavar="T",
        help="largest angle of the normal from z [degrees]; default: 10",
    )
    parser.add_argument("--reach", type=float, default=1.0, metavar="Z", help="several spacings [nm]; default: 1")
    parser.add_argument(
        "--spacing", type=float, metavar="D", help="true spacing [nm], for the factor of efficiency or field factor"
    )
    add_reading(parser)
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap._common.validation import check_number
    from apt_evap.cli._files import file_of, read
    from apt_evap.detection.hits import Hits
    from apt_evap.reconstruction.lattice_planes import find_planes

    content = read(options)
    if not isinstance(content, Hits) or content.positions is None:
        raise ValueError(f"planes needs reconstructed ions, {options.file!r} has no positions: reconstruct it first")
    positions = file_of(options).select(content).positions
    true = None if options.spacing is None else check_number(options.spacing, "--spacing", above=0, unit="nm")
    at = None if options.at is None else _place(options.at)
    planes = find_planes(positions, at, radius=options.radius, widest=options.tilt, reach=options.reach)
    tell(options, str(planes))
    result = {
        "file": options.file,
        "found": planes.found,
        "amplitude": planes.amplitude,
        "amplitude_by_chance": planes.by_chance.max(),
        "spacing": planes.spacing,
        "spacing_error": planes.spacing_error,
        "depth_resolution": planes.distances.depth_resolution,
        "normal": planes.normal.tolist(),
        "tilt": planes.tilt,
    }
    if true is not None and planes.found:
        factor, error = planes.spacing / true, planes.spacing_error / true
        other = factor**-0.5
        other_error = error * other / (2 * factor)
        result |= {"efficiency_ratio": factor, "efficiency_ratio_error": error}
        result |= {"field_factor_ratio": other, "field_factor_ratio_error": other_error}
        tell(
            options,
            f"the spacing is {true:g} nm with {factor:.3f} ± {error:.3f} times the efficiency, or with {other:.3f} ± "
            f"{other_error:.3f} times the field factor: it depends on efficiency / field factor^2",
        )
    tell_json(options, result)
    return 0


def _place(text):
    """Two numbers [nm]."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--at must be two numbers X,Y [nm], got {text!r:.80}") from None
    return x, y
