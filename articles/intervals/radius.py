"""Twins for `fit_radius`: is the hidden radius inside the interval?

    python articles/intervals/radius.py FOLDER --twins 8

A family of Ni[111] tips with radii of 14 to 40 a, and twins with hidden radii between 16 and 36 a (uniform in ln R).
All tips have other lattice origins, and shank angles and surface thresholds that differ by up to 20 %. All ions have
the same emission. Runs are stored in FOLDER, so that the script can be stopped and continued. Before the first ion
that flies, a third of a layer of the cap evaporates.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import apt_evap as ae

RADII = (14.0, 16.3, 18.9, 22.0, 25.5, 29.6, 34.4, 40.0)
LOW, HIGH = 16.0, 36.0
EMISSION = ae.RollUp(ae.TruncatedNormal(0.1, 0.1), probability=0.5, others=ae.TruncatedNormal(0.1, 0.1))
RINGS = ((8.0, 14.0), (14.0, 20.0), (20.0, 28.0))
EDGES = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0)
LAYER = 14  # ions of a layer of the cap per square of the radius [a]


def run_of(number, radius, ions, folder):
    """Run of a tip with a radius in lattice constants, stored in the folder."""
    path = folder / f"run{number}.h5"
    if path.exists():
        return ae.load(path)
    random = np.random.default_rng((2026, number))
    angle, threshold = random.uniform(0.8, 1.2, 2)
    nickel = ae.material("Ni")
    tip = ae.Tip(
        nickel,
        apex_radius=radius * nickel.a,
        axis=(1, 1, 1),
        shank_angle=1.5 * angle,
        shank_length=radius * nickel.a,
        depth=6 * nickel.a,
        offset_seed=number,
    )
    tip.criteria = (replace(tip.criterion, surface_threshold=threshold * tip.surface_threshold),)
    simulation = ae.Simulation(tip, seed=number, n_threads=1)
    for _ in simulation.emitter.advance(round(LAYER * radius**2 / 3)):
        pass
    run = simulation.run(ions, [ae.Unperturbed(), EMISSION], responses=False, progress=False)
    run.save(path)
    return run


def counts(run, bins=200):
    """Map of the complete detector."""
    return run.hits(EMISSION).map(like=run.detector.grid(bins), position_step=None)


def main():
    """Fit the radius of every twin."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--twins", type=int, default=8)
    parser.add_argument("--layers", type=float, default=1.0, help="layers of the cap in a run")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    ions = [round(options.layers * LAYER * radius**2) for radius in RADII]
    family = [run_of(number, *each, options.folder) for number, each in enumerate(zip(RADII, ions, strict=True))]
    inside = 0
    for twin in range(options.twins):
        hidden = float(np.exp(np.random.default_rng((8, twin)).uniform(np.log(LOW), np.log(HIGH))))
        run = run_of(100 + twin, hidden, round(options.layers * LAYER * hidden**2), options.folder)
        projection = ae.simulation.image_compression(run).projection
        fit = ae.fit.fit_radius(family, counts(run), projection, EMISSION, (1, 1, 1), fold=3, rings=RINGS, radii=EDGES)
        found, (low, high) = fit.radius / 0.352, (bound / 0.352 for bound in fit.interval)
        inside += low <= hidden <= high
        bounds = f"({low:.1f} to {high:.1f})"
        print(f"hidden {hidden:5.1f} a: {found:5.1f} a {bounds}, chi square {fit.chi_square.min():.1f}")
    print(f"{inside} of {options.twins} intervals of 95 % contain the hidden radius")


if __name__ == "__main__":
    main()
