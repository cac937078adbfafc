"""Isotopes of the elements, and the mass of each ion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_sequence
from apt_evap.specimen.nuclides import ISOTOPES

# relative: atomic weights rounded to three digits still count as natural, the isotopes of Ni, Cu, Fe and Si do not
_SAME_MASS = 1e-3
MOST_ELECTRONS = 118
"""Electrons of the heaviest atom, oganesson: no atomic ion has more charges [e]."""


def mean_mass(element: str) -> float:
    """Mean mass of the natural isotopes of an element of `ISOTOPES` [Da]; KeyError for others."""
    return sum(mass * abundance for mass, abundance in ISOTOPES[element])


def draw_isotopes(names: Sequence[str], species: ArrayLike, masses: ArrayLike, u: ArrayLike) -> Floats:
    """Mass of each ion [Da], drawn from the natural isotopes of its element by uniform random numbers `u` in (0, 1).

    The mass of a species is kept, without isotopes, if its name is not in `ISOTOPES` or its mass differs from the
    natural mean by more than 0.1 %, such as that of an enriched isotope.
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
