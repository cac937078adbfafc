"""Chemical symbols and molecules in files of ranges: CO is not cobalt."""

import warnings

import numpy as np
import pytest

from apt_evap.detection.hits import Hits
from apt_evap.io._texts import ELEMENTS, atoms_of
from apt_evap.io.formats import read_ranges
from apt_evap.warnings import DataWarning

# molecules of two elements that differ from a third one in case only: CO and Co, SI and Si, ...
PAIRS = sorted((symbol, symbol.upper()) for symbol in ELEMENTS if len(symbol) == 2 and {*symbol.upper()} <= ELEMENTS)


def table(pair):
    """Two ranges, of a species of one atom and of a molecule, in every format."""
    first, second = pair
    rows = f"-- {first} {second}\n. 10 11 1 0\n. 20 21 0 1\n"
    return {
        ".rrng": f"[Ions]\nIon1={first}\nIon2={second}\n[Ranges]\nRange1=10 11 {first}:1\nRange2=20 21 {second}:1\n",
        ".rng": f"2 2\n{first}\n{first} 0 0 1\n{second}\n{second} 1 0 0\n{rows}",
        ".env": f"2 2\n{first} 0 0 1\n{second} 1 0 0\n{first} 10 11 1\n{second} 20 21 1\n",
    }


def test_there_are_many_such_pairs():
    assert len(PAIRS) > 20 and {("Co", "CO"), ("Sc", "SC"), ("Ni", "NI"), ("Hf", "HF")} <= {*PAIRS}


@pytest.mark.parametrize("suffix", [".rrng", ".rng", ".env"])
@pytest.mark.parametrize("order", [1, -1])
def test_elements_and_molecules_that_differ_in_case(tmp_path, suffix, order):
    path = tmp_path / f"a{suffix}"
    for element, molecule in PAIRS:
        path.write_text(table((element, molecule)[::order])[suffix])
        ranges = read_ranges(path)
        assert ranges.names == (element, molecule)[::order]
        assert ranges.composition == ({element: 1}, dict.fromkeys(molecule, 1))[::order]
        atoms = ranges.count_atoms(Hits(mass_to_charge=[10.5] * 3 + [20.5]))
        ions = dict(zip(ranges.names, (3, 1), strict=True))
        assert atoms == {element: ions[element], **dict.fromkeys(molecule, ions[molecule])}


def test_texts_in_another_case_are_the_only_ion_that_fits(tmp_path):
    path = tmp_path / "a.rrng"

    def names(ions, *keys):
        listed = "".join(f"Ion{k}={ion}\n" for k, ion in enumerate(ions, 1))
        rows = "".join(f"Range{k}={k}0 {k}1 {key}:1\n" for k, key in enumerate(keys, 1))
        path.write_text(f"[Ions]\n{listed}[Ranges]\n{rows}")
        return read_ranges(path).names

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert names(["Si", "SiO2"], "SI", "si", "sio2", "SIO2") == ("Si", "Si", "SiO2", "SiO2")
        assert names([], "si", "CO", "Co", "SiO2", "Mn2O", "U235") == (
            "Si", "CO", "Co", "SiO2", "Mn2O", "U235",
        )  # fmt: skip
    with pytest.warns(
        DataWarning, match="line 4: 'xyz' is neither an element nor an ion of the file: kept as its name"
    ):
        assert names([], "si", "xyz") == ("Si", "xyz")
    with pytest.warns(DataWarning, match=r"a\.rrng', line 5: 'co' may be any of Co, CO, it is read as Co"):
        assert names(["Co", "CO"], "co") == ("Co",)


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".rrng", "[Ranges]\nRange1=59 60 SiO2:1\nRange2=75 76 SiO2:2 H:1\nRange3=80 81 Name:Si2O3\n"),
        (".rng", "2 3\nS\nSiO2 0 0 1\nH\nH 1 0 0\n-- SiO2 H\n. 59 60 1 0\n. 75 76 2 1\n. 80 81 0 3\n"),
    ],
)
def test_molecules_count_with_their_atoms(tmp_path, suffix, text):
    path = tmp_path / f"a{suffix}"
    path.write_text(text)
    composition = read_ranges(path).composition
    assert composition[:2] == ({"Si": 1, "O": 2}, {"Si": 2, "O": 4, "H": 1})
    assert composition[2] in ({"Si": 2, "O": 3}, {"H": 3})


def test_charge_states_in_the_place_of_atoms_are_warned_of(tmp_path):
    """A public writer puts the charge state behind the colon."""
    path = tmp_path / "a.rrng"

    def read(*rows):
        path.write_text("[Ranges]\n" + "".join(f"Range{k}={row}\n" for k, row in enumerate(rows, 1)))
        return read_ranges(path)

    for rows in (
        ["29.2 29.7 Co:2"],  # by the mass of the isotope
        ["60.5 62.0 W:3", "45.5 46.5 W:4"],
        ["137.5 138.5 Ba:1", "68.5 69.5 Ba:2"],  # by the other range of the species
    ):
        with pytest.warns(DataWarning, match=r"a\.rrng': \w+:\d from .* has the mass of \w+ with \d charges"):
            read(*rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read("0.9 1.2 H:1", "1.9 2.2 H:2", "2.9 3.2 H:3")
        read("13.8 14.2 Si:1", "27.8 28.2 Si:1", "55.8 56.2 Si:2", "83.8 84.2 Si:3")
        read("11.9 12.1 C:1", "23.9 24.1 C:2", "17.9 18.1 C:3", "5.9 6.1 C:1", "43.9 44.2 C:1 O:2")


def test_atoms_of_formulas():
    assert atoms_of("SC") == {"S": 1, "C": 1} and atoms_of("Sc") == {"Sc": 1}
    assert np.all([not atoms_of(word) for word in ("sc", "Xx", "", "Si-O", "1H")])
