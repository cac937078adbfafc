"""Lines and poles of a run with responses for every emission, with the intervals that its uncertain numbers allow.

    python predicted.py RUNS/Mg_160.h5 --pole 0 0 0 1 --temperature 40 --other RUNS/Mg_80.h5

For each family of lines about a pole: the density on the line, and 1 to 2 degrees beside it, over that 3
to 6 degrees beside it, as in `../three_metals/predictions.py`; and the density about the pole by degree. Columns: the
rule of the metal as it is, for a field 10 % lower and higher, a cohesive energy 20 % lower and higher, two other
temperatures; for atoms that do not roll at all, as on a warm specimen if atoms leave at F(T); for one part of the gain
of the hop along the surface, if there is a file of hops; and the rule on a run with another radius.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "three_metals"))
from energies import ByGain, gain_line
from fills import by_degree, dark_up_to
from judge import map_of, projection_of
from predictions import across, lines_about

import apt_evap as ae

PART = 0.04
"""Part of the gain along the surface; of R = 80 a, before larger runs."""


def rules_of(metal, temperature, scale, hops):
    """Emissions by name."""

    def rule(temperature=temperature, field=1.0, cohesion=1.0):
        changed = ae.material(
            metal.name,
            evaporation_field=field * metal.evaporation_field,
            cohesive_energy=cohesion * metal.cohesive_energy,
        )
        # the energies of the simulation belong to the voltage, which is in proportion to the field
        return ae.RollUp.of_metal(changed, temperature, scale / field)

    rules = {
        "rule": rule(),
        "F -10%": rule(field=0.9),
        "F +10%": rule(field=1.1),
        "E -20%": rule(cohesion=0.8),
        "E +20%": rule(cohesion=1.2),
        "20 K": rule(20.0),
        "150 K": rule(150.0),
        "none rolls": ae.LateralVelocity(rule().others),
    }
    if hops:
        rules[f"{PART:g} G"] = ByGain(metal.name, gain_line(metal.name, hops), PART, scale, by_gain=True)
    return rules


def part_of(emission, run):
    """Part of the ions in the field of view that roll."""
    probability = emission if isinstance(emission, ByGain) else getattr(emission, "probability", None)
    seen = run.emissions[~run.not_flown]
    return 0.0 if probability is None else probability.probabilities(seen).mean()


def shown(run, emissions, pole, projection):
    """Rows of the table about a pole: its name, and a text for each emission."""
    orientation = ae.Orientation.from_settings(run.settings["tip"])
    lattice = ae.maps.poles(orientation.material, 10)
    labels = np.array(["{" + "".join(str(index) for index in np.sort(np.abs(plane))) + "}" for plane in lattice.planes])
    normals = orientation.directions(lattice.normals)
    nearest = orientation.nearest_pole(tuple(pole))
    direction = np.asarray(nearest.direction)
    away = np.degrees(np.arccos(min(direction[2], 1.0)))
    outer = min(run.settings["flights"]["field_of_view"] - 2 - away, 16)
    maps = [map_of(run, emission) for emission in emissions]
    yield "part that rolls", [f"{part_of(emission, run):.2f}" for emission in emissions]
    radial = [by_degree(map, projection, nearest) for map in maps]
    yield "pole, degree 1 to 8", [" ".join(f"{density:.2f}" for density in densities[:8]) for densities in radial]
    yield "dark up to, ring at [degrees]", ["{:.1f}, {:.1f}".format(*dark_up_to(densities)) for densities in radial]
    for towards, directions in lines_about(direction, normals, labels) if outer > 8 else []:
        cells = [across(map, projection, direction, directions, outer) for map in maps]
        yield towards, [f"{on:.2f} {beside:.2f} ({error:.2f})" for (on, error), (beside, _) in cells]


def main():
    """Print the table of one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--other", type=Path, help="run with another radius")
    parser.add_argument("--hops", type=Path, help="file of hops.py")
    parser.add_argument("--temperature", type=float, default=60.0, help="[K]")
    parser.add_argument("--pole", type=int, nargs="+", required=True, help="indices, such as 1 1 1")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    columns, tables = [], []
    for path in (options.run, *([options.other] if options.other else [])):
        run = ae.load(path)
        scale = float(np.median(run.at_evaporation_field().energy_scales))
        metal = ae.Orientation.from_settings(run.settings["tip"]).material
        rules = rules_of(metal, options.temperature, scale, options.hops)
        if path == options.other:
            rules = {f"R = {run.settings['tip']['apex_radius'] / metal.a:.0f} a": rules["rule"]}
        columns += rules
        table = list(shown(run, list(rules.values()), options.pole, projection_of(run)))
        flown = np.count_nonzero(~run.not_flown)
        print(f"{path.name}: {flown:,} ions about {options.pole}")
        tables.append(table)
    print("| line | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for rows in zip(*tables, strict=True):
        print(f"| {rows[0][0]} | " + " | ".join(cell for _, cells in rows for cell in cells) + " |")


if __name__ == "__main__":
    main()
