"""`apt-evap proxigram`: composition as a function of the distance from an isosurface."""

import argparse

from apt_evap.cli._clouds import add_cloud, add_end, read_cloud
from apt_evap.cli._options import number_type
from apt_evap.cli._output import tell, tell_json

_LENGTHS = {
    "step": "width of the steps; default: 0.1",
    "reach": "largest distance; default: 3",
    "voxel": "edge of the voxels; default: 0.5",
    "delocalisation": "standard deviation of the Gaussian over which ions are distributed; default: 0.5",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Draw the composition as a function of the distance from an isosurface of a solute."
    parser.epilog = (
        "example:\n"
        "  apt-evap proxigram R5083.pos --ranges R5083.rrng --solute Cu --isovalue 0.1\n"
        "  apt-evap proxigram precipitate.h5 --solute Cu --isovalue 0.25 --largest"
    )
    group = add_cloud(parser, "proxigram")
    group.add_argument("--isovalue", type=float, metavar="X", required=True, help="fraction of the solute, such as 0.1")
    group.add_argument("--largest", action="store_true", help="only the largest part of the isosurface")
    for name, text in _LENGTHS.items():
        group.add_argument(f"--{name}", type=number_type("nm"), metavar="NM", help=text)
    add_end(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap import plot
    from apt_evap.workflows.written_pictures import save_figure

    cloud, solute, picture = read_cloud(options, "proxigram")
    lengths = {name: getattr(options, name) for name in _LENGTHS if getattr(options, name) is not None}
    profile = cloud.proxigram(solute, options.isovalue, largest=options.largest, **lengths)
    title = f"{', '.join(solute)} at {100 * options.isovalue:g} %, {profile.area:.3g} nm²"
    done = save_figure(picture, plot.composition_profile(profile, title=title).figure)
    tell(options, f"{cloud!r}")
    tell(options, f"isosurface of {profile.area:.4g} nm^2")
    tell(options, done)
    tell_json(options, {"wrote": str(picture), "file": options.file, "ions": len(cloud)} | profile.to_dict())
    return 0
