"""What the explorer, a twin and a report print reads the same ions as the command that printed it, to the bit."""

import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.codec import declared
from apt_evap.cli._explorer_of_files import explorer_and_view
from apt_evap.cli._files import file_of, measured_of, measured_source, note, read
from apt_evap.cli.parser import make_parser
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.workflows.twin_of_map import Twin
from apt_evap.workflows.twin_options import TwinOptions

pytestmark = [
    pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning"),  # ions outside grids and ranges
    pytest.mark.usefixtures("spectra_once"),
]
N = 20_000
ABUNDANCES = (0.6808, 0.2622, 0.0114, 0.0363, 0.0093)  # of nickel
# words of the file and of one option; all others are as if they were not given
OPTIONS = {
    "format": ["ions.dat", "--format", ".epos"],
    "partial": ["cut.epos", "--partial"],
    "byte_order": ["little.pos", "--byte-order", "little"],
    "unit": ["ions.epos", "--unit", "cm"],
    "voltage_unit": ["volts.epos", "--voltage-unit", "V"],
    "undistort": ["ions.epos", "--undistort", "grid.csv"],
    "exchange_axes": ["ions.epos", "--undistort", "exchanged.csv", "--exchange-axes"],
    "distance": ["times.raw", "--distance", "90.12345", "--mass", "25,33.3"],
    "time_zero": ["times.raw", "--distance", "90", "--t0", "12.5", "--mass", "25,33.3"],
    "ions": ["ions.epos", "--ions", "100,15000"],
    "mass": ["ions.epos", "--mass", ",29.3"],
    "voltage": ["ions.epos", "--voltage", "4003.123456,"],
    "circle": ["ions.epos", "--circle", "2.2,0.5,-0.25"],
    "box": ["ions.epos", "--box", "-2.5,1,-1,2"],
    "species": ["ions.epos", "--ranges=-ranges.rrng", "--species", "Ni,B"],
    "ranges": ["times.raw", "--distance", "90", "--ranges=-ranges.rrng", "--species", "Ni"],
    "peaks": ["ions.epos", "--element", "Ni"],
}
TOGETHER = [
    ["-ions.epos", "--unit", "cm", "--undistort", "grid.csv", "--circle", "20", "--ions", "50,", "--element", "Ni"],
    ["ions.epos", "--ions", "50,18000", "--voltage", ",4700", "--element", "Ni", "--all-ions", "--mass", "20,40"],
    ["times.raw", "--distance", "90", "--t0", "3", "--element", "Ni", "--circle", "2.5"],
    ["ions.epos", "--ranges=-ranges.rrng", "--species", "Ni", "--ions", ",9000", "--undistort", "grid.csv"],
]
ALL = ["--element", "Ni", "--all-ions"]
FORMATS = [  # that have places on a detector
    ["multiple.epos", *ALL, "--ions", "100,2500"],
    ["semicolon.csv", *ALL, "--circle", "2.2,0.5,-0.25"],
    ["tab.txt", *ALL, "--box", "-2.5,1,-1,2"],
    ["comma.csv", *ALL, "--voltage", "4100.5,"],
    ["pyccapt.h5", *ALL, "--mass", "20,40"],
    ["ions.nxs", *ALL, "--undistort", "grid.csv"],
]
PLACELESS = [OPTIONS["byte_order"], ["ions.ato"], ["places.csv"], ["--format=.ato", "of_rouen"]]


def pulses(numbers):
    """Columns of the pulses of ions, by the number of each."""
    _, rows, counts = np.unique(numbers, return_inverse=True, return_counts=True)
    return {"pulse_id": rows, "multiplicity": counts[rows]}


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    random = np.random.default_rng(5)
    nickel = random.choice(np.array([57.9353, 59.9308, 60.9311, 61.9283, 63.928]) / 2, N, p=ABUNDANCES)
    mass = np.where(random.random(N) < 0.6, nickel, random.uniform(5, 60, N))
    mass = (mass * random.normal(1, 3e-4, N)).astype("f4")
    x, y = random.uniform(-3, 3, (2, N)).astype("f4")
    volts = np.linspace(4000, 5000, N).astype("f4")
    places = random.random((N, 3)).astype("f4")
    ions = ae.Hits(
        x=x, y=y, mass_to_charge=mass, voltage=volts, pulse_voltage=0 * volts, time_of_flight=100 + mass,
        positions=places, pulse_id=np.arange(N), multiplicity=np.ones(N, int),
    )  # fmt: skip
    for name in ("ions.epos", "-ions.epos", "cut.epos", "big.epos"):
        ae.write(folder / name, ions)
    (folder / "ions.dat").write_bytes((folder / "ions.epos").read_bytes())
    (folder / "cut.epos").write_bytes((folder / "ions.epos").read_bytes()[:-10])
    with pytest.warns(ae.warnings.DataWarning, match="kV"):
        ae.write(folder / "volts.epos", replace(ions, voltage=volts / 100))
    ae.write(folder / "big.pos", ions)
    np.frombuffer((folder / "big.pos").read_bytes(), ">f4").astype("<f4").tofile(folder / "little.pos")
    first = ions[:3000]
    together = np.sort(random.integers(0, 2000, 3000))  # pulses of several ions
    ae.write(folder / "multiple.epos", replace(first, **pulses(together)))
    ae.write(folder / "semicolon.csv", replace(first, **pulses(together)), separator="semicolon")
    ae.write(folder / "tab.csv", first, separator="tab", decimals=4)
    (folder / "tab.csv").rename(folder / "tab.txt")
    text = (folder / "semicolon.csv").read_text()
    (folder / "comma.csv").write_text("\ufeff" + text.replace(".", ","), newline="\r\n")
    ae.write(folder / "pyccapt.h5", first)
    ae.write(folder / "ions.nxs", first, elements=("Ni",))
    (folder / "places.csv").write_text("m/n (Da);X_nm;Y_nm;Z_nm\n28,97;1,5;2;3\n13,5;4;5,25;6\n")
    table = np.hstack([10 * places, mass[:, None], np.zeros((N, 10))]).astype("<f4")
    for name in ("ions.ato", "of_rouen"):
        (folder / name).write_bytes(np.array([0, 3], "<u4").tobytes() + table.tobytes())
    rows = np.zeros((N, 8), "<f4")
    rows[:, 0], rows[:, 3], rows[:, 4] = volts, x, y
    rows[:, 5] = np.sqrt(mass * (90**2 + x**2 + y**2) / (1.92971e-4 * volts))
    rows[:, 7] = np.arange(1, N + 1, dtype=np.uint32).view("<f4")
    rows.tofile(folder / "times.raw")
    nodes = [(i, j) for i in range(-9, 10) for j in range(-9, 10)]
    lines = ["detectorX,detectorY,gridX,gridY", *(f"{i * 4 + 0.08 * i * i},{j * 4},{i},{j}" for i, j in nodes)]
    (folder / "grid.csv").write_text("\n".join(lines))
    (folder / "exchanged.csv").write_text("\n".join(["detectorY,detectorX,gridX,gridY", *lines[1:]]))
    (folder / "-ranges.rrng").write_text("[Ranges]\nRange1=28.8 29.2 Ni:1\nRange2=10 20.5 B:1\n")
    counts = ions.map(bins=40)
    names = ("v", "x", "y")
    np.savez(folder / "map.npz", **dict(zip(names, (counts.values, counts.x_edges, counts.y_edges), strict=True)))
    return folder


@pytest.fixture
def folder(files, monkeypatch):
    monkeypatch.chdir(files)


def same(ions, others):
    """Whether ions are the same, with all that both know of them."""
    columns = {*ions.columns} & {*others.columns}
    assert columns >= {"mass_to_charge"} or "x" in columns
    return len(ions) == len(others) > 0 and all(
        np.array_equal(getattr(ions, name), getattr(others, name), equal_nan=True) for name in columns
    )


def parsed(command, *words):
    words = [word if word != "-ions.epos" else "./-ions.epos" for word in words]
    return make_parser(command).parse_args([command, *words])


def test_every_option_of_reading_is_here():
    assert set(OPTIONS) | {"path", "arrays"} == set(declared(MeasuredFile))


CASES = [
    # "3" fits the flight; all options are read alone or together, all formats slowly
    pytest.param(words, id=" ".join(words), marks=[pytest.mark.slow] if "3" in words or words in FORMATS else [])
    for words in (*OPTIONS.values(), *TOGETHER, *FORMATS)
    if words[0] != "little.pos"  # no places on a detector
]


@pytest.mark.parametrize("words", CASES)
def test_the_explorer_prints_what_it_shows(folder, words):
    """The command and the Python lines of the page."""
    explorer, view = explorer_and_view(parsed("explore", *words))
    shell = shlex.split(explorer.commands(view).shell)
    again, _ = explorer_and_view(make_parser().parse_args(["explore", *shell[2:]]))
    assert same(again.measured, explorer.measured)
    whole = measured_of(
        parsed("index", *words, *(["--element", "Ni", "--all-ions"] if "--element" not in words else []))
    )
    assert same(whole, explorer.measured)  # and the other commands read the same
    (line,) = [line for line in explorer.commands(view).python.splitlines() if line.startswith("measured = ")]
    names = {"Explorer": lambda run, measured: SimpleNamespace(bins_like=lambda bins: measured), "ae": ae}
    exec(line, names)
    assert same(names["measured"], explorer.measured)


@pytest.mark.parametrize("words", CASES)
def test_the_command_of_a_twin_reconstructs_its_ions(folder, words, monkeypatch, tmp_path):
    words = [*words, *([] if "--element" in words else ["--element", "Ni"])]
    options = parsed("twin", *words)
    known = {"distance": options.distance or 90.0, "efficiency": 0.4}
    monkeypatch.setattr(Twin, "_known", lambda self, study: SimpleNamespace(arguments=known))
    chosen = TwinOptions("Ni", 1.0, None, None, options.distance, 0.5, None, (), (), None)
    how = {"threads": 1, "progress": False, "note": note, "command": ""}
    twin = Twin(tmp_path / "t", measured_source(options), chosen, **how)
    command = shlex.split(twin._reconstruct_command(None))
    again = make_parser("reconstruct").parse_args(command[1:])
    assert again.distance == known["distance"] and again.element == "Ni"
    assert same(file_of(again).select(read(again), note), twin.measured)


def test_pulses_of_several_ions_are_those_that_were_written(folder):
    first, second = ae.read("multiple.epos"), ae.read("semicolon.csv")
    assert same(first, second) and "multiplicity" in first.columns and first.multiplicity.max() > 3


@pytest.mark.parametrize("words", PLACELESS, ids=" ".join)
def test_ions_without_places_are_read_from_what_is_printed(folder, words):
    file = file_of(parsed("info", *words))
    hits = file.load(ae.read)
    assert same(eval(file.code(hits.columns), {"ae": ae}), hits)
    assert same(read(parsed("info", *file.words())), hits)
    if words[0] == "little.pos":
        assert same(hits, ae.read("big.pos"))


def test_maps_are_read_from_what_is_printed(folder):
    words = ["map.npz", "--arrays", "v,x,y", "--unit", "cm"]
    explorer, view = explorer_and_view(parsed("explore", *words))
    again, _ = explorer_and_view(make_parser().parse_args(["explore", *shlex.split(explorer.commands(view).shell)[2:]]))
    python = eval(file_of(parsed("map", *words)).code(()), {"ae": ae})
    for counts in (again.measured, python):
        assert np.array_equal(counts.values, explorer.measured.values)
        assert np.array_equal(counts.x_edges, explorer.measured.x_edges)


def test_records_differ_where_the_ions_may(folder):
    """One record for each option, and for each value of it; the name of a file does not matter."""
    files = [MeasuredFile("ions.epos"), MeasuredFile("ions.epos", partial=False)]
    files += [file_of(parsed("map", *words)) for words in (*OPTIONS.values(), *TOGETHER)]
    records = {file.digest() for file in files}
    assert len(records) == len(files)
    assert MeasuredFile("ions.epos").digest() == MeasuredFile("-ions.epos").digest()
    assert MeasuredFile(Path("a.epos"), ions=(5.0, None)) == MeasuredFile("a.epos", ions=(5, None))
    for wrong in ({"ions": (1,)}, {"circle": 5}, {"box": (1, 2)}, {"mass": "ab"}, {"distance": -1.0}, {"unit": 3}):
        (name,) = wrong
        with pytest.raises(ValueError, match=name):
            MeasuredFile("a.epos", **wrong)
