"""
Temperature and the dark lines
==============================

Contrast of the zone lines about a (111) pole of nickel for several temperatures of the specimen.

Every temperature is a run of its own, because it changes the order of evaporation. Two perturbations are flown in it:
none, and roll-up with the energies of Shaikh et al., arXiv 2509.13744. The contrast is the standard deviation of the
azimuthal profile in a ring about the pole (`ring_statistics`): 0 without lines. A measured map of nickel has 0.15, 0.13
and 0.11. The script prints a table. With ``--full`` the tip has R = 40 a, with 60,000 ions at each temperature.
"""

import argparse

import apt_evap as ae

ROLL_UP = ae.RollUp(ae.TruncatedNormal(mean=0.155, standard_deviation=0.155))


def evaporate(temperature, radius, ions):
    """Run of a nickel tip along [111] with a radius [a]; 0 K is the extremal law."""
    nickel = ae.material("Ni")
    size = radius * nickel.a
    tip = ae.Tip(nickel, apex_radius=size, axis=(1, 1, 1), shank_length=2 * size, offset_seed=3)
    simulation = ae.Simulation(tip, law=ae.Arrhenius(temperature), seed=1)
    return simulation.run(ions, [ae.Unperturbed(), ROLL_UP], responses=False)


def counts(run, perturbation):
    """Map of the complete detector, in bins of 0.75 mm."""
    return run.hits(perturbation).map(like=run.detector.grid(400), position_step=None)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="R = 40 a, 60,000 ions")
parser.add_argument("--temperatures", type=float, nargs="+", default=[0, 80, 300], metavar="K")
parser.add_argument("--radius", type=float, help="other radius, in lattice constants")
parser.add_argument("--ions", type=int, help="ions at each temperature")
options = parser.parse_args()
radius = options.radius or (40 if options.full else 16)
ions = options.ions or (60_000 if options.full else 8_000)

print("temperature, perturbation: contrast in rings of 5-9, 9-14 and 14-20 degrees")
for temperature in options.temperatures:
    run = evaporate(temperature, radius, ions)
    projection = ae.simulation.image_compression(run).projection
    for name, perturbation in (("unperturbed", ae.Unperturbed()), ("roll-up", ROLL_UP)):
        rings = ae.maps.ring_statistics(counts(run, perturbation), projection, fold=3)
        numbers = ", ".join(f"{ring.contrast:.2f} ± {ring.error:.2f}" for ring in rings)
        print(f"{temperature:3g} K, {name:11}: {numbers}")
