"""
A precipitate and a grain boundary in a superalloy
==================================================

Composition and order of a gamma prime precipitate, and the excess of an element at a grain boundary, in truth and in a
reconstruction.

The matrix of the tip is Ni[001] with 5 % Al. It contains a sphere of Ni3Al with the order L1_2, and a second grain that
is rotated by 30 degrees about the axis. Ti is segregated to the grain boundary. Al has the evaporation field of 28
V/nm. The script prints the results and writes superalloy.png. The run takes about half a minute on a processor core.
"""

import argparse
from pathlib import Path

import numpy as np
from recorded import FIT, reconstruct

import apt_evap as ae

NICKEL = ae.material("Ni")
COLORS = {"Ni": "0.8", "Al": "C0", "Ti": "C3"}

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="R = 11 nm in place of 5.5 nm, and a sphere twice as large")
parser.add_argument("--redraw", action="store_true", help="load the run that an earlier call has saved")
parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder for the run and the picture")
options = parser.parse_args()
options.output.mkdir(parents=True, exist_ok=True)
scale = 2.0 if options.full else 1.0
radius, r = 5.5 * scale, 1.3 * scale

# %%
# The specimen. Both grains have the same solutes, with a segregation to their boundary.

boundary = ae.specimen.HalfSpace(point=(1.2 * scale, 0, 0), normal=(1, 0, 0))
sphere = ae.specimen.Sphere((-1.2 * scale, 0, radius - 0.6 * scale - r), r)
segregation = ae.specimen.Segregation(bulk=0.01, peak=0.15, width=0.35, region=boundary)
solutes, fields = {"Al": 0.05, "Ti": segregation}, {"Al": 28.0}
phases = [
    ae.specimen.Phase("gamma", NICKEL, solutes=solutes, evaporation_field=fields),
    ae.specimen.Phase(
        "second grain", NICKEL, boundary, axis=(0, 0, 1), rotation=30.0, solutes=solutes, evaporation_field=fields
    ),
    ae.specimen.Phase(
        "gamma prime", NICKEL, sphere, order=ae.specimen.Superlattice("L1_2", "Al"), evaporation_field=fields
    ),
]
path = options.output / "superalloy.h5"
if options.redraw:
    run = ae.load(path)
else:
    tip = ae.Tip(phases=phases, apex_radius=radius, axis=(0, 0, 1), shank_length=2 * radius, depth=4.0, seed=1)
    simulation = ae.Simulation(tip, seed=1)
    run = simulation.run(round(34_000 * scale**3), [ae.Unperturbed()], responses=False, progress=False)
    run.save(path)

# %%
# What the instrument records, and its reconstruction.

reconstruction = reconstruct(run, radius, NICKEL)
hits = reconstruction.hits
phase, species = hits.extra["phase"], np.array(run.elements)[hits.extra["species"]]
sites, found = hits.positions, reconstruction.fitted_positions(run, FIT)
errors = reconstruction.errors(run, FIT, groups=phase)
print(run, reconstruction, errors, sep="\n")
for number, name in enumerate(run.phase_names):
    row = np.flatnonzero(errors.by_group.groups == number)[0]
    print(f"{name}: lateral {errors.by_group.lateral[row]:.2f}, depth {errors.by_group.depth[row]:.2f} nm")

particle = ae.reconstruction.precipitate_errors(reconstruction, phase == 2, run, species == "Al", fit=FIT)
print(
    f"gamma prime: {particle.ions} ions; semi-axes true {particle.true.lateral:.2f} x {particle.true.depth:.2f} nm, "
    f"apparent {particle.apparent.lateral:.2f} x {particle.apparent.depth:.2f} nm; Al true "
    f"{particle.true_composition[-1]:.1%}, apparent {particle.apparent_composition[-1]:.1%} ± "
    f"{particle.composition_errors[-1]:.1%}; overlap {particle.overlap:.1%}"
)
for name, positions in (("sites", sites), ("reconstruction", found)):
    for label, chosen in (("all ions", phase == 2), ("Al", (phase == 2) & (species == "Al"))):
        planes = ae.reconstruction.distribution_map(positions[chosen])
        print(f"planes of {label} in gamma prime, {name}: {planes.spacing:.3f} nm")

profiles = {}
for name, positions in (("sites", sites), ("reconstruction", found)):
    away = phase != 2  # the precipitate has no Ti
    profiles[name] = ae.measures.segregation_profile(
        boundary.distance(positions[away]), species[away] == "Ti", reach=2.0
    )
    peak = profiles[name]
    print(
        f"Ti at the boundary, {name}: bulk {peak.bulk:.1%}, peak {peak.peak:.1%}, width {peak.width:.2f} ± "
        f"{peak.width_error:.2f} nm at {peak.centre:+.2f} nm, excess {4 / NICKEL.a**3 * peak.excess:.1f} ± "
        f"{4 / NICKEL.a**3 * peak.excess_error:.1f} atoms/nm^2"
    )

# %%
# Hits, slices of the specimen and of the reconstruction, and the profile across the boundary.

figure = ae.plot.new_figure((9.6, 6.4))
figure.set_layout_engine("compressed")
panels = figure.subplots(2, 2)
slices = [np.abs(positions[:, 1]) < 0.5 * scale for positions in (sites, found)]
for ax, (x, y), chosen, title in (
    (panels[0, 0], (hits.x, hits.y), np.ones(len(hits), bool), "hits"),
    (panels[0, 1], sites.T[[0, 2]], slices[0], "true sites"),
    (panels[1, 0], found.T[[0, 2]], slices[1], "reconstruction"),
):
    for name, color in COLORS.items():
        kind = chosen & (species == name)
        ax.scatter(x[kind], y[kind], 2 if title == "hits" else 5, color, linewidths=0, rasterized=True, label=name)
    ax.set(title=title, aspect="equal", xlabel="x [nm]", ylabel="z [nm]")
panels[0, 0].set(xlabel="x [mm]", ylabel="y [mm]")
panels[0, 1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, markerscale=2)
panels[1, 0].set(xlim=panels[0, 1].get_xlim(), ylim=panels[0, 1].get_ylim())
for (name, profile), color in zip(profiles.items(), ("k", "C3"), strict=True):
    panels[1, 1].errorbar(profile.centres, 100 * profile.fraction, 100 * profile.fraction_errors, fmt="o", color=color)
    distances = np.linspace(-2, 2, 200)
    panels[1, 1].plot(distances, 100 * profile.fitted(distances), color=color, label=name)
panels[1, 1].set(title="Ti at the grain boundary", xlabel="distance [nm]", ylabel="Ti [%]", ylim=(-0.5, 20))
panels[1, 1].legend(loc="upper left", frameon=False)
figure.savefig(options.output / "superalloy.png", dpi=80)
