"""Make the master patterns that come with the package, from simulations: apt_evap/maps/indexing/patterns/*.npz.

    python tools/master_patterns.py RUNS              # all of them, about 80 minutes of one core
    python tools/master_patterns.py RUNS --only Ni 20

Runs are kept in the folder RUNS. The extremal law, charges at a constant potential, a law that sees the field of all
other charges. All ions start 0.1 nm above their site with 0.35 eV, sigma/mean 1, in real units: without roll-up in
random directions; with roll-up onto a mean of their neighbours (sharpness 0.4).
"""

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae

PATTERNS = Path(__file__).parents[1] / "apt_evap" / "maps" / "indexing" / "patterns"
ENERGY, HEIGHT, SHARPNESS = 0.35, 0.1, 0.4  # eV, nm: see articles/common_rules
JOBS = {  # element and radius [a]: number of tips, events before the first ion, ions of each tip
    ("Ni", 20): (6, 5_000, 14_000),
    ("W", 20): (6, 2_500, 7_000),
    ("Si", 20): (6, 6_000, 20_000),
    ("Ti", 20): (6, 2_500, 8_000),
    ("Ni", 40): (2, 15_000, 55_000),
    ("W", 40): (1, 10_000, 50_000),
    ("Si", 40): (1, 20_000, 60_000),
    ("Ni", 80): (1, 40_000, 120_000),
    ("W", 80): (1, 30_000, 120_000),
    ("Si", 80): (1, 60_000, 120_000),
    ("Ti", 80): (1, 30_000, 120_000),
}
FIRST_AXIS = {"Ti": (5, 3, 3)}  # the first tip: near the middle of the standard triangle; the others are random


def simulated(element, radius, skip, ions, seed):
    """Run of one tip."""
    material = ae.material(element)
    size = radius * material.a
    axis = FIRST_AXIS.get(element, (0.36, 0.52, 0.775))
    if seed > 1:
        axis = tuple(np.random.default_rng(seed).normal(size=3).tolist())
    tip = ae.Tip(material, size, axis=axis, shank_length=2 * size, depth=8 * material.a, offset_seed=seed)
    simulation = ae.Simulation(
        tip,
        seed=seed,
        rule=ae.ConstantPotential(law_field="others"),
        detector=ae.Detector(distance=100.0, width=500.0, projection="equidistant"),
    )
    pilot = simulation.run(256, responses=False, progress=False).at_evaporation_field()
    scale = float(np.median(pilot.energy_scales))
    energy = ae.TruncatedNormal(ENERGY * scale, ENERGY * scale)
    emissions = [
        ae.LateralVelocity(energy, HEIGHT),
        ae.RollUp(energy, 1.0, SHARPNESS, HEIGHT),
        ae.Unperturbed(),  # for the image compression
    ]
    for _ in simulation.emitter.advance(skip):
        pass
    return simulation.run(ions, emissions, responses=False)


def main():
    """Simulate what is missing, and write the patterns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the runs")
    parser.add_argument("--only", nargs=2, metavar=("ELEMENT", "RADIUS"))
    options = parser.parse_args()
    options.runs.mkdir(parents=True, exist_ok=True)
    for (element, radius), (tips, skip, ions) in JOBS.items():
        if options.only and options.only != [element, str(radius)]:
            continue
        paths = [options.runs / f"{element}_{radius}_{seed}.h5" for seed in range(1, tips + 1)]
        for seed, path in enumerate(paths, 1):
            if not path.exists():
                simulated(element, radius, skip, ions, seed).save(path)
        pattern = ae.fit.master_pattern([ae.load(path) for path in paths])
        path = PATTERNS / f"{pattern.structure}_{radius}.npz"
        pattern.save(path)
        print(f"{path.name}: {pattern.ions:,} ions, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
