"""
Runs with a known truth
=======================

Specimens of aluminium with phases of other evaporation fields, evaporated at a constant potential, and what a detector
sees of them. Each run is one file ``NAME_SEED.npz`` with the sites, phases and species of all atoms in sequence, their
landing places, and the voltage at which each site would have left. A run of R = 12 nm takes 3.1 to 3.3 minutes of
processor time on an EPYC, 3.8 with rolled ions, one of R = 20 nm 7.5. ``python runs.py NAME:SEED ...
-o FOLDER`` makes those that the folder does not have; ``NAME:1-5`` are five seeds. Without names, the list of all.
``twin.h5`` is a run of the matrix alone, R = 6 nm.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import apt_evap as ae

ALUMINIUM = ae.material("Al")
VOLUME = ALUMINIUM.a**3 / 4  # nm^3
R = 12.0  # nm
AXIS = 0, 1, 2
COVER, BELOW, SIZE = 0.8, 1.2, 3.2  # nm: matrix above and below a sphere, its radius
SMALL = 2.2  # nm: radius of a sphere in a large specimen
ROLLING = 3.25  # energies at 1,000 V over those at the voltage of a measurement


def sphere(name, ratio, tilt=0.0, azimuth=35.0, radius=SIZE, cover=COVER, apex=R):
    """A sphere below the surface, at an angle from the axis [degrees], with a field relative to the matrix."""
    return phase(name, ball(tilt, azimuth, radius, cover, apex), ratio)


def ball(tilt, azimuth, radius, cover, apex=R):
    """Region of a sphere."""
    theta, phi = np.radians((tilt, azimuth))
    way = np.array((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)))
    return ae.specimen.Sphere(tuple((apex - cover - radius) * way), radius)


def layer(ratio, tilt, width=2.4, apex=R):
    """A layer through the place of the sphere, its normal at an angle from the axis [degrees]."""
    theta = np.radians(tilt)
    normal = np.array((0.8 * np.sin(theta), 0.6 * np.sin(theta), np.cos(theta)))
    middle = normal[2] * (apex - COVER - SIZE)
    return phase("layer", ae.specimen.Layer(middle - width / 2, middle + width / 2, tuple(normal)), ratio)


def grain(apex=R):
    """A second grain, [111] along the axis; the boundary, 20 degrees from it, crosses it 4 nm below the apex."""
    lean = np.radians(20)
    normal = (0.8 * np.cos(lean), 0.6 * np.cos(lean), np.sin(lean))
    return phase("grain", ae.specimen.HalfSpace((0.0, 0.0, apex - 4.0), normal), 1.0, axis=(1, 1, 1))


def phase(name, region, ratio, **more):
    """A phase of aluminium with an evaporation field relative to that of the matrix."""
    return ae.specimen.Phase(name, ALUMINIUM, region, evaporation_field=ratio * ALUMINIUM.evaporation_field, **more)


def alloy(region, share):
    """Matrix of 2 % and region of another share of copper, whose evaporation field is 0.6 times that of aluminium."""
    copper = ae.material("Cu", a=ALUMINIUM.a)
    fields = {"Al": ALUMINIUM.evaporation_field, "Cu": 0.6 * ALUMINIUM.evaporation_field}
    matrix = ae.specimen.Phase("matrix", ALUMINIUM, solutes={copper: 0.02}, evaporation_field=fields)
    return [matrix, ae.specimen.Phase("sphere", ALUMINIUM, region, solutes={copper: share}, evaporation_field=fields)]


def case(name):
    """Phases beside the matrix, angle of the shank [degrees], emissions, radius of the apex [nm] and axis of a case."""
    name, *words = name.split("-")
    name, _, percent = name.partition("@")
    low = float(percent or 80) / 100
    shank = next((float(word.removeprefix("shank")) for word in words if word.startswith("shank")), 1.5)
    apex = next((float(word.removeprefix("R")) for word in words if word.startswith("R")), R)
    axis = next((tuple(map(int, word.removeprefix("axis"))) for word in words if word.startswith("axis")), AXIS)
    emissions = {"rest": ae.Unperturbed()}
    if "rolled" in words:
        emissions["metal"] = ae.RollUp.of_metal("Al", energy_scale=ROLLING)
        emissions["all"] = ae.RollUp(ae.TruncatedNormal(0.3 * ROLLING, 0.3 * ROLLING))
    phases = {
        "pure": lambda: [],
        "sphere_low": lambda: [sphere("sphere", low, apex=apex)],
        "sphere_low_off": lambda: [sphere("sphere", 0.8, 20, apex=apex)],
        "sphere_small": lambda: [sphere("sphere", 0.8, radius=SMALL, apex=apex)],
        "sphere_high": lambda: [sphere("sphere", 1.2, apex=apex)],
        "sphere_edge": lambda: [sphere("sphere", 0.85, 31, radius=2.4, apex=apex)],
        "layer_high": lambda: [layer(1.15, 0, apex=apex)],
        "layer_low": lambda: [layer(0.85, 0, apex=apex)],
        "layer40_high": lambda: [layer(1.15, 40, apex=apex)],
        "layer40_low": lambda: [layer(0.85, 40, apex=apex)],
        "two_spheres": lambda: [
            sphere("low", 0.8, 14, 0, 1.8, 0.6, apex),
            sphere("high", 1.2, 16, 200, 1.8, 1.8, apex),
        ],
        "grains": lambda: [grain(apex)],
        "core_shell": lambda: [
            phase("shell", ball(0, 0, 3.0, 0.8, apex), 1.15),
            phase("core", ball(0, 0, 1.7, 2.1, apex), 0.85),
        ],
    }
    if name == "alloy_sphere":
        return alloy(ball(0, 0, SIZE, COVER, apex), 0.4), shank, emissions, apex, axis
    return [ae.specimen.Phase("matrix", ALUMINIUM), *phases[name]()], shank, emissions, apex, axis


CASES = (
    "pure:1-5 sphere_low:1-5 sphere_high:1-5 layer_high:1-5 two_spheres:1-5 layer_low-shank10:1-5 layer40_high:1 "
    "layer40_low:1 sphere_edge:1 core_shell:1 grains:1 alloy_sphere:1 sphere_small-R20:1 sphere_small-R30:1-2 "
    "two_spheres-R20:1 sphere_high-rolled:1 sphere_low-axis111:1-3 sphere_low@70-axis111:1 sphere_low@90-axis111:1 "
    "sphere_high-axis111:1 core_shell-axis111:1 sphere_low-axis001:1-3 sphere_low@90-axis001:1 sphere_high-axis001:1 "
    "sphere_low-axis011:1-3 sphere_low@90-axis011:1 sphere_high-axis011:1 sphere_low-axis113:1 sphere_low-axis122:1 "
    "sphere_low@70:1 sphere_low@90:1 sphere_low@75-axis001:1"
).split()  # fmt: skip


def evaporate(name, seed, folder):
    """Evaporate a case and keep what a reconstruction and its judgement need."""
    phases, shank, emissions, apex, axis = case(name)
    offset = 100 * seed + sum(map(ord, name.split("-axis")[0])) % 97
    tip = ae.Tip(
        phases=phases, apex_radius=apex, axis=axis, shank_angle=shank, shank_length=2 * apex, depth=11.0,
        offset_seed=offset, seed=offset,
    )  # fmt: skip
    size = SMALL if name.startswith("sphere_small") else SIZE
    ions = round((COVER + 2 * size + BELOW) * np.pi * apex**2 / VOLUME, -3)
    simulation = ae.Simulation(tip, seed=offset, rule=ae.ConstantPotential(), n_threads=1)
    run = simulation.run(int(ions), list(emissions.values()), responses=False, progress=False)
    kept = {"sites": run.emissions.positions, "phase": run.phase, "species": run.species}
    kept["voltage"] = run.voltage * run.evaporation_fields / run.fields
    for label, emission in emissions.items():
        hits = run.hits(emission)
        kept[label] = np.stack([hits.x, hits.y], axis=1).astype(np.float32)
    np.savez(folder / f"{name}_{seed}.npz", **kept)


def twin(folder):
    """A smaller specimen of the matrix alone, whose errors are those of the emission and the lattice."""
    tip = ae.Tip("Al", apex_radius=6.0, axis=AXIS, shank_angle=1.5, shank_length=12.0, depth=11.4,
                 offset_seed=301, seed=301)  # fmt: skip
    simulation = ae.Simulation(tip, seed=301, rule=ae.ConstantPotential(), n_threads=1)
    run = simulation.run(int(8.4 * np.pi * 6**2 / VOLUME), [ae.Unperturbed()], responses=False, progress=False)
    run.save(folder / "twin.h5")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="NAME:SEEDS", help=f"default: {' '.join(CASES)}")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs"), help="folder; default: runs")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    if not (options.output / "twin.h5").exists():
        twin(options.output)
    for text in options.cases or CASES:
        name, seeds = text.split(":")
        first, _, last = seeds.partition("-")
        for seed in range(int(first), int(last or first) + 1):
            if (options.output / f"{name}_{seed}.npz").exists():
                continue
            start = time.process_time()
            evaporate(name, seed, options.output)
            print(f"{name}:{seed}: {time.process_time() - start:.0f} s of processor time", flush=True)


if __name__ == "__main__":
    main()
