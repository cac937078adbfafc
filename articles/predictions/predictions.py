"""
Predicted maps of six metals
============================

Maps of tips that nobody has fitted, by one set of rules.

The rules of the emission are those that describe the measured maps of nickel and aluminium best, see the results in
the documentation: energies of 0.35 eV in real units for all ions, a launch 0.1 nm above the surface, and a fraction of
ions that rolls up onto a mean of its neighbours. Only this fraction depends on the metal. It is 0.05 for aluminium and
0.6 for nickel; between their evaporation fields it is interpolated, and beyond them it is constant. With
``--charges Robin`` the rules are those found with Robin's charges.

By default one small tip is simulated. With ``--full`` all six have R = 80 a and 300,000 ions. The run of each tip is
stored in the folder ``-o``, so that the script can be stopped and continued.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import apt_evap as ae

TIPS = {
    "W[110]": ("W", (1, 1, 0)),
    "Fe[110]": ("Fe", (1, 1, 0)),
    "Cu[111]": ("Cu", (1, 1, 1)),
    "Au[111]": ("Au", (1, 1, 1)),
    "Al[001]": ("Al", (0, 0, 1)),
    "Ni[001]": ("Ni", (0, 0, 1)),
}
ENERGY = 0.35  # mean and standard deviation before the truncation [eV], in real units
HEIGHT = 0.1  # nm
FIELDS = 19.0, 35.0  # evaporation fields of Al and Ni [V/nm]
# charging rule, sharpness, and the fractions of Al and Ni that roll up
RULES = {
    "constant potential": (ae.ConstantPotential(law_field="charge"), 2.0, (0.05, 0.6)),
    "Robin": (ae.Robin(), 0.15, (0.05, 0.4)),
}


def emission_of(material, rules, scale):
    """Emission of a metal; `scale` is the simulated energy per real energy."""
    _, sharpness, fractions = RULES[rules]
    energy = ae.TruncatedNormal(ENERGY * scale, ENERGY * scale)
    fraction = float(np.interp(material.evaporation_field, FIELDS, fractions))
    return ae.RollUp(energy, fraction, sharpness, HEIGHT, others=energy)


def evaporate(element, axis, rules, radius, ions, path):
    """Run of a tip with a radius [a], and its emission; from the file if it exists."""
    if path is not None and path.exists():
        run = ae.load(path)
        return run, run.perturbations[1]
    material = ae.material(element)
    size = radius * material.a
    tip = ae.Tip(material, size, axis=axis, shank_length=2 * size, depth=6 * material.a)
    simulation = ae.Simulation(tip, seed=1, rule=RULES[rules][0])
    # the first ions give the voltage at which the cap has the evaporation field
    pilot = simulation.run(256, responses=False, progress=False).at_evaporation_field()
    emission = emission_of(material, rules, float(np.median(pilot.energy_scales)))
    run = simulation.run(ions, [ae.Unperturbed(), emission], responses=False)
    if path is not None:
        run.save(path)
    return run, emission


def draw(axis, name, run, emission, bins):
    """Map of a run with its indexed poles, in an equidistant projection and without the broad gradient."""
    seen = run.on_detector(ae.Detector(distance=100.0, width=160.0, projection="equidistant"))
    counts = seen.hits(emission).map(like=seen.detector.grid(bins), position_step=None)
    ae.plot.detector_map(counts.flattened(25.0).smoothed(1.0), axis, title=name, colorbar=False, caption=False)
    orientation = ae.Orientation.from_settings(run.settings["tip"])
    ae.plot.poles(
        axis, orientation, ae.simulation.image_compression(seen).projection, families=6, zone_families=(), size=7
    )


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--full", action="store_true", help="six tips, R = 80 a, 300,000 ions")
parser.add_argument("--charges", choices=RULES, default="constant potential", help="rules found with these charges")
parser.add_argument("--tip", action="append", choices=TIPS, help="only this tip; may be repeated")
parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="folder of runs and pictures")
options = parser.parse_args()
radius, ions, bins = (80, 300_000, 200) if options.full else (12, 4_000, 60)
if options.output:
    options.output.mkdir(parents=True, exist_ok=True)
names = options.tip or (list(TIPS) if options.full else ["Ni[001]"])
figure, axes = plt.subplots(-(-len(names) // 3), min(len(names), 3), squeeze=False, layout="constrained")
figure.set_size_inches(4.6 * axes.shape[1], 4.4 * axes.shape[0])
for name, axis in zip(names, axes.flat, strict=False):
    stem = f"{name.rstrip(']')} {options.charges}".replace("[", " ").replace(" ", "_")
    path = options.output and options.output / f"{stem}.h5"
    run, emission = evaporate(*TIPS[name], options.charges, radius, ions, path)
    print(f"{name}: {len(run):,} ions, {emission}")
    draw(axis, name, run, emission, bins)
for axis in axes.flat[len(names) :]:
    axis.remove()
if options.output:
    figure.savefig(options.output / "predictions.png", dpi=110)
plt.show()
