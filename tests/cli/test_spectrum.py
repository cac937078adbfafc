"""`apt-evap spectrum`, and the default masses of the commands that index a map."""

import json

import numpy as np
import pytest

import apt_evap as ae
from apt_evap import plot
from apt_evap.cli._files import measured_of
from apt_evap.cli.main import main
from apt_evap.cli.parser import make_parser
from apt_evap.io.formats import read_ranges
from apt_evap.io.rrng import write_rrng
from apt_evap.spectra.mass_ranges import Ranges

N, BELOW = 12_000, 6000
MASSES = {"Ni": (57.9353, 59.9308, 60.9311, 61.9283, 63.9280), "Al": (26.9815,)}


@pytest.fixture
def alloy(tmp_path):
    """Path of an .epos of nickel and aluminium over a background, and the number of ions of each."""
    rng = np.random.default_rng(4)
    nickel = rng.choice(MASSES["Ni"], N, p=[0.6808, 0.2622, 0.0114, 0.0363, 0.0093])
    mass = np.concatenate([nickel, np.full(N, MASSES["Al"][0]), rng.uniform(5, 100, BELOW)])
    mass *= rng.normal(1, 5e-4, len(mass))
    angle, radius = 2 * np.pi * rng.random(len(mass)), 15 * np.sqrt(rng.random(len(mass)))
    ones = np.ones(len(mass))
    hits = ae.Hits(
        x=radius * np.cos(angle), y=radius * np.sin(angle), mass_to_charge=mass, time_of_flight=300 * ones,
        voltage=5000 * ones, pulse_voltage=0 * ones, positions=rng.random((len(mass), 3)),
        pulse_id=np.arange(len(mass)), pulses=np.ones(len(mass), int), multiplicity=np.ones(len(mass), int),
    )  # fmt: skip
    path = tmp_path / "alloy.epos"
    ae.write(path, hits)
    return path


def selected(*words):
    return measured_of(make_parser("index").parse_args(["index", *map(str, words)]))


@pytest.mark.usefixtures("rough_layout")
def test_peaks_are_named_drawn_and_saved(alloy, tmp_path, capsys):
    saved, picture = tmp_path / "a.rrng", tmp_path / "a.png"
    assert main(["spectrum", str(alloy), "--save", str(saved), "-o", str(picture), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert {ion["name"] for ion in content["ions"]} == {"Ni⁺", "Al⁺"}
    assert picture.stat().st_size > 10_000
    counted = read_ranges(saved).count_atoms(ae.read(alloy))
    assert all(abs(counted[element] - N) < 0.03 * N for element in MASSES)
    assert main(["spectrum", str(alloy), "--save", str(saved), "-o", str(picture)]) == 2  # would overwrite ranges
    assert "--force" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.0, np.nan])
def test_ions_without_a_mass_have_no_spectrum(tmp_path, capsys, monkeypatch, mass):
    monkeypatch.chdir(tmp_path)
    np.tile(np.array([1, 2, 3, mass], ">f4"), (300, 1)).tofile("a.pos")
    for command in ("spectrum", "composition"):
        assert main([command, "a.pos"]) == 2
        out, err = capsys.readouterr()
        assert out == "" and "needs detected ions with a mass-to-charge ratio above 0, got none of <Hits: 300" in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.pos"]


@pytest.mark.usefixtures("blank_pictures")
def test_ranges_of_a_file_are_drawn_and_counted(alloy, tmp_path, capsys):
    names = {"Ni": (57.0, 61.5), "Al": (26.5, 27.5)}
    low, high = np.array(list(names.values())).T
    write_rrng(tmp_path / "a.rrng", Ranges(tuple(names), low, high, composition=tuple({name: 1} for name in names)))
    words = ["spectrum", str(alloy), "--ranges", str(tmp_path / "a.rrng"), "-o", str(tmp_path / "a.png")]
    assert main([*words, "--json"]) == 0
    mass = ae.read(alloy).mass_to_charge
    counted = {name: int(((mass >= low) & (mass < high)).sum()) for name, (low, high) in names.items()}
    assert json.loads(capsys.readouterr().out)["ions_in_ranges"] == counted
    ax = plot.spectrum(ae.spectrum(ae.read(alloy)), ranges=read_ranges(tmp_path / "a.rrng"))
    assert {text.get_text() for text in ax.texts} == set(names)


@pytest.mark.parametrize("element", MASSES)
def test_the_ions_of_the_crystal_are_taken_and_said(alloy, element, capsys):
    hits = selected(alloy, "--element", element)
    assert abs(len(hits) - N) < 0.03 * N
    assert np.mean(np.abs(hits.mass_to_charge[:, None] / MASSES[element] - 1).min(axis=1) < 3e-3) > 0.98
    assert f"{len(hits):,} of {2 * N + BELOW:,} ions are used" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "number"), [(["--all-ions"], 2 * N + BELOW), (["--mass", "50,"], None), (["--mass", "26,28"], None)]
)
def test_the_user_chooses_other_ions(alloy, words, number, capsys):
    hits = selected(alloy, "--element", "Ni", *words)
    expected = number
    if number is None:
        low, high = ((float(part) if part else np.inf) for part in words[1].split(","))
        masses = ae.read(alloy).mass_to_charge
        expected = np.count_nonzero((masses >= low) & (masses < high))
    assert len(hits) == expected and "ions are used" not in capsys.readouterr().err


def test_all_ions_are_used_and_said_where_the_crystal_has_no_peaks(alloy, capsys):
    assert len(selected(alloy, "--element", "W")) == 2 * N + BELOW
    assert "all ions are used: no peaks of W" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--element", "w"], "elements must be"),
        (["--save", "ranges.txt"], "--save must be"),
        (["--mass", "20,30"], "--mass and --species"),
        (["--t0", "inf"], "must be a number"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(alloy, tmp_path, monkeypatch, words, what, capsys):
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    assert main(["spectrum", str(alloy), *words]) == 2
    error = capsys.readouterr().err
    assert what in error and error.count("\n") == 1
    assert set(tmp_path.iterdir()) == before


def test_saving_without_a_name_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    ae.write("noise.pos", ae.Hits(mass_to_charge=rng.uniform(1, 100, 5000), positions=rng.random((5000, 3))))
    assert main(["spectrum", "noise.pos", "--save", "a.rrng"]) == 2
    assert "ranges need peaks" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["noise.pos"]


def test_the_lines_of_the_explorer_have_the_same_masses(tmp_path):
    from apt_evap.cli._explorer_of_files import explorer_and_view

    rng = np.random.default_rng(2)
    rows = np.zeros((3000, 8), "<f4")
    rows[:, 0], rows[:, 1], rows[:, 5] = 5000.0, 1000.0, rng.uniform(300, 900, 3000)
    rows[:, 3:5] = rng.uniform(-20, 20, (3000, 2))
    rows[:, 7] = np.arange(1, 3001, dtype=np.uint32).view("<f4")
    path = tmp_path / "a.raw"
    rows.tofile(path)
    words = ["explore", str(path), "--distance", "90", "--t0", "12.5", "--mass", "20,60"]
    explorer, _ = explorer_and_view(make_parser("explore").parse_args(words))
    hits = eval(explorer.ions_of_file.code, {"ae": ae})
    assert np.array_equal(hits.mass_to_charge, explorer.measured.mass_to_charge) and 100 < len(hits) < 2900
    # the voltage of an ion is that at the top of the pulse
    time, across = hits.time_of_flight - 12.5, hits.x**2 + hits.y**2
    assert np.allclose(hits.mass_to_charge, 1.92971e-4 * 6000 * time**2 / (90**2 + across), rtol=1e-4)
