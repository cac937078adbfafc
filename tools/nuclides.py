"""Write the table of natural nuclides, ``apt_evap/specimen/nuclides.py``.

Needs the packages periodictable (masses of AME2020, isotopic compositions of the CIAAW of 2021) and molmass
(compositions of NIST, those of Berglund and Wieser, 2011). Each number of the one is compared with the other:

    pip install periodictable molmass
    python tools/nuclides.py
"""

import textwrap
from pathlib import Path

import molmass
import periodictable

# the commission gives ranges for these: representative values of Berglund and Wieser
RANGES = ("H", "Li", "B", "C", "N", "O", "Mg", "Si", "S", "Cl", "Ar", "Br", "Tl", "Pb")
# relative: the commission has revised Se, Mo, Yb, Hg and others since 2009, by less
REVISED = 0.03
MASS = 5e-5  # Da
# the first source has no natural composition of uranium: that of Meija et al. (2016)
URANIUM = ((234.0409, 5.4e-05), (235.0439, 0.007204), (238.0508, 0.992742))
HEAD = '''"""Masses and abundances of the natural nuclides of all elements, written by ``tools/nuclides.py``.

Abundances: CIAAW, Isotopic compositions of the elements 2021 (Meija et al., Pure Appl. Chem. 88, 293 (2016), with later
revisions). The commission gives ranges for H, Li, B, C, N, O, Mg, Si, S, Cl, Ar, Br, Tl and Pb: the values here are the
representative ones of Berglund and Wieser, Pure Appl. Chem. 83, 397 (2011). Masses: AME2020 (Wang et al., Chinese Phys.
C 45, 030003 (2021)), rounded to 1e-4 Da.
"""

# fmt: off
ISOTOPES: dict[str, tuple[tuple[float, float], ...]] = {
'''
TAIL = '''}
# fmt: on
"""Mass [Da] and natural abundance (fraction) of each natural isotope, by element."""
'''


def isotopes(element):
    """Mass [Da] and abundance of the natural isotopes of an element of periodictable, by mass number."""
    name = element.symbol
    natural = {number: element[number] for number in element.isotopes if element[number].abundance > 0}
    if not natural:
        return {}
    second = {number: value for number, value in molmass.ELEMENTS[name].isotopes.items() if value.abundance > 0}
    table = {}
    for number, nuclide in natural.items():
        abundance = nuclide.abundance / 100
        other = second.get(number)
        if other is None:
            print(f"{name}-{number} is not in the second source, abundance {abundance:g}")
        else:
            assert abs(nuclide.mass - other.mass) < MASS, (name, number)
            if name in RANGES:
                abundance = other.abundance
            elif abs(abundance - other.abundance) > REVISED * other.abundance:
                print(f"{name}-{number}: {abundance:g} here, {other.abundance:g} in the second source")
        table[number] = (nuclide.mass, abundance)
    assert set(second) <= set(table), name
    assert abs(sum(abundance for _, abundance in table.values()) - 1) < 1e-9, name
    return table


def main():
    """Write the module."""
    lines = []
    for element in periodictable.elements:
        table = isotopes(element) if element.number > 0 else {}
        if element.symbol == "U" and not table:
            table = {round(mass): (mass, abundance) for mass, abundance in URANIUM}
        if table:
            text = ", ".join(f"({mass:.4f}, {abundance:.9g})" for mass, abundance in table.values())
            comma = "," if len(table) == 1 else ""
            line = f'"{element.symbol}": ({text}{comma}),'
            lines += textwrap.wrap(line, 120, initial_indent=" " * 4, subsequent_indent=" " * 8)
    path = Path(__file__).parents[1] / "apt_evap" / "specimen" / "nuclides.py"
    path.write_text(HEAD + "\n".join(lines) + "\n" + TAIL)


if __name__ == "__main__":
    main()
