"""Runs of tungsten, nickel and aluminium along their measured axes, for three charging rules.

    python runs.py RUNS W 160 --rule others --seed 1

One file for each metal, radius, rule and seed, `W_160_others_1.h5`; a file that is there is not made again. All atoms
evaporate, only ions that can arrive in the measured field of view fly. Every emission is flown for the same ions, in
the exact field. Energies are 0.35 eV in real units, sigma/mean 1, launches 0.1 nm above the site unless the name says
otherwise. With --fly responses, each ion gets its responses instead (`_responses.h5`), for any emission afterwards
(`rules.py`); with --fly law, only the one rule for all metals is flown (`_law.h5`). The responses can also cover
roll-ups onto second neighbours (--shells 2, `_responses_shells.h5`). With --leave bonds, the field at which an atom
leaves depends on its bonds to first and second neighbours; with --leave hop, an atom leaves as soon as it can hop.
"""

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae

ENERGY, HEIGHT = 0.35, 0.1  # eV, nm
# Direction at the middle of the measured map, and half the opening angle of the flights [degrees]: the image
# compression of these free specimens is about 1 there. Aluminium has two orientations, its map is undecided.
AXES = {
    "W": ((0.03, 0.69, 0.72), 18.0),
    "Ni": ((0.302, 0.540, 0.786), 25.3),
    "Al": ((0.31, 0.61, 0.73), 26.7),
    "Al-2": ((0.39, 0.50, 0.77), 24.0),
}
RULES = {
    "others": ae.ConstantPotential(),
    "charge": ae.ConstantPotential(law_field="charge"),
    "Robin": ae.Robin(),
}
LAWS = {
    "field": lambda metal: ae.Extremal(),
    "bonds": lambda metal: ae.Extremal(bonds=ae.evaporation.PairEnergies(second_weight=0.5)),
    "hop": lambda metal: ae.Extremal(hop=ae.emission.Migration.of(metal)),
}
EMISSIONS = (
    "unperturbed", "lateral", "lateral, height 0.2", "strongest", "sharpness 0.15", "sharpness 0.4", "sharpness 2",
    "sharpness 0.4, height 0.2",
)  # fmt: skip


def emissions(scale):
    """Perturbations in the order of `EMISSIONS`; `scale` is the simulated energy per real energy."""
    energy = ae.TruncatedNormal(ENERGY * scale, ENERGY * scale)
    return [
        ae.Unperturbed(),
        ae.LateralVelocity(energy, HEIGHT),
        ae.LateralVelocity(energy, 2 * HEIGHT),
        ae.RollUp(energy),
        ae.RollUp(energy, 1.0, 0.15, HEIGHT),
        ae.RollUp(energy, 1.0, 0.4, HEIGHT),
        ae.RollUp(energy, 1.0, 2.0, HEIGHT),
        ae.RollUp(energy, 1.0, 0.4, 2 * HEIGHT),
    ]


def prepared(tip, rule, half_angle, skip, seed=1, threads=None, law=None, shells=1):
    """Simulation of a tip after some events without flights, and the simulated energy per real energy."""
    common = {"seed": seed, "rule": rule, "n_threads": threads, "law": law, "shells": shells}
    pilot = simulation_of(tip, **common).run(256, responses=False, progress=False)
    scale = float(np.median(pilot.at_evaporation_field().energy_scales))
    return advanced(tip, half_angle, skip, **common), scale


def simulation_of(tip, *, shells, **settings):
    """Simulation whose responses reach so many shells of neighbours."""
    return ae.Simulation(tip, response_settings=ae.ResponseSettings(shells=shells), **settings)


def advanced(tip, half_angle, skip, *, shells=1, **settings):
    """Simulation of a tip after some events without flights."""
    flights = ae.simulation.FlightSettings(field_of_view=half_angle)
    simulation = simulation_of(tip, shells=shells, flight_settings=flights, **settings)
    for _ in simulation.emitter.advance(skip):
        pass
    return simulation


def simulated(metal, radius, rule, seed, skip, ions, threads, kind, leave, shells):
    """Run of one specimen; the second one has other atoms at the apex."""
    axis, half_angle = AXES[metal]
    material = ae.material(metal.partition("-")[0])
    size = radius * material.a
    shank = size if radius >= 160 else 2 * size
    tip = ae.Tip(material, size, axis=axis, shank_length=shank, depth=8 * material.a, offset_seed=seed)
    law = LAWS[leave](material)
    simulation, scale = prepared(tip, RULES[rule], half_angle, skip, seed, threads, law, shells)
    if kind == "responses":
        return simulation.run(ions, progress=False)
    rolls = ae.RollUp.of_metal(material, energy_scale=scale)
    flown = [ae.Unperturbed(), rolls] if kind == "law" else emissions(scale)
    return simulation.run(ions, flown, responses=False, progress=False)


def main():
    """Simulate one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the runs")
    parser.add_argument("metal", choices=AXES)
    parser.add_argument("radius", type=int, help="in lattice constants")
    parser.add_argument("--rule", choices=RULES, default="others")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--skip", type=int, default=110_000, help="events before the first ion that flies")
    parser.add_argument("--ions", type=int, default=300_000)
    parser.add_argument("--threads", type=int)
    kinds = ("emissions", "responses", "law")
    parser.add_argument("--fly", choices=kinds, default=kinds[0], help="eight emissions, responses, or the one law")
    parser.add_argument("--shells", type=int, default=1, help="shells of neighbours onto which atoms can roll, 1 or 2")
    parser.add_argument("--leave", choices=LAWS, default="field", help="what decides which atom leaves next")
    options = parser.parse_args()
    kind = "" if options.fly == kinds[0] else f"_{options.fly}"
    kind += "_shells" if options.shells > 1 else ""
    kind += "" if options.leave == "field" else f"_{options.leave}"
    path = options.runs / f"{options.metal}_{options.radius}_{options.rule}_{options.seed}{kind}.h5"
    options.runs.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        arguments = options.metal, options.radius, options.rule, options.seed, options.skip, options.ions
        simulated(*arguments, options.threads, options.fly, options.leave, options.shells).save(path)


if __name__ == "__main__":
    main()
