"""
Rules of the roll-up
====================

Contrast of the zone lines about a (111) pole of nickel for several rules of the roll-up, all from one run.

In the model of Shaikh et al., arXiv 2509.13744, every ion rolls up onto its neighbour of highest charge. This draws
black lines between bright ones, which no measured map shows. One run also covers other rules: only
a fraction of the ions rolls up (``probability``), the ion rolls onto a mean of its strongest neighbours
(``sharpness``), it starts above the surface (``height``), and ions that do not roll up have a lateral energy
(``others``). The script prints a table and draws the maps of four rules. With ``--full`` the tip has R = 40 a, with
50,000 ions.
"""

import argparse

import matplotlib.pyplot as plt

import apt_evap as ae

ENERGY = ae.TruncatedNormal(mean=0.155, standard_deviation=0.155)
RULES = {
    "unperturbed": ae.Unperturbed(),
    "all, strongest neighbour": ae.RollUp(ENERGY),
    "half, strongest neighbour": ae.RollUp(ENERGY, probability=0.5),
    "all, sharpness 0.15": ae.RollUp(ENERGY, sharpness=0.15),
    "60 %, sharpness 0.15": ae.RollUp(ENERGY, probability=0.6, sharpness=0.15),
    "60 %, sharpness 0.15, others 0.155 eV": ae.RollUp(ENERGY, probability=0.6, sharpness=0.15, others=ENERGY),
    "40 %, sharpness 0.3, others 0.155 eV": ae.RollUp(ENERGY, probability=0.4, sharpness=0.3, others=ENERGY),
    "unperturbed, 0.1 nm above the site": ae.Unperturbed(height=0.1),
}
DRAWN = "unperturbed", "all, strongest neighbour", "all, sharpness 0.15", "60 %, sharpness 0.15"


def evaporate(radius, ions):
    """Run of a nickel tip along [111] with a radius [a], with responses."""
    nickel = ae.material("Ni")
    size = radius * nickel.a
    tip = ae.Tip(nickel, apex_radius=size, axis=(1, 1, 1), shank_length=2 * size)
    return ae.Simulation(tip, seed=1).run(ions)


def counts(run, perturbation, bins=400):
    """Map of the complete detector."""
    return run.hits(perturbation).map(like=run.detector.grid(bins), position_step=None)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="R = 40 a, 50,000 ions")
parser.add_argument("--run", metavar="RUN.h5", help="a run with responses, instead of a new one")
parser.add_argument("-o", "--output", metavar="PICTURE.png", help="picture of four maps")
options = parser.parse_args()
run = ae.load(options.run) if options.run else evaporate(*((40, 50_000) if options.full else (12, 3_000)))

projection = ae.simulation.image_compression(run).projection
print("contrast in rings of 5-9, 9-14 and 14-20 degrees; density within 1, 2, 3 and 6 degrees over the mean")
for name, perturbation in RULES.items():
    counted = counts(run, perturbation)
    rings = ae.maps.ring_statistics(counted, projection, fold=3)
    contrasts = ", ".join(f"{ring.contrast:.2f} ± {ring.error:.2f}" for ring in rings)
    densities = " ".join(f"{density:.2f}" for density in ae.maps.pole_profile(counted, projection).density)
    print(f"{name:38}: {contrasts}; {densities}")

maps = [counts(run, RULES[name], 160).smoothed(2.0) for name in DRAWN]
axes = ae.plot.detector_maps(maps, DRAWN, columns=2)
for axis in axes.flat:
    axis.set(xlim=(-110, 110), ylim=(-110, 110))
if options.output:
    axes.flat[0].figure.savefig(options.output, dpi=80)
plt.show()
