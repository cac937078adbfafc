"""The scorer of the benchmark against answers whose errors are known, and what its generator gives away."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import apt_evap as ae

FOLDER = Path(__file__).parents[2] / "benchmarks" / "ground_truth"
ANSWERS = {
    "apex radius": 8.0, "compression": 1.05, "number": 0.0, "axis": [0.6, 0.0, -0.8], "Cu of matrix": 2.0,
    "thickness": 0.5,
}  # fmt: skip


def module(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


score = module("score")


@pytest.fixture
def truth(tmp_path):
    (tmp_path / "truth").mkdir()
    sites = np.random.default_rng(1).normal(size=(500, 3))
    for name, withheld in (("one", False), ("two", True)):
        with h5py.File(tmp_path / "truth" / f"{name}.h5", "w") as file:
            file["positions"] = sites
            file.attrs["answers"], file.attrs["withheld"] = json.dumps(ANSWERS), withheld
    return tmp_path, sites


def errors_of(folder, answers):
    rows = score.score(folder / "truth", folder / answers)
    return {(row[0], row[3] if row[2] not in ("lateral", "depth") else row[2]): row[4:] for row in rows}


def test_errors_are_those_that_were_put_in_from_csv_and_h5(truth):
    folder, sites = truth
    (folder / "mine").mkdir()
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    shifted = sites @ turn.T + (3.0, -2.0, 7.0)  # neither a shift nor a turn about the axis counts
    shifted[::2, 2] += 0.2
    shifted[1::2, 2] -= 0.2
    shifted[3] = np.nan
    values = {
        "apex radius": (8.8, 0.5), "compression": (1.05, 0.0), "number": (2.0, 1.0), "axis h": (0.0, np.nan),
        "axis k": (8.0, np.nan), "axis l": (6.0, np.nan), "Cu of matrix": (2.5, 0.1),
    }  # fmt: skip
    lines = [f"{name},{value},{error if np.isfinite(error) else ''}" for name, (value, error) in values.items()]
    (folder / "mine" / "one.csv").write_text("quantity,value,error\n" + "\n".join(lines))
    np.savetxt(folder / "mine" / "one_positions.csv", shifted, delimiter=",", header="x,y,z", comments="")
    with h5py.File(folder / "mine" / "two.h5", "w") as file:
        for name, (value, error) in values.items():
            file[name] = [value, error]
        file["positions"] = shifted
    found = errors_of(folder, "mine")
    for name in ("one", "two"):
        assert found[name, "apex radius"] == (pytest.approx(10.0), 1.0)
        assert found[name, "compression"] == (0.0, 1.0)  # an error of 0 is stated, and held here
        assert found[name, "number"] == (2.0, 0.0)
        assert found[name, "axis"][0] == pytest.approx(0.0, abs=1e-6)  # an equivalent direction
        assert found[name, "Cu of matrix"] == (0.5, 0.0)
        assert np.isnan(found[name, "thickness"][0])
        assert found[name, "lateral"][0] < 0.02 and found[name, "depth"][0] == pytest.approx(0.2, abs=0.01)
    lines = {
        (line["withheld"], line["task"]): line for line in score.summary(score.score(folder / "truth", folder / "mine"))
    }
    line = lines[False, "number"]
    assert (line["asked"], line["answered"], line["held"], line["stated"]) == (1, 1, 0, 1)
    line = lines[False, "structure"]
    assert (line["asked"], line["answered"], line["stated"]) == (1, 0, 0)
    assert lines[True, "constants"]["median"] == pytest.approx(5.0)


def test_a_tilted_or_mirrored_or_stretched_volume_is_wrong(truth):
    _, sites = truth
    tilt = np.radians(5)
    tilted = sites @ np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    assert score.position_errors(tilted, sites)[1] == pytest.approx(np.sin(tilt), rel=0.1)
    assert score.position_errors(sites * (1, 1, -1), sites)[1] == pytest.approx(2.0, rel=0.1)
    assert score.position_errors(sites * (1.1, 1.1, 1), sites)[0] == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert np.isnan(score.position_errors(np.full_like(sites, np.nan), sites)).all()
    assert score.axis_angle(np.array([0, 1, 1]), np.array([0, 0, 1])) == pytest.approx(45)


def test_answers_of_nothing_score_nothing(truth):
    folder, _ = truth
    (folder / "none").mkdir()
    assert all(np.isnan(row[4]) for row in score.score(folder / "truth", folder / "none"))
    assert all(line["answered"] == 0 for line in score.summary(score.score(folder / "truth", folder / "none")))


def test_the_interval_of_a_median_covers_it():
    held = 0
    for seed in range(60):
        errors = [np.array([value]) for value in np.random.default_rng(seed).normal(3, 1, 25)]
        low, high = score.interval(errors)
        held += low <= 3 <= high
    assert 50 <= held <= 60  # of 57


def test_the_interval_of_a_median_is_that_of_medians_of_drawn_specimens():
    errors = [np.arange(k, 3.0 * k + 1) for k in (1, 4, 2, 7)]
    chosen = np.random.default_rng(0).integers(4, size=(score.DRAWS, 4))
    medians = [np.median(np.concatenate([errors[k] for k in row])) for row in chosen]
    assert score.interval(errors) == tuple(np.quantile(medians, (0.025, 0.975)))


def test_wrong_answers_are_named(truth):
    folder, _ = truth
    (folder / "bad").mkdir()
    (folder / "bad" / "one.csv").write_text("quantity,value\nnumber,many\n")
    with pytest.raises(SystemExit, match=r"one\.csv must have the columns quantity, value"):
        score.score(folder / "truth", folder / "bad")
    (folder / "bad" / "one.csv").unlink()
    (folder / "bad" / "one_positions.csv").write_text("x,y,z\n1,2,3\n")
    with pytest.raises(SystemExit, match="each of 500 ions, got 1 x 3"):
        score.score(folder / "truth", folder / "bad")


def test_the_scorer_needs_no_part_of_this_package(truth):
    folder, _ = truth
    code = f"import runpy, sys; sys.argv = ['score.py', {str(folder / 'truth')!r}, {str(folder)!r}]\n"
    code += f"try: runpy.run_path({str(FOLDER / 'score.py')!r}, run_name='__main__')\n"
    code += "except SystemExit: pass\nassert not any(name.startswith('apt_evap') for name in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("shell", ["", "Mg"])
def test_the_shares_of_a_true_ball_and_its_shell_are_found(shell):
    random = np.random.default_rng(4)
    places = 5 * random.random((6000, 3))
    around, draw = np.linalg.norm(places - 2.5, axis=1), random.random(len(places))
    element = np.where(draw < np.where(around < 1, 0.4, 0.02), "Cu", "Al")
    if shell:
        element[(around > 1) & (around < 1.4)] = np.where(draw < 0.4, "Mg", "Al")[(around > 1) & (around < 1.4)]
    cloud = ae.measures.PointCloud.of(ae.Hits(positions=places, extra={"element": element}))
    found = module("baselines").precipitates(cloud, {"solute": "Cu", "shell": shell})
    assert found["number"][0] == 1 and found["radius"][0] == pytest.approx(1.0, abs=0.1)
    assert found["Cu of phase"][0] == pytest.approx(40, abs=3 * found["Cu of phase"][1] + 3)
    assert found["Cu of matrix"][0] == pytest.approx(2, abs=0.6)
    if shell:
        assert found["shell thickness"][0] == pytest.approx(0.4, abs=0.15)  # the error of the radius enters twice
        assert found["Mg of shell"][0] == pytest.approx(40, abs=12)
        assert found["Mg of matrix"][0] < 0.5  # those of the shell are not of the matrix: 2.6 % with them


def test_draws_of_a_specimen_have_their_own_seeds_and_files(monkeypatch, tmp_path):
    generate = module("generate")
    assert [generate.seed_of("nickel", draw=draw) for draw in range(3)] == [102, 1102, 2102]
    of_iron = [generate.seed_of("iron", "a secret", draw) for draw in range(3)]
    assert len(set(of_iron)) == 3 and of_iron[0] == generate.seed_of("iron", "a secret")
    assert generate.seed_of("iron", None, 1) is None  # withheld, too
    written = []
    monkeypatch.setattr(generate, "write", lambda folder, name, secret, draw: written.append((name, draw)))
    monkeypatch.setattr(sys, "argv", ["generate.py", str(tmp_path), "nickel", "--draw", "2"])
    generate.main()
    assert written == [("nickel", 2)] and generate.file_of("nickel", 2) == "nickel_2"


@pytest.mark.slow
def test_the_generator_gives_nothing_away_and_withholds(tmp_path, capsys):
    generate = module("generate")
    generate.write(tmp_path, "iron")
    assert "withheld" in capsys.readouterr().out and not list(tmp_path.iterdir())
    assert generate.seed_of("iron", "a secret") != generate.seed_of("iron", "another")
    assert sum("seed" not in kind for kind in generate.SETTINGS["specimens"].values()) == 4
    generate.write(tmp_path, "layers", ions=12_000, draw=1)
    with h5py.File(tmp_path / "measured" / "layers_1.h5") as file:
        assert set(file) == {"x", "y", "voltage", "element"}
        given = dict(file.attrs)
        assert not {"radius", "axis", "field_factor", "seed"} & set(given)
        asked, n = json.loads(given["questions"]), len(file["x"])
    answers, sites, withheld = score.read_truth(tmp_path / "truth" / "layers_1.h5")
    assert set(answers) == set(asked) and not withheld and len(sites) == n > 1000
    assert 35 < answers["Cu of phase"] < 50 > 3 > answers["Cu of matrix"] > 1
    assert 0.5 <= answers["thickness"] <= 0.7 and 7.0 < answers["apex radius"] < 9.5


def test_the_axis_of_an_answer_is_at_the_centre_of_the_detector():
    orientation = ae.Orientation("Fe", (1, 2, 9), 20.0)
    along = np.array([1, 2, 9]) / np.sqrt(86)
    for centre, angle in (((0.0, 0.0), 0.0), ((10.8, 13.9), np.hypot(10.8, 13.9) / 97.7)):
        candidate = SimpleNamespace(orientation=orientation, projection=ae.detection.Projection(97.7, centre))
        axis = module("baselines").axis_of(candidate)
        assert np.arccos(min(1.0, axis @ along)) == pytest.approx(angle, abs=1e-7)
