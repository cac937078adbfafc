"""Specimens of the benchmark: what an instrument measures of them, and the truth.

    python benchmarks/ground_truth/generate.py FOLDER [NAME ...] [--draw K] [--secret FILE]

writes ``measured/NAME.h5`` and ``truth/NAME.h5``, of further draws ``NAME_K.h5``. The secret is a text; by default it
is read from the variable APT_GROUND_TRUTH_SECRET. Without it, the specimens whose seeds are withheld are left out.
"""

import argparse
import hashlib
import json
import os
import sys
import time
import tomllib
import warnings
from pathlib import Path

import h5py
import numpy as np

import apt_evap as ae

SETTINGS = tomllib.loads((Path(__file__).parent / "specimens.toml").read_text())


def seed_of(name, secret=None, draw=0):
    """Seed of a specimen or of a further draw of it, None if it is withheld and the secret is not known."""
    if "seed" in SETTINGS["specimens"][name]:
        return SETTINGS["specimens"][name]["seed"] + 1000 * draw
    if not secret:
        return None
    if hashlib.sha256(secret.encode()).hexdigest() != SETTINGS["secret_sha256"]:
        print(f"{name}: not the secret of specimens.toml, but another specimen of the same kind", file=sys.stderr)
    return int.from_bytes(hashlib.sha256(f"{secret}/{file_of(name, draw)}".encode()).digest()[:8])


def file_of(name, draw):
    """Name of the files of a draw of a specimen."""
    return f"{name}_{draw}" if draw else name


def direction(random):
    """A random direction."""
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)


def balls(random, radius, depth):
    """Two or three spheres in the field of view that are evaporated whole."""
    number, placed = int(random.integers(2, 4)), []
    while len(placed) < number:
        size = random.uniform(0.85, 1.15)
        across = (0.55 * radius - size) * np.sqrt(random.random())
        turn = 2 * np.pi * random.random()
        cover = random.uniform(0.3, depth - 2 * size - 0.5)
        place = (across * np.cos(turn), across * np.sin(turn), np.sqrt(radius**2 - across**2) - cover - size)
        if all(np.linalg.norm(np.subtract(place, ball.centre)) > size + ball.radius + 0.6 for ball in placed):
            placed.append(ae.specimen.Sphere(tuple(map(float, place)), float(size)))
        elif random.random() < 0.01:
            placed.clear()
    return placed


def structure(kind, metal, solute, random, radius, depth):
    """Phases of a specimen, and the answers about its structure."""
    host = metal.evaporation_field
    share = {solute: float(random.uniform(0.01, 0.03))}
    matrix = ae.specimen.Phase("matrix", metal, solutes=share, evaporation_field=host)
    name = kind.get("structure")
    if name is None:
        return [matrix], {"number": 0.0}
    ratio = float(random.uniform(*kind.get("field", (1, 1))))
    rich = {solute: float(random.uniform(0.35, 0.5))}
    if name == "precipitates":
        spheres = balls(random, radius, depth)
        union = ae.specimen.Union(spheres)
        phases = [ae.specimen.Phase("phase", metal, union, solutes=rich, evaporation_field=ratio * host)]
        answers = {"number": float(len(spheres)), "radius": float(np.mean([ball.radius for ball in spheres]))}
    elif name == "core and shell":
        core = ae.specimen.Sphere((0.0, 0.0, radius - 0.4 - 1.4), float(random.uniform(0.75, 0.9)))
        thickness = float(random.uniform(0.35, 0.5))
        shell = ae.material(kind["shell"], a=metal.a)
        phases = [
            ae.specimen.Phase("phase", metal, core, solutes=rich, evaporation_field=ratio * host),
            ae.specimen.Phase("shell", metal, ae.specimen.CoreShell(core, thickness), solutes={shell: 0.4},
                              evaporation_field=host / ratio),
        ]  # fmt: skip
        answers = {"number": 1.0, "radius": core.radius, "shell thickness": thickness}
    elif name == "layers":
        tilt, turn = np.radians(random.uniform(*kind["tilt"])), 2 * np.pi * random.random()
        normal = (float(np.sin(tilt) * np.cos(turn)), float(np.sin(tilt) * np.sin(turn)), float(np.cos(tilt)))
        thickness, spacing = float(random.uniform(0.5, 0.7)), float(random.uniform(1.3, 1.6))
        first = normal[2] * (radius - 0.5) - thickness
        layers = [ae.specimen.Layer(first - k * spacing, first - k * spacing + thickness, normal) for k in range(2)]
        union = ae.specimen.Union(layers)
        phases = [ae.specimen.Phase("phase", metal, union, solutes=rich, evaporation_field=ratio * host)]
        answers = {"thickness": thickness, "spacing": spacing}
    else:
        peak, width = float(random.uniform(0.1, 0.2)), float(random.uniform(0.3, 0.5))
        bulk = share[solute]
        turn, lean = 2 * np.pi * random.random(), np.radians(random.uniform(0, 10))
        normal = (np.cos(lean) * np.cos(turn), np.cos(lean) * np.sin(turn), np.sin(lean))
        boundary = ae.specimen.HalfSpace((0.0, 0.0, radius - 2), tuple(map(float, normal)))
        both = {solute: ae.specimen.Segregation(bulk=bulk, peak=peak, width=width, region=boundary)}
        matrix = ae.specimen.Phase("matrix", metal, axis=tuple(direction(random)), solutes=both, evaporation_field=host)
        phases = [ae.specimen.Phase("grain", metal, boundary, axis=tuple(direction(random)), solutes=both,
                                    evaporation_field=host)]  # fmt: skip
        answers = {"excess": (peak - bulk) * width * np.sqrt(2 * np.pi) / volume_of(metal)}
    return [matrix, *phases], answers


def volume_of(metal):
    """Volume of an atom of a cubic metal [nm^3]."""
    return metal.a**3 / {"fcc": 4, "bcc": 2}[metal.structure]


def emission_of(kind, metal, random, scale):
    """Initial conditions of the ions; the scale is that of true eV to those at 1000 V."""
    name = kind.get("emission", "at rest")
    if name == "measured":
        return ae.RollUp.of_metal(metal, energy_scale=scale)
    if name == "hidden":
        mean, width = scale * random.uniform(*SETTINGS["draws"]["hidden_energy"], 2)
        return ae.RollUp(ae.TruncatedNormal(float(mean), float(width)))
    return ae.Unperturbed()


def specimen(name, seed, ions=None):
    """Run, ions that the instrument records, their sites, what is given with them, and the answers."""
    kind, draws, conditions = SETTINGS["specimens"][name], SETTINGS["draws"], SETTINGS["conditions"]
    random = np.random.default_rng(seed)
    metal = ae.material(kind["material"])
    solute = ae.material(kind["solute"], a=metal.a)
    radius, factor = float(random.uniform(*draws["radius"])), float(random.uniform(2.8, 3.8))
    axis, rotation = direction(random), float(random.uniform(0, 360))
    phases, answers = structure(kind, metal, solute, random, radius, draws["depth"])
    tip = ae.Tip(
        phases=phases, apex_radius=radius, axis=tuple(axis), rotation=rotation, shank_length=radius,
        depth=draws["depth"] + 3.0, offset_seed=int(random.integers(1 << 30)), seed=int(random.integers(1 << 30)),
    )  # fmt: skip
    emission = emission_of(kind, metal, random, 1000 / (factor * metal.evaporation_field * radius))
    simulation = ae.Simulation(
        tip, seed=int(random.integers(1 << 30)), rule=ae.ConstantPotential(), n_threads=1,
        detector=ae.Detector(conditions["distance"], conditions["field_of_view"] + 5),
        flight_settings=ae.simulation.FlightSettings(field_of_view="detector"),
    )  # fmt: skip
    number = round(np.pi * radius**2 * draws["depth"] / volume_of(metal)) if ions is None else ions
    run = simulation.run(number, [emission], responses=False, progress=False)
    real = run.at_evaporation_field(field_factor=factor)
    hits = run.hits(emission)  # of true energies at the true voltage
    rows = hits.detected & (np.hypot(hits.x, hits.y) <= conditions["field_of_view"] / 2)
    rows &= random.random(len(run)) < conditions["efficiency"]
    if kind.get("structure") != "boundary":
        answers["axis"] = axis.tolist()
    elements = np.array(run.elements)[run.species]
    seen = {"x": hits.x, "y": hits.y, "voltage": real.instrument_voltages, "element": elements.astype("S2")}
    seen, sites = {column: values[rows] for column, values in seen.items()}, run.emissions.positions[rows]
    # the constants with which a cap places the ions nearest to their sites
    cap = ae.reconstruct(
        ae.Hits(x=seen["x"], y=seen["y"]), radius=radius, projection="compressed", compression=1.05,
        atomic_volume=volume_of(metal), distance=conditions["distance"], efficiency=conditions["efficiency"],
        detector_radius=conditions["field_of_view"] / 2,
    ).errors(sites)  # fmt: skip
    answers = {"apex radius": radius * cap.radius_factor, "compression": cap.compression, **answers}
    for number, phase in enumerate(phases):
        if kind.get("structure") != "boundary":
            for element in dict.fromkeys((kind["solute"], kind.get("shell", kind["solute"]))):
                answers[f"{element} of {phase.name}"] = 100 * float(np.mean(elements[run.phase == number] == element))
    given = conditions | {
        "material": kind["material"], "solute": kind["solute"], "shell": kind.get("shell", ""),
        "structure": kind.get("structure", "random alloy"), "crystal": metal.structure, "a": metal.a,
        "atomic_volume": volume_of(metal), "evaporation_field": metal.evaporation_field,
        "questions": json.dumps([name for name in answers]),
    }  # fmt: skip
    return run, seen, sites, given, answers


def write(folder, name, secret=None, ions=None, draw=0):
    """Simulate a specimen and write its two files."""
    seed, file_name = seed_of(name, secret, draw), file_of(name, draw)
    if seed is None:
        print(f"{name}: withheld")
        return
    start = time.process_time()
    warnings.simplefilter("ignore", ae.warnings.EmissionWarning)  # the solutes are few, and roll up like the metal
    run, seen, sites, given, answers = specimen(name, seed, ions)
    for part in ("measured", "truth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    with h5py.File(folder / "measured" / f"{file_name}.h5", "w") as file:
        for column, values in seen.items():
            file[column] = values
        file.attrs.update(given)
    with h5py.File(folder / "truth" / f"{file_name}.h5", "w") as file:
        file["positions"] = sites
        file["all_positions"] = run.emissions.positions  # of all atoms that evaporated
        file["all_elements"] = np.array(run.elements).astype("S2")[run.species]
        file.attrs["answers"] = json.dumps(answers)
        file.attrs["withheld"] = "seed" not in SETTINGS["specimens"][name]
    seconds = time.process_time() - start
    print(f"{file_name}: {len(sites):,} of {len(run):,} ions, {seconds:.0f} s of processor", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="specimens; default: all")
    parser.add_argument("--draw", type=int, default=0, help="number of the draw of each specimen, from 0 on")
    parser.add_argument("--secret", type=Path, help="file with the secret")
    options = parser.parse_args()
    secret = options.secret.read_text().strip() if options.secret else os.environ.get("APT_GROUND_TRUTH_SECRET")
    if unknown := set(options.names) - set(SETTINGS["specimens"]):
        parser.error(f"names must be of {', '.join(SETTINGS['specimens'])}, got {', '.join(sorted(unknown))}")
    for name in options.names or SETTINGS["specimens"]:
        write(options.folder, name, secret, draw=options.draw)


if __name__ == "__main__":
    main()
