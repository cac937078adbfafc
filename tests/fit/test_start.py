"""Settings of a simulation from a measured map, and the commands that go from a file to an answer."""

import json
import os
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.fit.start_settings import FIELD_FACTOR, MARK, registration_start_of
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.specimen.symmetry import point_group


@pytest.fixture
def found(indexed_nickel):
    return indexed_nickel


@pytest.mark.slow
def test_the_settings_are_those_of_the_map(found, tmp_path):
    truth, indexing = found
    start = ae.fit.settings_of(indexing, minutes=5)
    start.save(tmp_path / "nickel.toml")
    config = read_config(tmp_path / "nickel.toml")
    tip = {name: config.tip[name] for name in ("material", "axis", "rotation")}
    made = ae.Orientation(**tip)
    # what the tip shows at the centre of its detector is what the map shows at the centre of its field of view
    places = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 12.0]])
    centre = np.array(start.registration["start"].shift)
    simulated = config.detector.seen_from_apex.compressed(1.03).directions(places) @ made.matrix
    measured = ae.detection.Projection(60.0).directions(places + centre) @ truth.matrix
    group = point_group("fcc")
    angles = [np.degrees(np.arccos(np.clip((simulated @ each * measured).sum(axis=1), -1, 1))).max() for each in group]
    assert min(angles) < 1.5  # of the indexing
    assert config.detector.width > 70.0
    panel = config.maps.panels[1].perturbation
    assert isinstance(panel, ae.RollUp) and panel.probability == pytest.approx(0.5, abs=0.15)
    assert config.maps.panels[2].perturbation == ae.RollUp.of_metal("Ni")
    for field in (35.0, 31.5, 38.5):  # as in the table, and as far as it is known
        assert f"{ae.emission.Migration(4.44, field).threshold:.2f}" in start.text
    assert all("#" in line for line in start.text.splitlines() if line.startswith(("axis", "rotation", "apex", "ions")))
    assert np.isnan(start.radii).all() and "no voltages" in start.text


def test_the_place_of_a_run_is_that_of_its_settings(found, tmp_path):
    """The registration of a run begins where its settings say, on the map that they were made from only."""
    _, indexing = found
    path, other = tmp_path / "W.npz", tmp_path / "other" / "W.npz"
    other.parent.mkdir()
    path.write_bytes(b"one")
    other.write_bytes(b"two")
    map = replace(indexing.map, source=str(path))
    start = ae.fit.settings_of(replace(indexing, map=map), minutes=1)
    start.save(tmp_path / "w.toml")
    read, made = registration_start_of(tmp_path / "w.toml", map), start.registration
    assert read.keys() == made.keys() and read["scales"] == made["scales"] and read["rotations"] == made["rotations"]
    assert read["tolerance"] == pytest.approx(made["tolerance"], rel=1e-3)
    assert read["start"].shift == pytest.approx(made["start"].shift, abs=0.01)
    for source in (str(other), "", "missing.npz"):  # the same name is not the same file
        assert registration_start_of(tmp_path / "w.toml", replace(map, source=source)) == {}
    path.write_bytes(b"another measurement")
    assert registration_start_of(tmp_path / "w.toml", map) == {}


def test_results_have_short_representations(found):
    _, indexing = found
    for result in (indexing, indexing.best):
        assert len(repr(result)) < 160
        assert not re.search(r"\d\.\d{5}", repr(result))


def test_undecided_settings_say_so_at_once(found):
    """Without a per cent, which would be a confidence."""
    _, indexing = found
    undecided = replace(indexing, decided=False, reason="two orientations explain the same")
    text = ae.fit.settings_of(undecided, minutes=5).text
    assert any("NOT DECIDED" in line for line in text.splitlines()[:4]) and "%" not in text
    assert "NOT DECIDED" not in ae.fit.settings_of(indexing, minutes=5).text


def test_the_radius_is_that_of_the_voltage(found):
    _, indexing = found
    hits = ae.Hits(
        x=np.zeros(3000),
        y=np.zeros(3000),
        voltage=np.linspace(2000.0, 3000.0, 3000),
        pulse_voltage=np.full(3000, 500.0),
    )
    field = ae.material("Ni").evaporation_field
    start = ae.fit.settings_of(indexing, hits, minutes=2)
    # medians of the first and last thousand ions
    assert start.radii == pytest.approx([v / (FIELD_FACTOR * field) for v in (2666.5, 3333.5)], rel=1e-3)
    assert start.simulated_radius <= sum(start.radii) / 2 + 1e-9
    low, high = start.radii
    assert start.size_text.startswith(f"simulating R = {start.simulated_radius:.1f} nm, the largest of those not above")
    assert start.size_text.endswith(f"that of the specimen is {low:.0f} to {high:.0f} nm by its voltages")
    assert "not known" in ae.fit.settings_of(indexing, minutes=2).size_text
    other = ae.fit.settings_of(indexing, hits, field_factor=2 * FIELD_FACTOR, minutes=2)
    assert other.radii == pytest.approx([radius / 2 for radius in start.radii])
    lens = ae.detection.LocalElectrode(distance=40e3, aperture=20e3, shank_angle=5.0)
    behind = ae.fit.settings_of(indexing, hits, lens=lens, minutes=2)
    assert behind.radii[0] == pytest.approx(float(lens.radius(2666.5, field)), rel=1e-3)
    assert "shank_angle = 5" in behind.text


def test_less_time_makes_a_smaller_tip(found):
    _, indexing = found
    large, small = (ae.fit.settings_of(indexing, minutes=minutes) for minutes in (20.0, 2.0))
    assert small.simulated_radius < large.simulated_radius
    assert small.cost.hours * 60 <= 2.0
    with pytest.raises(ValueError, match="minutes must be at least") as refusal:
        ae.fit.settings_of(indexing, minutes=1e-3)
    least = float(str(refusal.value).split("at least ")[1].split()[0])
    assert ae.fit.settings_of(indexing, minutes=least).cost.hours * 60 <= least


def test_a_run_that_ends_with_its_time_has_spare_ions(found):
    _, indexing = found
    usual, spare = (ae.fit.settings_of(indexing, minutes=2, spare=spare) for spare in (1.0, 1.2))
    assert spare.cost == usual.cost and spare.simulated_radius == usual.simulated_radius
    ions = [tomllib.loads(start.text)["simulation"]["ions"] for start in (usual, spare)]
    assert ions[1] == pytest.approx(1.2 * ions[0], rel=1e-3)
    most = tomllib.loads(ae.fit.settings_of(indexing, minutes=2, spare=1e3).text)["simulation"]["ions"]
    assert ions[1] < most <= 150_000  # the shape of the tip limits them


def test_threads_and_what_follows_share_the_minutes(found):
    """Two threads are 1 / (0.2 + 0.8 / 2) times as fast as one, for events follow one another."""
    _, indexing = found
    alone = ae.fit.settings_of(indexing, minutes=2).text
    assert ae.fit.settings_of(indexing, minutes=4, part=0.5).text == alone
    assert ae.fit.settings_of(indexing, minutes=2 * 0.6, threads=2).text == alone
    with pytest.raises(ValueError, match="minutes must be at least") as refusal:
        ae.fit.settings_of(indexing, minutes=1e-3, part=0.5)
    least = float(str(refusal.value).split("at least ")[1].split()[0])
    assert ae.fit.settings_of(indexing, minutes=least, part=0.5).cost.hours * 60 <= least / 2


def test_bad_arguments_are_named(found):
    _, indexing = found
    lens = ae.detection.LocalElectrode(distance=40e3, aperture=20e3, shank_angle=5.0)
    for name, options in (
        ("minutes", {"minutes": -1}),
        ("spare", {"spare": 0.5}),
        ("field_factor", {"field_factor": 0}),
        ("threads", {"threads": 0}),
    ):
        with pytest.raises(ValueError, match=name):
            ae.fit.settings_of(indexing, **options)
    with pytest.raises(ValueError, match="field_factor"):
        ae.fit.settings_of(indexing, lens=lens, field_factor=3.0)
    with pytest.raises(ValueError, match="indexing"):
        ae.fit.settings_of("w.toml")


@pytest.mark.slow
def test_commands_from_a_file_to_settings(found, tmp_path, monkeypatch, capsys):
    _, indexing = found
    monkeypatch.chdir(tmp_path)
    np.savez(
        "measured.npz",
        values=np.where(indexing.map.mask, indexing.map.values.astype(float), np.nan),
        x_edges_mm=indexing.map.x_edges,
        y_edges_mm=indexing.map.y_edges,
    )
    assert main(["index", "measured.npz", "--element", "Ni", "--scales", "56,64", "--distance", "90", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["compression"] == 90 / answer["candidates"][0]["scale"] == pytest.approx(1.5, rel=0.03)
    assert answer["verdict"] == "indexed" and (tmp_path / "measured_indexed.png").stat().st_size > 10_000
    arguments = ["start", "measured.npz", "--element", "Ni", "--scales", "56,64", "--minutes", "2", "-o", "mine.toml"]
    assert main(arguments) == 0
    assert (tmp_path / "mine.toml").read_text().startswith(MARK)
    assert main([*arguments, "--quiet"]) == 2 and "'mine.toml' exists: --force" in capsys.readouterr().err
    (tmp_path / "mine.toml").write_text("[tip]\n")
    assert main(arguments) == 2 and "mine.toml" in capsys.readouterr().err
    assert main([*arguments, "--force", "--quiet"]) == 0
    assert (tmp_path / "mine.toml").read_text().startswith(MARK)
    assert main(["index", "measured.npz", "--element", "Ni", "--pole=-1,x"]) == 2
    assert "--pole" in capsys.readouterr().err


NAMES = [
    'a.epos\n[tip]\nmaterial = "W"',
    'a\noutput = "\\u002ftmp\\u002fevil.h5"\n#',
    *("bell\x07", "x\ry", "caf\udce9", "\x7f", "\u2028", "tab\t", "\ud800"),
]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_files_do_not_become_settings(found, tmp_path, name):
    _, indexing = found
    usual = tomllib.loads(ae.fit.settings_of(indexing, minutes=5).text)
    start = ae.fit.settings_of(replace(indexing, map=replace(indexing.map, source=name)), minutes=5)
    start.save(tmp_path / "mine.toml")
    assert tomllib.loads((tmp_path / "mine.toml").read_text(encoding="utf-8")) == usual


@pytest.mark.parametrize("name", ["Ni", 'My "alloy" = [tip] \\n', "Ünobtainium"])
def test_a_material_of_a_user_is_that_of_the_run(found, tmp_path, name):
    _, indexing = found
    mine = ae.Material(
        name, structure="fcc", a=0.40, evaporation_field=20.0, charge_state=2, mass=61.7, sources={"a": "x\n[tip]"}
    )
    best = replace(indexing.best, orientation=replace(indexing.best.orientation, material=mine))
    start = ae.fit.settings_of(replace(indexing, candidates=(best,)), minutes=5)
    start.save(tmp_path / "mine.toml")
    config = read_config(tmp_path / "mine.toml")
    assert config.tip["material"] == mine and config.tip["material"].polarizability is None
    assert config.tip["apex_radius"] == pytest.approx(start.simulated_radius)


def test_a_pipe_in_the_place_of_the_settings_is_refused(found, tmp_path, monkeypatch, capsys):
    from apt_evap.fit.start_settings import is_start

    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(ae.FileError, match="regular file"):
        is_start(tmp_path / "pipe.toml")
    for mark in ("1,2,1e400,0,0", "1,2,nan,0,0", "1,2,0.5,0,0"):
        assert main(["index", "none.npz", "--element", "W", "--pole", mark]) == 2
        assert "--pole" in capsys.readouterr().err


@pytest.mark.slow
def test_a_twin_is_made_from_a_file_and_continues(found, tmp_path, monkeypatch, capsys):
    _, indexing = found
    monkeypatch.chdir(tmp_path)
    np.savez(
        "measured.npz", values=indexing.map.values, x_edges_mm=indexing.map.x_edges, y_edges_mm=indexing.map.y_edges,
        mask=indexing.map.mask,
    )  # fmt: skip
    arguments = ["twin", "measured.npz", "--element", "Ni", "--scales", "56,64", "--minutes", "0.6", "-o", "twin"]
    assert main(arguments) == 0
    first = capsys.readouterr().out
    assert "radius: not known" in first and "report.html" in first
    runs = (tmp_path / "twin" / "run.h5").read_bytes()
    assert main(arguments) == 0  # nothing is repeated
    assert (tmp_path / "twin" / "run.h5").read_bytes() == runs
    assert "nothing to do" in capsys.readouterr().out
