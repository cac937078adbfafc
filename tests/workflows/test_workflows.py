"""Workflows from Python: they make what the commands make."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rough import ROUGH

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.io import measured_file
from apt_evap.plot.report.html_page import read_report
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.warnings import WorkflowWarning
from apt_evap.workflows import compare_maps

SMALL = """
[tip]
material = "Ni"
apex_radius = "6 a"
axis = [1, 1, 1]
[simulation]
ions = 40
"""
NO_PICTURES = pytest.mark.usefixtures("blank_pictures")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.toml").write_text(SMALL)
    return tmp_path


@NO_PICTURES
def test_a_simulated_file_is_that_of_the_command(folder, capsys):
    assert main(["run", "small.toml", "-o", "shell.h5", "--seed", "3"]) == 0
    told = capsys.readouterr().out.splitlines()
    lines, seen = [], []
    simulated = ae.simulate(
        "small.toml", "mine.h5", seed=3, threads=2, note=lines.append, progress=lambda *numbers: seen.append(numbers)
    )
    assert simulated.run.fingerprint() == ae.load("shell.h5").fingerprint() == ae.load("mine.h5").fingerprint()
    assert (simulated.path, simulated.picture) == (Path("mine.h5"), Path("mine.png")) and simulated.picture.exists()
    assert seen[0] == (0, 40) and seen[-1][1] == 40
    assert [line.replace("mine", "shell") for line in lines if "ions/s" not in line] == [
        line for line in told if "ions/s" not in line
    ]
    assert simulated.run.fingerprint() in simulated._repr_html_()
    assert capsys.readouterr().out == ""


@NO_PICTURES
def test_a_simulated_file_is_extended_and_nobody_elses_is_replaced(folder):
    first = ae.simulate("small.toml", ions=20, progress=False)
    assert len(first.run) == 20 and not first.interrupted
    longer = ae.simulate("small.toml", resume=True, progress=False)
    assert len(longer.run) == 40 and np.array_equal(longer.run.site[:20], first.run.site)
    again = ae.simulate("small.toml", resume=True, progress=False)
    assert again.picture is None and again.run.fingerprint() == longer.run.fingerprint()
    Path("small.h5").write_text("precious")
    with pytest.raises(ae.FileError, match="overwrite=True"):
        ae.simulate("small.toml", progress=False)
    assert Path("small.h5").read_text() == "precious"
    assert len(ae.simulate("small.toml", overwrite=True, ions=5, progress=False).run) == 5


@NO_PICTURES
@pytest.mark.filterwarnings("error")
def test_a_simulation_ends_when_its_time_is_over(folder):
    lines = []
    ended = ae.simulate("small.toml", ions=600, seconds=0, progress=False, note=lines.append)
    assert ended.run.ended == StopReason.TIME_OVER and not ended.interrupted
    assert 0 < len(ended.run) < 600 and lines[0] == "at most 600 ions, as many as the time allows"
    assert ae.load("small.h5").fingerprint() == ended.run.fingerprint()


@pytest.mark.slow
def test_a_finished_run_without_its_picture_gets_it(folder):
    """The same command gives the same files, wherever it was killed."""
    first = ae.simulate("small.toml", ions=20, progress=False)
    picture = first.picture.read_bytes()
    first.picture.unlink()
    again = ae.simulate("small.toml", ions=20, resume=True, progress=False)
    assert again.picture.read_bytes() == picture and len(again.run) == 20
    assert ae.simulate("small.toml", ions=20, resume=True, progress=False).picture is None


@NO_PICTURES
def test_what_to_know_about_a_run_is_a_warning(folder):
    Path("small.toml").write_text(SMALL + "responses = false\n[responses]\nheight = 0.1\n[detector]\nwidth = 300\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ae.simulate("small.toml", ions=10, progress=False)
    texts = [str(warning.message) for warning in caught if warning.category is WorkflowWarning]
    assert "the table [responses] is not used" in texts[0]
    assert all(warning.filename == __file__ for warning in caught)


@pytest.mark.parametrize("options", [[], ["--ions", "5"]])
def test_a_table_that_is_a_number_is_one_sentence(folder, capsys, options):
    Path("wrong.toml").write_text("simulation = 3\n[tip]\nmaterial = 'Ni'\napex_radius = 3.0\n")
    assert main(["run", "wrong.toml", *options]) == 2
    assert "'wrong.toml': [simulation] must be a table" in capsys.readouterr().err


@pytest.fixture(scope="session")
def pair(small_tip, made_once):
    """A run, and what would have been measured of the same ions with other random numbers."""
    run = made_once(small_tip, 2000, seed=1, **ROUGH)[:1000]
    hits = replace(run, seed=2).hits(ae.RollUp(ae.TruncatedNormal(0.2, 0.1))).within_circle(60.0)
    return run, hits.map(bins=24, extent=(-60, 60, -60, 60))


def save_map(path, measured):
    edges = {"x_edges_mm": measured.x_edges, "y_edges_mm": measured.y_edges}
    np.savez(path, counts=measured.counts, **edges, inside=measured.mask)


GRID = ae.fit.EnergyGrid(means=(0.1, 0.2), relative_spreads=(0.5, 1.0))
QUICK = ae.fit.FitSettings(replicas=1, resamples=2)
HERE = ae.Registration(0.0, 1.0, (0.0, 0.0))


@pytest.mark.slow
@NO_PICTURES
def test_a_comparison_is_that_of_the_command(folder, pair, capsys):
    run, measured = pair
    run.save("run.h5")
    save_map("map.npz", measured)
    options = "--means 0.1,0.2 --relative-spreads 0.5,1 --replicas 1 --resamples 2 --registration 0,1,0,0".split()
    assert main(["compare", "run.h5", "map.npz", "-o", "shell", *options]) == 0
    told, lines = capsys.readouterr().out, []
    study = ae.compare("run.h5", "map.npz", "mine", GRID, QUICK, registration=HERE, note=lines.append, progress=False)
    assert "\n".join(lines).replace("mine", "shell") + "\n" == told
    contents = [json.loads(Path(name, "study.json").read_text()) for name in ("shell", "mine")]
    assert contents[0] == contents[1] == study.to_dict()
    names = {path.name for path in Path("shell").iterdir()}
    assert {path.name for path in Path("mine").iterdir()} == names
    origin = read_report("mine/report.html")["origin"]
    assert [described["name"] for described in origin["files"]] == ["run.h5", "map.npz"] and not origin["command"]


@pytest.mark.slow
@NO_PICTURES
def test_a_comparison_of_data_in_memory_writes_nothing_unless_it_is_asked_to(folder, pair):
    run, measured = pair
    before = sorted(Path().iterdir())
    study = ae.compare(run, measured, grid=GRID, settings=QUICK, registration=HERE, progress=False)
    assert sorted(Path().iterdir()) == before
    direct = ae.fit_energies(run, measured, GRID, QUICK, registration=HERE, progress=False)
    assert study.to_dict() == direct.to_dict()
    Path("mine").mkdir()
    Path("mine/maps.png").write_text("precious")
    with pytest.raises(ae.FileError, match="overwrite=True"):
        ae.compare(run, measured, "mine", GRID, QUICK, registration=HERE, progress=False)
    ae.compare(run, measured, "mine", GRID, QUICK, registration=HERE, progress=False, overwrite=True)
    assert Path("mine/report.html").exists() and Path("mine/maps.png").read_bytes() != b"precious"
    with pytest.raises(ValueError, match="run must have responses"):
        ae.compare(replace(run, responses=None), measured, "other")
    assert not Path("other").exists()


@pytest.mark.slow
@NO_PICTURES
def test_a_comparison_takes_what_a_simulation_returned_and_reads_nothing_twice(folder, pair, monkeypatch):
    save_map("map.npz", pair[1])
    Path("small.toml").write_text(SMALL.replace("6 a", "8 a").replace("40", "600"))
    simulated = ae.simulate("small.toml", progress=False)
    expected = ae.compare("small.h5", "map.npz", None, GRID, QUICK, registration=HERE, progress=False)
    monkeypatch.delattr(compare_maps, "load")
    monkeypatch.delattr(measured_file, "sha256_of")
    study = ae.compare(simulated, "map.npz", "mine", GRID, QUICK, registration=HERE, progress=False)
    assert study.to_dict() == expected.to_dict()
    report = read_report("mine/report.html")
    assert [described["name"] for described in report["origin"]["files"]] == ["small.h5", "map.npz"]


def test_a_sweep_is_shown_as_a_table(folder):
    Path("study.toml").write_text('base = "small.toml"\n[sweep]\n"simulation.seed" = [1, 2, 3]\n')
    shown = ae.studies.plan_sweep("study.toml")._repr_html_()
    assert "simulation.seed" in shown and "waiting" in shown and "<td>3</td>" in shown
