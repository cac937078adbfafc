"""Part of the atoms that roll, for evaporation fields that are 10 % lower to 10 % higher: 400 events of small tips."""

import apt_evap as ae

AXES = {"Mg": (0, 0, 0, 1), "W": (0, 1, 1), "Ni": (1, 1, 1), "Cu": (1, 1, 1), "Fe": (0, 0, 1), "Al": (1, 1, 1)}
FACTORS = (0.90, 0.95, 1.00, 1.05, 1.10)
RADIUS = 12  # lattice constants


def parts(name, events=400):
    """Part of the atoms that roll, for each of `FACTORS`."""
    metal = ae.material(name)
    length = RADIUS * metal.a
    tip = ae.Tip(metal, apex_radius=length, shank_length=length, axis=AXES[name], offset_seed=1)
    simulation = ae.Simulation(tip, seed=1, rule=ae.ConstantPotential())
    run = simulation.run(events, progress=False)
    for factor in FACTORS:
        rule = ae.emission.Migration(metal.cohesive_energy, factor * metal.evaporation_field)
        yield float(rule.probabilities(run.emissions).mean())


if __name__ == "__main__":
    for name in AXES:
        print(name, " ".join(f"{part:.2f}" for part in parts(name)))
