"""Random substitutional alloys: the species of each atom."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.validation import check_kind, check_number, check_seed
from apt_evap.specimen.materials import Material, as_material


def check_solutes(
    solutes: Mapping[Material, float] | Mapping[str, float] | None, seed: int | None
) -> dict[Material, float]:
    """Return atomic fractions by Material.

    Parameters
    ----------
    solutes : mapping or None
        Atomic fraction by element (str or Material).
    seed : int or None
        Needed if there are solutes.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        If a fraction is not positive, if they sum to more than 1, or if there is no seed.
    """
    fractions = {}
    if solutes is not None:
        check_kind(solutes, "solutes", Mapping, "a mapping of an element to its atomic fraction")
    for element, fraction in (solutes or {}).items():
        solute = as_material(element, "solutes")
        fractions[solute] = check_number(fraction, f"fraction of {solute.name}", above=0, at_most=1)
    if sum(fractions.values()) > 1:
        raise ValueError(f"solutes must have fractions with a sum <= 1, got {sum(fractions.values()):g}")
    if fractions or seed is not None:
        check_seed(seed, "seed (of the random sites of the solutes)")
    return fractions


def draw_species(n: int, fractions: Mapping[Material, float], seed: int | None) -> NDArray[np.int32]:
    """Draw the species of each of n atoms: 0 is the host, the solutes follow in the order of `fractions`.

    Parameters
    ----------
    n : int
        Number of atoms.
    fractions : dict
        Atomic fractions of the solutes.
    seed : int
        Seed of the draw.

    Returns
    -------
    ndarray of int32, shape (n,)
    """
    if not fractions:
        return np.zeros(n, dtype=np.int32)
    edges = np.cumsum(list(fractions.values()))
    index = np.searchsorted(edges, np.random.default_rng(seed).random(n), side="right")
    return ((index + 1) % (len(fractions) + 1)).astype(np.int32)
