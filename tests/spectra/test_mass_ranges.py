import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apt_evap._common.files import FileError
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.io.formats import read, read_ranges
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.warnings import DataWarning

DATA = Path(__file__).parents[3] / "shared" / "data"

TIDY = """[Ions]
Number=3
Ion1=Si
Ion2=Cr
Ion3=O
[Ranges]
Number=3
Range1=13.5 14.25 Vol:0.02003 Si:1 Color:CCCCCC
Range2=67.5 69.5 Vol:0.04083 Cr:1 O:1 Color:ff0000
Range3=83.5 86.5 Vol:0.06966 Name:oxide Cr:1 O:2 Color:00FF00
"""

UNTIDY = """\ufeff; a comment
  [ ranges ]

RANGE1 = Color:CCCCCC  13,5   14,25 SI : 1 vol: 0,02003
range 2=67.5 69.5 o:1 CR:1 Colour:#FF0000
Range3=name:oxide 83.50 8.65e1 Vol: Cr:1 O:2
Range4=13.5 14.25 Vol:0.02003 Si:1 Color:CCCCCC
number = 4

[IONS]
Ion2=Cr
Ion1 = Si
Ion1 = Si
ion3=O extra
"""


@pytest.fixture
def save(tmp_path):
    def save(text, encoding="utf-8", name="a.rrng"):
        (tmp_path / name).write_bytes(text.encode(encoding))
        return tmp_path / name

    return save


def of(masses):
    return Hits(mass_to_charge=masses, pulse_id=np.arange(len(masses)))


def strict(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_ranges(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_tidy_file(save, encoding):
    ranges = strict(save(TIDY.replace("\n", "\r\n"), encoding))
    assert ranges.names == ("Si", "CrO", "oxide") and ranges.species_names == ranges.names
    assert ranges.low.tolist() == [13.5, 67.5, 83.5] and ranges.high.tolist() == [14.25, 69.5, 86.5]
    assert ranges.volume.tolist() == [0.02003, 0.04083, 0.06966]
    assert ranges.colour == ("#CCCCCC", "#FF0000", "#00FF00")
    assert ranges.composition == ({"Si": 1}, {"Cr": 1, "O": 1}, {"Cr": 1, "O": 2})
    assert "Si, CrO, oxide" in repr(ranges) and "a.rrng" in repr(ranges)


def test_an_untidy_file_says_the_same(save):
    tidy, untidy = strict(save(TIDY)), strict(save(UNTIDY))
    assert untidy.names == ("Si", "OCr", "oxide")  # a formula follows the file
    assert untidy.composition == tidy.composition
    np.testing.assert_array_equal(untidy.low, tidy.low)
    np.testing.assert_array_equal(untidy.high, tidy.high)
    assert untidy.volume[0] == 0.02003 and np.isnan(untidy.volume[1:]).all()
    assert untidy.colour == ("#CCCCCC", "#FF0000", "")


@pytest.mark.parametrize(
    "line, problem",
    [
        ("Range1=13 Si:1", "line 2: expected two bounds"),
        ("Range1=13 14 15 Si:1", "two bounds"),
        ("Range1=14 13 Si:1", "the lower one first"),
        ("Range1=13 far Si:1", "a bound .*'far'"),
        ("Range1=13 nan Si:1", "a bound .*'nan'"),
        ("Range1=13 1e999 Si:1", "a bound .*'1e999'"),
        ("Range1=13 14 Si:one", "number of atoms such as Si:1, got 'Si:one'"),
        ("Range1=13 14 Vol:much Si:1", "a volume"),
        ("Range1=13 14 Color:FFFFFF", "expected an element"),
        ("Range=13 14 Si:1", "no lines Range1"),
        ("", "no lines Range1"),
    ],
)
def test_lines_that_cannot_be_understood(save, line, problem):
    with pytest.raises(FileError, match=rf"a\.rrng.*{problem}"):
        read_ranges(save(f"[Ranges]\n{line}\n"))


@pytest.mark.parametrize(
    "text",
    [
        f"[{' ' * 4_000}x\n[Ranges]\nRange1=27 29 Si:1\n",
        f"[Ranges]\nRange1=27 29{' ' * 200_000}Si{' ' * 200_000}:{' ' * 200_000}1\n",
        f"[Ranges]\nRange1=27 29 Si:1 {': ' * 200_000}\n",
        f"[Ranges]\n{'[' * 200_000}\nRange1=27 29 Si:1 {'x:' * 200_000}\n",
        f"[{' x' * 200_000}]\n[Ranges]\nrange{' ' * 200_000}1=27 29 Si:1\n",
    ],
)
def test_many_spaces_take_no_longer_than_other_text(save, text):
    """A pattern that looks at them once from each of them takes a minute for these, or hours."""
    began = time.process_time()
    try:
        assert read_ranges(save(text)).names == ("Si",)
    except FileError as error:
        assert len(str(error)) < 500
    assert time.process_time() - began < 5


def test_what_is_no_rrng(save, tmp_path):
    with pytest.raises(FileError, match=r"a\.rrng.*empty"):
        read_ranges(save(""))
    with pytest.raises(FileError, match="No such file"):
        read_ranges(tmp_path / "none.rrng")
    with pytest.warns(UserWarning, match="states 3 ranges but contains 2"):
        assert len(read_ranges(save(TIDY[: TIDY.index("Range3")]))) == 2


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # most of these ions are outside
def test_ions_are_within_low_and_below_high():
    ranges = Ranges(["Si", "O", "Si"], [14.0, 16.0, 28.0], [15.0, 17.0, 29.0])
    hits = of([13.99, 14.0, 14.5, 15.0, 16.5, 28.5, 29.0, np.nan, np.inf, -1.0])
    assert ranges.index(hits).tolist() == [-1, 0, 0, -1, 1, 2, -1, -1, -1, -1]
    assert ranges.species(hits).tolist() == [-1, 0, 0, -1, 1, 0, -1, -1, -1, -1]
    assert ranges.labels(hits, "?").tolist() == ["?", "Si", "Si", "?", "O", "Si", "?", "?", "?", "?"]
    assert ranges.select(hits, "Si").pulse_id.tolist() == [1, 2, 5]
    assert ranges.select(hits, "O", "Si").pulse_id.tolist() == [1, 2, 4, 5]
    with pytest.raises(ValueError, match="no species 'Fe', only Si, O"):
        ranges.select(hits, "Fe")
    with pytest.raises(ValueError, match="no species None"):
        ranges.select(hits)
    with pytest.raises(ValueError, match="no column 'mass_to_charge'"):
        ranges.species(Hits(x=[1.0]))


def test_where_ranges_overlap_the_first_wins_and_a_warning_says_so(save):
    text = "[Ranges]\nRange1=20 30 Al:1\nRange2=10 25 B:1\nRange3=22 23 C:1\n"
    with pytest.warns(UserWarning, match=r"a\.rrng.*2 ranges overlap.*first .* is used: Al 20-30 over B 10-25"):
        ranges = read_ranges(save(text))
    assert ranges.labels(of([10, 19.5, 20, 22.5, 24, 29, 30])).tolist() == ["B", "B", "Al", "Al", "Al", "Al", "X"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Ranges(list("ab"), [1, 2], [2, 3])  # adjoining ranges do not overlap


@given(
    bounds=st.lists(st.tuples(st.integers(0, 20), st.integers(1, 8)), min_size=1, max_size=8),
    masses=st.lists(st.floats(-2, 32, width=32), min_size=1, max_size=30),
)
def test_every_ion_is_in_the_first_range_that_holds_it(bounds, masses):
    low = np.array([low for low, _ in bounds])
    high = low + [width for _, width in bounds]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ranges = Ranges([f"r{i}" for i in range(len(low))], low, high)
    naive = [next((i for i in range(len(low)) if low[i] <= mass < high[i]), -1) for mass in masses]
    assert ranges.index(of(masses)).tolist() == naive


@pytest.mark.parametrize(
    "arguments, problem",
    [
        (([], [], []), "at least one range"),
        ((["a"], [2.0], [1.0]), "low must be < high .* 2 to 1 for 'a'"),
        ((["a"], [1.0, 2.0], [3.0, 4.0]), r"low must have shape \(1,\)"),
        ((["a"], [1.0], [2.0], None, ["#FFFFFF"] * 2), "colour must have one entry"),
        ((["Si\n[Ranges]"], [1.0], [2.0]), "names of species must be text of 1 to 100 printable"),
        (([""], [1.0], [2.0]), "names of species must be text of 1 to 100 printable"),
        ((["a"], [1.0], [2.0], None, ["FF\nRange9=1 2"]), "colour must be text of 1 to 100 printable"),
        ((["a"], [1.0], [2.0], None, None, [{"S\ni": 1}]), "elements of a composition must be text of 1 to 100"),
    ],
)
def test_bad_ranges_are_named(arguments, problem):
    with pytest.raises(ValueError, match=problem):
        Ranges(*arguments)


@pytest.mark.skipif(not DATA.exists(), reason="the measured Si.epos and Si.rrng are not there")
def test_ranges_of_a_measured_file():
    ranges = strict(DATA / "Si.rrng")
    hits = read(DATA / "Si.epos", columns=("mass_to_charge",))
    mass = hits.mass_to_charge.astype(float)
    counts = np.bincount(ranges.index(hits) + 1, minlength=26)
    within = [
        np.count_nonzero((mass >= low) & (mass < high)) for low, high in zip(ranges.low, ranges.high, strict=True)
    ]
    assert len(ranges) == 25 and ranges.species_names == ("Si", "Cr", "Cu", "C", "O", "CrO", "CrO2", "Cr2O")
    assert counts[1:].tolist() == within and counts.sum() == 945_211
    doubly = np.isin(ranges.index(hits), [0, 4, 5])  # Si2+, by its masses
    assert np.mean(doubly) == pytest.approx(0.79, abs=0.005)  # as measured: 79 %


# ---- other selections ----------------------------------------------------------------------------------------------


def measured():
    return Hits(
        x=[0.0, 3.0, np.nan, 6.0, 0.0],
        y=[0.0, 4.0, 0.0, 8.0, 5.0],
        voltage=[4e3, 4.5e3, 5e3, np.nan, 6e3],
        pulse_id=[0, 0, 1, 2, 2],
        multiplicity=[2, 2, 1, 2, 2],
        positions=np.zeros((5, 3)),
    )


def test_circle():
    hits = measured()
    assert hits.within_circle(5.0).pulse_id.tolist() == [0, 0, 2] and hits.within_circle(4.99).pulse_id.tolist() == [0]
    assert hits.within_circle(0.5, centre=(6, 8)).y.tolist() == [8]
    missed = Hits(x=[0.0, 0.0], y=[0.0, 0.0], outcome=[Outcome.HIT, Outcome.MISSED])
    assert len(missed.within_circle(1.0)) == 1
    for radius, centre in ((0, (0, 0)), (np.nan, (0, 0)), (1, (0, 0, 0)), (1, (np.inf, 0))):
        with pytest.raises(ValueError, match=r"radius|centre"):
            hits.within_circle(radius, centre)
    with pytest.raises(ValueError, match="no column 'x'"):
        Hits(voltage=[1.0]).within_circle(1.0)


def test_window():
    hits = measured()
    assert hits.window(voltage=(4e3, 5e3)).x.tolist() == [0, 3]
    assert hits.window(voltage=(4.5e3, None)).pulse_id.tolist() == [0, 1, 2]
    assert hits.window(voltage=(None, None)).pulse_id.tolist() == [0, 0, 1, 2]  # NaN is in none
    assert hits.window(ion=(1, 3)).pulse_id.tolist() == [0, 1]
    assert hits.window(ion=(1, 3), multiplicity=(2, None)).pulse_id.tolist() == [0]
    assert hits.window(ion=(1, 3)).multiplicity.tolist() == [2, 1]  # of the pulse, whatever is selected
    assert Hits(x=[1.0, 2.0, 3.0], ion=[7, 8, 9]).window(ion=(8, 9)).x.tolist() == [2.0]
    assert len(hits.window()) == 5


def test_windows_that_adjoin_share_no_ion():
    hits = of(np.linspace(0, 10, 1001))
    parts = [hits.window(mass_to_charge=(low, low + 1.25)) for low in np.arange(0, 10, 1.25)]
    assert sum(map(len, parts)) == 1000  # 10 is in none


@pytest.mark.parametrize("bounds", [5, (1,), (1, 2, 3), (2, 1), "ab", ("a", "b"), (np.nan, 1), None])
def test_bounds_that_are_none(bounds):
    with pytest.raises(ValueError, match="voltage"):
        measured().window(voltage=bounds)


def test_columns_that_cannot_be_windowed():
    with pytest.raises(ValueError, match="positions"):
        measured().window(positions=(0, 1))
    with pytest.raises(ValueError, match="no column 'site'"):
        measured().window(site=(0, 1))


@pytest.mark.parametrize(
    "extra", [{"a": [1.0, 2.0]}, {"a": 5}, {"a": np.zeros((5, 1, 1))}, {"a": [[1], [1, 2], 3, 4, 5]}]
)
def test_extra_columns_are_checked(extra):
    with pytest.raises(ValueError):
        Hits(x=np.zeros(5), extra=extra)


def test_ranges_of_another_file_are_named():
    ranges = Ranges(["Si", "O"], [14.0, 16.0], [15.0, 17.0])
    hits = Hits(mass_to_charge=[14.5, 14.5, 16.5, 20.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(ranges.select(hits, "Si")) == 2
    with pytest.warns(DataWarning, match="2 of 4"):
        assert len(ranges.select(hits[[0, 1, 3, 3]], "Si")) == 2
