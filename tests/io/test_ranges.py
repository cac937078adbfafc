"""Range files .rng and .env, with molecular ions, beside .rrng (tests/detection/test_mass_ranges.py)."""

import numpy as np
import pytest
from ion_files import ENV, RNG

from apt_evap._common.files import FileError
from apt_evap.detection.hits import Hits
from apt_evap.io import rng
from apt_evap.io.formats import read_ranges
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.warnings import DataWarning


@pytest.fixture
def save(tmp_path):
    def save(text, name="a.rng"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return save


def test_every_value_of_an_rng(save):
    ranges = read_ranges(save(RNG))
    assert ranges.names == ("Cr", "Si", "CrO", "CrO2")
    assert ranges.low.tolist() == [25.9, 13.8, 67.5, 83.5] and ranges.high.tolist() == [26.3, 14.2, 68.4, 84.4]
    assert ranges.composition == ({"Cr": 1}, {"Si": 1}, {"Cr": 1, "O": 1}, {"Cr": 1, "O": 2})
    # of the element, none for a molecular ion, and that of the extension
    assert ranges.colour == ("#FF8000", "#CCCCCC", "", "#00FF00")
    assert np.isnan(ranges.volume).all() and ranges.source.endswith("a.rng")


def test_the_extension_may_be_missing_or_have_its_own_ranges(save):
    table, extension = RNG.split("--- polyatomic extension\n")
    assert read_ranges(save(table)).names == ("Cr", "Si", "CrO", "CrO2")
    own = table + "--- polyatomic extension\n" + extension.replace("83.5 84.4", "99.5 100.4")
    ranges = read_ranges(save(own))
    assert ranges.names[-2:] == ("CrO2", "CrO2") and ranges.high[-1] == 100.4
    assert ranges.composition[-1] == {"Cr": 1, "O": 2}


def test_a_column_that_is_a_molecule_or_no_element(save):
    text = (
        RNG.split("\n\n")[0]
        .replace("Si 0.80", "SiO2 0.80")
        .replace("O 0,0", "U235 0,0")
        .replace(" Cr Si O", " Cr SiO2 U235")
    )
    ranges = read_ranges(save(text))
    assert ranges.names[1] == "SiO2" and ranges.composition[1] == {"Si": 1, "O": 2}
    assert ranges.composition[2] == {"Cr": 1, "U": 1}


def test_decimal_commas_comments_and_windows(save):
    text = "# a comment\n" + RNG.replace("25.9 26.3", "25,9 26,3").replace("\n", "\r\n")
    assert read_ranges(save(text)).low[0] == 25.9


def test_rng_that_is_odd(save):
    with pytest.warns(DataWarning, match=r"a\.rng', line 1: states 5 ranges but contains 4"):
        assert len(read_ranges(save(RNG.replace("3 4", "3 5", 1)))) == 4
    with pytest.warns(DataWarning, match="1 range without species"):
        assert len(read_ranges(save(RNG.replace(". 13.8 14.2 0 1 0", ". 13.8 14.2 0 0 0")))) == 3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3 4", "3 4 5", "line 1: expected the numbers of species and of ranges, got '3 4 5'"),
        ("3 4", "3 many", "line 1: expected the numbers of species and of ranges, got 'many'"),
        ("3 4", "90 4", "expected 90 species and then a line of dashes"),
        ("--------------- Cr", "Cr", "line 8: expected a line of dashes"),
        ("1 1\nCrO2\n", "", "line 15: expected the numbers of species and of ranges"),
    ],
)
def test_rng_that_is_wrong(save, old, new, message):
    with pytest.raises(FileError, match=rf"a\.rng'.*{message}"):
        read_ranges(save(RNG.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("old", "new", "message", "names"),
    [
        ("Cr 1.00 0.50", "Cr red 0.50", "line 3: expected a part of a colour from 0 to 1, got 'red'", "Cr Si CrO CrO2"),
        ("Cr 1.00 0.50 0.00", "Cr", "line 3: expected a species and its colour, got 'Cr'", "Cr Si CrO CrO2"),
        ("- Cr Si O", "- Cr Si", "line 8: expected 3 species after the dashes, got 2", "Cr Si CrO CrO2"),
        ("- Cr Si O", "- Cr Qq O", "line 8: 'Qq' is not in the list of species: read as Si", "Cr Si CrO CrO2"),
        ("25.9 26.3 1 0 0", "25.9 26.3 1 0", "line 9: expected two bounds and 3 numbers of atoms", "Si CrO CrO2"),
        ("25.9 26.3", "26.3 25.9", "line 9: .* lower one first, got 26.3 and 25.9: left out", "Si CrO CrO2"),
        ("25.9 26.3", "nan 26.3", "line 9: expected a bound .Da., got 'nan': left out", "Si CrO CrO2"),
        ("25.9 26.3 1", "25.9 26.3 -1", "line 9: expected a number of atoms, got '-1'", "Si CrO CrO2"),
        ("--- polyatomic extension\n", "", "line 14: expected a range, got '1 1'", "Cr Si CrO CrO2"),
    ],
)
def test_odd_lines_of_an_rng(save, old, new, message, names):
    with pytest.warns(DataWarning, match=rf"a\.rng', .*{message}"):
        assert " ".join(read_ranges(save(RNG.replace(old, new, 1))).names) == names


def test_every_value_of_an_env(save):
    ranges = read_ranges(save(ENV, "a.env"))
    assert ranges.names == ("Mn", "Mn2O", "Hyd")
    assert ranges.low.tolist() == [27.33, 62.85, 0.93] and ranges.high.tolist() == [27.95, 63.13, 3.18]
    # Angstrom^3 to nm^3: one rounding
    assert ranges.volume == pytest.approx([0.01166, 0.02, 0.01166], rel=1e-15)
    assert ranges.colour == ("#0080FF", "#000000", "#FF0000")
    assert ranges.composition == ({"Mn": 1}, {"Mn": 2, "O": 1}, {})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3 3\n", "\n", "no line with the numbers of species and of ranges"),
        ("3 3\n", "3 0\n", r"line 5: expected 3 species and 0 ranges \(at least one\)"),
        ("3 3\n", "3 90\n", "line 5: expected 3 species and 90 ranges"),
    ],
)
def test_env_that_is_wrong(save, old, new, message):
    with pytest.raises(FileError, match=rf"a\.env'.*{message}"):
        read_ranges(save(ENV.replace(old, new, 1), "a.env"))


@pytest.mark.parametrize(
    ("old", "new", "message", "names"),
    [
        ("Mn\t0.0\t0.5\t1.0", "Mn\t0.0", "line 7: expected a species and its colour", "Mn Mn2O Hyd"),
        ("27,33\t27,95", "27,95\t27,33", "line 11: expected two bounds", "Mn2O Hyd"),
        ("27,33\t27,95\t11.66\t1.0", "27,33", "line 11: expected a species and two bounds", "Mn2O Hyd"),
        ("11.66", "large", "line 11: expected a volume", "Mn2O Hyd"),
        ("3 3\n", "3 2\n", "line 5: states 2 ranges but contains 3: all are read", "Mn Mn2O Hyd"),
        ("Mn2O\t62", "Mn9Q\t62", "line 12: 'Mn9Q' is not in the list of species", "Mn Mn9Q Hyd"),
    ],
)
def test_odd_lines_of_an_env(save, old, new, message, names):
    with pytest.warns(DataWarning, match=rf"a\.env', .*{message}"):
        assert " ".join(read_ranges(save(ENV.replace(old, new, 1), "a.env")).names) == names


def test_the_format_may_be_given(save):
    assert read_ranges(save(RNG, "ranges.txt"), format="rng").names[0] == "Cr"
    with pytest.raises(FileError, match=r"must be one of \.rrng, \.rng, \.env, \.xrng, got format='pos'"):
        read_ranges(save(RNG), format="pos")
    with pytest.raises(FileError, match="no lines Range1"):
        read_ranges(save(RNG, "a.rrng"))


def test_a_molecular_ion_counts_with_all_its_atoms(save):
    ranges = read_ranges(save(RNG))
    hits = Hits(mass_to_charge=[26.0, 84.0, 84.1, 68.0, 1.0, np.nan])
    assert ranges.count_atoms(hits) == {"Cr": 4, "Si": 0, "O": 5}
    assert Ranges(["A"], [1.0], [2.0]).count_atoms(hits) == {}


def test_repeated_ranges_of_an_rng_are_interpreted_once(save, monkeypatch):
    """200,000 of them take 0.6 s instead of 4.3 s."""
    interpreted, row = [], rng._row
    monkeypatch.setattr(rng, "_row", lambda *given: interpreted.append(given) or row(*given))
    text = "1 2000\nNi\nNi 0 0 0\n-- Ni\n" + ". 1 2 1\n" * 1999
    assert len(read_ranges(save(text + ". 3 4 1\n"))) == 2
    assert len(interpreted) == 2
    with pytest.warns(DataWarning, match="states 2000 ranges but contains 1999"):
        read_ranges(save(text))


def test_a_file_that_is_something_else_is_not_said_to_lack_lines_alone(save, tmp_path):
    with pytest.raises(FileError, match=r"expected one of \.rrng, \.rng, \.env, \.xrng, got suffix '\.txt'"):
        read_ranges(save("Si 27.9 28.2\n", "a.fig.txt"))
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(FileError, match=r"a\.h5' is an HDF5 file, no file of mass ranges: expected one of \.rrng"):
        read_ranges(tmp_path / "a.h5")
