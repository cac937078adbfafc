"""Twins for the rules of the roll-up: are the hidden probability and sharpness inside their intervals?

    python articles/intervals/rules.py FOLDER --twins 4

Tips of Ni[111], R = 20 a. The twins have other lattice origins, and radii, shank angles and
surface thresholds that differ by up to 10 %. Their maps have a hidden probability, sharpness and energy;
`fit_energies` searches all three in the frame of the instrument. Runs are stored in FOLDER, so that the script can be
stopped and continued.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from coverage import inside

import apt_evap as ae

RADIUS = 20.0  # a
INSTRUMENT = ae.Registration(rotation=17.0, scale=0.4, shift=(3.0, -2.0))
OPTIONS = {"probability": (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), "sharpness": (0.05, 0.15, 0.3, 0.6, 1.2)}
MEANS, RSDS = (0.05, 0.1, 0.155, 0.3), (1.0,)
NAMES = ("probability", "sharpness", "mean")


def hidden(twin):
    """Probability, sharpness and mean energy [eV] of a twin; the last two uniform in their logarithms."""
    random = np.random.default_rng((9, twin))
    sharpness, mean = np.exp(random.uniform(np.log([0.08, 0.08]), np.log([0.8, 0.25])))
    return float(random.uniform(0.1, 0.9)), float(sharpness), float(mean)


def rule(energy, probability, sharpness):
    """A share of the ions rolls up; the others have the same energy in random directions."""
    return ae.RollUp(energy, probability, sharpness, others=energy)


def run_of(number, ions, folder):
    """Run of a specimen, stored in the folder; number 0 is the one that is fitted."""
    path = folder / f"rules{number}.h5"
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
    simulation = ae.Simulation(tip, seed=number, n_threads=1)
    run = simulation.run(ions, progress=False)
    run.save(path)
    return run


def main():
    """Fit every twin."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--twins", type=int, default=4)
    parser.add_argument("--ions", type=int, default=15_000)
    parser.add_argument("--model-errors", type=float, nargs="+", default=[0.0, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5])
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    run, found = run_of(0, options.ions, options.folder), []
    for twin in range(options.twins):
        probability, sharpness, mean = truth = hidden(twin)
        other = run_of(1 + twin, options.ions, options.folder)
        emission = rule(ae.TruncatedNormal(mean, mean), probability, sharpness)
        hits = INSTRUMENT.hits(other.hits(emission)).within_circle(INSTRUMENT.scale * 60.0, INSTRUMENT.shift)
        study = ae.fit_energies(
            run,
            hits.map(64),
            ae.fit.EnergyGrid(rule, MEANS, RSDS, options=OPTIONS),
            ae.fit.FitSettings(replicas=4, resamples=40, objective="similarity"),
            registration=INSTRUMENT,
            n_threads=1,
            progress=False,
        )
        best = study.refined
        print(f"hidden {', '.join(f'{name} {value:.3g}' for name, value in zip(NAMES, truth, strict=True))}:", end=" ")
        print(", ".join(f"{name} {best.bounded(name)}" for name in NAMES), f"SSIM {best.score}", flush=True)
        hidden_values = dict(zip(NAMES, truth, strict=True))
        found.append([list(inside(study, hidden_values, error).values()) for error in options.model_errors])
    print(f"\n{len(found)} twins; model error, then the intervals that contain the hidden value")
    for error, row in zip(options.model_errors, np.mean(found, axis=0), strict=True):
        print(f"{error:5.2f}  {', '.join(f'{name} {share:.0%}' for name, share in zip(NAMES, row, strict=True))}")


if __name__ == "__main__":
    main()
