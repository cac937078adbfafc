"""Random solutes: their fractions, profiles about a boundary, and the random numbers of the sites.

The random numbers of a site depend on the seed and on the indices of the site in its lattice only. A deeper shell, or
another shape, is therefore the same alloy.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.counter_random import GAMMA, mix, open_interval
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_kind, check_number, check_seed
from apt_evap._core.elementary import exponential
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.regions import check_region

VACANCY, SUBLATTICE, SOLUTE = range(3)
"""Uses of the random numbers of a site."""


@dataclass(frozen=True)
class Segregation:
    r"""Fraction of a solute that changes with the distance from a boundary.

    Parameters
    ----------
    bulk : float
        Atomic fraction far from the boundary.
    peak : float
        Atomic fraction at the boundary; below `bulk` for a depleted boundary.
    width : float
        Standard deviation of the profile [nm].
    region : region, optional
        The region with this boundary. By default that of the phase; for the matrix, the nearest boundary of any other
        phase.

    Raises
    ------
    ValueError
        If a number is outside its range.

    Notes
    -----
    .. math:: x(d) = x_\mathrm{bulk} + (x_\mathrm{peak} - x_\mathrm{bulk}) \exp(-d^2 / 2 w^2)

    with the distance d from the boundary.
    """

    bulk: float
    peak: float
    width: float
    region: Any = None

    def __post_init__(self):
        for name in ("bulk", "peak"):
            object.__setattr__(self, name, check_number(getattr(self, name), name, at_least=0, at_most=1))
        object.__setattr__(self, "width", check_number(self.width, "width", above=0, unit="nm"))
        if self.region is not None:
            check_region(self.region)
            check_kind(self.region, "region", "distance", "a region with a boundary, such as Sphere((0, 0, 20), 4)")

    @property
    def largest(self) -> float:
        """Largest fraction."""
        return max(self.bulk, self.peak)

    def fractions(self, distances: Floats) -> Floats:
        """Atomic fraction at distances from the boundary [nm], shape (n,)."""
        scaled = distances / self.width
        return self.bulk + (self.peak - self.bulk) * exponential(-0.5 * scaled * scaled)


def check_solutes(
    solutes: Mapping[Material, Any] | Mapping[str, Any] | None, *, profiles: bool = True
) -> dict[Material, Any]:
    """Return fractions by Material.

    Parameters
    ----------
    solutes : mapping or None
        Atomic fraction, or `Segregation`, by element (str or Material).
    profiles : bool
        Whether a `Segregation` is possible.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        If a fraction is not positive, or if they sum to more than 1.
    """
    fractions: dict[Material, Any] = {}
    if solutes is not None:
        check_kind(solutes, "solutes", Mapping, "a mapping of an element to its atomic fraction")
    for element, fraction in (solutes or {}).items():
        solute = as_material(element, "solutes")
        if isinstance(fraction, Segregation) and profiles:
            fractions[solute] = fraction
        else:
            fractions[solute] = check_number(fraction, f"fraction of {solute.name}", above=0, at_most=1)
    total = sum(each.largest if isinstance(each, Segregation) else each for each in fractions.values())
    if total > 1:
        raise ValueError(f"solutes must have fractions with a sum <= 1, got {total:g}")
    return fractions


def site_numbers(seed: int, lattice: int, cells: Integers, site: int, use: int) -> Floats:
    """Random number in (0, 1) of each lattice site.

    Parameters
    ----------
    seed : int
        Seed of the specimen.
    lattice : int
        Number of the lattice.
    cells : ndarray of int, shape (3, n)
        Indices of the cells.
    site : int
        Number of the site in each cell.
    use : int
        Use of the number, such as `VACANCY`.

    Returns
    -------
    ndarray, shape (n,)
    """
    state = mix(np.array([check_seed(seed)], dtype=np.uint64) + GAMMA)
    for index in (lattice, site, use, *cells):
        key = np.atleast_1d(np.asarray(index, dtype=np.int64)).view(np.uint64) + np.uint64(1)
        state = mix(state + key * GAMMA)
    return open_interval(state)


def choose(numbers: Floats, fractions: list[Any]) -> NDArray[np.int32]:
    """Index of the fraction that each random number falls into, -1 for none.

    Parameters
    ----------
    numbers : ndarray, shape (n,)
        Random numbers in (0, 1).
    fractions : list
        Fractions, numbers or arrays (n,), with a sum <= 1.

    Returns
    -------
    ndarray of int, shape (n,)
    """
    chosen = np.full(len(numbers), -1, dtype=np.int32)
    edge = np.zeros(len(numbers))
    for index, fraction in enumerate(fractions):
        upper = edge + fraction
        chosen[(numbers >= edge) & (numbers < upper)] = index
        edge = upper
    return chosen
