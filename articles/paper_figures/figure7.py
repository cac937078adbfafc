"""
Zone lines and the radius of the tip
====================================

Widths of a depleted and an enhanced zone line on the detector, for two tips whose radii differ by a factor of 1.5.

This script reproduces figure 7 of Shaikh et al., arXiv 2509.13744: Ni[111] with roll-up. It writes figure7.png,
figure7.json and the two runs. The tips have R = 20 a and 30 a. With ``--full`` they are as large as in the paper,
R = 80 a and 120 a, for which the paper finds equal widths.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import apt_evap as ae
from apt_evap.plot.profile_figures import rectangles as draw_rectangles

# energies of Shaikh et al. for nickel
ROLL_UP = ae.RollUp(ae.TruncatedNormal(mean=0.155, standard_deviation=0.155))
# The crystal is rotated such that a depleted line is along y and an enhanced line along x, as in the paper. [111] is an
# axis with three-fold symmetry, so that each line has two equivalent ones. The profiles of all three are added.
RECTANGLES = {
    "depleted": ae.maps.Rectangle(centre=(0, 52), angle=-90, length=36, width=24),
    "enhanced": ae.maps.Rectangle(centre=(28, 0), angle=0, length=24, width=30),
}
TURNS = (0, 120, 240)  # degrees


def evaporate(radius, ions):
    """Run of a tip with a given radius [a]; only the flights after roll-up are computed."""
    nickel = ae.material("Ni")
    tip = ae.Tip(
        nickel,
        apex_radius=radius * nickel.a,
        axis=(1, 1, 1),
        rotation=90,
        shank_length=2 * radius * nickel.a,
        offset_seed=1,  # no atom on the axis: the three lines differ by chance, like lines of different specimens
        depth=10 * nickel.a,  # depth of the shell of atoms in memory; it is deepened during evaporation
    )
    return ae.Simulation(tip, voltage=1000.0, seed=1).run(ions, [ROLL_UP], responses=False)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="R = 80 a and 120 a, as in the paper")
parser.add_argument("--radii", type=float, nargs=2, help="other radii, in lattice constants")
parser.add_argument("--ions", type=int, help="ions of the larger tip; the smaller tip loses the same fraction")
parser.add_argument("--bins", type=int, default=30, help="bins of each profile (default: %(default)s)")
parser.add_argument("--redraw", action="store_true", help="use the runs that are in the folder")
parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="FOLDER", help="default: the current folder")
options = parser.parse_args()
radii = sorted(options.radii or ((80, 120) if options.full else (20, 30)), reverse=True)
ions_of_larger = options.ions or (1_500_000 if options.full else 135_000)
options.output.mkdir(parents=True, exist_ok=True)

names = [f"R = {radius:g} a" for radius in radii]
# both tips evaporate to the same depth relative to their radius: the number of ions scales with its cube
runs = []
for name, radius in zip(names, radii, strict=True):
    path = options.output / f"figure7_R{radius:g}a.h5"
    if options.redraw:
        runs.append(ae.load(path))
    else:
        runs.append(evaporate(radius, round(ions_of_larger * (radius / radii[0]) ** 3)))
        runs[-1].save(path)
    print(f"{name}: {runs[-1]}")
hits = [run.hits(ROLL_UP) for run in runs]

figure = ae.plot.new_figure((11.0, 9.4))
panels = figure.subplots(4, 2, width_ratios=(1, 1.15), height_ratios=(3, 1, 3, 1))
results = {}
for row, (kind, rectangle) in enumerate(RECTANGLES.items()):
    rectangles = [rectangle.turned(angle) for angle in TURNS]
    profiles = [ae.maps.zone_line_profile(hit, rectangles, bins=options.bins) for hit in hits]
    lines = [ae.maps.fit_zone_line(profile, exponent=None) for profile in profiles]
    comparison = ae.maps.compare_profiles(*profiles)
    difference = (lines[0].width - lines[1].width) / (lines[0].width_error ** 2 + lines[1].width_error ** 2) ** 0.5
    for name, line in zip(names, lines, strict=True):
        print(f"{kind} line, {name}: {line}, chi-square {line.chi_square:.0f} / {line.degrees_of_freedom}")
    print(
        f"  widths differ by {difference:+.1f} errors; chi-square of the profiles {comparison.chi_square:.0f} / "
        f"{comparison.degrees_of_freedom} (probability {comparison.probability:.2g}), relative "
        f"difference beyond noise {comparison.relative:.1%}"
    )
    results[kind] = {
        "rectangle [mm]": asdict(rectangle),
        "lines": dict(zip(names, map(asdict, lines), strict=True)),
        "width difference / error": difference,
        "profiles": {
            name: {"position [mm]": p.position.tolist(), "density": p.density.tolist(), "error": p.error.tolist()}
            for name, p in zip(names, profiles, strict=True)
        },
        "chi_square": comparison.chi_square,
        "degrees_of_freedom": comparison.degrees_of_freedom,
        "probability": comparison.probability,
    }

    # the map of the larger tip, beside the profiles of both tips
    for panel in panels[2 * row : 2 * row + 2, 0]:
        panel.remove()
    map_axes = figure.add_subplot(panels[0, 0].get_gridspec()[2 * row : 2 * row + 2, 0])
    density = hits[0].map(like=ae.Detector(width=150.0).grid(150), position_step=None).smoothed(1.0)
    ae.plot.detector_map(density, map_axes, title=f"{kind} lines, {names[0]}")
    draw_rectangles(rectangles, map_axes)
    axes = panels[2 * row : 2 * row + 2, 1]
    axes[1].sharex(axes[0])
    ae.plot.profile_comparison(*profiles, names, axes, lines=lines)

figure.savefig(options.output / "figure7.png")
settings = dict(zip(names, (run.settings for run in runs), strict=True))
ions = dict(zip(names, map(len, runs), strict=True))
results = {"settings": settings, "ions": ions, "perturbation": repr(ROLL_UP), "results": results}
(options.output / "figure7.json").write_text(json.dumps(results, indent=1) + "\n")
