"""Ordered compounds: which element is on which site of a crystal."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from apt_evap._common.codec import checked, choice, from_plain, settings
from apt_evap._common.types import Integers
from apt_evap._common.validation import check_count, check_number, check_sequence, short_text
from apt_evap.specimen.alloy import by_material
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
        (element, check_number(fraction, f"fraction of {element.name}", above=0, at_most=1))
        for element, fraction in by_material(value, name).items()
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


def _of_file(plain, name):
    """Occupant from a file: a name, a table of a material or of fractions, or pairs of a material and its fraction."""
    if plain in ("", None):  # TOML has no None
        return None
    if isinstance(plain, list):
        return by_material(plain, name)
    return as_material(plain, name) if isinstance(plain, Mapping) and "structure" in plain else plain


def _second(value, name):
    if value is None:
        raise ValueError(f"{name} must be an element or a mapping of elements to fractions, got None")
    return _with_materials(_occupant(value, name))


@settings
class Superlattice:
    """Order of a compound of two elements on the sites of a crystal.

    The first element is the material of the phase. The crystal is cubic: the small tetragonal distortion of real L1_0
    compounds is not modelled.
    """

    prototype: str = choice("See `apt_evap.specimen.ordered.PROTOTYPES`.", PROTOTYPES)
    second: Any = checked(
        "Element on the sites of the second sublattice; or several with their fractions there, such as "
        '``{"Al": 0.6, "Ti": 0.4}``, whose sum is 1.',
        "Material or str or mapping",
        _second,
        read=_of_file,
        hash=False,
    )

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


def _sites(value, name):
    sites = check_sequence(value, name, "elements")
    return tuple(_with_materials(_occupant(site, name)) for site in sites)


def _cells(value, name):
    cells = check_sequence(value, name, "three integers")
    if len(cells) != 3:
        raise ValueError(f"{name} must be three integers, got {short_text(value)}")
    return tuple(check_count(n, name, at_least=1, at_most=100) for n in cells)


@settings
class UnitCell:
    """Elements on the sites of a cell of a user's own.

    Examples
    --------
    L1_2 with a quarter of the corners occupied by a third element: ``UnitCell(({"Al": 0.75, "Ti": 0.25}, None, None,
    None))``.
    """

    sites: Sequence[Any] = checked(
        "Element of each site: a Material or its name, None for the material of the phase, or a mapping of elements to "
        "fractions. In the order of the sites in `apt_evap.specimen.lattice.BASES`; with several cells, those of cell "
        "(0, 0, 0) come first, then (0, 0, 1) and so on.",
        "sequence",
        _sites,
        read=lambda plain, name: [_of_file(site, name) for site in check_sequence(plain, name, "elements")],
        hash=False,
    )
    cells: tuple[int, int, int] = checked(
        "Conventional cells along each axis after which the sites repeat.",
        "tuple of int",
        _cells,
        default=(1, 1, 1),
    )

    def _check(self):
        n_cells = int(np.prod(self.cells))
        if not self.sites or len(self.sites) % n_cells or len(self.sites) > _MOST_SITES:
            raise ValueError(
                f"sites must be a multiple of {n_cells} cells and at most {_MOST_SITES:,}, got {len(self.sites)}"
            )

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
        return [_occupant(site, "sites") for site in self.sites]


def check_order(order: Any, structure: str) -> None:
    """Raise a ValueError unless `order` is None, or an order that fits the structure."""
    if order is None:
        return
    if not isinstance(order, Superlattice | UnitCell):
        raise ValueError(
            f'order must be a Superlattice such as Superlattice("L1_2", "Al") or a UnitCell, got {short_text(order)}'
        )
    if order.structure is not None and order.structure != structure:
        raise ValueError(f"order {order.prototype} needs the structure {order.structure}, got {structure}")  # type: ignore[union-attr]
    n_sites = int(np.prod(order.period)) * len(BASES[structure])
    if len(order.occupants()) != n_sites:
        raise ValueError(f"order must have {n_sites} sites for {structure}, got {len(order.occupants())}")


def sublattice(order: Superlattice | UnitCell, cells: Integers, site: int, n_sites: int) -> Integers:
    """Index into `occupants` of a site in each of the cells with indices (3, n), of `n_sites` per cell, int (n,)."""
    i, j, k = (index % n for index, n in zip(cells, order.period, strict=True))
    return ((i * order.period[1] + j) * order.period[2] + k) * n_sites + site


def order_of(plain: Any, name: str = "order") -> Superlattice | UnitCell:
    """Order from its plain form; which one is known from its parameters."""
    kind = UnitCell if isinstance(plain, Mapping) and "sites" in plain else Superlattice
    return from_plain(plain, kind, what=name)
