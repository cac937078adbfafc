"""
The response of chosen atoms
============================

Where surface atoms land as the energy of the perturbation grows from 0 to 1 eV.

Redraws figure 2 of Shaikh et al., arXiv 2509.13744: lateral velocities of Al[012], roll-up of Ni[111]. Writes
figure2.png and figure2.json. Tips have R = 20 a; `--full` makes them as large as the paper's, R = 80 a.
"""

# sphinx_gallery_thumbnail_path = 'figure2.png'

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import apt_evap as ae

ENERGIES = np.linspace(0, 1, 51)  # eV
# nearest neighbours of the atoms: 6 at a kink, 7 at a step, 8 in a row of it; and where, seen from the cap's centre
NEIGHBOURS = (6, 6, 7, 7, 8, 6)
DIRECTIONS = ((8, 200), (33, 75), (22, 320), (36, 190), (30, 260), (28, 20))  # polar angle and azimuth [degrees]


@dataclass(frozen=True, eq=False)
class ChosenFirst:
    """A law by which some atoms leave before all others.

    Parameters
    ----------
    atoms : ndarray
        Their indices in the specimen.
    """

    atoms: np.ndarray

    def keys(self, tip, atoms, fields, bonds):
        """Keys of the usual law, a million times as large for the chosen atoms."""
        return ae.Extremal().keys(tip, atoms, fields, bonds) * np.where(np.isin(atoms, self.atoms), 1e6, 1.0)


def choose(emitter):
    """Surface atoms with given numbers of neighbours, nearest to given directions: indices in the specimen (n,)."""
    tip, places = emitter.tip, emitter.positions
    neighbours = cKDTree(tip.positions).query_ball_point(places, tip.bond_length, return_length=True) - 1
    towards = places / np.linalg.norm(places, axis=1)[:, None]
    chosen = []
    for number, (polar, azimuth) in zip(NEIGHBOURS, np.radians(DIRECTIONS), strict=True):
        direction = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        chosen.append(np.argmax(np.where(neighbours == number, towards @ direction, -1.0)))
    return emitter.atoms[chosen]


def respond(element, axis, radius):
    """The charged specimen, its chosen atoms, and the run in which they alone leave."""
    metal = ae.material(element)
    tip = ae.Tip(metal, radius * metal.a, axis, shank_length=radius * metal.a, depth=8 * metal.a)
    emitter = ae.Emitter(tip)
    chosen = choose(emitter)
    run = ae.Simulation(tip, seed=1, law=ChosenFirst(chosen)).run(len(chosen))
    order = [int(np.flatnonzero(run.site == atom)[0]) for atom in chosen]  # the one of highest charge left first
    return emitter, run, order


def reach(x, y, start):
    """Farthest place from the start for each ion [mm], shape (n,)."""
    n = len(x)
    return np.hypot(x.reshape(n, -1) - start.x.reshape(n, 1), y.reshape(n, -1) - start.y.reshape(n, 1)).max(axis=1)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="tips of R = 80 a, as in the paper")
parser.add_argument("--radius", type=float, help="apex radius in lattice constants, instead of 20 or 80")
parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="FOLDER", help="the current one by default")
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
    colors = ae.plot.ion_colors(len(ions))
    name = f"{element}[{''.join(map(str, axis))}]"
    ae.plot.specimen(emitter, ax=apex_view, colormap="bone", title=f"{name}, R = {radius:g} a")
    ae.plot.mark_atoms(run.emissions.positions[ions], apex_view, colors=colors)
    ae.plot.response(run, ions, mechanism, detector, energies=ENERGIES, zoom=1, title=f"{name}, {mechanism}")

    still = ae.lateral_tracks(run, ions, [0.0], [0.0])
    lateral = ae.lateral_tracks(run, ions, [0.5])
    rolled, rolled_on = (ae.rollup_tracks(run, ions, [energy]) for energy in (0.0, 0.5))
    table = {
        "neighbours": list(NEIGHBOURS),
        "field [V/nm]": run.fields[ions].tolist(),
        "x [mm]": still.x.ravel().tolist(),
        "y [mm]": still.y.ravel().tolist(),
        "lateral 0.5 eV [mm]": reach(lateral.x, lateral.y, still).tolist(),
        "roll [mm]": reach(rolled.x, rolled.y, still).tolist(),
        "then 0.5 eV [mm]": reach(rolled_on.x, rolled_on.y, rolled).tolist(),
        # how well the polynomials follow the flights: those of an atom amid its neighbours bend beyond them
        "residual [mm]": run.responses.residuals[ions].max(axis=1).tolist(),
    }
    results[name] = {"settings": run.settings, "color": colors, "marked": int(run.flagged.sum()), **table}
    print(f"{name}: how far ions move on the detector, in the farthest direction, by the roll alone and from there")
    print("  ".join(f"{title:>12}" for title in table))
    for row in zip(*table.values(), strict=True):
        print("  ".join(f"{value:{max(12, len(title))}.4g}" for title, value in zip(table, row, strict=True)))

figure.savefig(options.output / "figure2.png")
settings = {"radius [a]": radius, "energies [eV]": ENERGIES.tolist()}
(options.output / "figure2.json").write_text(json.dumps({"settings": settings, "results": results}, indent=1) + "\n")
