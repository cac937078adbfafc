"""`apt-evap map`: draw detector maps of a run or of measured ions, with the poles of the crystal."""

import argparse
from pathlib import Path

from apt_evap.cli._options import (
    FILE_HELP,
    MAX_BINS,
    add_flight,
    add_peaks,
    add_reading,
    add_real_units,
    add_speech,
    integer_type,
    number_type,
    numbers_type,
)
from apt_evap.cli._output import tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Draw detector maps of a run or of measured ions, or a map."
    parser.epilog = (
        "example:\n"
        "  apt-evap map R5083.epos --bins 128\n"
        "  apt-evap map R5083.epos --ranges R5083.rrng --species Si --voltage 4000, --circle 15 -o silicon.png\n"
        "  apt-evap map ni111.h5 --perturbation Unperturbed --perturbation RollUp:0.3,0.1 -o energies.png\n"
        "  apt-evap map ni111.h5 --field-ion Ne -o image.png\n"
        "  apt-evap map ni111.h5 --poles\n"
        "  apt-evap map ni111.h5 --width 85 -o figure.pdf\n"
        "  apt-evap map R5083.epos --poles W --axis 0,1,1 --distance 90\n\n"
        "a perturbation is NAME, NAME:NUMBERS or a TOML table:\n"
        "  Unperturbed              RollUp:0.2 (eV, all ions)    RollUp:0.155,0.155 (mean, standard deviation)\n"
        "  LateralVelocity:0.3,0.1  Combined:0.155,0.155,0.75 (the last number is the roll-up fraction)\n"
        '  \'{name = "RollUp", energy = {name = "Thermal", temperature = 50}}\''
    )
    parser.add_argument("file", metavar="FILE", help=FILE_HELP)
    add_reading(parser)
    parser.add_argument(
        "-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_map.png in this folder"
    )
    parser.add_argument(
        "--bins",
        type=integer_type(1, MAX_BINS),
        metavar="N",
        help="bins along the longer side; default: about sqrt(ions)",
    )
    parser.add_argument("--smooth", type=number_type("mm"), metavar="MM", help="sigma of a Gaussian; default: one bin")
    parser.add_argument(
        "--perturbation",
        action="append",
        metavar="P",
        help="perturbation of the ions of a run; repeat it for maps side by side",
    )
    parser.add_argument(
        "--field-ion",
        nargs="?",
        const="Ne",
        choices=("He", "Ne", "Ar", "H2"),
        metavar="GAS",
        help="field-ion image of the surface at the end of a run, in He, Ne, Ar or H2; default: Ne",
    )
    parser.add_argument(
        "--width",
        type=number_type("mm"),
        metavar="MM",
        help="figure for a paper, this wide, such as 85: panel letters and a scale bar, no titles",
    )
    _add_crystal(parser)
    add_real_units(parser)
    parser.add_argument("--force", action="store_true", help="overwrite a file not made by apt-evap")
    add_speech(parser)


def _add_crystal(parser):
    """Add options of the crystal on the map."""
    group = parser.add_argument_group("crystal", "Poles and zone lines over the map.")
    group.add_argument(
        "--poles",
        nargs="?",
        const="",
        metavar="NAME",
        help="draw them, of a run or of a crystal such as W, or of a material of your own, as for apt-evap index, "
        "which also searches where they are",
    )
    group.add_argument(
        "--axis",
        type=numbers_type,
        metavar="H,K,L",
        help="pole near the centre of the map, or with --rotation the axis",
    )
    group.add_argument("--rotation", type=float, metavar="DEGREES", help="of the crystal about its axis; no search")
    group.add_argument("--scale", type=number_type("mm/rad"), metavar="S", help="scale of the map [mm/rad]")
    add_flight(group)
    add_peaks(group)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap.cli._maps_of_file import maps_of_file
    from apt_evap.workflows.maps_of_run import map_summaries
    from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path, save_picture

    picture = picture_path(options.output or f"{Path(options.file).stem}_map.png")
    check_output(picture, is_picture, options.force)
    maps, titles, title, crystal, phases = maps_of_file(options)
    colors = {} if options.field_ion is None else {"colormap": "gray", "label": "brightness / mean"}
    written = save_picture(picture, maps, titles, title, crystal, width=options.width, phases=phases, **colors)
    tell(options, written)
    tell_json(options, {"wrote": str(picture), "file": options.file, "maps": map_summaries(maps, titles)})
    return 0
