"""Ions of a mass spectrum: formulas, isotopes, names, and which elements and charge states are probable."""

import re
from collections import defaultdict
from collections.abc import Mapping
from functools import lru_cache
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, did_you_mean, short_text
from apt_evap.specimen.nuclides import ISOTOPES

# fmt: off
HIGHEST_CHARGE = {
    "H": 1, "D": 1, "He": 1, "Li": 1, "Be": 2, "B": 2, "C": 2, "N": 2, "O": 1, "F": 1, "Ne": 1, "Na": 1, "Mg": 2,
    "Al": 3, "Si": 3, "P": 2, "S": 2, "Cl": 1, "Ar": 1, "K": 1, "Ca": 2, "Sc": 3, "Ti": 3, "V": 3, "Cr": 3, "Mn": 2,
    "Fe": 2, "Co": 2, "Ni": 2, "Cu": 2, "Zn": 2, "Ga": 2, "Ge": 2, "As": 2, "Se": 2, "Br": 1, "Kr": 1, "Rb": 1,
    "Sr": 2, "Y": 3, "Zr": 4, "Nb": 4, "Mo": 4, "Ru": 3, "Rh": 2, "Pd": 2, "Ag": 2, "Cd": 2, "In": 2, "Sn": 2, "Sb": 2,
    "Te": 2, "I": 1, "Xe": 1, "Cs": 1, "Ba": 2, "La": 3, "Ce": 3, "Pr": 3, "Nd": 3, "Sm": 3, "Eu": 3, "Gd": 3, "Tb": 3,
    "Dy": 3, "Ho": 3, "Er": 3, "Tm": 3, "Yb": 3, "Lu": 3, "Hf": 4, "Ta": 4, "W": 4, "Re": 4, "Os": 4, "Ir": 3, "Pt": 3,
    "Au": 2, "Hg": 2, "Tl": 1, "Pb": 2, "Bi": 2, "Th": 4, "U": 4,
}
"""Highest charge state of an atomic ion that is tried: see the tables of docs/composition.rst, with ionisation energies
(NIST) and fields by the curves of Kingham, Surf. Sci. 116, 273 (1982). Never more than the electrons of the atom, nor a
noble gas shell."""
GASES = ("H", "C", "N", "O")
"""Elements of the residual gas, and of organic molecules: they need no atomic ion."""
NOBLE = ("He", "Ne", "Ar", "Kr", "Xe")
COMMON = frozenset(
    "D Li B F Na Mg Al Si P S Cl K Ca Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Y Zr Nb Mo Ag In Sn Sb Hf Ta W Re Pt Au U Gd "
    "Nd".split()
)
"""Elements of frequent specimens. The others are rare: more evidence is needed for them."""
# fmt: on
LEAST_ABUNDANCE = 5e-4
"""Abundance over the largest of an ion, below which an isotope is left out."""
_RESOLVED = 0.02  # Da: isobars closer than this are one line in every spectrum
_MOST_ATOMS = 20  # of one element in a formula
_FORMULA = re.compile(r"(?:(\d{1,3})(?=[A-Z]))?([A-Z][a-z]?)(\d*)")
_SUBSCRIPTS, _SUPERSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"), str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def ion_name(formula: str, charge: int) -> str:
    """Name of an ion, such as "C₂⁺" for two atoms with one charge, and "C²⁺" for one atom with two."""
    parts = []
    for isotope, element, number in _FORMULA.findall(formula):
        parts.append(isotope.translate(_SUPERSCRIPTS) + element + number.translate(_SUBSCRIPTS))
    return "".join(parts) + (str(charge).translate(_SUPERSCRIPTS) if charge > 1 else "") + "⁺"


def _parsed(formula):
    atoms: dict[str, int] = defaultdict(int)
    at = 0
    for match in _FORMULA.finditer(formula):
        if match.start() != at:
            return None
        at = match.end()
        isotope, element, number = match.groups()
        # "Si28" is one atom of an isotope: no ion has ten or more atoms of an element and also that number
        if not isotope and number and int(number) > 9 and int(number) in _mass_numbers(element):
            isotope, number = number, ""
        if number.startswith("0") or int(number or 1) > _MOST_ATOMS:
            return None
        symbol = f"{isotope}{element}" if isotope else element
        atoms["D" if symbol in ("2H", "H2") and isotope else symbol] += int(number or 1)
    return dict(atoms) if at == len(formula) and atoms else None


def _mass_numbers(element):
    return {round(mass) for mass, _ in ISOTOPES.get(element, ())}


def atoms_of_formula(formula: str) -> dict[str, int]:
    """Number of atoms of each element, or isotope, in an ion such as "CrO2", "D2O" or "18O2".

    Raises
    ------
    ValueError
        If the text is not a formula of elements of `ISOTOPES`, D, or natural isotopes of them.
    """
    check_kind(formula, "elements", str, 'formulas such as "W" or "CrO"')
    return dict(_atoms(formula))


@lru_cache(8192)
def _atoms(formula):
    """Atoms of a formula of known elements."""
    atoms = _parsed(formula) if len(formula) <= 30 else None
    if atoms is None:
        raise ValueError(f'elements must be formulas such as "W" or "CrO2", got {short_text(formula)}')
    for symbol in atoms:
        _natural(symbol)
    return atoms


def element_of(symbol: str) -> str:
    """Chemical element of an element, D, or an isotope such as "57Fe"."""
    return symbol.lstrip("0123456789")


def _natural(symbol):
    """Masses and abundances of the isotopes of an element, or the mass of one isotope such as "57Fe"."""
    if symbol == "D":
        return ((2.0141, 1.0),)
    number, element = symbol[: len(symbol) - len(element_of(symbol))], element_of(symbol)
    if element not in ISOTOPES:
        hint = did_you_mean(element, [*ISOTOPES, "D"])
        raise ValueError(f"elements must be chemical symbols such as W, got {short_text(symbol)}{hint}")
    if not number:
        return ISOTOPES[element]
    chosen = [mass for mass, _ in ISOTOPES[element] if round(mass) == int(number)]
    if not chosen:
        known = ", ".join(map(str, sorted(_mass_numbers(element))))
        raise ValueError(f"isotopes of {element} must be one of {known}, got {short_text(symbol)}")
    return ((chosen[0], 1.0),)


def formula_of_atoms(atoms: Mapping[str, int]) -> str:
    """Formula of an ion: metals first, then carbon, nitrogen, oxygen and hydrogen."""
    if set(atoms) == {"H", "O"}:
        order = ["O", "H"] if atoms["H"] == 1 else ["H", "O"]
    elif set(atoms) == {"D", "O"}:
        order = ["O", "D"] if atoms["D"] == 1 else ["D", "O"]
    else:
        rank = {"C": 1, "N": 2, "O": 3, "D": 4, "H": 5}
        order = sorted(atoms, key=lambda symbol: (rank.get(symbol, 0), symbol))
    return "".join(symbol + (str(atoms[symbol]) if atoms[symbol] > 1 else "") for symbol in order)


class Abundances:
    """Abundances of isotopes: natural ones, or those of an enriched specimen.

    Parameters
    ----------
    enriched : mapping, optional
        Abundances of the isotopes of elements by mass number, such as {"Si": {28: 0.5, 30: 0.5}}.

    Raises
    ------
    ValueError
        If an element or an isotope is unknown, or abundances are negative or do not sum to one.
    """

    def __init__(self, enriched: Mapping[str, Mapping[int, float]] | None = None) -> None:
        self.enriched = {} if enriched is None else {name: _checked(name, shares) for name, shares in _items(enriched)}
        self._lines: dict[str, tuple[Floats, Floats]] = {}

    def of(self, symbol: str) -> Any:
        """Mass [Da] and abundance of the isotopes of an element, D, or one isotope."""
        return self.enriched.get(symbol) or _natural(symbol)

    def lines(self, formula: str) -> tuple[Floats, Floats]:
        """Masses [Da] and abundances of an ion, isobars together, without isotopes below `LEAST_ABUNDANCE`."""
        if formula not in self._lines:
            pattern = {0.0: 1.0}
            for symbol, number in atoms_of_formula(formula).items():
                for _ in range(number):
                    longer: dict[float, float] = defaultdict(float)
                    for mass, share in pattern.items():
                        for more, abundance in self.of(symbol):
                            longer[round(mass + more, 4)] += share * abundance
                    pattern = _joined(longer)
            masses, shares = np.array(sorted(pattern.items())).T
            enough = shares > LEAST_ABUNDANCE * shares.max()
            self._lines[formula] = masses[enough], shares[enough] / shares[enough].sum()
        return self._lines[formula]


def _items(enriched):
    check_kind(enriched, "isotopes", Mapping, 'abundances such as {"Si": {28: 0.5, 30: 0.5}}')
    return enriched.items()


def _checked(name, shares):
    """Mass and abundance of each isotope of an enriched element."""
    if name not in ISOTOPES:
        hint = did_you_mean(name, ISOTOPES) if isinstance(name, str) else ""
        raise ValueError(f"isotopes must be of chemical elements such as Si, got {short_text(name)}{hint}")
    check_kind(shares, f"isotopes of {name}", Mapping, "abundances by mass number such as {28: 0.5, 30: 0.5}")
    masses = {round(mass): mass for mass, _ in ISOTOPES[name]}
    rows = []
    for number, share in shares.items():
        if number not in masses:
            known = ", ".join(map(str, masses))
            raise ValueError(f"isotopes of {name} must be one of {known}, got {short_text(number)}")
        if not isinstance(share, Real) or not 0 <= float(share) <= 1:
            raise ValueError(f"abundances of {name} must be from 0 to 1, got {short_text(share)}")
        if share > 0:
            rows.append((masses[number], float(share)))
    total = sum(share for _, share in rows)
    if not abs(total - 1) < 0.005:
        raise ValueError(f"abundances of {name} must sum to 1, got {total:g}")
    return tuple((mass, share / total) for mass, share in sorted(rows))


def _joined(pattern):
    """Isobars as one line, with the mean of their masses; shares that no spectrum shows are left out."""
    joined: list[list[float]] = []
    for mass, share in sorted(pattern.items()):
        if share < 1e-6:
            continue
        if joined and mass - joined[-1][0] < _RESOLVED:
            both = joined[-1][1] + share
            joined[-1] = [(joined[-1][0] * joined[-1][1] + mass * share) / both, both]
        else:
            joined.append([mass, share])
    return {mass: share for mass, share in joined}


class Ion(NamedTuple):
    """Formula and charge state of an ion."""

    formula: str
    charge: int

    @property
    def name(self) -> str:
        """Such as "C₂⁺"."""
        return ion_name(*self)

    @property
    def atoms(self) -> dict[str, int]:
        """Number of atoms of each element."""
        return atoms_of_formula(self.formula)
