"""
A specimen that is heated on one side
=====================================

Evaporates nickel under laser pulses that heat one side, and under pulses that heat all sides alike. Prints the shape of
the apex, the shares of the hits and the charge states on either side, and draws sections, detector maps and maps of
charge states.

    python one_side.py --ions 200000
"""

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae

RADIUS, SIDE = 16, 15.0  # lattice constants; degrees: ions within this angle from the axis belong to no side


def simulate(asymmetry, ions, folder):
    """Run of Ni[111] whose laser comes from +x, from its file if there is one."""
    path = Path(folder) / f"asymmetry{asymmetry:g}_{ions}.h5"
    if not path.exists():
        nickel = ae.material("Ni")
        size = RADIUS * nickel.a
        tip = ae.Tip(nickel, size, axis=(1, 1, 1), shank_angle=2.0, shank_length=6 * size, offset_seed=1)
        law = ae.Arrhenius(50.0, laser=ae.evaporation.Laser(150.0, asymmetry=asymmetry))
        simulation = ae.Simulation(tip, seed=1, law=law, n_threads=1)
        simulation.run(ions, [ae.Unperturbed()], responses=False, progress=False, checkpoint=path).save(path)
    return ae.load(path)
