"""
Pure crystals without a phase
=============================

Cap and evolving surface beside the truth, for eight crystals of R = 10 nm at four half angles. ``python crystals.py -o
FOLDER`` evaporates those that the folder does not have, 37 to 104 s of processor time each, and prints one line of
lateral / depth errors [nm] for each. Radius and compression are those that fit the cap at 30 degrees.
"""

import argparse
from pathlib import Path

import numpy as np
import table

import apt_evap as ae
from apt_evap.specimen.lattice import atom_density

CRYSTALS = {
    "Au": (0, 1, 2), "W": (0, 1, 1), "Mg": (0, 0, 1), "Si": (0, 0, 1),  # the recession was chosen on these
    "Fe": (0, 0, 1), "Pt": (1, 1, 1), "Ti": (1, 0, 1), "Ge": (1, 1, 3),
}  # fmt: skip
R, DEPTH = 10.0, 5.0  # nm
HALF_ANGLES = 30.0, 20.0, 25.0, 35.0  # the first one gives the constants


def evaporate(element, axis, path):
    """Evaporate a crystal and keep what a reconstruction and its judgement need."""
    offset = 1000 + sum(map(ord, element + "".join(map(str, axis))))
    tip = ae.Tip(element, apex_radius=R, axis=axis, shank_angle=1.5, shank_length=2 * R, depth=DEPTH + 2.8,
                 offset_seed=offset, seed=offset)  # fmt: skip
    emission = ae.Unperturbed()
    ions = int(round(DEPTH * np.pi * R**2 * density(element), -3))
    simulation = ae.Simulation(tip, seed=offset, rule=ae.ConstantPotential(), n_threads=1)
    run = simulation.run(ions, [emission], responses=False, progress=False)
    hits = run.hits(emission)
    voltage = run.voltage * run.evaporation_fields / run.fields
    places = np.stack([hits.x, hits.y], axis=1).astype(np.float32)
    np.savez(path, sites=run.emissions.positions, phase=run.phase, species=run.species, voltage=voltage, rest=places)


def density(element):
    """Atoms of a crystal in 1 nm^3."""
    material = ae.material(element)
    return atom_density(material.structure, material.a, material.c)


def reconstructed(hits, element, half_angle, radius, compression, **how):
    """Reconstruction with given constants."""
    return ae.reconstruct(
        hits, atomic_volume=1 / density(element), distance=table.DISTANCE, efficiency=table.EFFICIENCY, radius=radius,
        detector_radius=table.DISTANCE * np.tan(np.radians(half_angle)), projection="compressed",
        compression=compression, **how,
    )  # fmt: skip


def compare(element, path):
    """Errors by the cap and by the surface at each half angle, as text."""
    radius, compression = R, 1.0
    for half_angle in HALF_ANGLES:
        hits, sites, phase = table.detected(path, half_angle=half_angle)
        for _ in range(3 if half_angle == HALF_ANGLES[0] else 0):
            cap = reconstructed(hits, element, half_angle, radius, compression)
            fitted = cap.errors(sites, fit=("shift", "radius", "compression"))
            radius, compression = radius * fitted.radius_factor, fitted.compression
        found = reconstructed(hits, element, half_angle, radius, compression, shape="evolving")
        parts = []
        for one in (reconstructed(hits, element, half_angle, radius, compression), found):
            row = table.measured(one, sites, phase, [])
            parts.append(f"{row['lateral']:.3f} / {row['depth']:.3f}")
        yield f"{half_angle:g} degrees: {', '.join(parts)}; {found.verdict}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("crystals", nargs="*", metavar="ELEMENT", help=f"default: {' '.join(CRYSTALS)}")
    parser.add_argument("-o", "--output", type=Path, default=Path("crystals"), help="folder; default: crystals")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for element in options.crystals or CRYSTALS:
        axis = CRYSTALS[element]
        path = options.output / f"{element}{''.join(map(str, axis))}_1.npz"
        if not path.exists():
            evaporate(element, axis, path)
        for line in compare(element, path):
            print(f"{path.stem}, {line}", flush=True)


if __name__ == "__main__":
    main()
