"""Width of dark lines against the energy of the perturbation, from one run: Ni[111], Robin's charges, as in figure 7.

    python dark_lines.py RUN.h5                       # makes the run if it is not there; --radius 40 --ions 90000

All energies use the same ions, from their responses. Widths are full widths at half height of the line that figure 7
calls depleted and, for velocities in random directions, of the dark lines from [111] that unperturbed ions show.
Energies are those of an experiment, sigma/mean 1.
"""

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae

ENERGIES = (0.0, 0.02, 0.05, 0.1, 0.155, 0.2, 0.3)  # eV
LIMIT = 2.5  # eV at the voltage of the run: covers the tails of the distributions
LINES = {  # from [111]; the first is the depleted one of figure 7, the second its enhanced one
    "towards {024}": ae.maps.Rectangle(centre=(0, 52), angle=-90, length=36, width=24),
    "towards {022}": ae.maps.Rectangle(centre=(30, 0), angle=0, length=28, width=44),
    "towards {113}": ae.maps.Rectangle(centre=(-30, 0), angle=180, length=28, width=44),
}
TURNS = (0, 120, 240)  # degrees


def simulated(radius, ions):
    """Run with responses of the ions up to 40 degrees."""
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, radius * nickel.a, axis=(1, 1, 1), rotation=90, shank_length=2 * radius * nickel.a,
                 offset_seed=1, depth=10 * nickel.a)  # fmt: skip
    responses = ae.ResponseSettings(energy_limit=LIMIT)
    flights = ae.simulation.FlightSettings(field_of_view=40.0)
    simulation = ae.Simulation(tip, seed=1, flight_settings=flights, response_settings=responses, n_threads=1)
    return simulation.run(ions, progress=False)


def perturbations(energy):
    """Roll-up and velocities in random directions with a mean energy, by name."""
    spread = ae.TruncatedNormal(energy, energy) if energy else 0.0
    return {"roll-up": ae.RollUp(spread), "random directions": ae.LateralVelocity(spread)}


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--radius", type=float, default=40, help="in lattice constants")
    parser.add_argument("--ions", type=int, default=90_000)
    options = parser.parse_args()
    if not options.run.exists():
        simulated(options.radius, options.ions).save(options.run)
    run = ae.load(options.run)
    real = run.at_evaporation_field()
    print(run, "true mean energy over the mean", round(ae.TruncatedNormal(0.1, 0.1).true_mean / 0.1, 3))
    for name in perturbations(0.0):
        for place, rectangle in LINES.items():
            rectangles = [rectangle.turned(angle) for angle in TURNS]
            for energy in ENERGIES:
                hits = real.hits(perturbations(energy)[name])
                profile = ae.maps.zone_line_profile(hits, rectangles, bins=30)
                try:
                    line = ae.maps.fit_zone_line(profile, exponent=None)
                except ValueError as error:
                    print(f"{name}, {place}, {energy:5.3f} eV: {error}")
                    continue
                depth = line.height / line.background
                print(f"{name}, {place}, {energy:5.3f} eV: {line}, height over ground {depth:+.2f}, exponent "
                      f"{line.exponent:.1f}, chi-square {line.chi_square:.0f} / {line.degrees_of_freedom}, "
                      f"density in the middle {profile.density[np.abs(profile.position).argmin()]:.3g}")  # fmt: skip


if __name__ == "__main__":
    main()
