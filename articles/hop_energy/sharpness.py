"""Sharpness of the mean of three neighbours against the energy along the surface, on runs of several metals.

    python sharpness.py W RUNS/W_160.h5 --temperature 80
    python sharpness.py Mg RUNS/Mg_160.h5

A row for each sharpness and part of the polarisation energy alpha F^2/2. For tungsten and nickel it has the
amplitudes of the rings and the correlation, as in `../three_metals/judge.py`; for magnesium the density on the line
towards {01-13}, and 1 to 2 degrees beside it. All else is the rule of the metal.
"""

import argparse
import warnings
from dataclasses import replace

import numpy as np
from energies import AXES, METALS, amplitude, folded, map_of, measured_fold, named, projection_of, rings
from predictions import across

import apt_evap as ae

SHARPNESSES = (1.0, 0.4, 0.2, 0.1)
PARTS = (0.06, 0.12, 0.25, 0.5)


def main():
    """Print the table of one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metal", choices=AXES)
    parser.add_argument("run")
    parser.add_argument("--temperature", type=float, default=80.0, help="[K]")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    run = ae.load(options.run)
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    projection, orientation = projection_of(run), ae.Orientation.from_settings(run.settings["tip"])
    rule = ae.RollUp.of_metal(options.metal, options.temperature, scale)
    if options.metal == "Mg":
        lattice, pole = ae.maps.poles(orientation.material, 10), np.array([0.0, 0.0, 1.0])
        normals = orientation.directions(lattice.normals)
        toward = normals[named(lattice.planes, (0, 1, 3)) & (normals[:, 2] > 0.5)]
    else:
        target = measured_fold(options.metal)
    for sharpness in SHARPNESSES:
        for part in PARTS:
            mean = part * rule.probability.polarization * scale
            emission = replace(rule, sharpness=sharpness, energy=ae.TruncatedNormal(mean, mean))
            map = map_of(run, emission)
            if options.metal == "Mg":
                (on, error), (beside, _) = across(map, projection, pole, toward, 16)
                text = f"on {on:.2f} +- {error:.2f}, beside {beside:.2f}"
            else:
                fold = folded(map, orientation, projection, METALS[options.metal])
                pairs = zip(rings(fold, METALS[options.metal]), rings(target, METALS[options.metal]), strict=True)
                text = " ".join(f"{amplitude(*pair):.2f}" for pair in pairs)
                text += f", correlation {fold.correlation(target):.2f}"
            print(f"{options.metal} sharpness {sharpness:g}, part {part:g}: {text}", flush=True)


if __name__ == "__main__":
    main()
