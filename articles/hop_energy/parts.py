"""Part of the atoms in the field of view that roll by the rule of the metal, with one number changed at once.

python parts.py RUNS/W_160.h5 RUNS/W_80.h5 RUNS/Ni_160.h5 ...
"""

import sys
from pathlib import Path

import apt_evap as ae

CHANGES = {
    "rule": (1.0, 1.0, 80.0), "F -10%": (0.9, 1.0, 80.0), "F -5%": (0.95, 1.0, 80.0), "F +5%": (1.05, 1.0, 80.0),
    "F +10%": (1.1, 1.0, 80.0), "E -20%": (1.0, 0.8, 80.0), "E +20%": (1.0, 1.2, 80.0), "20 K": (1.0, 1.0, 20.0),
    "150 K": (1.0, 1.0, 150.0),
}  # fmt: skip
"""Factors of the field of evaporation and of the cohesive energy, and the temperature [K]."""


def main():
    """Print a row for each run."""
    print("| run | " + " | ".join(CHANGES) + " |\n" + "|---" * (len(CHANGES) + 1) + "|")
    for path in sys.argv[1:]:
        run = ae.load(path)
        metal = ae.Orientation.from_settings(run.settings["tip"]).material
        cells = []
        for field, cohesion, temperature in CHANGES.values():
            law = ae.emission.Migration(cohesion * metal.cohesive_energy, field * metal.evaporation_field, temperature)
            cells.append(f"{law.probabilities(run.emissions[~run.not_flown]).mean():.2f}")
        print(f"| {Path(path).stem} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
