"""Scores of related and unrelated runs and maps, as `compare` gives them with its defaults.

    python pairs.py RUNS NICKEL.npz ALUMINIUM.npz TUNGSTEN.raw

Four runs and six maps, three measured ones and those of three second specimens: other radius, axis, lattice origin,
emission, rotation and scale. Related: the same crystal structure, with the axis of the run on the map. The 24 pairs are
compared without any known registration. One line for each: method and correlation of the registration, verdict,
objective, uncorrected and corrected score of the best point. Runs are kept in the folder RUNS.
"""

import argparse
import math
import warnings
from pathlib import Path

import apt_evap as ae

RUNS = {  # element, radius [a], axis, ions
    "Ni": ("Ni", 30, (0.29, 0.54, 0.79), 40_000),
    "Al": ("Al", 24, (1, 1, 1), 30_000),
    "W": ("W", 30, (0.03, 0.69, 0.72), 40_000),
    "Si": ("Si", 20, (0, 0.1, 1), 30_000),
}
SECOND = {  # the same, with an emission
    "Ni, 2nd": ("Ni", 22, (0.35, 0.5, 0.79), 20_000, ae.RollUp(ae.TruncatedNormal(0.2, 0.2), 0.9, 0.4, 0.1)),
    "W, 2nd": ("W", 22, (0.0, 0.63, 0.77), 20_000, ae.LateralVelocity(ae.TruncatedNormal(0.3, 0.3), 0.1)),
    "Si, 2nd": ("Si", 16, (0.05, 0.0, 1), 20_000, ae.RollUp(ae.TruncatedNormal(0.3, 0.3), 0.7, 0.4, 0.1)),
}

SMALLER, FIELD_OF_VIEW = 0.3, math.radians(38.0)  # measured mm per simulated mm, half angle of the second specimens
STRUCTURES = {"nickel": "fcc", "aluminium": "fcc", "tungsten": "bcc"}


def run_of(folder, name, element, radius, axis, ions):
    """The run of a specimen, simulated unless it is in the folder."""
    path = folder / f"{name.replace(', ', '_')}.h5"
    if not path.exists():
        material = ae.material(element)
        size = radius * material.a
        tip = ae.Tip(material, size, axis=axis, shank_length=size, depth=6 * material.a, offset_seed=len(name))
        simulation = ae.Simulation(tip, seed=1, rule=ae.ConstantPotential())
        for _ in simulation.emitter.advance(4_000):  # until the shape is that of a specimen
            pass
        simulation.run(ions, progress=False).save(path)
    return ae.load(path)


def main():
    """Print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("nickel")
    parser.add_argument("aluminium")
    parser.add_argument("tungsten", help="ions")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    maps = {name: ae.io.read_map(getattr(options, name)) for name in ("nickel", "aluminium")}
    maps["tungsten"] = ae.spectrum(ae.read(options.tungsten), "W", distance=305.0).select("W").map(bins=128)
    structures = dict(STRUCTURES)
    for name, (*specimen, emission) in SECOND.items():
        run = run_of(options.folder, name, *specimen)
        moved = ae.Registration(50.0, SMALLER, (2.0, -1.0)).hits(run.hits(emission))
        radius = SMALLER * ae.simulation.image_compression(run).projection.scale * FIELD_OF_VIEW
        maps[name] = ae.Hits(x=moved.x, y=moved.y).within_circle(radius, (4.0, -1.0)).map(bins=64)
        structures[name] = ae.material(specimen[0]).structure
    grid = ae.fit.EnergyGrid("roll-up", options={"probability": (0.0, 0.5, 1.0)}, relative_spreads=(0.1, 1.0))
    warnings.simplefilter("ignore")
    for run_name, specimen in RUNS.items():
        run = run_of(options.folder, run_name, *specimen)
        for map_name, measured in maps.items():
            related = ae.material(specimen[0]).structure == structures[map_name]
            settings = ae.fit.FitSettings(resamples=20)
            try:
                distance = 305.0 if map_name == "tungsten" else None  # mm
                study = ae.compare(run, measured, None, grid, settings, distance=distance, progress=False)
            except ValueError as error:
                print(f"{run_name:3} {map_name:9}: refused, {error}", flush=True)
                continue
            registration = study.registration
            print(
                f"{run_name:3} {map_name:9} {'related' if related else 'unrelated':9}: {registration.method:6}"
                f" {registration.score:5.2f}, {study.likeness.verdict:9}, {study.settings.objective:10}"
                f" {study.plain['optimum'].value:5.2f} {study.optimum.score.value:5.2f}; {study.score_text}",
                flush=True,
            )


if __name__ == "__main__":
    main()
