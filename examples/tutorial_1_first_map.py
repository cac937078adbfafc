"""
1. First map
============

A nickel tip along [111], evaporated once and seen under four perturbations.

``python tutorial_1_first_map.py 500`` evaporates 500 atoms instead of 15,000, which take some fifteen seconds. Writes
ni111_perturbations.h5 and .png, and ni111_rollup.epos, into the current folder.
"""

import sys

import apt_evap as ae

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 15_000

# %%
# A material is a few numbers, each with its source. The tip is a crystal cut to a spherical cap on a shank: here
# small, R = 20 a = 7 nm, and with the [111] direction along its axis.

nickel = ae.material("Ni")
print(nickel)
tip = ae.Tip(nickel, apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_length=20 * nickel.a)
print(tip)

# %%
# A simulation charges the surface when it is made. Its run evaporates atoms, one by one, and flies every ion with the
# 30 launches that fix its response: how its hit depends on its velocity along the surface.

simulation = ae.Simulation(tip, voltage=1000.0, seed=1, detector=ae.Detector(distance=100.0, width=300.0))
run = simulation.run(n_ions)
run.save("ni111_perturbations.h5")
print(run)

# %%
# So the perturbation of the emission is chosen afterwards. These energies are those that :cite:t:`Shaikh` find for
# nickel. Without perturbation the zone lines through the (111) pole are dark; ions that rolled up make them bright.

energy = ae.TruncatedNormal(mean=0.155, standard_deviation=0.155)
perturbations = {
    "unperturbed": ae.Unperturbed(),
    "lateral velocity": ae.LateralVelocity(energy),
    "roll-up": ae.RollUp(energy),
    "3/4 roll-up, 1/4 lateral": ae.Combined(energy, rollup_fraction=0.75),
}
maps = []
for name, perturbation in perturbations.items():
    hits = run.hits(perturbation)
    print(f"{name}: {hits}")
    maps.append(hits.map(bins=160).smoothed(2.0))  # of the whole detector
axes = ae.plot.detector_maps(maps, list(perturbations))
axes[0].figure.savefig("ni111_perturbations.png")

# %%
# Simulated ions can be written as a measurement is. The ions that missed the detector are left out, with a warning.

ae.write("ni111_rollup.epos", run.hits(ae.RollUp(energy)))
print(ae.read("ni111_rollup.epos"))

# %%
# The charged surface as it is after the last ion has left. Its fields may be far from the 35 V/nm at which nickel
# evaporates: the voltage scales all of them alike, and only their ratios say which atom leaves next.

emitter = simulation.emitter
print(f"{len(emitter):,} surface atoms left, fields {emitter.fields.min():.1f} to {emitter.fields.max():.1f} V/nm")
