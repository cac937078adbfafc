"""
4. A perturbation of your own
=============================

A perturbation is any object with a method over a batch of emissions. Here one that launches along the surface: of the
ions that have a neighbour to roll onto only a share rolls up.
"""

# sphinx_gallery_thumbnail_path = 'figure2.png'

import sys
from dataclasses import dataclass, replace

import numpy as np

import apt_evap as ae
from apt_evap.emission.surface_frame import launch_tangentially, rollup_direction
from apt_evap.units import speed_from_energy

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 400

# %%
# ``tangential`` says who rolls and how fast along the surface; from it follow the hits of any run with responses,
# also of one that was saved long ago. ``launch`` is for flights of its own. The random numbers belong to the ions:
# the same ion gets the same ones whatever the size of a batch.


@dataclass(frozen=True)
class SometimesRollUp:
    """A share of the ions rolls up; the others start at rest from their site.

    Parameters
    ----------
    energy : distribution
        Energy of those that roll [eV].
    share : float
        Probability to roll.
    """

    energy: object
    share: float

    def tangential(self, emissions, random):
        """Who rolls, and the velocities along t1 and t2 of `tangent_frame` [nm/ns]."""
        u = random.uniform(2)
        can_roll, first, second = rollup_direction(emissions)
        rolled = can_roll & (u[:, 1] < self.share)
        speed = np.where(rolled, speed_from_energy(self.energy.quantile(u[:, 0]), emissions.masses), 0.0)
        return rolled, speed * first, speed * second

    def launch(self, emissions, random):
        """Positions and velocities, for flights of this perturbation itself."""
        return launch_tangentially(emissions, *self.tangential(emissions, random))


# %%
# Named when the run starts, it is flown as it is. Afterwards the responses give it too: here the two are compared.

nickel = ae.material("Ni")
tip = ae.Tip(nickel, apex_radius=8 * nickel.a, axis=(1, 1, 1), shank_length=8 * nickel.a)
half = SometimesRollUp(ae.TruncatedNormal(0.155, 0.155), share=0.5)
run = ae.Simulation(tip, seed=1).run(n_ions, emissions=[half])

run.save("own.h5")
run = ae.load("own.h5")
flown = run.hits(half)
by_response = run.hits(half, by_response=True)
error = np.hypot(by_response.x - flown.x, by_response.y - flown.y)[flown.detected & by_response.detected]
print(f"{flown}\nresponses against flights: median {np.median(error):.4f} mm, largest {error.max():.4f} mm")

# %%
# One run serves every share. A share changes where ions land, and hardly how many of them hit the detector.

shares = np.linspace(0, 1, 5)
hit = [run.hits(replace(half, share=share)).counts[ae.Outcome.HIT] for share in shares]
print("hits by share of roll-up:", dict(zip(shares.tolist(), hit, strict=True)))
