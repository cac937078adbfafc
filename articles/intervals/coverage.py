"""Coverage of the intervals of `fit_energies`: the fraction of twins whose hidden energies are inside.

    python articles/intervals/coverage.py FOLDER --twins 40

A twin is a map made from another specimen than the one that is fitted: another lattice origin, and a radius, a shank
angle and a surface threshold that differ by up to 20 %. Its energies are hidden: a mean of 0.08 to 0.3 eV and a
relative standard deviation of 0.1 to 1.5, both uniform in their logarithms. Runs are stored in FOLDER, so that the
script can be stopped and continued. Each fit uses the true registration.

For each model error, the script prints how many of the intervals of 95 % contain the hidden values, with the
binomial error.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import apt_evap as ae
from apt_evap.fit.intervals import intervals

VARIATION = 0.2  # of radius, shank angle and surface threshold
ERRORS = (0.0, 0.03, 0.04, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4)  # of the model, by default
INSTRUMENT = ae.Registration(rotation=17.0, scale=0.4, shift=(3.0, -2.0))
NAMES = ("mean", "relative_spread", "true_mean", "true_standard_deviation")


def specimen(number, radius, within=VARIATION):
    """Tip of Ni[111]; number 0 is fitted, with a radius in lattice constants; those of others differ by a part."""
    random = np.random.default_rng((2026, number))
    sizes = np.ones(3) if number == 0 else random.uniform(1 - VARIATION, 1 + VARIATION, 3)
    sizes[0] = 1 + (sizes[0] - 1) * within / VARIATION
    nickel = ae.material("Ni")
    tip = ae.Tip(
        nickel,
        apex_radius=radius * sizes[0] * nickel.a,
        axis=(1, 1, 1),
        shank_angle=3.0 * sizes[1],
        shank_length=20 * nickel.a,
        offset_seed=1000 + number,
    )
    tip.criteria = (replace(tip.criterion, surface_threshold=sizes[2] * tip.surface_threshold),)
    return tip


def run_of(number, radius, ions, folder=None, within=VARIATION):
    """Run of a specimen, stored in the folder."""
    path = None if folder is None else folder / f"run{number}_{within:g}.h5"
    if path is not None and path.exists():
        return ae.load(path)
    simulation = ae.Simulation(
        specimen(number, radius, within),
        seed=number,
        n_threads=1,
        # to a tenth of a bin
        flight_settings=ae.simulation.FlightSettings(opening_angle=0.6, tolerance=1e-2),
        response_settings=ae.ResponseSettings(
            site=ae.simulation.Design((1, 0), ((0.0, 1), (1.0, 4)), 6),
            rolled=ae.simulation.Design((2, 0), ((0.0, 1), (1.0, 6)), 18, place=True),
            bound=1.0,
        ),
    )
    run = simulation.run(ions, progress=False)
    if path is not None:
        run.save(path)
    return run


def hidden_energy(number):
    """Energy distribution of a twin."""
    random = np.random.default_rng((7, number))
    mean, relative_spread = np.exp(random.uniform(np.log([0.08, 0.1]), np.log([0.3, 1.5])))
    return ae.TruncatedNormal(float(mean), float(relative_spread * mean))


def measured_map(run, energy, bins=48, draws=4, radius=60.0):
    """Map of several draws of the ions within a circle, in the frame of the instrument."""
    columns = []
    for seed in range(5000, 5000 + draws):
        hits = INSTRUMENT.hits(replace(run, seed=seed).hits(ae.RollUp(energy)))
        columns.append(hits.within_circle(INSTRUMENT.scale * radius, INSTRUMENT.shift))
    x, y = (np.concatenate([getattr(hits, name) for hits in columns]) for name in "xy")
    return ae.Hits(x=x, y=y).map(bins)


def truth_of(energy):
    """The hidden values by name."""
    values = energy.mean, energy.standard_deviation / energy.mean, energy.true_mean, energy.true_standard_deviation
    return dict(zip(NAMES, values, strict=True))


def fitted(run, measured, objective="similarity"):
    """Study of a twin."""
    settings = ae.fit.FitSettings(replicas=4, resamples=40, objective=objective)
    return ae.fit_energies(run, measured, None, settings, registration=INSTRUMENT, n_threads=1, progress=False)


def bounds_of(study, model_error):
    """Interval of each number, for a model error."""
    refined = study.refined
    best = []
    for name, axis in study.grid.axes.items():
        scale = np.log if name == "relative_spread" else np.asarray
        value = refined.options[name] if name in refined.options else getattr(refined, name)
        best.append(np.interp(scale(value), scale(axis), np.arange(len(axis))))
    return intervals(study.grid, np.concatenate([study.scores[None], study.resampled]), best, model_error).bounds


def inside(bounds, truth):
    """Whether the interval of each number contains its hidden value, dict of bool."""
    return {name: bounds[name][0] <= value <= bounds[name][1] for name, value in truth.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--twins", type=int, default=40)
    parser.add_argument("--radius", type=float, default=14.0, help="radius of the fitted specimen [a]")
    parser.add_argument("--ions", type=int, default=10_000)
    parser.add_argument("--objective", choices=("similarity", "folded"), default="similarity")
    parser.add_argument("--within", type=float, default=VARIATION, help="part by which the radii of twins differ")
    parser.add_argument("--model-errors", type=float, nargs="+", default=ERRORS)
    options = parser.parse_args()
    options.folder.mkdir(exist_ok=True)
    run = run_of(0, options.radius, options.ions, options.folder)
    found, widths = [], []
    for number in range(100, 100 + options.twins):
        energy = hidden_energy(number)
        twin = run_of(number, options.radius, options.ions, options.folder, options.within)
        study = fitted(run, measured_map(twin, energy), options.objective)
        truth = truth_of(energy)
        bounds = [bounds_of(study, error) for error in options.model_errors]
        found.append([list(inside(each, truth).values()) for each in bounds])
        widths.append([[(each[name][1] - each[name][0]) / truth[name] for name in NAMES] for each in bounds])
        print(number, {name: round(value, 3) for name, value in truth.items()}, flush=True)
        print(study, flush=True)
    counts = np.sum(found, axis=0)
    print(f"\n{len(found)} twins; model error, intervals that contain the hidden value, their median width over it")
    for error, row, width in zip(options.model_errors, counts, np.median(widths, axis=0), strict=True):
        shares = row / len(found)
        errors = np.sqrt(np.maximum(shares * (1 - shares), 1 / len(found)) / len(found))
        texts = (
            f"{name} {s:.0%} ± {e:.0%}, {w:.2f}" for name, s, e, w in zip(NAMES, shares, errors, width, strict=True)
        )
        print(f"{error:5.2f}  {'; '.join(texts)}")


if __name__ == "__main__":
    main()
