"""`apt-evap planes`: spacing and orientation of lattice planes in reconstructed ions."""

import argparse

from apt_evap.cli._options import add_reading, add_speech
from apt_evap.cli._output import tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Spacing and normal of the lattice planes in a cylinder of reconstructed ions, such as at a pole, and how\n"
        "sharp they are. The true spacing calibrates the reconstruction: multiply the efficiency by the observed\n"
        "spacing divided by the true one."
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
        "--spacing", type=float, metavar="D", help="true spacing [nm], for the factor of the efficiency"
    )
    add_reading(parser)
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap._common.validation import check_number
    from apt_evap.cli._files import file_of, read
    from apt_evap.detection.hits import Hits
    from apt_evap.reconstruction.calibration import find_planes

    content = read(options)
    if not isinstance(content, Hits) or content.positions is None:
        raise ValueError(f"planes needs reconstructed ions, {options.file!r} has no positions: reconstruct it first")
    positions = file_of(options).select(content).positions
    at = None if options.at is None else _place(options.at)
    planes, normal, tilt = find_planes(positions, at, radius=options.radius, widest=options.tilt, reach=options.reach)
    result = {
        "file": options.file,
        "spacing": planes.spacing,
        "amplitude": planes.amplitude,
        "depth_resolution": planes.depth_resolution,
        "normal": normal.tolist(),
        "tilt": tilt,
    }
    tell(options, f"spacing {planes.spacing:.4f} nm, amplitude {planes.amplitude:.3f} (1 for perfect planes)")
    tell(options, f"scatter about the planes {planes.depth_resolution:.3f} nm, of {planes.references:,} ions")
    tell(options, f"normal ({', '.join(f'{part:.3f}' for part in normal)}), {tilt:.1f} degrees from z")
    if options.spacing is not None:
        factor = planes.spacing / check_number(options.spacing, "--spacing", above=0, unit="nm")
        result["efficiency_factor"] = factor
        tell(options, f"the spacing is {options.spacing:g} nm with {factor:.3f} times the efficiency")
    tell_json(options, result)
    return 0


def _place(text):
    """Two numbers [nm]."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--at must be two numbers X,Y [nm], got {text!r:.80}") from None
    return x, y
