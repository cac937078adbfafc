"""
4. A perturbation of your own
=============================

A perturbation is any object with a method that takes a batch of emissions. In this example, the ions start with a
velocity along the surface, and only a fraction of them rolls up.
"""

# sphinx_gallery_thumbnail_path = '../articles/paper_figures/figure2.png'

import sys
from dataclasses import dataclass, replace

import numpy as np

import apt_evap as ae
from apt_evap.emission.emissions import launch_tangentially
from apt_evap.emission.surface_frame import rollup_direction
from apt_evap.units import speed_from_energy

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 400

# %%
# The method ``tangential`` returns which ions roll up, and the velocities along the surface. It gives the hits of any
# run with responses, also of a saved one. The method ``launch`` is used for new flights with this perturbation. The
# random numbers are keyed by ion: an ion always has the same numbers, for any batch size.


@dataclass(frozen=True)
class SometimesRollUp:
    """A fraction of the ions rolls up; the others start at rest from their site.

    Parameters
    ----------
    energy : distribution
        Energy of the ions that roll up [eV].
    probability : float
        Probability that an ion with a surface nearest neighbour rolls up.
    """

    energy: object
    probability: float

    def tangential(self, emissions, random):
        """Which ions roll up, and the velocities along t1 and t2 of `tangent_frame` [nm/ns]."""
        u = random.uniform(2)
        can_roll, first, second = rollup_direction(emissions)
        rolled = can_roll & (u[:, 1] < self.probability)
        speed = np.where(rolled, speed_from_energy(self.energy.quantile(u[:, 0]), emissions.masses), 0.0)
        return rolled, speed * first, speed * second

    def launch(self, emissions, random):
        """Start positions and velocities, for flights with this perturbation."""
        return launch_tangentially(emissions, *self.tangential(emissions, random))


# %%
# If the perturbation is passed to the run, its flights are computed directly. The responses give the same hits
# approximately. Both are compared here.

nickel = ae.material("Ni")
tip = ae.Tip(nickel, apex_radius=8 * nickel.a, axis=(1, 1, 1), shank_length=8 * nickel.a)
half = SometimesRollUp(ae.TruncatedNormal(0.155, 0.155), probability=0.5)
run = ae.Simulation(tip, seed=1).run(n_ions, emissions=[half])

run.save("own.h5")
run = ae.load("own.h5")
direct = run.hits(half)
from_response = run.hits(half, by_response=True)
error = np.hypot(from_response.x - direct.x, from_response.y - direct.y)[direct.detected & from_response.detected]
print(f"{direct}\nresponses against flights: median {np.median(error):.4f} mm, largest {error.max():.4f} mm")

# %%
# One run is sufficient for all probabilities. The probability changes the hit positions, but it hardly changes the
# number of ions that hit the detector.

probabilities = np.linspace(0, 1, 5)
counts = [run.hits(replace(half, probability=each)).counts[ae.Outcome.HIT] for each in probabilities]
print("hits by roll-up probability:", dict(zip(probabilities.tolist(), counts, strict=True)))
