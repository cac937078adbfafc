"""Lines and poles of a run with responses, with the interval that 10 % of the field of evaporation allows.

    python predicted.py RUNS/Mg_80_wide.h5 --pole 0 0 0 1

For each family of lines about a pole: the density on the line, and 1 to 2 degrees beside it, over that 3
to 6 degrees beside it, as in `../three_metals/predictions.py`; and the density about the pole by degree. Columns: the
rule of the metal for a field 10 % lower, as in the table, and 10 % higher; and for atoms that do not roll at all, as
on a warm specimen if atoms leave at F(T).
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "three_metals"))
from fills import by_degree
from judge import map_of, projection_of
from predictions import across, lines_about

import apt_evap as ae
from apt_evap.maps.crystallography.directions import poles

FACTORS = (0.9, 1.0, 1.1)


def main():
    """Print the table of one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--temperature", type=float, default=60.0, help="[K]")
    parser.add_argument("--pole", type=int, nargs="+", required=True, help="indices, such as 1 1 1")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    run = ae.load(options.run)
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    orientation, projection = ae.Orientation.from_settings(run.settings["tip"]), projection_of(run)
    metal = orientation.material
    rules = {}
    for factor in FACTORS:
        changed = ae.material(metal.name, evaporation_field=factor * metal.evaporation_field)
        # the energies of the simulation belong to the voltage, which is in proportion to the field
        rules[f"F x {factor:g}"] = ae.RollUp.of_metal(changed, options.temperature, scale / factor)
    middle = rules["F x 1"]
    rules["none rolls"] = ae.LateralVelocity(middle.others)
    maps = {name: map_of(run, rule) for name, rule in rules.items()}
    for name, rule in rules.items():
        part = getattr(rule, "probability", None)
        part = 0.0 if part is None else part.probabilities(run.emissions).mean()
        print(f"{options.run.name}, {name}: {part:.2f} roll, {maps[name].shown_ions}")
    found = poles(metal, 10)
    labels = np.array(["{" + "".join(str(index) for index in np.sort(np.abs(plane))) + "}" for plane in found.planes])
    normals = orientation.directions(found.normals)
    nearest = orientation.nearest_pole(tuple(options.pole))
    pole = np.asarray(nearest.direction)
    outer = min(run.settings["flights"]["field_of_view"] - 2 - np.degrees(np.arccos(min(pole[2], 1.0))), 16)
    print(f"about {options.pole}, up to {outer:.0f} degrees")
    for name, map in maps.items():
        radial = by_degree(map, projection, nearest)
        print(f"  {name:12} by degree", " ".join(f"{density:.2f}" for density in radial))
    for towards, directions in lines_about(pole, normals, labels) if outer > 8 else []:
        cells = []
        for map in maps.values():
            (on, error), (beside, _) = across(map, projection, pole, directions, outer)
            cells.append(f"{on:.2f} +- {error:.2f}, {beside:.2f}")
        print(f"  {towards:16} " + " | ".join(cells))


if __name__ == "__main__":
    main()
