"""Short run of all parts of the compiled core, on several threads, for checkers that slow it down by a factor of 100.

python tools/workout.py [ions] [threads]
"""

import sys

import numpy as np

import apt_evap as ae
from apt_evap._core.interactions import InteractionLists
from apt_evap._core.octree import Octree

ions = int(sys.argv[1]) if len(sys.argv) > 1 else 40
n_threads = int(sys.argv[2]) if len(sys.argv) > 2 else 3
tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1), shank_length=2.5, offset_seed=1, depth=1.2)

# events and flights in parallel; the shell is deepened when evaporation reaches its innermost atoms
settings = ae.evaporation.ChargeSettings(sweep_interval=max(2, ions // 4))
simulation = ae.Simulation(tip, seed=1, n_threads=n_threads, charge_settings=settings)
run = simulation.run(ions, (ae.RollUp(ae.TruncatedNormal(0.155, 0.155)),), progress=False, batch_size=max(2, ions // 3))
emitter = simulation.emitter
emitter.extend_shell()
emitter.relax(tolerance=1e-7)  # in double precision
batch = emitter.evaporate(3)

# rates, their sums and the bonds of the neighbours, under a control of the voltage
law = ae.Arrhenius(80.0, bonds=ae.evaporation.PairEnergies(second_weight=0.5))
warm = ae.Simulation(tip, seed=1, n_threads=n_threads, charge_settings=settings, law=law)
warm = warm.run(ions, responses=False, progress=False)
assert np.isfinite(warm.clock.waits).all()

# sums with the octree and over all atoms, on several threads
points = emitter.positions + 0.5 * emitter.normals
field, potential = emitter.field_at(points), emitter.potential_at(points)
exact = emitter.field_at(points[:50], opening_angle=0)
tree = Octree(emitter.positions, emitter.charges, n_threads=n_threads)
copy = tree.copy()
lists = InteractionLists(copy, 0.6, n_threads)
sums = np.zeros((copy.capacity, 3))
for double_precision in (False, True):
    lists.sweep(sums, double_precision, n_threads)
assert np.isfinite(sums).all() and np.isfinite(potential).all() and np.isfinite(batch.charges).all()
worst = np.linalg.norm(field[:50] - exact, axis=1).max() / np.linalg.norm(exact, axis=1).max()
assert worst < 0.01, worst  # octree with the default opening angle against the sum over all atoms
print(f"{run}\nlargest difference between octree and direct sum: {worst:.1e} of the largest field")
