"""`apt-evap clusters`: clusters of a solute."""

import argparse
import math

from apt_evap.cli._clouds import add_cloud, add_end, read_cloud
from apt_evap.cli._declared_options import add_declared
from apt_evap.cli._output import tell, tell_json

_SETTINGS = ("d_max", "n_min", "order", "envelope", "erosion")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Find clusters of a solute by the maximum separation method, and draw them with their compositions.\n"
        "Without --d-max, it and --n-min are chosen against random labels of the same ions."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap clusters R5083.pos --ranges R5083.rrng --solute Cu\n"
        "  apt-evap clusters R5083.pos --ranges R5083.rrng --solute Cu,Mg --d-max 0.5 --n-min 20 --envelope 0.5\n"
        "  apt-evap clusters precipitate.h5 --solute Cu          true sites of a run, for comparison"
    )
    add_declared(add_cloud(parser, "clusters"), "measures.clusters", "ClusterSettings", _SETTINGS)
    add_end(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap import plot
    from apt_evap.workflows.written_pictures import save_figure

    cloud, solute, picture = read_cloud(options, "clusters")
    chosen = {name: getattr(options, name) for name in _SETTINGS if getattr(options, name) is not None}
    result = cloud.clusters(solute, **chosen)
    done = save_figure(picture, plot.clusters(result)[0].figure)
    tell(options, f"{cloud!r}")
    if result.choice is not None:
        separation = f"d_max {result.choice.d_max:.3f} nm, N_min {result.settings.n_min}"
        tell(options, f"chosen against random labels: {separation} (p = {result.choice.p_value:.2f})")
    number = f"{len(result)} {'cluster' if len(result) == 1 else 'clusters'}"
    tell(options, f"{number} with {result.clustered_fraction:.1%} of the solutes")
    if len(result):
        value, error = result.number_density()
        tell(options, f"{value:.3g} ± {error:.2g} per nm^3; {int(result.at_edge.sum())} at the edge count by one half")
        for name, part in (("clusters", result.fractions()), ("matrix", result.matrix_fractions())):
            listed = ", ".join(
                f"{element} {100 * x:.2f} ± {100 * s:.2f} %" for element, (x, s) in part.items() if math.isfinite(x)
            )
            tell(options, f"{name}: {listed or 'no composition, as no other ion is between their solutes'}")
        atoms = result.atoms.sum(axis=0)
        if (total := atoms.sum()) > 0:  # erosion may leave none
            listed = ", ".join(f"{name} {100 * n / total:.2f} %" for name, n in zip(cloud.elements, atoms, strict=True))
            tell(options, f"all ions after envelope and erosion, which are near solutes by choice: {listed}")
    tell(options, done)
    tell_json(options, {"wrote": str(picture), "file": options.file, "ions": len(cloud)} | result.to_dict())
    return 0
