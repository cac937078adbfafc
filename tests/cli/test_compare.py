"""`apt-evap compare`: what it writes, what it takes, what it refuses."""

import csv
import hashlib
import json
import os
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fits import fit_energies
from matplotlib.image import imread
from rough import ROUGH
from systems import MODES, PIPES

import apt_evap as ae
from apt_evap._common.codec import for_json
from apt_evap.cli.compare import _measured
from apt_evap.cli.main import main
from apt_evap.cli.parser import make_parser
from apt_evap.plot.report.html_page import read_report

ROLLUP = ae.RollUp(ae.TruncatedNormal(0.2, 0.1))
FILES = {"study.json", "scores.csv", "scores.png", "maps.png", "registration.png", "report.html"}
QUICK = ["--means", "0.1,0.2,0.3", "--relative-spreads", "0.5,1", "--replicas", "1", "--resamples", "4", "--bins", "24"]
HERE = ["--registration", "0,1,0,0"]
NO_PICTURES = pytest.mark.usefixtures("blank_pictures")


@pytest.fixture(scope="session")
def made(small_tip, made_once, tmp_path_factory):
    """A run, and what would have been measured of the same ions with other random numbers: ions, a map, a run."""
    folder = tmp_path_factory.mktemp("made")
    run = made_once(small_tip, 2000, seed=1, **ROUGH)
    other = replace(run, seed=2)
    run.save(folder / "run.h5")
    other.save(folder / "other.h5")
    hits = other.hits(ROLLUP).within_circle(60.0)
    ae.write(folder / "ions.epos", ae.Hits(x=hits.x, y=hits.y, mass_to_charge=hits.mass_to_charge))
    map = hits.map(bins=48, extent=(-60, 60, -60, 60))
    edges = {"x_edges_cm": map.x_edges / 10, "y_edges_cm": map.y_edges / 10}
    np.savez(folder / "map.npz", counts=map.counts, **edges, inside=map.mask)
    return folder


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in made.iterdir():
        os.link(path, tmp_path / path.name)
    return tmp_path


def failed(capsys, *arguments):
    """The sentence of a command that fails and leaves nothing behind; what a reader warns of may go before."""
    before = sorted(str(path) for path in Path().rglob("*"))
    assert main(["compare", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and re.fullmatch(r"(apt-evap: warning: [^\n]+\n)*apt-evap: error: [^\n]+\n", err)
    assert sorted(str(path) for path in Path().rglob("*")) == before
    return err.replace(os.sep, "/")


@pytest.mark.slow
@MODES
@NO_PICTURES
def test_files_that_are_overwritten_keep_their_modes(folder):
    arguments = ["compare", "run.h5", "map.npz", "-o", "study", *QUICK, *HERE, "--quiet"]
    assert main(arguments) == 0
    for name in FILES:
        (folder / "study" / name).chmod(0o640)
    assert main(arguments) == 0
    assert {path.stat().st_mode & 0o777 for path in (folder / "study").iterdir()} == {0o640}


@PIPES
def test_a_pipe_is_no_registration_and_no_study(folder, capsys):
    os.mkfifo("pipe.json")
    err = failed(capsys, "run.h5", "map.npz", *QUICK, "--registration", "pipe.json")
    assert "cannot read 'pipe.json': Not a regular file" in err
    Path("study").mkdir()
    os.mkfifo("study/study.json")
    assert "Not a regular file" in failed(capsys, "run.h5", "map.npz", "-o", "study", *QUICK, *HERE)


def test_everything_is_written(folder, capsys, rough_layout):
    assert main(["compare", "run.h5", "map.npz", "-o", "study", *QUICK, *HERE]) == 0
    out, _ = capsys.readouterr()
    first, *_, last = out.splitlines()
    assert len(out.splitlines()) <= 4
    assert "alike" in first and "no energy" in first and "to study" in last  # of few ions
    assert json.loads(Path("study/study.json").read_text())["likeness"]["verdict"] in first
    assert {path.name for path in Path("study").iterdir()} == FILES
    held = json.loads(Path("study/study.json").read_text())
    assert np.shape(held["scores"]) == (1, 2, 3)
    assert held["settings"]["replicas"] == 1 and held["settings"]["map_bins"] == [24, 24]
    with open("study/scores.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["score"]) for row in rows] == pytest.approx(np.ravel(held["scores"]), rel=1e-5)
    assert [float(row["mean_eV"]) for row in rows] == [0.1, 0.2, 0.3] * 2
    for name in FILES:
        if name.endswith(".png"):
            assert imread(f"study/{name}")[..., :3].std() > 0.05
    report = read_report("study/report.html")
    assert report["study"] == held
    assert report["origin"]["command"] == shlex.join(
        ["apt-evap", "compare", "run.h5", "map.npz", "-o", "study", *QUICK, *HERE]
    )
    sums = [(name, hashlib.sha256(Path(name).read_bytes()).hexdigest()) for name in ("run.h5", "map.npz")]
    assert [(each["name"], each["sha256"]) for each in report["origin"]["files"]] == sums
    # it is what Python gives
    study = fit_energies(
        ae.load("run.h5"), ae.io.read_map("map.npz"), means=(0.1, 0.2, 0.3), relative_spreads=(0.5, 1),
        replicas=1, resamples=4, bins=24, registration=ae.Registration(0, 1, (0, 0)), progress=False,
    )  # fmt: skip
    assert held == study.to_dict()


@pytest.mark.slow
@NO_PICTURES
def test_a_folder_of_its_own_is_written_again(folder, capsys):
    arguments = ["compare", "run.h5", "map.npz", "-o", "study", *QUICK, *HERE, "--quiet"]
    assert main(arguments) == 0
    Path("study/notes.txt").write_text("mine")
    Path("study/maps.png").unlink()
    assert main([*arguments, "--seed", "5"]) == 0
    assert capsys.readouterr() == ("", "")
    assert {path.name for path in Path("study").iterdir()} == FILES | {"notes.txt"}
    assert json.loads(Path("study/study.json").read_text())["settings"]["seed"] == 5


@NO_PICTURES
def test_files_of_others_are_kept(folder, capsys):
    Path("study").mkdir()
    Path("study/maps.png").write_bytes(b"mine")
    arguments = ["run.h5", "map.npz", "-o", "study", *QUICK, *HERE]
    assert "study/maps.png' exists and was not made by apt-evap: --force overwrites it" in failed(capsys, *arguments)
    assert Path("study/maps.png").read_bytes() == b"mine"
    assert main(["compare", *arguments, "--force", "--quiet"]) == 0
    assert Path("study/maps.png").read_bytes() != b"mine"
    Path("file").touch()
    for force in ([], ["--force"]):
        assert "'file'" in failed(capsys, "run.h5", "map.npz", "-o", "file", *force)
    assert "cannot write 'none/study'" in failed(capsys, "run.h5", "map.npz", "-o", "none/study")


@pytest.mark.slow
@NO_PICTURES
def test_ions_and_runs_are_taken_too(folder):
    hits = ae.load("other.h5").hits(ROLLUP).within_circle(60.0)
    masses = 26.98 * np.random.default_rng(1).normal(1, 4e-4, len(hits))
    ae.write("ions.epos", ae.Hits(x=hits.x, y=hits.y, mass_to_charge=masses))
    selected = ["--mass", "20,30"]  # for the map only
    assert main(["compare", "run.h5", "ions.epos", *QUICK, *HERE, "--quiet", "--mechanism", "lateral", *selected]) == 0
    report = Path("ions_study/report.html").read_text()
    section = report[report.index("<summary>Composition") :]
    assert "<th>Al</th><td>100.00" in section and "unexplained: 0.0%" in section
    held = json.loads(Path("ions_study/study.json").read_text())
    assert held["grid"]["mechanism"] == "lateral" and held["ceiling"] is not None
    arguments = ["run.h5", "other.h5", *QUICK, *HERE, "--quiet", "-o", "again"]
    assert main(["compare", *arguments, "--perturbation", "RollUp:0.2,0.1"]) == 0
    assert "RollUp" in json.loads(Path("again/study.json").read_text())["settings"]["measured"]
    assert "<summary>Composition" not in Path("again/report.html").read_text()


@pytest.mark.slow
@NO_PICTURES
def test_a_registration_from_a_file(folder, capsys):
    turned = ae.Registration(20.0, 0.9, (1.0, -2.0), True)
    Path("r.json").write_text(json.dumps(for_json(turned)))
    arguments = ["compare", "run.h5", "map.npz", *QUICK, "--quiet"]
    assert main([*arguments, "-o", "first", "--registration", "r.json"]) == 0
    assert main([*arguments, "-o", "second", "--registration", "first/study.json"]) == 0
    assert main([*arguments, "-o", "third", "--registration", "20,0.9,1,-2,mirror"]) == 0
    held = [json.loads(Path(name, "study.json").read_text()) for name in ("first", "second", "third")]
    assert held[0] == held[1] == held[2]
    assert held[0]["registration"] == for_json(turned) | {"doubtful": False}
    Path("bad.json").write_text("[]")
    assert "'bad.json' does not contain a registration" in failed(
        capsys, "run.h5", "map.npz", "--registration", "bad.json"
    )


@pytest.mark.slow
@NO_PICTURES
def test_arrays_by_name(folder, capsys):
    with np.load("map.npz") as held:
        renamed = {"n": held["counts"], "a": held["x_edges_cm"], "b": held["y_edges_cm"]}
    np.savez("named.npz", **renamed)
    arguments = ["run.h5", "named.npz", *QUICK, *HERE, "--quiet"]
    assert "named.npz' must contain exactly one array for the edges" in failed(capsys, *arguments)
    assert main(["compare", *arguments, "--arrays", "n,a,b", "--unit", "cm"]) == 0
    assert json.loads(Path("named_study/study.json").read_text())["settings"]["measured_noise"] == "not known"


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["run.h5"], "the following arguments are required: MEASURED"),
        (["run.h5", "map.npz", "--means", "a"], "--means: must be numbers separated by commas, got 'a'"),
        (["run.h5", "map.npz", "--means", "0.2,0.1"], "means must be increasing numbers"),
        (["run.h5", "map.npz", "--mechanism", "both"], "invalid choice: 'both'"),
        (["run.h5", "map.npz", "--mechanism", "rollup"], "invalid choice: 'rollup' (did you mean 'roll-up'?)"),
        (["run.h5", "map.npz", "--rollup-fractions", "0.5"], "rollup_fractions are only for the mechanism 'combined'"),
        (["run.h5", "map.npz", "--registration", "1,2"], "--registration must be a .json file or ROTATION,SCALE"),
        (["run.h5", "map.npz", "--registration", "0,-1,0,0"], "scale must be a finite number > 0"),
        (["run.h5", "map.npz", "--temperature", "0"], "temperature must be a finite number [K] > 0"),
        (["run.h5", "map.npz", "--arrays", "counts"], "--arrays must name values, edges in x and y"),
        (["run.h5", "ions.epos", "--arrays", "a,b,c"], "--arrays is for a map in an .npz file, got 'ions.epos'"),
        (["run.h5", "other.h5"], "'other.h5' is a run: its ions need --perturbation"),
        (["run.h5", "ions.epos", "--perturbation", "Unperturbed"], "'ions.epos' contains measured ions"),
        (["run.h5", "none.epos"], "cannot read 'none.epos'"),
        (["ions.epos", "map.npz"], "'ions.epos'"),
    ],
)
def test_what_is_refused(folder, capsys, arguments, sentence):
    assert sentence in failed(capsys, *arguments, *([] if "--registration" in arguments else HERE))


@pytest.mark.slow
@NO_PICTURES
def test_measured_ions_are_selected(folder, capsys):
    arguments = ["run.h5", "ions.epos", *QUICK, *HERE, "--quiet"]
    assert main(["compare", *arguments, "-o", "all"]) == 0
    assert main(["compare", *arguments, "-o", "part", "--circle", "40"]) == 0
    held = [json.loads(Path(name, "study.json").read_text())["settings"]["measured"] for name in ("all", "part")]
    assert held[0] != held[1]
    assert "--voltage: ions.epos has no column 'voltage'" in failed(capsys, *arguments, "--voltage", "1,2")
    assert "--ions is for ions, got 'map.npz'" in failed(capsys, "run.h5", "map.npz", *HERE, "--ions", "0,5")


def test_a_run_without_responses_is_refused(folder, small_tip, capsys):
    ae.Simulation(small_tip).run(50, responses=False, progress=False).save("nr.h5")
    sentence = "'nr.h5' must have responses, got <Run: 50 ions"
    assert sentence in failed(capsys, "nr.h5", "map.npz", *HERE)


def test_help(capsys):
    assert main(["compare", "--help"]) == 0
    assert "example: apt-evap compare" in capsys.readouterr().out


@pytest.mark.slow
@NO_PICTURES
def test_a_doubtful_registration_is_told_once_and_kept(folder, capsys):
    """A map of the same ions turned by random angles: it lies on the run, and has none of its lines."""
    hits = ae.load("other.h5").hits(ROLLUP).within_circle(60.0)
    radius = np.hypot(hits.x, hits.y)
    for seed in range(1, 9):  # a search without lines may leave little in common, and then ends with a sentence
        angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(radius))
        map = replace(hits, x=radius * np.cos(angle), y=radius * np.sin(angle)).map(bins=40, extent=(-60, 60, -60, 60))
        np.savez("noise.npz", counts=map.counts, x_edges_cm=map.x_edges / 10, y_edges_cm=map.y_edges / 10)
        failure = main(["compare", "run.h5", "noise.npz", "-o", "noise", *QUICK])
        out, err = capsys.readouterr()
        if not failure:
            break
        assert "common region of both maps" in err and not Path("noise").exists()
    assert not failure
    assert "registration" not in err and out.count("the registration, correlation") == 1
    assert "registration.png, --registration sets" in out
    told = read_report("noise/report.html")["origin"]["warnings"]
    assert not any("registration" in text for text in told)  # the report has a sentence of its own
    assert Path("noise/report.html").read_text().count("The registration is doubtful") == 1
    assert json.loads(Path("noise/study.json").read_text())["registration"]["doubtful"] is True
    assert main(["compare", "run.h5", "noise.npz", "-o", "given", *QUICK, *HERE]) == 0
    assert "the registration, correlation" not in capsys.readouterr().out


def test_a_registration_without_common_hits_is_refused(folder, capsys):
    away = ["--registration=0,1,5000,0"]
    assert "registration" in failed(capsys, "run.h5", "map.npz", "-o", "away", *QUICK, *away)


def test_masses_follow_from_the_times_of_flight(monkeypatch):
    """With --distance, --mass selects ions of a file that has times of flight only, as in the other commands."""
    rng, n = np.random.default_rng(1), 4000
    x, y = rng.uniform(-20, 20, (2, n))
    time = np.where(rng.random(n) < 0.25, 500.0, 700.0)
    hits = ae.Hits(x=x, y=y, time_of_flight=time, voltage=np.full(n, 5000.0))
    monkeypatch.setattr("apt_evap.cli._files.read", lambda options: hits)
    masses = hits.with_masses(90.0, 1.0).mass_to_charge
    words = ["compare", "run.h5", "ions.raw", "--distance", "90", "--t0", "1"]
    bounds = f"--mass={masses[time < 600].min() - 0.01},{masses[time < 600].max() + 0.01}"
    selected = _measured(make_parser("compare").parse_args([*words, bounds]))
    assert len(selected) == np.count_nonzero(time < 600)
