"""Twins for the rules of the roll-up: are the hidden probability and sharpness inside their intervals?

    python benchmarks/rules.py FOLDER --twins 4

Tips of Ni[111], R = 20 a, with wide responses. The twins have other lattice origins, and radii, shank angles and
surface thresholds that differ by up to 10 %. Their maps have a hidden probability, sharpness and energy;
`fit_energies` searches all three in the frame of the instrument. Runs are stored in FOLDER, so that the script can be
stopped and continued.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import apt_evap as ae

RADIUS = 20.0  # a
INSTRUMENT = ae.Registration(rotation=17.0, scale=0.4, shift=(3.0, -2.0))
OPTIONS = {"probability": (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), "sharpness": (0.05, 0.15, 0.3, 0.6, 1.2)}
MEANS, RSDS = (0.05, 0.1, 0.155, 0.3), (1.0,)
HIDDEN = ((0.5, 0.2, 0.155), (0.7, 0.1, 0.1), (0.3, 0.4, 0.2), (0.9, 0.3, 0.08))


def rule(energy, probability, sharpness):
    """A share of the ions rolls up; the others have the same energy in random directions."""
    return ae.RollUp(energy, probability, sharpness, others=energy)


def run_of(number, ions, folder):
    """Run of a specimen, stored in the folder; number 0 is the one that is fitted."""
    path = folder / f"wide{number}.h5"
    if path.exists():
        return ae.load(path)
    random = np.random.default_rng((2026, number))
    sizes = np.ones(3) if number == 0 else random.uniform(0.9, 1.1, 3)
    nickel = ae.material("Ni")
    tip = ae.Tip(
        nickel,
        apex_radius=RADIUS * sizes[0] * nickel.a,
        axis=(1, 1, 1),
        shank_angle=1.5 * sizes[1],
        shank_length=2 * RADIUS * nickel.a,
        offset_seed=number,
    )
    tip.criteria = (replace(tip.criterion, surface_threshold=sizes[2] * tip.surface_threshold),)
    simulation = ae.Simulation(tip, seed=number, n_threads=1, response_settings=ae.ResponseSettings.wide())
    run = simulation.run(ions, progress=False)
    run.save(path)
    return run


def main():
    """Fit every twin."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--twins", type=int, default=4)
    parser.add_argument("--ions", type=int, default=15_000)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    run, inside = run_of(0, options.ions, options.folder), np.zeros(2, int)
    for twin in range(options.twins):
        probability, sharpness, mean = HIDDEN[twin % len(HIDDEN)]
        other = run_of(1 + twin, options.ions, options.folder)
        emission = rule(ae.TruncatedNormal(mean, mean), probability, sharpness)
        hits = INSTRUMENT.hits(other.hits(emission)).within_circle(INSTRUMENT.scale * 60.0, INSTRUMENT.shift)
        study = ae.fit_energies(
            run,
            hits.map(64),
            rule,
            means=MEANS,
            rsds=RSDS,
            options=OPTIONS,
            registration=INSTRUMENT,
            n_threads=1,
            progress=False,
        )
        best = study.refined
        rows = [best.options[name] for name in OPTIONS]
        bounds = [best.intervals[name] for name in OPTIONS]
        inside += [low <= value <= high for value, (low, high) in zip((probability, sharpness), bounds, strict=True)]
        print(
            f"hidden {probability}, {sharpness}, {mean} eV: probability {rows[0]:.2f} ({bounds[0][0]:.2f} to "
            f"{bounds[0][1]:.2f}), sharpness {rows[1]:.2f} ({bounds[1][0]:.2f} to {bounds[1][1]:.2f}), mean "
            f"{best.bounded('mean')} eV, SSIM {best.score}",
            flush=True,
        )
    print(f"of {options.twins} intervals of 95 %, {inside[0]} contain the probability and {inside[1]} the sharpness")


if __name__ == "__main__":
    main()
