"""Maps of other metals by the rule of `README.md`, before anyone compares: one run for each.

    python predictions.py simulate RUNS "Ni 001"     # or all of them, one after the other
    python predictions.py judge RUNS

Nothing is selected here: energy, height, sharpness and the two constants of `Migration` are those of tungsten and
nickel; cohesive energies are Kittel's, fields those of `ae.material` (magnesium: Tsong). 300,000 atoms evaporate after
the first layer, those within the field of view fly.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

import apt_evap as ae

ENERGY, HEIGHT, SHARPNESS = 0.2, 0.2, 2.0  # eV, nm
FIELD_OF_VIEW = 28.0  # degrees, half angle


class Case(NamedTuple):
    """One map."""

    metal: str
    axis: tuple[int, ...]
    cohesive_energy: float  # eV
    temperatures: tuple[float, ...] = (60.0,)  # K
    radius: int = 80  # in lattice constants


CASES = {
    "W 011": Case("W", (0, 1, 1), 8.90, (60.0, 150.0), 100),
    "Ni 001": Case("Ni", (0, 0, 1), 4.44),
    "Fe 001": Case("Fe", (0, 0, 1), 4.28),
    "Fe 025": Case("Fe", (0, 2, 5), 4.28),
    "Fe 112": Case("Fe", (1, 1, 2), 4.28),
    "Cu 111": Case("Cu", (1, 1, 1), 3.49),
    "Pt 001": Case("Pt", (0, 0, 1), 5.84),
    "Mg 0001": Case("Mg", (0, 0, 1), 1.51, (40.0,)),
    "Si 001": Case("Si", (0, 0, 1), 4.63, radius=50),
}
MAGNESIUM = ae.Material("Mg", "hcp", 0.321, 21.0, 2, 24.305, c=0.521)


def material_of(case):
    """The metal of a case."""
    return MAGNESIUM if case.metal == "Mg" else ae.material(case.metal)


def laws(case):
    """The law of each temperature."""
    field = material_of(case).evaporation_field
    return [ae.emission.Migration(case.cohesive_energy, field, temperature) for temperature in case.temperatures]


def simulated(case, ions, threads):
    """Run of one case: unperturbed, and the rule at each temperature."""
    material = material_of(case)
    size = case.radius * material.a
    tip = ae.Tip(material, size, axis=case.axis, shank_length=size, depth=8 * material.a, offset_seed=1)
    common = {"seed": 1, "rule": ae.ConstantPotential(law_field="others"), "n_threads": threads}
    common["response_settings"] = ae.ResponseSettings.wide()  # records the neighbours
    pilot = ae.Simulation(tip, **common).run(256, responses=False, progress=False)
    energy = ENERGY * float(np.median(pilot.at_evaporation_field().energy_scales))
    spread = ae.TruncatedNormal(energy, energy)
    rolls = [ae.RollUp(spread, law, SHARPNESS, HEIGHT, others=spread) for law in laws(case)]
    simulation = ae.Simulation(tip, flight_settings=ae.FlightSettings(field_of_view=FIELD_OF_VIEW), **common)
    for _ in simulation.emitter.advance(ions // 3):
        pass
    return simulation.run(ions, [ae.Unperturbed(), *rolls], responses=False, progress=False)


def main():
    """Simulate, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulate", "judge"))
    parser.add_argument("runs", type=Path)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--ions", type=int, default=300_000)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    options.runs.mkdir(parents=True, exist_ok=True)
    for name in options.cases:
        path = options.runs / f"{name.replace(' ', '_')}.h5"
        if options.what == "simulate" and not path.exists():
            simulated(CASES[name], options.ions, options.threads).save(path)


if __name__ == "__main__":
    main()
