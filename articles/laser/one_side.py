"""
A specimen that is heated on one side
=====================================

Evaporates nickel under laser pulses that heat one side, and under pulses that heat all sides alike. Prints the shape of
the apex, the shares of the hits and the charge states on either side, and draws sections, detector maps and maps of
charge states.

    python one_side.py --ions 200000
"""

import argparse
import math
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import scipy
from matplotlib.colors import LogNorm

import apt_evap as ae

RADIUS, SIDE = 16, 15.0  # lattice constants; degrees: ions within this angle from the axis belong to no side


def simulate(asymmetry, ions, folder):
    """Run of Ni[111] whose laser comes from +x, from its file if there is one."""
    path = Path(folder) / f"asymmetry{asymmetry:g}_{ions}.h5"
    if not path.exists():
        nickel = ae.material("Ni")
        size = RADIUS * nickel.a
        tip = ae.Tip(nickel, size, axis=(1, 1, 1), shank_angle=2.0, shank_length=14 * size, offset_seed=1)
        law = ae.Arrhenius(50.0, laser=ae.evaporation.Laser(150.0, asymmetry=asymmetry))
        simulation = ae.Simulation(tip, seed=1, law=law, n_threads=1)
        simulation.run(ions, [ae.Unperturbed()], responses=False, progress=False, checkpoint=path).save(path)
    return ae.load(path)


def measure(run, last=25_000):
    """Shape of the apex from the sites of the last ions, and what the sides have in common or not."""
    part = run[-last:]
    places, fields = part.emissions.positions, part.fields
    top = places[:, 2] > np.quantile(places[:, 2], 0.5)
    centre, radius = sphere(places[top])
    sides = {name: top & (sign * (places[:, 0] - centre[0]) > 0.5) for name, sign in (("hot", 1), ("cold", -1))}
    radii = {name: sphere(places[rows], centre)[1] for name, rows in sides.items()}
    beyond = math.sin(math.radians(SIDE)) * radius
    field = [np.median(fields[sign * places[:, 0] > beyond]) for sign in (1, -1)]
    hits = part.hits(ae.Unperturbed())
    share = np.mean(hits.x[hits.detected] > 0)
    print(
        f"  centre at x = {centre[0]:+.2f} nm, radius {radius:.2f} nm, {radii['hot']:.2f} nm on the hot side and "
        f"{radii['cold']:.2f} nm on the cold one; field hot/cold {field[0] / field[1]:.3f}; {share:.1%} of hits right"
    )


def sphere(places, start=(0.0, 0.0, 0.0)):
    """Centre and radius of the sphere through places; about a given axis if there is a start with an x."""
    guess = np.append(places.mean(axis=0) - (0, 0, 5.0), 6.0)
    if start[0]:  # of one side: only its radius and the height of its centre
        found = scipy.optimize.least_squares(
            lambda p: np.linalg.norm(places - (start[0], start[1], p[0]), axis=1) - p[1], guess[2:], loss="soft_l1"
        )
        return None, found.x[1]
    found = scipy.optimize.least_squares(lambda p: np.linalg.norm(places - p[:3], axis=1) - p[3], guess, loss="soft_l1")
    return found.x[:3], found.x[3]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ions", type=int, default=200_000)
    parser.add_argument("--runs", default=".", help="folder of the runs")
    parser.add_argument("-o", "--output", default="one_side.png")
    options = parser.parse_args()
    figure, axes = plt.subplots(2, 3, figsize=(12.0, 7.6), layout="constrained")
    for row, asymmetry in zip(axes, (1.0, 0.0), strict=True):
        run = simulate(asymmetry, options.ions, options.runs)
        print(f"asymmetry {asymmetry:g}:")
        for count in sorted({25_000, 50_000, 100_000, 150_000, len(run)}):
            print(f"  {count:,} ions")
            measure(run[:count])
        draw(run, row, "heated from the right" if asymmetry else "heated on all sides")
    figure.savefig(options.output, dpi=130)


def draw(run, axes, title, last=60_000):
    """Section of the surface, detector map, and map of the charge states of the last ions."""
    positions = ae.simulation.surface_after(run).positions
    section = positions[np.abs(positions[:, 1]) < 0.5]
    top = section[:, 2].max()
    axes[0].scatter(section[:, 0], section[:, 2] - top, s=3, color="black")
    axes[0].set(
        aspect="equal", xlim=(-8, 8), ylim=(-10, 1), title=f"surface, {title}", xlabel="x [nm]", ylabel="z [nm]"
    )
    real = run.at_evaporation_field(flight_charges=ae.emission.PostIonisation(0.7))[-last:]
    hits = real.hits(ae.Unperturbed())
    ae.plot.detector_map(hits.map(bins=100), ax=axes[1])
    axes[1].set_title("ions")
    states = ae.spectra.charge_state_ratio_map(hits, "Ni", bins=20).to_map()
    shown = axes[2].pcolormesh(
        states.x_edges, states.y_edges, np.where(states.mask, states.values, np.nan), norm=LogNorm(1e-3, 1.0)
    )
    axes[2].figure.colorbar(shown, ax=axes[2], label="Ni$^{2+}$ / Ni$^+$")
    axes[2].set(aspect="equal", title="charge states", xlabel="x [mm]", ylabel="y [mm]")


if __name__ == "__main__":
    main()
