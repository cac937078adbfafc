"""
Energies from a measured map
============================

From a measured map with indexed poles to the energies of the emission: the poles give the orientation of the specimen,
a tip is simulated along the axis that it really had, and `fit_energies` compares the two for every mechanism.

The poles, read off the map, are given as indices and place [mm]. For a map of nickel ::

    python measured_map.py Ni map.npz --pole "1 1 1: -9.6 -0.4" --pole "1 1 3: 2.4 6.2" --pole "1 3 1: -7.5 -13.5"

By default the tip is small, R = 20 a, and takes a minute; with ``--full`` it has R = 80 a and 300,000 ions, a quarter
of an hour on two cores. Writes the run, and for every mechanism the matrix, the maps side by side and a JSON file.
"""

# sphinx_gallery_thumbnail_path = 'figure3.png'

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae


def pole(text):
    """Indices and place of a pole, from "1 1 1: -9.6 -0.4"."""
    try:
        indices, place = text.split(":")
        return tuple(int(index) for index in indices.split()), tuple(float(value) for value in place.split())
    except ValueError:
        raise argparse.ArgumentTypeError(f'must be like "1 1 1: -9.6 -0.4", got {text!r}') from None


parser = argparse.ArgumentParser(description="Emission energies from a measured map with indexed poles.")
parser.add_argument("material", help="such as Ni")
parser.add_argument("measured", help=".npz with a map and its edges, or measured ions (.epos, ...)")
parser.add_argument("--pole", type=pole, action="append", required=True, help='"1 1 1: -9.6 -0.4" [mm]; two or more')
parser.add_argument("--centre", type=float, nargs=2, default=(0.0, 0.0), help="where the axis meets the map [mm]")
parser.add_argument(
    "--mechanism",
    action="append",
    choices=("roll-up", "lateral", "combined"),
    help="roll-up, lateral or combined; by default all three",
)
parser.add_argument("--bins", type=int, help="along the longer side of the map; by default as they are")
parser.add_argument("--smoothing", type=float, help="of both maps [mm]; by default half a bin, of densities one")
parser.add_argument("--run", help="take this run of a tip along the right axis instead of a new one")
parser.add_argument("--full", action="store_true", help="R = 80 a and 300,000 ions instead of R = 20 a and 20,000")
parser.add_argument("-o", "--output", default="measured_map", help="folder; default: measured_map")
options = parser.parse_args()
folder = Path(options.output)
folder.mkdir(parents=True, exist_ok=True)

# %%
# Orientation: the rotation, and the mm per radian, that bring the indexed poles closest to their places.

npz = options.measured.endswith(".npz")
measured = ae.read_map(options.measured) if npz else ae.read(options.measured).map(bins=options.bins or 128)
planes, places = zip(*options.pole, strict=True)
found = ae.fit_orientation(options.material, planes, places, centre=tuple(options.centre))
axis = " ".join(f"{index:.3f}" for index in found.orientation.axis)
print(f"axis [{axis}], turned by {found.orientation.rotation:.1f} degrees; poles within {found.rms:.2f} mm (rms)")

# %%
# A tip along that axis. Measured maps are closer to an equidistant projection than to a plane: so is this detector.

if options.run:
    run = ae.load(options.run)
else:
    material = ae.material(options.material)
    size, ions = (80, 300_000) if options.full else (20, 20_000)
    tip = ae.Tip(
        material,
        apex_radius=size * material.a,
        axis=found.orientation.axis,
        rotation=found.orientation.rotation,
        shank_length=2 * size * material.a,
        depth=6 * material.a,
    )
    run = ae.Simulation(tip, seed=1).run(ions)
    run.save(folder / "run.h5")
compression = ae.image_compression(run).compression
distance = 100.0
run = run.seen_by(ae.Detector(distance=distance, width=4 * distance, projection="equidistant"))
print(run)

# %%
# Registration: the poles fix it to a degree and a few per cent, the maps do the rest within these bounds. All
# mechanisms share the one of the map that correlates best.

MECHANISMS = {
    "roll-up": ae.RollUp(0.155),
    "lateral": ae.LateralVelocity(0.155),
    "combined": ae.Combined(0.155, 0.5),
}
scale = found.projection.scale * compression / distance
start = ae.Registration(0.0, scale, tuple(options.centre))
bounds = {"rotations": (-2.0, 2.0), "scales": (scale / 1.04, scale * 1.04), "tolerance": 1.0}
tried = [ae.register(run.hits(each), measured, start=start, **bounds) for each in MECHANISMS.values()]
registration = max(tried, key=lambda each: each.score)
print(f"by poles {start};\nby maps {registration}, correlation {registration.score:.2f}")

# %%
# The energies, for every mechanism.

np.set_printoptions(precision=3, suppress=True)
for mechanism in options.mechanism or MECHANISMS:
    study = ae.fit_energies(
        run, measured, mechanism, registration=registration, bins=options.bins, smoothing=options.smoothing
    )
    print(f"\n{study}\n{study.ssim}")
    study.save(folder / f"{mechanism}.json")
    ae.plot.ssim_matrix(study)[0].figure.savefig(folder / f"{mechanism}_ssim.png")
    ae.plot.side_by_side(study)[0].figure.savefig(folder / f"{mechanism}_maps.png")
