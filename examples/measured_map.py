"""
Energies from a measured map
============================

Emission energies from a measured map with indexed poles. The poles give the orientation of the specimen. A tip is
simulated along this axis, and `fit_energies` compares its maps with the measured map for every mechanism.

Each pole is given by its indices and its position on the map [mm]. For a map of nickel ::

    python measured_map.py Ni map.npz --pole "1 1 1: -9.6 -0.4" --pole "1 1 3: 2.4 6.2" --pole "1 3 1: -7.5 -13.5"

By default the tip is small, R = 20 a, and the script takes a minute. With ``--full`` the tip has R = 80 a and 300,000
ions, which take a quarter of an hour on two cores. The script writes the run. For every mechanism, it also writes the
scores, the maps side by side, and a JSON file.
"""

# sphinx_gallery_thumbnail_path = '../articles/hidden_energies/figure6.png'

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae


def pole(text):
    """Indices and position of a pole, from "1 1 1: -9.6 -0.4"."""
    try:
        indices, position = text.split(":")
        return tuple(int(index) for index in indices.split()), tuple(float(value) for value in position.split())
    except ValueError:
        raise argparse.ArgumentTypeError(f'must be like "1 1 1: -9.6 -0.4", got {text!r}') from None


parser = argparse.ArgumentParser(description="Emission energies from a measured map with indexed poles.")
parser.add_argument("material", help="for example Ni")
parser.add_argument("measured", help="map with bin edges (.npz), or measured ions (.epos, ...)")
parser.add_argument("--pole", type=pole, action="append", required=True, help='"1 1 1: -9.6 -0.4" [mm]; two or more')
parser.add_argument(
    "--centre", type=float, nargs=2, default=(0.0, 0.0), help="position of the specimen axis on the map [mm]"
)
parser.add_argument(
    "--mechanism",
    action="append",
    choices=("roll-up", "lateral", "combined"),
    help="roll-up, lateral or combined; default: all three",
)
parser.add_argument("--bins", type=int, help="bins along the longer side; default: those of the map")
parser.add_argument("--smoothing", type=float, help="of both maps [mm]; default: half a bin, one bin for densities")
parser.add_argument("--objective", choices=("folded", "similarity"), help="what is compared; default: folded")
parser.add_argument("--run", help="use this run of a tip along the same axis, without a new simulation")
parser.add_argument("--full", action="store_true", help="R = 80 a and 300,000 ions instead of R = 20 a and 20,000")
parser.add_argument("-o", "--output", default="measured_map", help="folder; default: measured_map")
options = parser.parse_args()
folder = Path(options.output)
folder.mkdir(parents=True, exist_ok=True)

# %%
# Orientation: the rotation, and the scale in mm per radian, that fit the positions of the indexed poles best.

npz = options.measured.endswith(".npz")
measured = ae.io.read_map(options.measured) if npz else ae.read(options.measured).map(bins=options.bins or 128)
planes, positions = zip(*options.pole, strict=True)
fit = ae.maps.fit_orientation(options.material, planes, positions, centre=tuple(options.centre))
axis = " ".join(f"{index:.3f}" for index in fit.orientation.axis)
print(f"axis [{axis}], rotation {fit.orientation.rotation:.1f} degrees; residual of the poles {fit.rms:.2f} mm (RMS)")

# %%
# A tip along this axis. Measured maps are close to an equidistant projection, which is also used for this detector.

if options.run:
    run = ae.load(options.run)
else:
    material = ae.material(options.material)
    size, ions = (80, 300_000) if options.full else (20, 20_000)
    tip = ae.Tip(
        material,
        apex_radius=size * material.a,
        axis=fit.orientation.axis,
        rotation=fit.orientation.rotation,
        shank_length=2 * size * material.a,
        depth=6 * material.a,
    )
    # charges whose lines are where measured ones are, as those of `apt-evap start`
    run = ae.Simulation(tip, rule=ae.ConstantPotential(), seed=1).run(ions)
    run.save(folder / "run.h5")
compression = ae.simulation.image_compression(run).compression
distance = 100.0
run = run.on_detector(ae.Detector(distance=distance, width=4 * distance, projection="equidistant"))
print(run)

# %%
# Registration: the poles determine it within a degree and a few per cent. Within these bounds it is refined with the
# maps. All mechanisms use the registration with the highest correlation.

MECHANISMS = {
    "roll-up": ae.RollUp(0.155),
    "lateral": ae.LateralVelocity(0.155),
    "combined": ae.Combined(0.155, 0.5),
}
scale = fit.projection.scale * compression / distance
start = ae.Registration(0.0, scale, tuple(options.centre))
bounds = {"rotations": (-2.0, 2.0), "scales": (scale / 1.04, scale * 1.04), "tolerance": 1.0}
candidates = [ae.register(run.hits(each), measured, start=start, **bounds) for each in MECHANISMS.values()]
registration = max(candidates, key=lambda each: each.score)
print(f"from poles: {start}\nfrom maps: {registration}, correlation {registration.score:.2f}")

# %%
# Emission energies for every mechanism.

np.set_printoptions(precision=3, suppress=True)
for mechanism in options.mechanism or MECHANISMS:
    settings = ae.fit.FitSettings(bins=options.bins, smoothing=options.smoothing, objective=options.objective)
    study = ae.fit_energies(run, measured, ae.fit.EnergyGrid(mechanism), settings, registration=registration)
    print(f"\n{study}\n{study.scores}")
    study.save(folder / f"{mechanism}.json")
    ae.plot.score_matrix(study)[0].figure.savefig(folder / f"{mechanism}_scores.png")
    ae.plot.side_by_side(study)[0].figure.savefig(folder / f"{mechanism}_maps.png")
