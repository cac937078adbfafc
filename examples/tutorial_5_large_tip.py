"""
5. Large tips
=============

How to simulate a tip of realistic size: keep only the outer shell in memory, and save long runs at intervals.

The script evaporates 1,000 atoms of a tip with R = 40 a. ``python tutorial_5_large_tip.py 2000 80`` evaporates 2,000
atoms of a tip with R = 80 a.
"""

# sphinx_gallery_thumbnail_path = 'soak.png'

import sys
import time

import apt_evap as ae

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000
size = float(sys.argv[2]) if len(sys.argv) > 2 else (40.0 if n_ions >= 1_000 else 10.0)

# %%
# The number of atoms of a tip increases with R\ :sup:`3`, and the number of surface atoms with R\ :sup:`2`. With
# ``depth``, only a shell of atoms near the surface is kept in memory. When evaporation reaches the innermost atoms of
# the shell, more of the crystal is generated. The atoms keep their numbers. The sequence of evaporation and the hits do
# not depend on the depth.

nickel = ae.material("Ni")
shape = {"apex_radius": size * nickel.a, "axis": (1, 1, 1), "shank_length": 2 * size * nickel.a}
tip = ae.Tip(nickel, **shape, depth=4 * nickel.a)
print(tip)

# %%
# The time of an event hardly depends on the size of the tip. Responses need 140 flights per ion. If only one
# perturbation is needed, one flight per ion is faster. For a run of hours, ``checkpoint="large.h5"`` saves the ions at
# intervals, and the run can be resumed.

start = time.perf_counter()
simulation = ae.Simulation(tip, seed=1)
print(f"{simulation.emitter}: charges solved in {time.perf_counter() - start:.1f} s")
for options in ({"responses": True}, {"responses": False, "emissions": [ae.RollUp(ae.TruncatedNormal(0.155, 0.155))]}):
    start = time.perf_counter()
    run = simulation.run(n_ions, **options)
    print(f"{run}\n{len(run) / (time.perf_counter() - start):,.0f} ions/s")
