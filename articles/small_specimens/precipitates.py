"""
Precipitates with a low and a high evaporation field
====================================================

How large, how dense and how pure a precipitate looks in a reconstruction, for two evaporation fields and three sizes.

Spheres of Al with 50 % Cu are just below the apex of an Al[012] tip. Their evaporation field is 0.85 or 1.2 times that
of the matrix. A sphere with the same field as the matrix shows the errors that have nothing to do with the field. An
instrument with an efficiency of 80 % records the ions, and they are reconstructed with the constants that fit the true
sites best. The script prints a table and writes precipitates.png. The runs take about two minutes on a processor core;
with ``--full``, the tip and the spheres are twice as large.
"""

import argparse
from pathlib import Path

import numpy as np
from recorded import FIT, reconstruct

import apt_evap as ae

ALUMINIUM = ae.material("Al")
COVER = 0.3  # nm of matrix between the apex and the sphere
CASES = {"low": (0.85, (0.8, 1.2, 1.6)), "equal": (1.0, (1.2,)), "high": (1.2, (0.8, 1.2, 1.6))}  # ratio, radii [nm]


def evaporate(ratio, r, radius):
    """Run of a tip with a sphere of radius r [nm], until the apex is 1.2 nm below the sphere."""
    field = ratio * ALUMINIUM.evaporation_field
    region = ae.specimen.Sphere((0, 0, radius - COVER - r), r)
    sphere = ae.specimen.Phase("sphere", ALUMINIUM, region, solutes={"Cu": 0.5}, evaporation_field=field)
    matrix = ae.specimen.Phase("matrix", ALUMINIUM)
    tip = ae.Tip(
        phases=[matrix, sphere], apex_radius=radius, axis=(0, 1, 2), shank_length=2 * radius, depth=4.0, seed=1
    )
    # what the cap sweeps until its apex is 1.2 nm below the sphere
    ions = round((COVER + 2 * r + 1.2) * np.pi * radius**2 / (ALUMINIUM.a**3 / 4), -3)
    return ae.Simulation(tip, seed=1).run(int(ions), [ae.Unperturbed()], responses=False, progress=False)


def draw(axes, run, reconstruction, name):
    """Hits, true sites and reconstructed positions of the ions; those of the sphere are red."""
    hits = reconstruction.hits
    inside = hits.extra["phase"] == 1
    sites, found = hits.positions, reconstruction.fitted_positions(run, FIT)
    numbers = np.flatnonzero(inside)
    window = np.zeros(len(hits), bool)
    window[numbers[0] : numbers[-1] + 1] = True  # while the sphere evaporates
    for ax, (x, y), chosen, size in (
        (axes[0], (hits.x, hits.y), window, 1.5),
        (axes[1], sites.T[[0, 2]], np.abs(sites[:, 1]) < 0.5, 4),
        (axes[2], found.T[[0, 2]], np.abs(found[:, 1]) < 0.5, 4),
    ):
        for kind, color in ((~inside, "0.7"), (inside, "C3")):
            ax.scatter(x[chosen & kind], y[chosen & kind], size, color, linewidths=0, rasterized=True)
        ax.set_aspect("equal")
    half = 3.0 * run.settings["tip"]["apex_radius"] / 5  # nm
    for ax in axes[1:]:
        ax.set(xlim=(-half, half), xlabel="x [nm]", ylabel="z [nm]")
    axes[2].set_ylim(axes[1].get_ylim())
    axes[0].set(xlabel="x [mm]", ylabel=f"{name}\ny [mm]")


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="R = 10 nm in place of 5 nm, and spheres twice as large")
parser.add_argument("--redraw", action="store_true", help="load the runs that an earlier call has saved")
parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder for the runs and the picture")
options = parser.parse_args()
options.output.mkdir(parents=True, exist_ok=True)
scale = 2.0 if options.full else 1.0
radius = 5.0 * scale

figure = ae.plot.new_figure((9.0, 8.6))
figure.set_layout_engine("compressed")
panels = figure.subplots(len(CASES), 3)
for title, ax in zip(("hits while the sphere evaporates", "true sites", "reconstruction"), panels[0], strict=True):
    ax.set_title(title)
for row, (name, (ratio, sizes)) in zip(panels, CASES.items(), strict=True):
    for r in (scale * size for size in sizes):
        path = options.output / f"precipitate_{name}_{r:g}.h5"
        if options.redraw:
            run = ae.load(path)
        else:
            run = evaporate(ratio, r, radius)
            run.save(path)
        reconstruction = reconstruct(run, radius, ALUMINIUM)
        hits = reconstruction.hits
        inside = hits.extra["phase"] == 1
        copper = np.array(run.elements)[hits.extra["species"]] == "Cu"
        found = ae.reconstruction.precipitate_errors(reconstruction, inside, run, copper, fit=FIT)
        errors = reconstruction.errors(run, FIT, groups=hits.extra["phase"])
        print(
            f"{name} field, r = {r:g} nm: {len(run):,} ions, {np.count_nonzero(run.phase == 1)} of the sphere, "
            f"{found.ions} recorded\n"
            f"  semi-axes: true {found.true.lateral:.2f} x {found.true.depth:.2f} nm, apparent "
            f"{found.apparent.lateral:.2f} x {found.apparent.depth:.2f} nm; density {found.density_ratio:.2f}\n"
            f"  Cu: true {found.true_composition[-1]:.1%}, apparent {found.apparent_composition[-1]:.1%} ± "
            f"{found.composition_errors[-1]:.1%}; overlap {found.overlap:.1%} (sites {found.true_overlap:.1%}), lost "
            f"{found.lost:.1%} (sites {found.true_lost:.1%})\n"
            f"  RMS errors of matrix and sphere: lateral {errors.by_group.lateral[0]:.2f}, "
            f"{errors.by_group.lateral[1]:.2f} nm; depth {errors.by_group.depth[0]:.2f}, "
            f"{errors.by_group.depth[1]:.2f} nm",
            flush=True,
        )
        if r == scale * 1.2:
            draw(row, run, reconstruction, f"{name} field")
figure.savefig(options.output / "precipitates.png", dpi=80)
