"""Ions that a spectrum may contain, by the elements that are present."""

from collections.abc import Collection, Sequence
from functools import lru_cache

import numpy as np

from apt_evap.specimen.nuclides import ISOTOPES
from apt_evap.spectra.ion_names import GASES, HIGHEST_CHARGE, NOBLE, Ion, atoms_of_formula, element_of, formula_of_atoms

# molecules of gases and adsorbed molecules that spectra of atom probes show
_GAS_MOLECULES = (
    "H2 H3 OH H2O H3O N2 O2 CO CO2 NO NH NH2 NH3 CH CH2 CH3 C2 C3 C4 C2H C2H2 CHO N3 CN C2O C5 O3 "
    "D2 D3 HD HD2 H2D OD D2O D3O OHD OHD2 OH2D CD ND"
).split()
_DOUBLY_CHARGED = {"C2", "C3", "C4", "C5", "CO2"}
UNUSUAL = frozenset({"O3", "N3", "C4", "C5", "H3"})
"""Molecules that need more evidence than their atoms say."""
# atoms that one to three atoms of a metal carry
_LIGANDS = tuple(
    atoms_of_formula(text)
    for text in "H H2 O OH H2O O2 O2H O3 N N2 NH N3 C C2 C3 CO CO2 CO3 CN D".split()
)  # fmt: skip
_MOST_METALS = 3


def atomic_ions(elements: Collection[str]) -> list[Ion]:
    """Atomic ions of elements with all charge states that are tried."""
    return [Ion(name, charge) for name in elements for charge in range(1, highest_charge(name) + 1)]


def highest_charge(symbol: str) -> int:
    """Highest charge state of an atomic ion of an element, D, or an isotope."""
    return HIGHEST_CHARGE.get("D" if symbol == "D" else element_of(symbol), 1)


@lru_cache(256)
def molecular_ions(present: frozenset[str], minor: frozenset[str]) -> tuple[Ion, ...]:
    """Molecular ions of the elements that are present: of gases, and of metals with ligands.

    Of `minor` elements, those of few ions, only a single atom with one other.
    """
    ions: dict[Ion, None] = {}
    for text in _GAS_MOLECULES:
        atoms = atoms_of_formula(text)
        if set(atoms) <= present:
            formula = formula_of_atoms(atoms)
            ions |= dict.fromkeys(Ion(formula, charge) for charge in ((1, 2) if text in _DOUBLY_CHARGED else (1,)))
    metals = sorted(present - {*GASES, "D", *NOBLE})
    ligands = [ligand for ligand in _LIGANDS if set(ligand) <= present]
    for metal in metals:
        few = metal in minor
        charges = (1, 2, 3) if highest_charge(metal) > 2 else (1, 2)
        for number in range(1, 2 if few else _MOST_METALS + 1):
            if number > 1:
                ions |= dict.fromkeys(Ion(formula_of_atoms({metal: number}), charge) for charge in (1, 2))
            for ligand in ligands:
                size = sum(ligand.values())
                if size > (1 if few else 4 if number < _MOST_METALS else 2):
                    continue
                formula = formula_of_atoms({metal: number} | ligand)
                for charge in charges if number == 1 else (1, 2):
                    ions[Ion(formula, charge)] = None
    major = [metal for metal in metals if metal not in minor]
    for at, metal in enumerate(major):
        for other in major[at + 1 :]:
            pair = {metal: 1, other: 1}
            ions |= dict.fromkeys(Ion(formula_of_atoms(pair), charge) for charge in (1, 2))
            if "O" in present:
                ions[Ion(formula_of_atoms(pair | {"O": 1}), 1)] = None
    return tuple(ions)


def ions_between(low: float, high: float, present: Collection[str], own: str) -> list[Ion]:
    """All ions whose most abundant isotopes have an m/n between bounds [Da], of any atoms that may be together.

    `present` are the elements of molecules, beside hydrogen; the ions of the element `own` are left out.
    """
    found = [ion for ion in atomic_ions([*HIGHEST_CHARGE]) if low < _main_mass(ion.formula) / ion.charge < high]
    metals = sorted({*present} - {*GASES, "D", own})
    allowed = ~(_GAS_ATOMS[:, [name not in {"H", *present} for name in GASES]] > 0).any(1)
    cores = [{}, *({metal: number} for metal in metals for number in (1, 2, 3))]
    cores += [{metal: 1, other: 1} for at, metal in enumerate(metals) for other in metals[at + 1 :]]
    for core in cores:
        mass = sum(_main_mass(name) * number for name, number in core.items())
        for charge in (1, 2) if core else (1,):
            sums = (mass + _GAS_MASSES) / charge
            for at in np.flatnonzero((sums > low) & (sums < high) & allowed):
                gases = {name: int(number) for name, number in zip(GASES, _GAS_ATOMS[at], strict=True) if number}
                if sum(gases.values()) <= (_MOST_LIGANDS if core else 2 * _MOST_LIGANDS) and (core or len(gases)):
                    found.append(Ion(formula_of_atoms(core | gases), charge))
    return [ion for ion in dict.fromkeys(found) if own not in ion.atoms]


@lru_cache(1024)
def _main_mass(symbol):
    """Mass of the most abundant isotope [Da]."""
    return max(("D" != symbol and ISOTOPES[element_of(symbol)]) or ((2.0141, 1.0),), key=lambda pair: pair[1])[0]


# atoms of H, C, N and O that may be together, and their masses [Da]
_MOST_LIGANDS = 4
_GAS_ATOMS = np.array([(h, c, n, o) for h in range(9) for c in range(5) for n in range(4) for o in range(5)])
_GAS_MASSES = _GAS_ATOMS @ np.array([_main_mass(name) for name in GASES])


def expected_ions(formulas: Sequence[str]) -> list[Ion]:
    """Ions of formulas that a user expects: up to three charges, never more than the electrons of its atoms allow."""
    ions = []
    for text in formulas:
        atoms = atoms_of_formula(text)
        if sum(atoms.values()) > 1:
            heavy = {symbol: number for symbol, number in atoms.items() if element_of(symbol) not in ("H", "D")}
            highest = min(3, sum(highest_charge(symbol) * number for symbol, number in heavy.items()))
            if set(map(element_of, atoms)) <= {"H", "D"}:
                highest = 1  # the second charge would take the only bond
            ions += [Ion(formula_of_atoms(atoms), charge) for charge in range(1, max(highest, 1) + 1)]
    return ions
