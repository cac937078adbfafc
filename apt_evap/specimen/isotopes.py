"""Isotopes of the elements, and the mass of each ion.

Abundances: CIAAW, Isotopic compositions of the elements 2021 (Meija et al., Pure Appl. Chem. 88, 293 (2016), with later
revisions). The commission gives ranges for H, B, C, N, O, Mg and Si: the values here are the representative ones of
Berglund and Wieser, Pure Appl. Chem. 83, 397 (2011), which lie inside. Masses: AME2020 (Wang et al., Chinese Phys. C
45, 030003 (2021)), rounded to 1e-4 Da.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_sequence

ISOTOPES: dict[str, tuple[tuple[float, float], ...]] = {
    "Mg": ((23.9850, 0.7899), (24.9858, 0.1000), (25.9826, 0.1101)),
    "Al": ((26.9815, 1.0),),
    "Si": ((27.9769, 0.92223), (28.9765, 0.04685), (29.9738, 0.03092)),
    "Ti": ((45.9526, 0.0825), (46.9518, 0.0744), (47.9479, 0.7372), (48.9479, 0.0541), (49.9448, 0.0518)),
    "Cr": ((49.9460, 0.04345), (51.9405, 0.83789), (52.9406, 0.09501), (53.9389, 0.02365)),
    "Fe": ((53.9396, 0.05845), (55.9349, 0.91754), (56.9354, 0.02119), (57.9333, 0.00282)),
    "Co": ((58.9332, 1.0),),
    "Ni": ((57.9353, 0.680769), (59.9308, 0.262231), (60.9311, 0.011399), (61.9283, 0.036345), (63.9280, 0.009256)),
    "Cu": ((62.9296, 0.6915), (64.9278, 0.3085)),
    "Mo": (
        (91.9068, 0.14649),
        (93.9051, 0.09187),
        (94.9058, 0.15873),
        (95.9047, 0.16673),
        (96.9060, 0.09582),
        (97.9054, 0.24292),
        (99.9075, 0.09744),
    ),
    "Rh": ((102.9055, 1.0),),
    "Ag": ((106.9051, 0.51839), (108.9048, 0.48161)),
    "Ta": ((179.9475, 0.0001176), (180.9480, 0.9998824)),
    "W": ((179.9467, 0.0012), (181.9482, 0.2650), (182.9502, 0.1431), (183.9509, 0.3064), (185.9544, 0.2843)),
    "Ir": ((190.9606, 0.3723), (192.9629, 0.6277)),
    "Pt": (
        (189.9599, 0.00012),
        (191.9610, 0.00782),
        (193.9627, 0.32864),
        (194.9648, 0.33775),
        (195.9650, 0.25211),
        (197.9679, 0.07356),
    ),
    "Au": ((196.9666, 1.0),),
}
"""Mass [Da] and natural abundance (fraction) of each stable isotope, by element."""

SPECTRUM_ISOTOPES: dict[str, tuple[tuple[float, float], ...]] = {
    "H": ((1.0078, 0.999885), (2.0141, 0.000115)),
    "B": ((10.0129, 0.199), (11.0093, 0.801)),
    "C": ((12.0, 0.9893), (13.0034, 0.0107)),
    "N": ((14.0031, 0.99636), (15.0001, 0.00364)),
    "O": ((15.9949, 0.99757), (16.9991, 0.00038), (17.9992, 0.00205)),
    "V": ((49.9472, 0.0025), (50.9440, 0.9975)),
    "Mn": ((54.9380, 1.0),),
    "Zr": ((89.9047, 0.5145), (90.9056, 0.1122), (91.9050, 0.1715), (93.9063, 0.1738), (95.9083, 0.0280)),
    "Nb": ((92.9064, 1.0),),
    "Re": ((184.9530, 0.3740), (186.9558, 0.6260)),
} | ISOTOPES
"""The same with elements that measured spectra have and whose charge states are not computed."""

# relative: atomic weights rounded to three digits still count as natural, the isotopes of Ni, Cu, Fe and Si do not
_SAME_MASS = 1e-3


def mean_mass(element: str) -> float:
    """Mean mass of the natural isotopes of an element of `SPECTRUM_ISOTOPES` [Da]; KeyError for others."""
    return sum(mass * abundance for mass, abundance in SPECTRUM_ISOTOPES[element])


def draw_isotopes(names: Sequence[str], species: ArrayLike, masses: ArrayLike, u: ArrayLike) -> Floats:
    """Draw the mass of each ion from the natural isotopes of its element.

    Parameters
    ----------
    names : sequence of str
        Name of each species.
    species : array_like of int
        Species of each ion, shape (n,).
    masses : array_like
        Mass of each species [Da], shape (number of species,). It is kept, without isotopes, for a species whose name is
        not in `ISOTOPES` or whose mass differs from the natural mean by more than 0.1 %, such as an enriched isotope.
    u : array_like
        Uniform random numbers in (0, 1), one per ion, shape (n,).

    Returns
    -------
    ndarray
        Mass of each ion [Da], shape (n,).

    Raises
    ------
    ValueError
        If shapes disagree, a mass is not positive, or a species or a random number is outside its range.
    """
    names = check_sequence(names, "names", "element names")
    masses = check_array(masses, "masses", (len(names),))
    if masses.size and masses.min() <= 0:
        raise ValueError(f"masses must be > 0 [Da], got {masses.min()}")
    species = check_array(species, "species", ("n",), dtype=np.int64)
    u = check_array(u, "u", (len(species),))
    if species.size and not 0 <= species.min() <= species.max() < len(names):
        raise ValueError(f"species must be from 0 to {len(names) - 1}, got {species.min()} to {species.max()}")
    if u.size and not 0 < u.min() <= u.max() < 1:
        raise ValueError(f"u must be in (0, 1), got {u.min()} to {u.max()}")
    drawn = masses[species]
    for index, (name, mass) in enumerate(zip(names, masses, strict=True)):
        if name not in ISOTOPES or abs(mass / mean_mass(name) - 1) > _SAME_MASS:
            continue
        isotopes, abundances = np.array(ISOTOPES[name]).T
        of_species = species == index
        # without the last edge: the sum of the abundances may be rounded to less than 1
        edges = np.cumsum(abundances)[:-1]
        drawn[of_species] = isotopes[np.searchsorted(edges, u[of_species], side="right")]
    return drawn
