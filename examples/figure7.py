"""
Zone lines and the radius of the tip
====================================

The widths of a depleted and an enhanced line on the detector, for two tips that differ by 1.5 in radius.

Redraws figure 7 of Shaikh et al., arXiv 2509.13744: Ni[111] that rolls up. Writes figure7.png, figure7.json and the two
runs. Tips have R = 20 a and 30 a; `--full` makes them as large as the paper's, R = 80 a and 120 a, where it finds equal
widths.
"""

# sphinx_gallery_thumbnail_path = 'figure7.png'

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

import apt_evap as ae

# the energies that Shaikh et al. find for nickel
ROLL_UP = ae.RollUp(ae.TruncatedNormal(mean=0.155, standard_deviation=0.155))
# the crystal is turned so that a depleted line runs along y and an enhanced one along x, as in the paper; each has two
# more like it, since [111] is an axis of three-fold symmetry, and all three are laid over each other
RECTANGLES = {
    "depleted": ae.Rectangle(centre=(0, 52), angle=-90, length=36, width=24),
    "enhanced": ae.Rectangle(centre=(28, 0), angle=0, length=24, width=30),
}
TURNS = (0, 120, 240)  # degrees


def evaporate(radius, ions):
    """The run of a tip of some radius [a], with the roll-up flown and nothing else."""
    nickel = ae.material("Ni")
    tip = ae.Tip(
        nickel,
        apex_radius=radius * nickel.a,
        axis=(1, 1, 1),
        rotation=90,
        shank_length=2 * radius * nickel.a,
        offset_seed=1,  # no atom on the axis: the three lines differ by chance, as lines of two specimens do
        depth=10 * nickel.a,  # tips grow deeper as they evaporate; this much is held at a time
    )
    return ae.Simulation(tip, voltage=1000.0, seed=1).run(ions, [ROLL_UP], responses=False)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="R = 80 a and 120 a, as in the paper")
parser.add_argument("--radii", type=float, nargs=2, help="other radii, in lattice constants")
parser.add_argument("--ions", type=int, help="ions of the larger tip; the smaller one loses its equal share")
parser.add_argument("--bins", type=int, default=30, help="strips of each profile (%(default)s)")
parser.add_argument("--redraw", action="store_true", help="take the runs that are in the folder")
parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="FOLDER", help="the current one by default")
options = parser.parse_args()
radii = sorted(options.radii or ((80, 120) if options.full else (20, 30)), reverse=True)
most = options.ions or (1_500_000 if options.full else 135_000)
options.output.mkdir(parents=True, exist_ok=True)

names = [f"R = {radius:g} a" for radius in radii]
# both evaporate to the same depth in units of their radius: ions go with its cube
runs = []
for name, radius in zip(names, radii, strict=True):
    path = options.output / f"figure7_R{radius:g}a.h5"
    if options.redraw:
        runs.append(ae.load(path))
    else:
        runs.append(evaporate(radius, round(most * (radius / radii[0]) ** 3)))
        runs[-1].save(path)
    print(f"{name}: {runs[-1]}")
hits = [run.hits(ROLL_UP) for run in runs]

figure = ae.plot.new_figure((11.0, 9.4))
panels = figure.subplots(4, 2, width_ratios=(1, 1.15), height_ratios=(3, 1, 3, 1))
results = {}
for row, (kind, rectangle) in enumerate(RECTANGLES.items()):
    alike = [rectangle.turned(angle) for angle in TURNS]
    profiles = [ae.zone_line_profile(hit, alike, bins=options.bins) for hit in hits]
    lines = [ae.fit_zone_line(profile, exponent=None) for profile in profiles]
    compared = ae.compare_profiles(*profiles)
    apart = (lines[0].width - lines[1].width) / (lines[0].width_error ** 2 + lines[1].width_error ** 2) ** 0.5
    for name, line in zip(names, lines, strict=True):
        print(f"{kind} line, {name}: {line}, chi-square {line.chi_square:.0f} for {line.degrees_of_freedom}")
    print(
        f"  widths differ by {apart:+.1f} errors; profiles by a chi-square of {compared.chi_square:.0f} for "
        f"{compared.degrees_of_freedom} (probability {compared.probability:.2g}), {compared.relative:.1%} beyond noise"
    )
    results[kind] = {
        "rectangle [mm]": asdict(rectangle),
        "lines": dict(zip(names, map(asdict, lines), strict=True)),
        "width difference / error": apart,
        "profiles": {
            name: {"position [mm]": p.position.tolist(), "density": p.density.tolist(), "error": p.error.tolist()}
            for name, p in zip(names, profiles, strict=True)
        },
        "chi_square": compared.chi_square,
        "degrees_of_freedom": compared.degrees_of_freedom,
        "probability": compared.probability,
    }

    # the map of the larger tip beside the profiles of both
    for unused in panels[2 * row : 2 * row + 2, 0]:
        unused.remove()
    beside = figure.add_subplot(panels[0, 0].get_gridspec()[2 * row : 2 * row + 2, 0])
    density = (
        hits[0].map(bins=150, extent=(-75, 75, -75, 75), quantum=None, mask=np.ones((150, 150), bool)).smoothed(1.0)
    )
    ae.plot.detector_map(density, beside, title=f"{kind} lines, {names[0]}")
    ae.plot.rectangles(alike, beside)
    axes = panels[2 * row : 2 * row + 2, 1]
    axes[1].sharex(axes[0])
    ae.plot.profile_comparison(*profiles, names, axes, lines=lines)

figure.savefig(options.output / "figure7.png")
settings = dict(zip(names, (run.settings for run in runs), strict=True))
ions = dict(zip(names, map(len, runs), strict=True))
results = {"settings": settings, "ions": ions, "perturbation": repr(ROLL_UP), "results": results}
(options.output / "figure7.json").write_text(json.dumps(results, indent=1) + "\n")
