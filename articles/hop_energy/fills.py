"""What in the rule of a metal fills its poles: one number of it changed at a time, on a run with responses.

    python fills.py RUNS/Ni_80.h5 --pole 1 1 1

The density about a pole by degree, in units of the mean of the map, and on the lines towards one family
and beside them, as in `../three_metals/predictions.py`.
"""

import argparse
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "three_metals"))
from judge import map_of, polar, projection_of
from predictions import across, lines_about

import apt_evap as ae


def variants(metal, scale, temperature):
    """Emissions by name."""
    rule = ae.RollUp.of_metal(metal, temperature, scale)

    def energy(mean):
        return ae.TruncatedNormal(mean * scale, mean * scale)

    return {
        "rule of the metal": rule,
        "sharpness 0 (strongest neighbour)": replace(rule, sharpness=0.0),
        "sharpness 0.4": replace(rule, sharpness=0.4),
        "rolled from the neighbour (height 0)": replace(rule, height=0.0),
        "height 0.1 nm": replace(rule, height=0.1),
        "others 0.2 nm above": replace(rule, others_height=0.2),
        "others at rest": replace(rule, others=None),
        "others 0.1 eV": replace(rule, others=energy(0.1)),
        "rolled with 0.03 eV": replace(rule, energy=energy(0.03)),
        "rolled with 0.3 eV": replace(rule, energy=energy(0.3)),
        "all roll": replace(rule, probability=1.0),
        "none rolls": ae.LateralVelocity(rule.others),
        "none rolls, at rest": ae.Unperturbed(),
    }


def by_degree(map, projection, pole, reach=12):
    """Density about a pole by degree, in units of the mean, from the map folded about it."""
    folded = ae.maps.folded(map, projection, *pole, reach=float(reach))
    angle, _ = polar(folded)
    return [np.nanmean(folded.density[(angle >= a) & (angle < a + 1)]) for a in range(reach)]


def dark_up_to(densities):
    """Angle from the pole at which the density rises to the mean, and that of the ring behind it [degrees]."""
    densities = np.asarray(densities)
    first = int(np.argmax(densities >= 1.0))
    ring = first + int(np.argmax(densities[first : first + 4]))
    if first == 0:
        return 0.0, ring + 0.5
    low, high = densities[first - 1 : first + 1]
    return first - 0.5 + (1.0 - low) / (high - low), ring + 0.5


def main():
    """Print the table of one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--temperature", type=float, default=60.0, help="[K]")
    parser.add_argument("--lines", type=int, default=3, help="families of lines that are shown")
    parser.add_argument("--pole", type=int, nargs="+", required=True, help="indices, such as 1 1 1")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    run = ae.load(options.run)
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    orientation, projection = ae.Orientation.from_settings(run.settings["tip"]), projection_of(run)
    found = ae.maps.poles(orientation.material, 10)
    labels = np.array(["{" + "".join(str(index) for index in np.sort(np.abs(plane))) + "}" for plane in found.planes])
    normals = orientation.directions(found.normals)
    nearest = orientation.nearest_pole(tuple(options.pole))
    pole = np.asarray(nearest.direction)
    outer = min(run.settings["flights"]["field_of_view"] - 2 - np.degrees(np.arccos(min(pole[2], 1.0))), 16)
    families = lines_about(pole, normals, labels)[: options.lines] if outer > 8 else []
    print("lines towards", ", ".join(name for name, _ in families), f"up to {outer:.0f} degrees: on, beside")
    for name, emission in variants(orientation.material.name, scale, options.temperature).items():
        map = map_of(run, emission)
        radial = by_degree(map, projection, nearest)
        lines = []
        for _, directions in families:
            (on, _), (beside, _) = across(map, projection, pole, directions, outer)
            lines.append(f"{on:.2f} {beside:.2f}")
        edges = "dark up to {:.1f}, ring at {:.1f}".format(*dark_up_to(radial))
        print(
            f"{name:38}", " ".join(f"{density:.2f}" for density in radial), f"| {edges} |", ", ".join(lines), flush=True
        )


if __name__ == "__main__":
    main()
