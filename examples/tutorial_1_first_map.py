"""
1. First map
============

Simulate a nickel tip along [111] once, and draw its detector map for four perturbations.

The script evaporates 15,000 atoms in about fifteen seconds. ``python tutorial_1_first_map.py 500`` evaporates 500
atoms. The script writes ni111_perturbations.h5 and .png, and ni111_rollup.epos, to the current folder.
"""

import sys

import apt_evap as ae

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 15_000

# %%
# A material is a small set of numbers, each with its source. The tip is a crystal, cut to the shape of a spherical cap
# on a conical shank. This tip is small, R = 20 a = 7 nm, with the [111] direction along its axis.

nickel = ae.material("Ni")
print(nickel)
tip = ae.Tip(nickel, apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_length=20 * nickel.a)
print(tip)

# %%
# When the simulation is created, it solves the charges of the surface. The run evaporates atoms one by one. Every ion
# is flown with 30 launches. They determine its response, that is, how its hit depends on its velocity along the
# surface.

simulation = ae.Simulation(tip, voltage=1000.0, seed=1, detector=ae.Detector(distance=100.0, width=300.0))
run = simulation.run(n_ions)
run.save("ni111_perturbations.h5")
print(run)

# %%
# The perturbation of the emission can therefore be chosen after the simulation. These are the energies of
# :cite:t:`Shaikh` for nickel. Without perturbation, the zone lines through the (111) pole are dark. If the ions roll
# up, they are bright.

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
    maps.append(hits.map(bins=160).smoothed(2.0))  # map of the whole detector
axes = ae.plot.detector_maps(maps, list(perturbations))
axes[0].figure.savefig("ni111_perturbations.png")

# %%
# Simulated ions can be saved in the format of a measurement. Ions that missed the detector are left out, with a
# warning.

ae.write("ni111_rollup.epos", run.hits(ae.RollUp(energy)))
print(ae.read("ni111_rollup.epos"))

# %%
# The emitter is the charged surface after the last evaporation. Its fields can differ strongly from the 35 V/nm at
# which nickel evaporates. The voltage scales all fields by the same factor, and only their ratios determine which atom
# evaporates next.

emitter = simulation.emitter
print(f"{len(emitter):,} surface atoms, fields {emitter.fields.min():.1f} to {emitter.fields.max():.1f} V/nm")
