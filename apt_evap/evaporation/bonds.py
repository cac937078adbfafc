"""Evaporation field of an atom by its bonds: a table over coordination numbers, or pair energies between species."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from apt_evap._common.codec import checked, from_plain, is_plain, number, settings
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_count, check_number, short_text
from apt_evap.specimen.lattice import COORDINATION, SECOND_SHELL_FACTORS
from apt_evap.specimen.materials import MATERIALS
from apt_evap.specimen.tip import Tip

IONISATION_WORKS = {
    "Be": 17.6,
    "Mg": 4.0,
    "Al": 1.7,
    "Si": 14.8,
    "Ti": 11.8,
    "V": 12.8,
    "Cr": 2.3,
    "Fe": 15.1,
    "Co": 15.0,
    "Ni": 2.5,
    "Cu": 3.1,
    "Zn": 5.1,
    "Ge": 13.8,
    "Zr": 11.7,
    "Nb": 12.5,
    "Mo": 14.0,
    "Ru": 14.7,
    "Rh": 15.6,
    "Pd": 3.2,
    "Ag": 3.3,
    "Hf": 13.6,
    "Ta": 34.1,
    "W": 36.6,
    "Re": 14.5,
    "Os": 15.8,
    "Ir": 15.4,
    "Pt": 16.2,
    "Au": 4.1,
    "Pb": 3.2,
}
"""Sum of the ionisation energies less n work functions [eV], for the charge n at the barrier in `MATERIALS`.

From first, second and third ionisation energies (NIST Atomic Spectra Database) and polycrystalline work functions
(Michaelson, J. Appl. Phys. 48, 4729, 1977).
"""

_BITS = 4  # per count of neighbours: up to 15
_LEAST = 0.1  # of the energy at a kink: repulsive bonds cannot lower the field below 1 %
_MOST = 4  # counts: tables of 16^4 numbers


class BondField(Protocol):
    """Interface of an evaporation field by bonds.

    A class of a user's own has the two attributes and the method `fields`; it is called once for all combinations of
    bonds, not during the events.
    """

    by_species: bool
    """Whether the species of the neighbours matter, or only their number."""
    second_shell: bool
    """Whether second neighbours are counted, too."""

    def fields(self, tip: Tip, species: int, nearest: Integers, second: Integers) -> Floats:
        """Evaporation field of atoms of one species with these bonds.

        Parameters
        ----------
        tip : Tip
            The specimen.
        species : int
            Index of the atom into its `elements`.
        nearest, second : ndarray of int, shape (k, m)
            Numbers of remaining nearest and second neighbours, of each species (m = number of species) or of all
            (m = 1).

        Returns
        -------
        ndarray, shape (k,)
            [V/nm], > 0.
        """
        ...


def _table(table, name):
    """Fields by element and number of bonds; in files the numbers are text."""
    if not isinstance(table, Mapping) or not table:
        raise ValueError(
            f"{name} must be fields by element and number of bonds, such as {{'W': {{4: 57.0, 3: 47.0}}}}, got "
            f"{short_text(table)}"
        )
    by_element = {}
    for element, fields in table.items():
        if not isinstance(fields, Mapping) or not fields:
            raise ValueError(f"{name} of {element} must be fields by number of bonds, got {short_text(fields)}")
        by_element[element] = {
            check_count(
                int(n) if isinstance(n, str) and n.isdecimal() else n, f"bonds in the {name} of {element}", at_most=15
            ): check_number(field, f"field in the {name} of {element}", above=0, at_most=1000, unit="V/nm")
            for n, field in fields.items()
        }
    return by_element


@settings
class CoordinationTable:
    """Evaporation field by the number of remaining nearest neighbours."""

    table: Mapping[str, Mapping[int, float]] = checked(
        "For each element a mapping of the number of nearest neighbours to the field. Numbers in between are "
        "interpolated, beyond the ends the field is that of the end. Other elements keep their evaporation fields.",
        "mapping",
        _table,
        unit="V/nm",
        hash=False,
    )
    by_species = False
    second_shell = False

    def fields(self, tip: Tip, species: int, nearest: Integers, second: Integers) -> Floats:
        """Evaporation fields [V/nm]: see `BondField.fields`."""
        element = tip.elements[species]
        if element.name not in self.table:
            return np.full(len(nearest), element.evaporation_field)
        numbers = sorted(self.table[element.name])
        return np.interp(nearest[:, 0], numbers, [self.table[element.name][n] for n in numbers])


TUNGSTEN_TABLE = CoordinationTable({"W": {n: 17.0 + 10.0 * n for n in range(1, 10)} | {0: 57.0}})
"""Evaporation fields of tungsten by coordination in the program pyvaporate (Ashton et al., 2020): 10 V/nm a bond."""


def _by_element(energies, name):
    if not isinstance(energies, Mapping):
        raise ValueError(f"{name} must be numbers [eV] by element, got {short_text(energies)}")
    return {key: check_number(energy, f"{name} of {key}", above=0, unit="eV") for key, energy in energies.items()}


def _by_pair(energies, name):
    if not isinstance(energies, Mapping):
        raise ValueError(f"{name} must be energies [eV] by pair such as 'Al-Cu', got {short_text(energies)}")
    for pair in energies:
        if not isinstance(pair, str) or pair.count("-") != 1:
            raise ValueError(f"{name} must be by pair such as 'Al-Cu', got {short_text(pair)}")
    return {
        pair: check_number(energy, f"{name} of {pair}", at_least=-10, at_most=10, unit="eV")
        for pair, energy in energies.items()
    }


@settings
class PairEnergies:
    r"""Evaporation field from pair energies of the remaining bonds, in the image-hump model.

    Notes
    -----
    .. math:: Λ_i = \sum_j ε(s_i, s_j), \quad ε_{AA} = \frac{2 E_A}{Z}, \quad ε_{AB} = \frac{ε_{AA} + ε_{BB}}{2} + w,
        \quad F_i = F_\mathrm{evap} \left( \frac{Λ_i + S}{E_A + S} \right)^2

    with the cohesive energy E_A and the coordination Z of the bulk (with the weighted second neighbours). An atom at a
    kink of the pure metal has half of the bonds, so that its Λ is E_A, and its field the evaporation field.
    """

    cohesive_energies: Mapping[str, float] | None = checked(
        "Cohesive energy by element; by default that of the material.",
        "mapping",
        _by_element,
        default=None,
        unit="eV",
        hash=False,
    )
    ionisation_works: Mapping[str, float] | None = checked(
        "S = sum of the ionisation energies less n work functions, by element, for the charge at the barrier; by "
        "default `IONISATION_WORKS`.",
        "mapping",
        _by_element,
        default=None,
        unit="eV",
        hash=False,
    )
    ordering: Mapping[str, float] = checked(
        'w > 0 for unlike bonds that are stronger than the mean of the like ones, by pair, such as {"Al-Cu": 0.05}; 0 '
        "for pairs that are not in it.",
        "mapping",
        _by_pair,
        default={},
        unit="eV",
        hash=False,
    )
    second_weight: float = number(
        "Energy of a bond to a second neighbour, relative to a nearest one. 0.5 is sensible for bcc, whose second "
        "neighbours are only 15 % farther; 0 does not count them.",
        default=0.0,
        at_least=0,
        at_most=1,
    )
    by_species = True

    @property
    def second_shell(self) -> bool:
        """Whether second neighbours are counted."""
        return self.second_weight > 0

    def _cohesive_energy(self, element):
        value = (self.cohesive_energies or {}).get(element.name, element.cohesive_energy)
        if value is None:
            raise ValueError(
                f"cohesive_energies must have a value for {element.name}, whose material has no cohesive_energy [eV], "
                f"got {short_text(list(self.cohesive_energies or ()))}"
            )
        return value

    def _work(self, element):
        works = self.ionisation_works or {}
        if element.name in works:
            return works[element.name]
        known = MATERIALS.get(element.name)
        if known is None or known.charge_state != element.charge_state:
            raise ValueError(
                f"ionisation_works must have a value for {element.name} with a charge of {element.charge_state} e "
                f"at the barrier, got {short_text(list(works))}"
            )
        return IONISATION_WORKS[element.name]

    def pair_energy(self, tip: Tip, first: int, second: int) -> float:
        """Energy of a bond between two species [eV]."""
        energies = []
        for index in (first, second):
            element = tip.elements[index]
            near, far = COORDINATION[tip.elements[0].structure]
            cohesive = self._cohesive_energy(element)
            energies.append(2.0 * cohesive / (near + self.second_weight * far))
        names = [tip.elements[index].name for index in (first, second)]
        extra = self.ordering.get("-".join(names), self.ordering.get("-".join(names[::-1]), 0.0))
        return 0.5 * (energies[0] + energies[1]) + (extra if first != second else 0.0)

    def energies(self, tip: Tip, species: int, nearest: Integers, second: Integers) -> Floats:
        """Energy of the bonds of atoms of one species [eV], shape (k,); parameters as in `fields`."""
        total = np.zeros(len(nearest))
        for other in range(len(tip.elements)):
            counts = nearest[:, other] + self.second_weight * second[:, other]
            total = total + self.pair_energy(tip, species, other) * counts
        return total

    def fields(self, tip: Tip, species: int, nearest: Integers, second: Integers) -> Floats:
        """Evaporation fields [V/nm]: see `BondField.fields`."""
        element = tip.elements[species]
        cohesive = self._cohesive_energy(element)
        work = self._work(element)
        ratio = (self.energies(tip, species, nearest, second) + work) / (cohesive + work)
        ratio = np.maximum(ratio, _LEAST)
        return element.evaporation_field * ratio * ratio


BONDS = (CoordinationTable, PairEnergies)
"""The built-in evaporation fields by bonds."""


def _bonds(bonds, name):
    complete = all(hasattr(bonds, method) for method in ("fields", "by_species", "second_shell"))
    if not complete or isinstance(bonds, type | Mapping) or not callable(bonds.fields):
        raise ValueError(
            f"{name} must be an evaporation field by bonds with by_species, second_shell and a method fields, such as "
            f"PairEnergies(), got {short_text(bonds)}"
        )
    return bonds


def bonds_field() -> Any:
    """Declare the evaporation field by bonds of a law; in a file also "TUNGSTEN_TABLE"."""

    def read(plain, name):
        if plain == "TUNGSTEN_TABLE":
            return TUNGSTEN_TABLE
        return from_plain(plain, *BONDS, what=name) if is_plain(plain) else plain

    text = "Evaporation field by the bonds of an atom; by default that of its species."
    return checked(text, "BondField", _bonds, default=None, read=read)


class BondCodes(NamedTuple):
    """Code of the bonds of each atom: four bits for the number of neighbours of each kind."""

    near: np.ndarray
    """Contribution of each atom to the code of its nearest neighbours, int32 (n,)."""
    far: np.ndarray
    """Contribution of each atom to the code of its second neighbours, int32 (n,)."""
    second_length: float
    """Atoms closer than this are second neighbours [nm]."""


def bond_table(bonds: Any, tip: Tip) -> tuple[BondCodes, Floats, Integers]:
    """Codes of the bonds of a specimen, the factor of 1/field for every code, and the species of each atom.

    The factor, shape (n_species, 16^counts), is the evaporation field of the species divided by that with these bonds.
    """
    n_kinds = len(tip.elements) if bonds.by_species else 1
    n_counts = n_kinds * (2 if bonds.second_shell else 1)
    if n_counts > _MOST:
        raise ValueError(
            f"bonds by species are possible for up to {_MOST} species (half with second neighbours), got {n_kinds}"
        )
    kinds = tip.species if bonds.by_species else np.zeros(len(tip), np.int32)
    near = np.left_shift(np.int32(1), _BITS * kinds.astype(np.int32)).astype(np.int32)
    far = np.left_shift(near, _BITS * n_kinds).astype(np.int32) if bonds.second_shell else np.zeros(len(tip), np.int32)
    every = np.arange(1 << (_BITS * n_counts))
    counts = np.stack([(every >> (_BITS * k)) & 15 for k in range(n_counts)], axis=1)
    nearest = counts[:, :n_kinds]
    second = counts[:, n_kinds:] if bonds.second_shell else np.zeros_like(nearest)
    table = np.empty((len(tip.elements), len(every)))
    for index, element in enumerate(tip.elements):
        fields = np.asarray(bonds.fields(tip, index, nearest, second), dtype=np.float64)
        if fields.shape != every.shape or not (np.isfinite(fields) & (fields > 0)).all():
            raise ValueError(
                f"fields of {type(bonds).__name__} must be {len(every)} numbers > 0 [V/nm] for {element.name}, got "
                f"{short_text(fields)}"
            )
        table[index] = element.evaporation_field / fields
    second = SECOND_SHELL_FACTORS[tip.elements[0].structure] * tip.nearest_neighbour_distance
    reach = min(second, tip.neighbour_radius) if bonds.second_shell else 0.0
    return BondCodes(near, far, reach), table, tip.species
