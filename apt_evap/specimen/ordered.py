"""Ordered compounds: which element is on which site of a crystal."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from apt_evap._common.types import Integers
from apt_evap._common.validation import check_choice, check_count, check_number, check_sequence, short_text
from apt_evap.specimen.lattice import BASES
from apt_evap.specimen.materials import Material, as_material

# structure, cells of the period, and the sites of the second element: (cell, site) in the order of `lattice.BASES`
PROTOTYPES: dict[str, tuple[str, tuple[int, int, int], tuple[tuple[tuple[int, int, int], int], ...]]] = {
    "L1_2": ("fcc", (1, 1, 1), (((0, 0, 0), 0),)),
    "L1_0": ("fcc", (1, 1, 1), (((0, 0, 0), 1), ((0, 0, 0), 2))),
    "B2": ("bcc", (1, 1, 1), (((0, 0, 0), 1),)),
    # every second corner, as the ions of one kind in rock salt
    "D0_3": (
        "bcc",
        (2, 2, 2),
        tuple(((i, j, k), 0) for i in (0, 1) for j in (0, 1) for k in (0, 1) if (i + j + k) % 2 == 0),
    ),
}
"""Prototypes of ordered compounds with two elements.

L1_2 (Cu3Au, Ni3Al): the corners of fcc; L1_0 (CuAu): every second (002) plane of fcc; B2 (CsCl, NiAl): the centres of
bcc; D0_3 (BiF3, Fe3Al): every second corner of bcc.
"""

Occupant = Material | str | Mapping[Any, float] | None
_MOST_SITES = 10_000


def _occupant(value, name):
    """A tuple of (Material, fraction), or () for the host."""
    if value is None:
        return ()
    if not isinstance(value, Mapping):
        return ((as_material(value, name), 1.0),)
    fractions = tuple(
        (as_material(element, name), check_number(fraction, f"fraction of {short_text(element)}", above=0, at_most=1))
        for element, fraction in value.items()
    )
    total = sum(fraction for _, fraction in fractions)
    if not abs(total - 1) < 1e-9:
        raise ValueError(f"{name} must have fractions with a sum of 1, got {total:g}")
    return fractions


def _with_materials(occupant):
    """Occupant as a user gives it, with materials instead of names."""
    if len(occupant) == 1:
        return occupant[0][0]
    return dict(occupant) or None


def _given(occupant):
    """Occupant in plain types, for a file."""
    return [[asdict(element), fraction] for element, fraction in occupant] or None


@dataclass(frozen=True)
class Order:
    """Order of a compound of two elements on the sites of a crystal.

    The first element is the material of the phase. The crystal is cubic: the small tetragonal distortion of real L1_0
    compounds is not modelled.

    Parameters
    ----------
    prototype : str
        "L1_2", "L1_0", "B2" or "D0_3", see `apt_evap.specimen.ordered.PROTOTYPES`.
    second : Material or str or mapping
        Element on the sites of the second sublattice; or several with their fractions there, such as
        ``{"Al": 0.6, "Ti": 0.4}``, whose sum is 1.

    Raises
    ------
    ValueError
        If the prototype is unknown, or the element is.
    """

    prototype: str
    second: Any = field(hash=False)

    def __post_init__(self):
        check_choice(self.prototype, "prototype", PROTOTYPES)
        if self.second is None:
            raise ValueError("second must be an element or a mapping of elements to fractions, got None")
        object.__setattr__(self, "second", _with_materials(_occupant(self.second, "second")))

    @property
    def structure(self) -> str:
        """Structure of the crystal without order."""
        return PROTOTYPES[self.prototype][0]

    @property
    def period(self) -> tuple[int, int, int]:
        """Cells after which the order repeats."""
        return PROTOTYPES[self.prototype][1]

    def occupants(self) -> list[tuple[tuple[Material, float], ...]]:
        """Elements with their fractions by (cell, site), the site fastest; empty for the material of the phase."""
        structure, period, second = PROTOTYPES[self.prototype]
        cells = [(i, j, k) for i in range(period[0]) for j in range(period[1]) for k in range(period[2])]
        occupant = _occupant(self.second, "second")
        return [occupant if (cell, site) in second else () for cell in cells for site in range(len(BASES[structure]))]

    def settings(self) -> dict[str, Any]:
        """Parameters in plain types."""
        return {"prototype": self.prototype, "second": _given(_occupant(self.second, "second"))}


@dataclass(frozen=True)
class Basis:
    """Elements on the sites of a cell of a user's own.

    Parameters
    ----------
    sites : sequence
        Element of each site: a Material or its name, None for the material of the phase, or a mapping of elements to
        fractions. In the order of the sites in `apt_evap.specimen.lattice.BASES`; with several cells, those of cell
        (0, 0, 0) come first, then (0, 0, 1) and so on.
    cells : tuple of int
        Conventional cells along each axis after which the sites repeat.

    Raises
    ------
    ValueError
        If an element is unknown, or the number of sites is not a multiple of the number of cells.

    Examples
    --------
    L1_2 with a quarter of the corners occupied by a third element: ``Basis(({"Al": 0.75, "Ti": 0.25}, None, None,
    None))``.
    """

    sites: Sequence[Any] = field(hash=False)
    cells: tuple[int, int, int] = (1, 1, 1)
    _occupants: tuple[Any, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        cells = check_sequence(self.cells, "cells", "three integers")
        if len(cells) != 3:
            raise ValueError(f"cells must be three integers, got {short_text(self.cells)}")
        cells = tuple(check_count(n, "cells", at_least=1, at_most=100) for n in cells)
        sites = check_sequence(self.sites, "sites", "elements")
        if not sites or len(sites) % int(np.prod(cells)) or len(sites) > _MOST_SITES:
            raise ValueError(
                f"sites must be a multiple of {int(np.prod(cells))} cells and at most {_MOST_SITES:,}, got {len(sites)}"
            )
        object.__setattr__(self, "cells", cells)
        occupants = tuple(_occupant(site, "sites") for site in sites)
        object.__setattr__(self, "sites", tuple(map(_with_materials, occupants)))
        object.__setattr__(self, "_occupants", occupants)

    @property
    def structure(self) -> None:
        """Any structure with this number of sites."""
        return

    @property
    def period(self) -> tuple[int, int, int]:
        """Cells after which the order repeats."""
        return self.cells

    def occupants(self) -> list[tuple[tuple[Material, float], ...]]:
        """Elements with their fractions by (cell, site), the site fastest; empty for the material of the phase."""
        return list(self._occupants)

    def settings(self) -> dict[str, Any]:
        """Parameters in plain types."""
        return {"sites": [_given(site) for site in self._occupants], "cells": list(self.cells)}


def check_order(order: Any, structure: str) -> None:
    """Raise a ValueError unless `order` is None, or an order that fits the structure."""
    if order is None:
        return
    if not isinstance(order, Order | Basis):
        raise ValueError(f'order must be an Order such as Order("L1_2", "Al") or a Basis, got {short_text(order)}')
    if order.structure is not None and order.structure != structure:
        raise ValueError(f"order {order.prototype} needs the structure {order.structure}, got {structure}")  # type: ignore[union-attr]
    n_sites = int(np.prod(order.period)) * len(BASES[structure])
    if len(order.occupants()) != n_sites:
        raise ValueError(f"order must have {n_sites} sites for {structure}, got {len(order.occupants())}")


def sublattice(order: Order | Basis, cells: Integers, site: int, n_sites: int) -> Integers:
    """Index of the sites of these cells into `occupants`.

    Parameters
    ----------
    order : Order or Basis
        The order.
    cells : ndarray of int, shape (3, n)
        Cells.
    site : int
        Number of the site in each cell.
    n_sites : int
        Sites per cell.

    Returns
    -------
    ndarray of int, shape (n,)
    """
    i, j, k = (index % n for index, n in zip(cells, order.period, strict=True))
    return ((i * order.period[1] + j) * order.period[2] + k) * n_sites + site


def order_from_dict(table: Any) -> Order | Basis:
    """Make an order from its description: its class under "name" and its parameters.

    Raises
    ------
    ValueError
        If a name or a parameter is unknown or missing.
    """
    kinds = {"Order": (Order, ("prototype", "second")), "Basis": (Basis, ("sites", "cells"))}
    kind, known = kinds[check_choice(table.get("name", "Order"), "name of order", kinds)]
    parameters = {key: value for key, value in table.items() if key != "name"}
    for key in parameters:
        check_choice(key, "parameter of order", known)
    if known[0] not in parameters or (kind is Order and "second" not in parameters):
        raise ValueError(f"order must have {', '.join(known)}, got {', '.join(parameters) or 'none'}")
    if "second" in parameters:
        parameters["second"] = _from_plain(parameters["second"])
    if "sites" in parameters:
        sites = check_sequence(parameters["sites"], "sites", "elements")
        parameters["sites"] = tuple(_from_plain(site) for site in sites)
    return kind(**parameters)


def _from_plain(value):
    """Occupant from its description in a file: text, a table of fractions, or a list of materials with fractions."""
    if value in ("", None):  # TOML has no None
        return None
    if isinstance(value, list):
        return {Material(**element): fraction for element, fraction in value}
    return value
