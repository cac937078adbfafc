"""
The response of chosen atoms
============================

Hit positions of chosen surface atoms for perturbations with energies from 0 to 1 eV.

This script reproduces figure 2 of Shaikh et al., arXiv 2509.13744: lateral velocities for Al[012], and roll-up for
Ni[111]. It writes figure2.png and figure2.json. The tips have R = 20 a. With ``--full`` they are as large as in the
paper, R = 80 a.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap.plot.responses import ion_colors
from apt_evap.plot.specimen_figures import mark_atoms

ENERGIES = np.linspace(0, 1, 51)  # eV
# numbers of nearest neighbours: 6 at a kink, 7 at a step, 8 in a row along a step; and directions from the cap centre
NEIGHBOURS = (6, 6, 7, 7, 8, 6)
DIRECTIONS = ((8, 200), (33, 75), (22, 320), (36, 190), (30, 260), (28, 20))  # polar angle and azimuth [degrees]


@dataclass(frozen=True, eq=False)
class ChosenFirst:
    """Law by which chosen atoms evaporate before all others.

    Parameters
    ----------
    atoms : ndarray
        Indices of the chosen atoms in the specimen.
    """

    atoms: np.ndarray

    def keys(self, tip, atoms, fields, bonds):
        """Keys of `Extremal`, multiplied by a million for the chosen atoms."""
        return ae.Extremal().keys(tip, atoms, fields, bonds) * np.where(np.isin(atoms, self.atoms), 1e6, 1.0)


def choose(emitter):
    """Indices in the specimen of surface atoms with given numbers of neighbours, closest to given directions, (n,)."""
    tip, positions = emitter.tip, emitter.positions
    neighbours = cKDTree(tip.positions).query_ball_point(positions, tip.bond_length, return_length=True) - 1
    directions = positions / np.linalg.norm(positions, axis=1)[:, None]
    choice = []
    for number, (polar, azimuth) in zip(NEIGHBOURS, np.radians(DIRECTIONS), strict=True):
        direction = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        choice.append(np.argmax(np.where(neighbours == number, directions @ direction, -1.0)))
    return emitter.atoms[choice]


def respond(element, axis, radius):
    """The emitter before the run, the run in which only the chosen atoms evaporate, and its ions in order of choice."""
    metal = ae.material(element)
    tip = ae.Tip(metal, radius * metal.a, axis, shank_length=radius * metal.a, depth=8 * metal.a)
    emitter = ae.evaporation.Emitter(tip)
    atoms = choose(emitter)
    run = ae.Simulation(tip, seed=1, law=ChosenFirst(atoms)).run(len(atoms))
    order = [int(np.flatnonzero(run.site == atom)[0]) for atom in atoms]  # the largest key evaporated first
    return emitter, run, order


def reach(x, y, start):
    """Largest distance of the hits of each ion from its start position on the detector [mm], shape (n,)."""
    n = len(x)
    return np.hypot(x.reshape(n, -1) - start.x.reshape(n, 1), y.reshape(n, -1) - start.y.reshape(n, 1)).max(axis=1)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="tips with R = 80 a, as in the paper")
parser.add_argument("--radius", type=float, help="apex radius in lattice constants; default: 20, or 80 with --full")
parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="FOLDER", help="default: the current folder")
options = parser.parse_args()
radius = options.radius or (80 if options.full else 20)
options.output.mkdir(parents=True, exist_ok=True)

figure = ae.plot.new_figure((10.4, 9.4))
rows = figure.subplots(2, 2)
results = {}
for (apex_view, detector), (element, axis, mechanism) in zip(
    rows, [("Al", (0, 1, 2), "lateral velocity"), ("Ni", (1, 1, 1), "roll-up")], strict=True
):
    emitter, run, ions = respond(element, axis, radius)
    colors = ion_colors(len(ions))
    name = f"{element}[{''.join(map(str, axis))}]"
    ae.plot.specimen(emitter, ax=apex_view, colormap="bone", title=f"{name}, R = {radius:g} a")
    mark_atoms(run.emissions.positions[ions], apex_view, colors=colors)
    ae.plot.response(run, ions, mechanism, detector, energies=ENERGIES, zoom=1, title=f"{name}, {mechanism}")

    unperturbed = ae.analysis.lateral_tracks(run, ions, [0.0], [0.0])
    lateral = ae.analysis.lateral_tracks(run, ions, [0.5])
    roll, roll_up = (ae.analysis.rollup_tracks(run, ions, [energy]) for energy in (0.0, 0.5))
    table = {
        "neighbours": list(NEIGHBOURS),
        "field [V/nm]": run.fields[ions].tolist(),
        "x [mm]": unperturbed.x.ravel().tolist(),
        "y [mm]": unperturbed.y.ravel().tolist(),
        "lateral 0.5 eV [mm]": reach(lateral.x, lateral.y, unperturbed).tolist(),
        "roll [mm]": reach(roll.x, roll.y, unperturbed).tolist(),
        "then 0.5 eV [mm]": reach(roll_up.x, roll_up.y, roll).tolist(),
        # deviation of the polynomials from the flights; it is largest for atoms with many neighbours
        "residual [mm]": run.responses.residuals[ions].max(axis=1).tolist(),
    }
    results[name] = {"settings": run.settings, "color": colors, "flagged": int(run.flagged.sum()), **table}
    print(f"{name}: how far the hits move, in the direction of largest effect, by the roll alone and then with energy")
    print("  ".join(f"{title:>12}" for title in table))
    for row in zip(*table.values(), strict=True):
        print("  ".join(f"{value:{max(12, len(title))}.4g}" for title, value in zip(table, row, strict=True)))

figure.savefig(options.output / "figure2.png")
settings = {"radius [a]": radius, "energies [eV]": ENERGIES.tolist()}
(options.output / "figure2.json").write_text(json.dumps({"settings": settings, "results": results}, indent=1) + "\n")
