"""Range files as people have them: isotopes, clusters, odd lines, the XML of AP Suite; texts of our own."""

import re
import warnings

import numpy as np
import pytest
from ion_files import ENV, RNG, xrng

from apt_evap._common.files import FileError
from apt_evap.detection.hits import Hits
from apt_evap.io._texts import composition_of
from apt_evap.io.formats import read, read_ranges
from apt_evap.io.rrng import write_rrng
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.warnings import DataWarning


def rrng(*ranges, ions=()):
    """Text of an .rrng file."""
    lines = ["[Ions]", f"Number={len(ions)}", *(f"Ion{k}={ion}" for k, ion in enumerate(ions, 1))]
    return "\n".join([*lines, "[Ranges]", f"Number={len(ranges)}", *(f"Range{k}={r}" for k, r in enumerate(ranges, 1))])


def rng(species, dashes, *rows):
    """Text of an .rng file."""
    lines = [f"{len(species)} {len(rows)}"]
    for name in species:
        lines += [f"long name of {name}", f"{name} 0.2 0.4 0.6"]
    return "\n".join([*lines, dashes, *rows]) + "\n"


@pytest.fixture
def save(tmp_path):
    def save(text, suffix=".rrng"):
        (tmp_path / f"a{suffix}").write_text(text)
        return tmp_path / f"a{suffix}"

    return save


def atoms(ranges):
    """Atoms of 1,000 ions in the middle of each range."""
    return ranges.count_atoms(Hits(mass_to_charge=np.repeat(0.5 * (ranges.low + ranges.high), 1000)))


def strict(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_ranges(path)


TITANIUM = rng(
    ("Ti46", "Ti48", "Li6", "Li7"), "------ Ti46 Ti48 Li6 Li7", ". 22.90 23.05 1 0 0 0", ". 23.90 24.15 0 1 0 0",
    ". 47.85 48.20 0 1 0 0", ". 5.95 6.10 0 0 1 0", ". 6.95 7.15 0 0 0 1",
)  # fmt: skip


def test_isotopes_are_one_atom(save):
    ranges = strict(save(TITANIUM, ".rng"))
    assert atoms(ranges) == {"Ti": 3000, "Li": 2000} and ranges.species_names == ("Ti46", "Ti48", "Li6", "Li7")

    ranges = strict(save(rrng(
        "28.85 29.10 Ni58:1", "29.85 30.08 Ni60:1", "14.9 15.1 N15:1", "73.8 74.1 Ni58:1 O16:1", "30.09 30.25 N15:2",
        ions=("Ni58", "Ni60", "N15", "O16"),
    )))  # fmt: skip
    assert atoms(ranges) == {"Ni": 3000, "N": 3000, "O": 1000}
    assert ranges.composition == ({"Ni": 1}, {"Ni": 1}, {"N": 1}, {"Ni": 1, "O": 1}, {"N": 2})
    assert ranges.names == ("Ni58", "Ni60", "N15", "Ni58O16", "N15N15")

    env = "3 4\nMg24 0.2 0.7 0.2\nMg26 0.1 0.5 0.1\nS34 0.9 0.8 0.1\n"
    env += "Mg24 11.9 12.08 23 0\nMg24 23.88 24.1 23 0\nMg26 25.88 26.1 23 0\nS34 33.85 34.1 26 0\n"
    assert atoms(strict(save(env, ".env"))) == {"Mg": 3000, "S": 1000}

    ranges = strict(save(rrng("44.8 45.1 Name:Zr90", "67.8 68.1 Name:Cr52O16", "27.85 28.1 Name:Fe56")))
    assert atoms(ranges) == {"Zr": 1000, "Cr": 1000, "O": 1000, "Fe": 1000}


def test_clusters_stay_clusters(save):
    ranges = strict(save(rrng(
        "719.5 722.5 C60:1", "350.5 351.2 Al13:1", "196.7 197.3 Au197:1", "2.00 2.04 H2:1", "391 394.5 Si14:1",
        "107.5 108.5 C9:1", ions=("C", "Al", "Au197", "H2", "Si"),
    )))  # fmt: skip
    assert atoms(ranges) == {"C": 69000, "Al": 13000, "Au": 1000, "H": 2000, "Si": 14000}


@pytest.mark.parametrize(
    ("species", "low", "high", "expected"),
    [
        ({"C12": 1}, 11.9, 12.1, {"C": 1}),
        ({"C12": 1}, 143.9, 144.2, {"C": 12}),
        ({"C12": 1}, 71.9, 72.1, {"C": 12}),  # twice charged
        ({"Si28": 2}, 55.8, 56.1, {"Si": 2}),
        ({"U235": 1, "O2": 1}, 266.8, 267.2, {"U": 1, "O": 2}),
        ({"Ti48O2": 1}, 79.8, 80.2, {"Ti": 1, "O": 2}),
        ({"Ti48O16": 1}, 63.8, 64.1, {"Ti": 1, "O": 1}),
        ({"Cl35": 1}, 34.8, 35.1, {"Cl": 1}),
        ({"C14": 1}, 13.9, 14.1, {"C": 1}),  # not natural: the mass decides
        ({"28Si": 1, "O": 1}, 43.9, 44.1, {"Si": 1, "O": 1}),
        ({"Ar40": 1}, 700.0, 701.0, {"Ar": 1}),  # no mass fits
        ({"H2": 1, "O": 1}, 17.9, 18.1, {"H": 2, "O": 1}),
        ({"D2O": 1}, 19.9, 20.1, {"D": 2, "O": 1}),
        ({"Hyd": 1, "O2": 1}, 19.9, 20.1, {"Hyd": 1, "O": 2}),
    ],
)
def test_the_mass_decides_between_isotopes_and_atoms(species, low, high, expected):
    assert composition_of(species, low, high)[0] == expected


def test_deuterium(save):
    ranges = strict(save(rrng(
        "2.005 2.025 D:1", "19.95 20.08 D2O:1", "45.85 46.15 Zr:1 D:1", "44.8 45.1 Zr:1", "4.01 4.05 D:2",
        ions=("D", "Zr", "O"),
    )))  # fmt: skip
    assert atoms(ranges) == {"D": 6000, "O": 1000, "Zr": 2000}


def test_decimal_numbers_of_atoms(save):
    ranges = strict(save(rrng(
        "58.6 60.3 vol:0.02232 Hf:1.000 color:5A5AFF", "95.7 97.2 Hf:1.000 N:1.00", "13.95 14.08 N:1.0",
        "31.9 32.08 O:2.000", ions=("Hf", "N", "O"),
    )))  # fmt: skip
    assert len(ranges) == 4 and atoms(ranges) == {"Hf": 2000, "N": 2000, "O": 2000}
    ranges = strict(save(TITANIUM.replace(" 1 0 0 0", " 1.0 0.0 0.0 0.0"), ".rng"))
    assert ranges.composition[0] == {"Ti": 1}


def test_dashes_that_touch_the_first_name(save):
    rows = (". 30.85 31.15 1 0 0", ". 46.3 46.65 1 0 0", ". 54.3 54.7 1 0 1", ". 58 62.2 0 1 0")
    ranges = strict(save(rng(("Nb", "Sn", "O"), "--------------Nb Sn O", *rows), ".rng"))
    assert ranges.names == ("Nb", "Nb", "NbO", "Sn") and atoms(ranges) == {"Nb": 3000, "O": 1000, "Sn": 1000}


def test_rows_with_numbers(save):
    rows = ("1 45.80 50.30 1 0", "2 11.95 12.10 0 1", "3 5.95 6.05 0 1")
    ranges = strict(save(rng(("Mo", "C"), "---- Mo C", *rows), ".rng"))
    assert ranges.low.tolist() == [45.8, 11.95, 5.95] and atoms(ranges) == {"Mo": 1000, "C": 2000}
    rows = (". 50.8 55.3 1 0 0", "2 106.7 107.2 0 1 0", ". 108.7 109.2 0 1 0", "4 0.99 1.03 0 0 1", "5 2.0 2.04 0 0 2")
    ranges = strict(save(rng(("Pd", "Ag", "H"), "---- Pd Ag H", *rows), ".rng"))
    assert ranges.names == ("Pd", "Ag", "Ag", "H", "H2") and atoms(ranges) == {"Pd": 1000, "Ag": 2000, "H": 3000}
    bare = rng(("Pd", "Ag", "H"), "---- Pd Ag H", *(row.split(maxsplit=1)[1] for row in rows))
    assert strict(save(bare, ".rng")).low.tolist() == ranges.low.tolist()


@pytest.mark.parametrize(
    ("name", "low", "high", "atoms"),
    [
        ("AlO+", 42.9, 43.1, {"Al": 1, "O": 1}),
        ("Al++", 13.4, 13.6, {"Al": 1}),
        ("Al2+", 13.4, 13.6, {"Al": 1}),
        ("Al2+", 53.8, 54.1, {"Al": 2}),
        ("Al\u00b2\u207a", 13.4, 13.6, {"Al": 1}),
        ("Al2O+2", 34.9, 35.1, {"Al": 2, "O": 1}),
        ("Ti48 2+", 23.9, 24.1, {"Ti": 1}),
        ("C60+", 719, 722, {"C": 60}),
        ("Al2+", 90.0, 91.0, {}),  # no ion of this name has such a mass
        ("Noise+", 13.4, 13.6, {}),
    ],
)
def test_names_with_a_charge(save, name, low, high, atoms):
    path = save(rrng(f"{low} {high} Vol:0 Name:{name} Color:FF0000", "26.9 27.1 Al:1 Charge:1", ions=("Al",)))
    ranges = strict(path)
    assert ranges.names[0] == name and ranges.composition == (atoms, {"Al": 1})


def test_names_with_blanks(save):
    ranges = strict(save(rrng(
        "60.20 60.45 Vol:0.01801 Ta:1 Name:Ta three plus Color:336699",
        "90.30 90.65 Vol:0.01801 Ta:1 Name:shoulder of Ta 2 Color:6699CC",
        "15.95 16.10 Vol:0.02883 Name: unknown peak Color:AAAAAA", ions=("Ta", "O"),
    )))  # fmt: skip
    assert ranges.names == ("Ta three plus", "shoulder of Ta 2", "unknown peak")
    assert atoms(ranges) == {"Ta": 2000} and ranges.composition[2] == {}
    assert ranges.colour == ("#336699", "#6699CC", "#AAAAAA")


def test_ranges_that_are_empty_or_reversed_cost_a_warning(save):
    text = rrng("29.5 29.75 Y:1", "0.0 0.0 O:1", "44.35 44.6 Y:1", "23.9 24.1 Ti:1", ions=("Y", "O", "Ti"))
    with pytest.warns(DataWarning, match=r"a\.rrng', line 9: .* got 0 and 0: left out"):
        ranges = read_ranges(save(text))
    assert ranges.names == ("Y", "Y", "Ti") and atoms(ranges) == {"Y": 2000, "Ti": 1000}
    rows = (". 29.5 29.75 1 0", ". 24.10 23.90 0 1", ". 44.35 44.6 1 0")
    with pytest.warns(DataWarning, match=r"a\.rng', line 8: .* got 24.1 and 23.9: left out"):
        assert read_ranges(save(rng(("Y", "Ti"), "--- Y Ti", *rows), ".rng")).names == ("Y", "Y")
    env = "2 3\nY 0.4 0.8 0.8\nTi 0.5 0.5 0.7\nY 29.5 29.75 33 0\nTi 24.1 23.9 18 0\nY 44.35 44.6 33 0\n"
    with pytest.warns(DataWarning, match=r"a\.env', line 5: .* got 24.1 and 23.9: left out"):
        assert read_ranges(save(env, ".env")).names == ("Y", "Y")


def test_many_odd_lines_are_one_warning(save):
    text = rrng(*(f"{k} {k + 1 - 2 * (k % 2)} Si:1" for k in range(10, 90)), ions=("Si",))
    with pytest.warns(DataWarning) as caught:
        assert len(read_ranges(save(text))) == 40
    assert len(caught) == 1 and "line 7: expected" in str(caught[0].message)
    assert re.search(r"also lines 15, 17, .*, \.\.\.$", str(caught[0].message)) and len(str(caught[0].message)) < 600


def test_the_xml_of_ap_suite(save):
    text = xrng((11.90, 12.12, 2, 0.02324, [12]), (39.85, 40.15, 1, 0.05207, [12, 8]), (32.55, 32.8, 2, 0.01521, [30]))
    ranges = strict(save(text, ".xrng"))
    assert ranges.names == ("Mg", "MgO", "Zn") and ranges.high.tolist() == [12.12, 40.15, 32.8]
    assert ranges.volume.tolist() == [0.02324, 0.05207, 0.01521]
    assert atoms(ranges) == {"Mg": 2000, "O": 1000, "Zn": 1000}
    # as some files end
    assert len(strict(save(text.replace("</ranges>", "<item>\n</ranges>"), ".xrng"))) == 3
    with pytest.raises(FileError, match=r"a\.xrng' cannot be read as ions; it contains ranges of mass"):
        read(save(text, ".xrng"))


def test_xml_that_is_wrong(save):
    text = xrng((11.90, 12.12, 2, 0.02324, [12]), (39.85, 40.15, 1, 0.05207, [12, 8]))
    for old, new, message in (
        ("<ranges>\n", "", "line 30: expected XML, mismatched tag .*, <rangefile> of line 2 is open"),
        ("<rangefile", "<!DOCTYPE a [<!ENTITY b 'c'>]>\n<rangefile", "line 1: expected XML without <!DOCTYPE>"),
        ("<ranges>", "<areas>", "line 31: expected XML, mismatched tag .*, <areas> of line 3 is open"),
        (text, "<rangefile>\n</rangefile>\n", "no element <ranges>"),
        (text, "<rangefile>\n<ranges>\n</ranges>\n</rangefile>\n", "has no range in <ranges>"),
        (text, "<a>" * 10_000, "line 1: expected at most 50 nested elements"),
    ):
        with pytest.raises(FileError, match=rf"a\.xrng'.*{message}"):
            read_ranges(save(text.replace(old, new, 1), ".xrng"))
    for old, new, message in (
        ("11.9<", "12.9<", "line 4: expected two bounds .*, the lower one first"),
        ("11.9<", "far<", "line 5: expected a bound"),
        ("11.9<", "-11.9<", "line 5: expected a bound >= 0"),
        (">12<", ">190<", "line 12: expected an atomic number from 1 to 118, got 190"),
    ):
        with pytest.warns(DataWarning, match=rf"a\.xrng', {message}"):
            assert read_ranges(save(text.replace(old, new, 1), ".xrng")).names == ("MgO",)


def test_what_is_written_has_a_volume_in_each_line(tmp_path):
    """Other programs find no range in a line without it."""
    ranges = Ranges(["Al", "Cu"], [26.94, 62.8], [27.14, 63.34], [np.nan, 0.0118], composition=[{"Al": 1}, {"Cu": 1}])
    write_rrng(tmp_path / "a.rrng", ranges)
    lines = [line for line in (tmp_path / "a.rrng").read_text().splitlines() if line.startswith("Range")]
    assert lines == ["Range1=26.9400 27.1400 Vol:0.00000 Al:1", "Range2=62.8000 63.3400 Vol:0.01180 Cu:1"]
    again = read_ranges(tmp_path / "a.rrng")
    assert np.isnan(again.volume[0]) and again.volume[1] == 0.0118
    assert again.composition == ranges.composition and again.low.tolist() == [26.94, 62.8]


# ---- one line made odd at a time ---------------------------------------------------------------------------------

SAMPLES = {
    ".rrng": rrng(
        "13,5 14.2 Vol:0.02 Si:1 Color:CCCCCC", "15.8 16.5 Name:oxide O:1", "27.9 28.2 Vol:0.02 Si28:1 Color:CCCCCC",
        "59.8 60.2 Vol:0.05 Si:1 O:2 Color:00FF00", ions=("Si", "O", "Si28"),
    ),
    ".rng": RNG,
    ".env": ENV,
    ".xrng": xrng((11.90, 12.12, 2, 0.02324, [12]), (39.85, 40.15, 1, 0.05207, [12, 8])),
}  # fmt: skip
ODDITIES = {
    "garbage": lambda words: ["?!~", "lorem", "ipsum"],
    "one word": lambda words: ["x"],
    "first word lost": lambda words: words[1:],
    "last word lost": lambda words: words[:-1],
    "first word twice": lambda words: [words[0], *words],
    "last word twice": lambda words: [*words, words[-1]],
    "reversed": lambda words: words[::-1],
    "glued": lambda words: ["".join(words)],
    "first two glued": lambda words: ["".join(words[:2]), *words[2:]],
    "word in it": lambda words: [*words[:1], "odd", *words[1:]],
    "word after": lambda words: [*words, "odd"],
    "stars": lambda words: [re.sub("[0-9]+", "**", word) for word in words],
    "letters for digits": lambda words: [word.replace("0", "O").replace("1", "l") for word in words],
    "signs": lambda words: [re.sub("(?<![0-9.])([0-9])", r"-\1", word) for word in words],
    "nan": lambda words: [re.sub(r"[0-9]+[.,][0-9]+", "nan", word) for word in words],
    "colons": lambda words: [word + ":" for word in words],
    "no colons": lambda words: [word.replace(":", " ") for word in words],
    "quotes": lambda words: [f'"{word}"' for word in words],
    "semicolons": lambda words: [";".join(words)],
}


LEGAL = {
    (".rrng", "last word lost", "Range2=15.8 16.5 Name:oxide O:1")
}  # a range of which nothing but the name is known


@pytest.mark.parametrize("suffix", SAMPLES)
@pytest.mark.parametrize("oddity", ODDITIES)
def test_one_odd_line(save, suffix, oddity):
    """An error or a warning that names the line, or the same ranges."""
    lines = SAMPLES[suffix].splitlines()
    good = strict(save(SAMPLES[suffix], suffix))
    for at, line in enumerate(lines, 1):
        words = ODDITIES[oddity](line.split()) if line.split() else []
        if not words:
            continue
        if (suffix, oddity, line) in LEGAL or (suffix == ".xrng" and "twice" in oddity and "atomicnumber" in line):
            continue
        odd = [*lines[: at - 1], " ".join(words), *lines[at:]]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                ranges = read_ranges(save("\n".join(odd) + "\n", suffix))
            except FileError as error:
                assert re.search(rf"\bline {at}\b", str(error)), f"{odd[at - 1]!r}: {error}"
                continue
        told = " ".join(str(warning.message) for warning in caught)
        same = (
            ranges.low.tolist() == good.low.tolist()
            and ranges.high.tolist() == good.high.tolist()
            and ranges.composition == good.composition
            and ranges.names == good.names
        )
        assert same or re.search(rf"\blines? (\d+, )*{at}\b", told), f"line {at}, {odd[at - 1]!r}: {ranges!r}; {told}"
