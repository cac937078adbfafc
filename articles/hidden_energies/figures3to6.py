"""
Emission energies of aluminium and nickel
=========================================

Similarity with a measured map on the energy grid of Shaikh et al. (2025), and the maps for the best energies: lateral
velocities for Al[012], roll-up for Ni[111], and both combined for nickel.

This script reproduces figures 3 to 6 of this paper, arXiv 2509.13744. Its experiments are not public. Without
arguments, a simulated twin replaces each measured map. The twin is another specimen, with other random numbers and the
energies found there. Its map is rotated, scaled, shifted and limited to a circle. The figures then show the method,
and how well it recovers known energies. To use measured maps, run ::

    python figures3to6.py --measured-al al.epos --measured-ni ni.npz

The measured specimens must have the axis [012] or [111]. For other axes, use measured_map.py. The registration is
automatic.

The script writes figure3.png to figure6.png, figures3to6.json and the runs. The tips have R = 20 a and 40,000 ions
each. With ``--full`` they are as large as in the paper, R = 80 a, with 400,000 ions each.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import apt_evap as ae

# axis, mechanism and energies of Shaikh et al. (2025): mean [eV], standard deviation / mean
CASES = {"Al": ((0, 1, 2), "lateral", 0.3, 0.316), "Ni": ((1, 1, 1), "roll-up", 0.155, 1.0)}
MECHANISMS = {"lateral": ae.LateralVelocity, "roll-up": ae.RollUp}
# registration of the twins on their detector, and its field of view: 30 degrees of flight directions
INSTRUMENT = ae.Registration(rotation=8.0, scale=0.3, shift=(1.5, -1.0))
FIELD_OF_VIEW = 18.0  # mm, radius

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--measured-al", metavar="FILE", help="measured ions or map (.npz) of aluminium along [012]")
parser.add_argument("--measured-ni", metavar="FILE", help="measured ions or map (.npz) of nickel along [111]")
parser.add_argument("--full", action="store_true", help="R = 80 a and 400,000 ions, as in the paper")
parser.add_argument("--radius", type=float, help="apex radius in lattice constants")
parser.add_argument("--ions", type=int, help="number of ions of each run")
parser.add_argument("--bins", type=int, help="bins across the measured maps; default: 64, or 128 with --full")
parser.add_argument("--resamples", type=int, default=200, help="resamples for the errors (default: %(default)s)")
parser.add_argument("--redraw", action="store_true", help="use the runs that are in their folder")
parser.add_argument("--runs", type=Path, metavar="FOLDER", help="folder of the runs; default: that of the figures")
parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="FOLDER", help="default: the current folder")
options = parser.parse_args()
radius = options.radius or (80 if options.full else 20)
ions = options.ions or (400_000 if options.full else 40_000)
bins = options.bins or (128 if options.full else 64)
runs = options.runs or options.output
for folder in (options.output, runs):
    folder.mkdir(parents=True, exist_ok=True)


def evaporate(metal, name, seed):
    """Run with responses; the seed also determines the origin of the lattice."""
    path = runs / f"{metal}_{name}_R{radius:g}a.h5"
    if options.redraw:
        return ae.load(path)
    material = ae.material(metal)
    tip = ae.Tip(
        material,
        apex_radius=radius * material.a,
        axis=CASES[metal][0],
        shank_length=2 * radius * material.a,
        offset_seed=seed,
        depth=10 * material.a,  # depth of the shell of atoms in memory
    )
    run = ae.Simulation(tip, voltage=1000.0, seed=seed).run(ions)
    run.save(path)
    return run


def measurement(metal, path):
    """Measured ions or map from a file, or the map of the twin."""
    if path:
        return ae.io.read_map(path) if path.endswith(".npz") else ae.read(path)
    _, mechanism, mean, relative_spread = CASES[metal]
    hits = evaporate(metal, "twin", seed=2).hits(
        MECHANISMS[mechanism](ae.TruncatedNormal(mean, relative_spread * mean))
    )
    # the edge of the field of view is known; an outline determined from few hits would extend beyond it
    centres = (np.arange(bins) + 0.5) * 2 / bins - 1
    inside = np.hypot(centres, centres[:, None]) < 1 - 2 / bins
    extent = (-FIELD_OF_VIEW, FIELD_OF_VIEW, -FIELD_OF_VIEW, FIELD_OF_VIEW)
    return INSTRUMENT.hits(hits).map(bins=bins, extent=extent, position_step=None, mask=inside)


studies, sources = {}, {}
for metal, path in (("Al", options.measured_al), ("Ni", options.measured_ni)):
    measured = measurement(metal, path)
    run = evaporate(metal, "run", seed=1)
    sources[metal] = {"simulated": repr(run), "measured": path or "twin", "map": repr(measured)}
    mechanism = CASES[metal][1]
    settings = ae.fit.FitSettings(bins=bins, resamples=options.resamples, objective="similarity")
    study = studies[f"{metal} {mechanism}"] = ae.fit_energies(run, measured, ae.fit.EnergyGrid(mechanism), settings)
    print(f"{metal}: {run};\n measured {measured};\n {study.registration}", flush=True)
    if metal == "Ni":
        # the registration determines the compared region: both mechanisms use the same one and can be compared
        grid = ae.fit.EnergyGrid("combined")
        studies["Ni combined"] = ae.fit_energies(run, measured, grid, settings, registration=study.registration)

figure = ae.plot.new_figure((12.0, 5.0))
for ax, (name, title) in zip(
    figure.subplots(1, 2), {"Al lateral": "Al[012], lateral", "Ni roll-up": "Ni[111], roll-up"}.items(), strict=True
):
    ae.plot.score_matrix(studies[name], [ax])
    ax.set_title(title)
figure.savefig(options.output / "figure3.png")
ae.plot.score_matrix(studies["Ni combined"])[0].figure.savefig(options.output / "figure4.png")
for name, number in (("Al lateral", 5), ("Ni roll-up", 6)):
    study, (metal, mechanism) = studies[name], name.split()
    best, (_, _, mean, relative_spread) = study.optimum, CASES[metal]
    titles = (
        "measured" if sources[metal]["measured"] != "twin" else f"twin, {mean:g} eV, σ/mean {relative_spread:g}",
        "simulated, unperturbed",
        f"simulated, {mechanism}\n{best.mean:g} eV, σ/mean {best.relative_spread:g}",
    )
    ae.plot.side_by_side(study, titles=titles)[0].figure.savefig(options.output / f"figure{number}.png")

print("\n| study | best | interpolated, 95 % | SSIM | unperturbed | thermal | uncorrected SSIM | two halves |")
print("|---|---|---|---|---|---|---|---|")
for name, study in studies.items():
    best, refined = study.optimum, study.refined
    combined = name == "Ni combined"
    grid = f"{best.mean:g} eV, {best.relative_spread:g}" + (f", f {best.rollup_fraction:g}" if combined else "")
    optimum = f"{refined.bounded('mean')} eV, {refined.bounded('relative_spread')}"
    optimum += f", f {refined.bounded('rollup_fraction')}" if combined else ""
    scores = [best.score, *study.baselines.values(), study.plain["optimum"], study.ceiling or "unknown"]
    print("|", " | ".join([name, grid, optimum, *map(str, scores)]), "|")
results = {
    "sources": sources,
    "energies of the twins": {
        metal: dict(zip(("axis", "mechanism", "mean [eV]", "relative_spread"), case, strict=True))
        for metal, case in CASES.items()
    },
    "studies": {name: study.to_dict() for name, study in studies.items()},
}
(options.output / "figures3to6.json").write_text(json.dumps(results, indent=1) + "\n")
