"""Part of the atoms that roll against the temperature, for the field of the table and for that at which atoms leave.

python temperature.py RUNS/W_160.h5 RUNS/Ni_160.h5

"Fixed": the rule of the metal, at F_evap at every temperature. "F(T)": the same barrier of 28 kT in both, so that atoms
leave at F_evap (1 - 28 kT/C), C = 1 eV; alpha as selected, and selected again so that the part at 80 K stays the same.
"""

import sys

import numpy as np
import shares

import apt_evap as ae

TEMPERATURES = (20.0, 40.0, 60.0, 80.0, 100.0, 150.0, 300.0)  # K
BARRIER = 1.0  # C, eV


def left_at(temperature):
    """Field at which atoms leave over that of the table."""
    return 1.0 - shares.BARRIER * ae.units.BOLTZMANN * temperature / BARRIER


def part(run, metal, temperature, field=1.0, alpha=1.0):
    """Part of the flown ions that roll."""
    rule = ae.emission.Migration(
        metal.cohesive_energy, field * metal.evaporation_field, temperature, polarizability=alpha * 1e-40
    )
    return float(rule.probabilities(run.emissions[~run.not_flown]).mean())


def main():
    """Print a row for each run and choice."""
    print("T [K]", *(f"{temperature:g}" for temperature in TEMPERATURES), sep=" | ")
    print("field over F_evap", *(f"{left_at(temperature):.2f}" for temperature in TEMPERATURES), sep=" | ")
    for path in sys.argv[1:]:
        run = ae.load(path)
        metal = ae.Orientation.from_settings(run.settings["tip"]).material
        again = 1.0 / left_at(80.0) ** 2
        for name, fields, alpha in (
            ("fixed", np.ones(len(TEMPERATURES)), 1.0),
            ("F(T)", [left_at(temperature) for temperature in TEMPERATURES], 1.0),
            ("F(T), alpha again", [left_at(temperature) for temperature in TEMPERATURES], again),
        ):
            parts = [
                part(run, metal, temperature, field, alpha)
                for temperature, field in zip(TEMPERATURES, fields, strict=True)
            ]
            print(f"{metal.name}, {name}", *(f"{number:.2f}" for number in parts), sep=" | ")


if __name__ == "__main__":
    main()
