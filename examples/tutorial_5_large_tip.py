"""
5. Large tips
=============

What a tip of real size needs: memory for its outer skin only, and a run that one can leave alone.

``python tutorial_5_large_tip.py 2000 80`` evaporates 2,000 atoms of a tip of R = 80 a; by default 1,000 of one of 40 a.
"""

# sphinx_gallery_thumbnail_path = 'soak.png'

import sys
import time

import apt_evap as ae

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000
size = float(sys.argv[2]) if len(sys.argv) > 2 else (40.0 if n_ions >= 1_000 else 10.0)

# %%
# The atoms of a tip grow with R\ :sup:`3`, those at its surface with R\ :sup:`2`. With ``depth`` only those that
# evaporation can reach are held; when it comes upon the innermost ones, more of the crystal is made, and the atoms
# keep their numbers. Which atom leaves when, and where its ion lands, does not depend on the depth.

nickel = ae.material("Ni")
whole = {"apex_radius": size * nickel.a, "axis": (1, 1, 1), "shank_length": 2 * size * nickel.a}
tip = ae.Tip(nickel, **whole, depth=4 * nickel.a)
print(tip)

# %%
# The cost of an event hardly depends on the size of the tip. Responses take 30 flights an ion; where one perturbation
# is all that is wanted, one flight an ion is faster. A run of hours is kept on the disk as it goes on with
# ``checkpoint="large.h5"``, and can be resumed.

began = time.perf_counter()
simulation = ae.Simulation(tip, seed=1)
print(f"{simulation.emitter}: charged in {time.perf_counter() - began:.1f} s")
for options in ({"responses": True}, {"responses": False, "emissions": [ae.RollUp(ae.TruncatedNormal(0.155, 0.155))]}):
    began = time.perf_counter()
    run = simulation.run(n_ions, **options)
    print(f"{run}\n{len(run) / (time.perf_counter() - began):,.0f} ions/s")
