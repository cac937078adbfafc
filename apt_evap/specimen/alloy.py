"""Random solutes: their fractions, profiles about a boundary, and the random numbers of the sites.

The random numbers of a site depend on the seed and on the indices of the site in its lattice only. A deeper shell, or
another shape, is therefore the same alloy.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.codec import checked, from_plain, number, settings
from apt_evap._common.counter_random import GAMMA, mix, open_interval
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_kind, check_number, check_pairs, check_seed
from apt_evap._core.elementary import exponential
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.regions import region_of, with_boundary

VACANCY, SUBLATTICE, SOLUTE = range(3)
"""Uses of the random numbers of a site."""


@settings
class Segregation:
    r"""Fraction of a solute that changes with the distance from a boundary.

    Notes
    -----
    .. math:: x(d) = x_\mathrm{bulk} + (x_\mathrm{peak} - x_\mathrm{bulk}) \exp(-d^2 / 2 w^2)

    with the distance d from the boundary.
    """

    bulk: float = number("Atomic fraction far from the boundary.", at_least=0, at_most=1)
    peak: float = number(
        "Atomic fraction at the boundary; below `bulk` for a depleted boundary.", at_least=0, at_most=1
    )
    width: float = number("Standard deviation of the profile.", above=0, unit="nm")
    region: Any = checked(
        "The region with this boundary. By default that of the phase; for the matrix, the nearest boundary of any "
        "other phase.",
        "region",
        with_boundary,
        default=None,
        read=region_of,
    )

    @property
    def largest(self) -> float:
        """Largest fraction."""
        return max(self.bulk, self.peak)

    def fractions(self, distances: Floats) -> Floats:
        """Atomic fraction at distances from the boundary [nm], shape (n,)."""
        scaled = distances / self.width
        return self.bulk + (self.peak - self.bulk) * exponential(-0.5 * scaled * scaled)


def by_material(values: Any, name: str) -> dict[Material, Any]:
    """Return the values of elements by Material, dict."""
    materials: dict[Material, Any] = {}
    for element, value in check_pairs(values, name, "a table of an element to its atomic fraction"):
        material = as_material(element, name)
        if material in materials:
            raise ValueError(f"{name} must have each element once, got {material.name} twice")
        materials[material] = value
    return materials


def check_solutes(
    solutes: Mapping[Material, Any] | Mapping[str, Any] | None, *, profiles: bool = True
) -> dict[Material, Any]:
    """Return fractions by Material; `profiles` tells whether a `Segregation` is possible."""
    fractions: dict[Material, Any] = {}
    if solutes is not None:
        check_kind(solutes, "solutes", Mapping, "a mapping of an element to its atomic fraction")
    for solute, fraction in by_material(solutes or {}, "solutes").items():
        if isinstance(fraction, Segregation) and profiles:
            fractions[solute] = fraction
        elif isinstance(fraction, Mapping) and profiles:  # of a file
            fractions[solute] = from_plain(fraction, Segregation, what=f"solute {solute.name}")
        else:
            fractions[solute] = check_number(fraction, f"fraction of {solute.name}", above=0, at_most=1)
    total = sum(part.largest if isinstance(part, Segregation) else part for part in fractions.values())
    if total > 1:
        raise ValueError(f"solutes must have fractions with a sum <= 1, got {total:g}")
    return fractions


def site_numbers(seed: int, lattice: int, cells: Integers, site: int, use: int) -> Floats:
    """Random number in (0, 1) of a lattice site in each cell of indices (3, n), for a use such as `VACANCY`."""
    state = mix(np.array([check_seed(seed)], dtype=np.uint64) + GAMMA)
    for index in (lattice, site, use, *cells):
        key = np.atleast_1d(np.asarray(index, dtype=np.int64)).view(np.uint64) + np.uint64(1)
        state = mix(state + key * GAMMA)
    return open_interval(state)


def choose(numbers: Floats, fractions: list[Any]) -> NDArray[np.int32]:
    """Index of the fraction that each random number in (0, 1) falls into, -1 for none, int (n,).

    Fractions are numbers or arrays (n,), with a sum <= 1.
    """
    chosen = np.full(len(numbers), -1, dtype=np.int32)
    edge = np.zeros(len(numbers))
    for index, fraction in enumerate(fractions):
        upper = edge + fraction
        chosen[(numbers >= edge) & (numbers < upper)] = index
        edge = upper
    return chosen
