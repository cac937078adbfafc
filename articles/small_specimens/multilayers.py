"""
Multilayers across and along the axis
=====================================

How sharp interfaces are in a reconstruction, for layers across the axis of the tip and along it.

A Ni[001] tip has coherent layers of another metal with an evaporation field of 28 V/nm, 0.8 times that of Ni. Its
interfaces are atomically sharp. The script prints the widths of the interfaces from 10 to 90 %, at the true sites and
in the reconstruction, and writes multilayers.png. The runs take about one minute on a processor core. ``--field 19`` is
the field of Al.
"""

import argparse
from pathlib import Path

import numpy as np
from recorded import FIT, reconstruct

import apt_evap as ae

NICKEL = ae.material("Ni")


def evaporate(normal, bounds, field, ions, radius):
    """Run of a tip with layers between bounds along a normal [nm]."""
    region = ae.specimen.Union([ae.specimen.Layer(lower, upper, normal=normal) for lower, upper in bounds])
    layers = ae.specimen.Phase("layers", ae.material("Al", a=NICKEL.a), region, evaporation_field=field)
    tip = ae.Tip(
        phases=[ae.specimen.Phase("Ni", NICKEL), layers], apex_radius=radius, axis=(0, 0, 1), shank_length=2 * radius,
        depth=4.0, offset_seed=1,
    )  # fmt: skip
    return ae.Simulation(tip, seed=1).run(ions, [ae.Unperturbed()], responses=False, progress=False)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="R = 10 nm in place of 5 nm, and layers twice as thick")
parser.add_argument("--field", type=float, default=28.0, help="evaporation field of the layers [V/nm]; default: 28")
parser.add_argument("--redraw", action="store_true", help="load the runs that an earlier call has saved")
parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder for the runs and the picture")
options = parser.parse_args()
options.output.mkdir(parents=True, exist_ok=True)
scale = 2.0 if options.full else 1.0
radius = 5.0 * scale

# %%
# Normal and bounds of the layers, and number of ions. Bounds are in the coordinates of the specimen: the apex is at z =
# `radius`.

apex = radius / scale
CASES = {
    "along": ((1, 0, 0), [(-2.25, -0.75), (0.75, 2.25)], 15_000),
    "across": ((0, 0, 1), [(apex - 1.9, apex - 0.7), (apex - 4.3, apex - 3.1)], 26_000),
}

figure = ae.plot.new_figure((9.6, 4.8))
figure.set_layout_engine("compressed")
panels = figure.subplots(len(CASES), 3)
for title, ax in zip(("true sites", "reconstruction", "fraction of the layers' metal"), panels[0], strict=True):
    ax.set_title(title)
for row, (name, (normal, bounds, ions)) in zip(panels, CASES.items(), strict=True):
    bounds = [(scale * lower, scale * upper) for lower, upper in bounds]
    path = options.output / f"{name}.h5"
    if options.redraw:
        run = ae.load(path)
    else:
        run = evaporate(normal, bounds, options.field, round(ions * scale**3), radius)
        run.save(path)
    reconstruction = reconstruct(run, radius, NICKEL)
    layer = reconstruction.hits.extra["phase"] == 1
    sites, found = reconstruction.hits.positions, reconstruction.fitted_positions(run, FIT)
    print(
        f"layers {name} the axis: {run}, {np.count_nonzero(run.detached)} detached; {reconstruction.errors(run, FIT)}"
    )

    # interfaces whose ions are recorded on both sides; near the axis the cap is nearly a plane
    axis = sites[:, :2] ** 2
    core = axis.sum(axis=1) < (1.5 * scale) ** 2
    along = np.array(normal, dtype=float)
    for place in sorted(bound for pair in bounds for bound in pair):
        for label, chosen in (("all ions", slice(None)), ("within 1.5 nm of the axis", core)):
            widths = []
            for positions in (sites[chosen], found[chosen]):
                try:
                    widths.append(
                        ae.measures.interface_profile(positions @ along - place, layer[chosen], reach=0.6 * scale)
                    )
                except ValueError:  # too few ions on one side
                    break
            else:
                true, apparent = widths
                print(
                    f"  interface at {place:g} nm, {label}: width {true.width:.2f} nm in truth, {apparent.width:.2f} ± "
                    f"{apparent.width_error:.2f} nm reconstructed, shifted by {apparent.centre - true.centre:+.2f} nm"
                )

    for ax, positions in zip(row, (sites, found), strict=False):
        near = np.abs(positions[:, 1]) < 0.4 * scale
        for kind, color in ((~layer, "0.7"), (layer, "C0")):
            ax.scatter(*positions[near & kind].T[[0, 2]], 3, color, linewidths=0, rasterized=True)
        ax.set(xlabel="x [nm]", ylabel="z [nm]", aspect="equal")
    row[1].set(xlim=row[0].get_xlim(), ylim=row[0].get_ylim())
    selection = slice(None) if normal[0] else core
    limits = np.percentile(sites[selection] @ along, [1, 99])
    edges = np.arange(*limits, NICKEL.a / 2)  # one plane of the crystal in each bin
    for positions, label in ((sites, "sites"), (found, "reconstruction")):
        places = positions[selection] @ along
        every, some = np.histogram(places, edges)[0], np.histogram(places[layer[selection]], edges)[0]
        seen = every > 0
        row[2].plot(((edges[1:] + edges[:-1]) / 2)[seen], some[seen] / every[seen], ".-", label=label)
    row[2].set(xlabel="x [nm]" if normal[0] else "z [nm]", ylim=(-0.05, 1.05))
panels[1, 2].legend(loc="upper center", bbox_to_anchor=(0.5, -0.3), ncols=2, frameon=False)
figure.savefig(options.output / "multilayers.png", dpi=80)
