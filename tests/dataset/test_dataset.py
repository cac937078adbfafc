"""Data sets: their truth is that of the runs, and their bytes depend on the study alone."""

import filecmp
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from sweeps import do

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.analysis.apex import fit_caps, image_compression
from apt_evap.cli.main import main
from apt_evap.dataset.description import verify
from apt_evap.dataset.making import make, plan_set, split_of
from apt_evap.dataset.settings import DatasetSettings
from apt_evap.simulation.run import load
from apt_evap.sweep.claims import Claims

BASE = """
[tip]
material = "Al"
apex_radius = "6 a"
shank_length = "6 a"
[simulation]
ions = 150
"""
STUDY = """
base = "base.toml"
sample = 4
seed = 3
[sweep]
"tip.axis" = "random"
"tip.solutes.Cu" = { uniform = [0.01, 0.1] }
[dataset]
title = "Aluminium"
licence = "CC0-1.0"
instrument = { preset = "straight, 100 mm", field_of_view = 150.0, resolution = { uniform = [0.0, 0.2] } }
emissions = ["Unperturbed", { name = "RollUp", energy = { uniform = [0.005, 0.01] } }]
draws = 2
runs_per_file = 2
split = [0.5, 0.25, 0.25]
"""


def planned(folder, study=STUDY, base=BASE, runs=True):
    """The planned set of a study in a folder, whose runs are done if wanted."""
    folder.mkdir(exist_ok=True)
    (folder / "base.toml").write_text(base)
    (folder / "study.toml").write_text(study)
    plan = plan_set(folder / "study.toml")
    for key, state in [(point.key, state) for point, state in plan.sweep.states()]:
        if runs and state.name == "open":
            do(plan.sweep, key)
    return plan


def check_same(one, other):
    """Two folders have the same files, byte by byte."""
    names = sorted(path.name for path in one.iterdir())
    assert names == sorted(path.name for path in other.iterdir())
    assert filecmp.cmpfiles(one, other, names, shallow=False) == (names, [], [])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A plan whose runs are done, and the folder of its set."""
    folder = tmp_path_factory.mktemp("made")
    plan = planned(folder)
    make(plan, folder / "set")
    return plan, folder / "set"


def test_the_ions_are_those_that_the_instrument_records(made):
    plan, folder = made
    data = ae.dataset.load(folder)
    assert len(data) == plan.examples == 12
    for example in data:
        run = load(plan.sweep.folder_of(example.about["run"]) / "run.h5")
        point, ions = plan.sweep.by_key[example.about["run"]], example.ions
        assert example.about["settings"] == point.document
        assert example.about["fingerprint"] == run.fingerprint()
        assert len(ions["x"]) == example.about["ions"] > 20
        number = ions["number"]
        assert np.array_equal(ions["site"], run.emissions.positions[number].astype(np.float32))
        assert np.array_equal(ions["species"], run.species[number]) and example.about["elements"] == ["Al", "Cu"]
        orientation = ae.Orientation.from_settings(run.settings["tip"])
        assert np.array_equal(example.about["orientation"], orientation.matrix)
        assert np.array_equal(example.cap["radius"], run.cap.radii.astype(np.float32))
        assert 0 <= example.instrument.resolution <= 0.2 and example.instrument.efficiency == 0.8
        if example.about["emission"]["name"] == "Unperturbed":
            real = run.at_evaporation_field()
            hits = real.record(example.instrument, ae.Unperturbed(), seed=example.about["seed"])
            assert np.array_equal(ions["x"], hits.x.astype(np.float32))
            assert np.array_equal(ions["voltage"], hits.voltage.astype(np.float32))
            assert np.array_equal(ions["multiplicity"], hits.multiplicity)


def test_examples_of_a_run_differ(made):
    examples = [each for each in ae.dataset.load(made[1]) if each.about["run"] == made[0].sweep.keys[0]]
    assert [each.about["emission"]["name"] for each in examples] == ["Unperturbed", "RollUp", "RollUp"]
    energies = [each.about["emission"]["energy"]["energy"] for each in examples[1:]]
    assert energies[0] != energies[1] and all(0.005 <= energy <= 0.01 for energy in energies)
    assert len({each.about["seed"] for each in examples}) == 3


def test_the_same_bytes_in_another_folder_and_after_a_second_time(made, tmp_path):
    plan = planned(tmp_path)
    make(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "set").glob("*.h5")}
    make(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")
    assert times == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "set").glob("*.h5")}


def test_missing_files_are_made_again(made, tmp_path):
    plan = planned(tmp_path)
    make(plan, tmp_path / "set")
    (tmp_path / "set" / "SHA256SUMS").unlink()
    next((tmp_path / "set").glob("*.h5")).unlink()
    make(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")


def test_more_samples_do_not_move_the_first_ones(made, tmp_path):
    plan = planned(tmp_path, STUDY.replace("sample = 4", "sample = 40"), runs=False)
    before = {point.key: shard.split for shard in made[0].shards for point in shard.points}
    after = {point.key: shard.split for shard in plan.shards for point in shard.points}
    assert before.items() <= after.items()
    assert {shard.split for shard in plan.shards} == {"train", "validation", "test"}
    full = {shard.name: shard.key for shard in made[0].shards if len(shard.points) == 2}
    assert full and full.items() <= {shard.name: shard.key for shard in plan.shards}.items()


def test_more_samples_after_an_interruption(made, tmp_path, monkeypatch):
    """Killed when the last file is replaced, but the checksums are those of the smaller set."""
    few = planned(tmp_path)
    make(few, tmp_path / "set")
    more = planned(tmp_path, STUDY.replace("sample = 4", "sample = 8"))
    assert any(shard.name == old.name and shard.key != old.key for shard in more.shards for old in few.shards)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("apt_evap.dataset.making.finish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        make(more, tmp_path / "set")
    with pytest.raises(FileError, match="SHA256SUMS"):
        verify(tmp_path / "set")
    make(more, tmp_path / "set")
    make(more, tmp_path / "other")
    check_same(tmp_path / "set", tmp_path / "other")
    with pytest.raises(FileError, match="runs that this study does not have"):  # and fewer
        make(planned(tmp_path), tmp_path / "set")
    check_same(tmp_path / "set", tmp_path / "other")


def test_runs_of_a_specimen_are_in_one_part(tmp_path):
    study = STUDY.replace(
        "[dataset]", '"law" = [{ name = "Extremal" }, { name = "Arrhenius", temperature = 50.0 }]\n[dataset]'
    )
    plan = planned(tmp_path, study.replace("sample = 4", "sample = 30"), runs=False)
    points, settings = plan.sweep.points, plan.settings
    assert len(points) == 60 and len({split_of(point, settings) for point in points}) == 3
    for one, other in zip(points[0::2], points[1::2], strict=True):
        assert one.document["tip"] == other.document["tip"]
        assert split_of(one, settings) == split_of(other, settings)


def test_the_split_follows_its_fractions(tmp_path):
    plan = planned(tmp_path, STUDY.replace("sample = 4", "sample = 400"), runs=False)
    numbers = [sum(len(shard.points) for shard in plan.shards if shard.split == name) for name in ae.dataset.SPLITS]
    # five standard deviations of binomial numbers
    for number, fraction in zip(numbers, (0.5, 0.25, 0.25), strict=True):
        assert abs(number - 400 * fraction) < 5 * np.sqrt(400 * fraction * (1 - fraction))


def test_poles_are_where_the_ions_around_them_arrive(tmp_path):
    """Ions that start within 10 degrees of a direction arrive around the position of its pole, for both projections."""
    base = BASE.replace("ions = 150", "ions = 3000").replace("6 a", "8 a")
    study = 'base = "base.toml"\nsample = 1\n[sweep]\n"tip.axis" = [[0, 0, 1]]\n[dataset]\nsplit = [1, 0, 0]\n'
    for projection in ("plane", "equidistant"):
        instrument = f'instrument = {{ distance = 50.0, field_of_view = 80.0, projection = "{projection}" }}\n'
        plan = planned(tmp_path, study + instrument, base)
        make(plan, tmp_path / projection)
        (example,) = ae.dataset.load(tmp_path / projection)
        run = load(plan.sweep.folder_of(plan.sweep.keys[0]) / "run.h5")
        assert example.about["compression"] == pytest.approx(image_compression(run).compression, rel=1e-6)
        directions = np.empty((len(run), 3))
        for cap in fit_caps(run):
            directions[cap.first : cap.last] = run.emissions.positions[cap.first : cap.last] - cap.centre
        directions = (directions / np.linalg.norm(directions, axis=1)[:, None])[example.ions["number"]]
        poles, checked = example.poles, 0
        inner = np.hypot(poles["x"], poles["y"]) < 25.0  # so that all ions around them are recorded
        for normal, x, y in zip(poles["normal"][inner], poles["x"][inner], poles["y"][inner], strict=True):
            near = directions @ normal > np.cos(np.radians(10.0))
            # ten degrees are 9 mm; the scatter of the compression of small tips is 5 %, and the mean of 50 ions of a
            # disk of 9 mm has an error of 0.6 mm
            assert np.count_nonzero(near) > 50
            assert np.hypot(example.ions["x"][near].mean() - x, example.ions["y"][near].mean() - y) < 3.0
            checked += 1
        assert checked >= 1
        (axis,) = np.flatnonzero((example.zone_lines["indices"] == [1, 1, 0]).all(axis=1))
        x, y = example.zone_lines["x"][axis], example.zone_lines["y"][axis]
        along = example.zone_lines["direction"][axis]
        seen = np.isfinite(x)
        # the line of a zone axis across the axis of the specimen is straight through the centre
        assert seen.sum() > 10 and np.abs(x * along[0] + y * along[1])[seen].max() < 1e-4


def test_damage_is_found(made, tmp_path):
    plan = planned(tmp_path)
    make(plan, tmp_path / "set")
    verify(tmp_path / "set")
    path = next((tmp_path / "set").glob("train*.h5"))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    for use in (lambda: verify(tmp_path / "set"), lambda: make(plan, tmp_path / "set")):
        with pytest.raises(FileError, match=path.name):
            use()
    path.unlink()
    with pytest.raises(FileError, match=path.name):
        verify(tmp_path / "set")
    make(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")
    sums = (tmp_path / "set" / "SHA256SUMS").read_text().splitlines()
    for digest, name in (line.split() for line in sums):
        assert hashlib.sha256((tmp_path / "set" / name).read_bytes()).hexdigest() == digest


def test_runs_that_fail_are_named_or_left_out(tmp_path):
    plan = planned(tmp_path)
    key = plan.sweep.keys[0]
    folder = plan.sweep.folder_of(key)
    (folder / "run.h5").unlink()
    claims = Claims(folder)
    claims.end(claims.take(len(claims.all()), 0), code=2, seconds=1.0, ions=0, message="too few atoms")
    with pytest.raises(FileError, match=key):
        make(plan, tmp_path / "set")
    content = make(plan, tmp_path / "set", without_failed=True)
    assert list(content["left_out"]) == [key]
    assert key in (tmp_path / "set" / "README.md").read_text()
    assert key not in ae.dataset.load(tmp_path / "set").table("examples")["run"]
    assert make(plan, tmp_path / "set", without_failed=True) == content


def test_tables_and_parts(made):
    data = ae.dataset.load(made[1])
    parts = [data.split(name) for name in ae.dataset.SPLITS]
    assert sum(map(len, parts)) == len(data)
    runs = [set(part.table("examples")["run"]) for part in parts]
    assert sum(map(len, runs)) == len(set().union(*runs)) == 4
    for part in (data, *parts):
        examples, ions = part.table("examples"), part.table("ions")
        for number, example in enumerate(part):
            own = ions["example"] == number
            assert np.flatnonzero(own)[0] == examples["first_ion"][number]
            assert np.array_equal(ions["site"][own], example.ions["site"])
            assert np.array_equal(part.table("poles")["x"][part.table("poles")["example"] == number],
                                  example.poles["x"], equal_nan=True)  # fmt: skip
    assert data[-1].about["name"] == data[len(data) - 1].about["name"]
    with pytest.raises(IndexError):
        data[len(data)]
    assert len(data[0].hits.map(bins=16).values) == 16


def test_only_the_chosen_fields(tmp_path):
    plan = planned(tmp_path, STUDY + 'fields = ["y", "x", "poles"]\n')
    make(plan, tmp_path / "set")
    example = ae.dataset.load(tmp_path / "set")[0]
    assert list(example.ions) == ["x", "y"] and not example.cap and len(example.poles["x"])


def test_data_frames(made):
    pandas = pytest.importorskip("pandas")
    data = ae.dataset.load(made[1])
    frame, table = data.frame("ions"), data.table("ions")
    assert isinstance(frame, pandas.DataFrame) and np.array_equal(frame["site_2"], table["site"][:, 2])
    assert data.frame("examples")["orientation_8"][0] == data[0].about["orientation"][2, 2]
    assert frame.attrs["units"]["x"] == "mm"


def test_xarray(made):
    pytest.importorskip("xarray")
    data = ae.dataset.load(made[1])
    dataset = data.to_xarray()
    assert np.array_equal(dataset["ions_x"], data.table("ions")["x"]) and dataset["ions_x"].attrs["units"] == "mm"
    assert dataset["poles_normal"].shape == (len(data.table("poles")["x"]), 3)


def test_parquet_has_the_same_content(made, tmp_path):
    pytest.importorskip("pyarrow")
    plan = planned(tmp_path, STUDY.replace("draws", 'format = "parquet"\ndraws'))
    for name in ("set", "again"):
        make(plan, tmp_path / name)
    check_same(tmp_path / "set", tmp_path / "again")
    one, other = ae.dataset.load(made[1]), ae.dataset.load(tmp_path / "set")
    for name in one.schema:
        for column, values in one.table(name).items():
            same = other.table(name)[column]
            assert same.dtype == values.dtype
            np.testing.assert_array_equal(same, values)
    np.testing.assert_array_equal(one[5].ions["site"], other[5].ions["site"])


def test_pytorch_reads_a_set(made, monkeypatch):
    """The Dataset of the page on data sets, in batches."""
    torch = pytest.importorskip("torch")
    page = (Path(__file__).parents[2] / "docs" / "howto" / "data_set.rst").read_text()
    lines = page[page.index("    def torch_dataset") :].split("\nWhat to observe")[0].splitlines()
    names = {}
    exec("\n".join(line[4:] for line in lines), names)
    data = ae.dataset.load(made[1])
    maps = names["torch_dataset"](data, bins=32)
    loaded = list(torch.utils.data.DataLoader(maps, batch_size=5))
    assert [len(batch) for batch, _ in loaded] == [5, 5, 2] and loaded[0][0].shape == (5, 32, 32)
    assert loaded[0][0][0].sum() == data[0].about["ions"]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("runs = 3", "runs"),
        ('fields = ["z"]', "fields"),
        ("emissions = []", "emissions"),
        ('emissions = ["RollUpp:0.1"]', "RollUpp"),
        ('emissions = [{ name = "RollUp", energy = { uniform = [2, 1] } }]', "energy"),
        ("instrument = { efficiency = 2.0 }", "efficiency"),
        ('instrument = "LEAP"', "preset"),
        ("split = [0.5, 0.5, 0.5]", "split"),
        ('format = "csv"', "format"),
    ],
)
def test_mistakes_name_the_setting(tmp_path, text, name):
    study = 'base = "base.toml"\nsample = 1\n[sweep]\n"tip.axis" = "random"\n[dataset]\n'
    with pytest.raises(FileError, match=name):
        planned(tmp_path, f"{study}{text}\n", runs=False)


def test_emissions_need_responses(tmp_path):
    with pytest.raises(FileError, match="responses"):
        planned(tmp_path, base=BASE + "responses = false\n", runs=False)


def test_settings_come_back():
    settings = DatasetSettings(emissions=["Unperturbed"], draws=4)
    assert settings.per_run == 1  # nothing is drawn


# ---- the command ---------------------------------------------------------------------------------------------------


def test_the_command_foretells_makes_and_verifies(made, tmp_path, capsys):
    plan = planned(tmp_path)
    assert main(["dataset", str(tmp_path / "study.toml"), "--plan", "--json"]) == 0
    foretold = json.loads(capsys.readouterr().out)
    assert foretold["examples"] == 12 and not (tmp_path / "study_set").exists()
    assert main(["dataset", str(tmp_path / "study.toml")]) == 0
    check_same(made[1], tmp_path / "study_set")
    size = sum(shard["bytes"] for shard in ae.dataset.load(made[1]).shards)
    ions = sum(shard["ions"] for shard in ae.dataset.load(made[1]).shards)
    per_ion = sum(field.bytes for field in plan.schema["ions"])
    assert ions * per_ion < size < foretold["bytes"] < 5 * size  # a fifth of the ions is recorded at least
    capsys.readouterr()
    assert main(["dataset", str(tmp_path / "study_set"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["counts"]["train"]["examples"] > 0
    (tmp_path / "study_set" / "README.md").write_text("")
    assert main(["dataset", str(tmp_path / "study_set")]) == 2


def started(study, folder):
    """The command in a process of its own."""
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; from apt_evap.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "dataset", str(study), "-o", str(folder), "--quiet"]
    return subprocess.Popen(command, stderr=subprocess.PIPE)


def finished(process):
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()


def test_a_killed_set_has_the_same_bytes(made, tmp_path):
    """Killed while the second run evaporates, when the first one is done."""
    planned(tmp_path, runs=False)
    process = started(tmp_path / "study.toml", tmp_path / "set")
    while not list((tmp_path / "study" / "points").glob("*/run.h5")):
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert not (tmp_path / "set" / "SHA256SUMS").exists()
    finished(started(tmp_path / "study.toml", tmp_path / "set"))
    check_same(made[1], tmp_path / "set")


@pytest.mark.slow
def test_a_set_that_is_killed_often_has_the_same_bytes(made, tmp_path):
    """Killed at random times, also while files are written."""
    random = np.random.default_rng(1)
    planned(tmp_path, runs=False)
    killed = 0
    while True:
        process = started(tmp_path / "study.toml", tmp_path / "set")
        try:
            process.communicate(timeout=random.uniform(1.0, 6.0) + 0.2 * killed)
            break
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
            killed += 1
    assert process.returncode == 0 and killed
    leftovers = [path for path in (tmp_path / "set").iterdir() if path.name.endswith(".part")]
    for path in leftovers:  # of a process that was killed while it wrote
        path.unlink()
    check_same(made[1], tmp_path / "set")
