"""Random alloys: which solutes there are, and which site has which."""

from collections.abc import Mapping

import numpy as np

from apt_evap._arrays import check_kind, check_number, check_seed
from apt_evap.material import as_material


def check_solutes(solutes, seed):
    """Atomic fraction by Material."""
    fractions = {}
    if solutes is not None:
        check_kind(solutes, "solutes", Mapping, "a mapping of an element to its atomic fraction")
    for element, fraction in (solutes or {}).items():
        solute = as_material(element, "solutes")
        fractions[solute] = check_number(fraction, f"fraction of {solute.name}", above=0, at_most=1)
    if sum(fractions.values()) > 1:
        raise ValueError(f"solutes must have fractions that sum to at most 1, got {sum(fractions.values()):g}")
    if fractions or seed is not None:
        check_seed(seed, "seed (the random places of the solutes are drawn from it)")
    return fractions


def draw_species(n, fractions, seed):
    """Index of the element of each of n atoms: the host is 0."""
    if not fractions:
        return np.zeros(n, dtype=np.int32)
    edges = np.cumsum(list(fractions.values()))
    drawn = np.searchsorted(edges, np.random.default_rng(seed).random(n), side="right")
    return ((drawn + 1) % (len(fractions) + 1)).astype(np.int32)
