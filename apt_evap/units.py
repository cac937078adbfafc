"""Units and constants: nm, V, e, eV, V/nm, Da, ns inside the package; detector coordinates in mm.

Values from CODATA 2018 (Tiesinga et al., Rev. Mod. Phys. 93, 025010, 2021).
"""

import math

import numpy as np
from numpy.typing import NDArray

ELEMENTARY_CHARGE = 1.602176634e-19
"""Elementary charge [C]."""

DALTON = 1.66053906660e-27
"""Atomic mass constant [kg]."""

BOLTZMANN = 8.617333262e-5
"""Boltzmann constant [eV/K]."""

COULOMB = 1.439964548
"""k_e = e/(4 pi eps0) [V nm]: a charge q [e] at r [nm] gives the potential COULOMB * q / r [V]."""

NM_PER_MM = 1e6

SPEED = math.sqrt(2 * ELEMENTARY_CHARGE / DALTON)
"""Speed [nm/ns] of 1 Da at 1 eV: v = SPEED * sqrt(energy / mass), 13891 nm/ns."""

FLIGHT_TIME = math.sqrt(2.0) / SPEED
"""[ns sqrt(V) / nm / sqrt(Da)]: converts the reduced time of a flight (m = charge state = e = 1) to ns."""


def speed_from_energy(energy: NDArray[np.float64] | float, mass: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Speed of an ion from its kinetic energy, v = sqrt(2 E / m).

    Parameters
    ----------
    energy : array_like
        Kinetic energy [eV].
    mass : array_like
        Mass [Da].

    Returns
    -------
    ndarray or float
        Speed [nm/ns], which is also m/s.
    """
    return SPEED * (energy / mass) ** 0.5
