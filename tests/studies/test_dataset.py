"""Data sets: their truth is that of the runs, and their bytes depend on the study alone."""

import errno
import filecmp
import hashlib
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from sweeps import do

import apt_evap as ae
from apt_evap._common.files import FileError, sha256_of
from apt_evap.cli.main import main
from apt_evap.simulation.apex import fit_caps, image_compression
from apt_evap.simulation.locks import try_lock
from apt_evap.simulation.run import load
from apt_evap.studies.dataset.dataset_settings import SPLITS, DatasetSettings
from apt_evap.studies.dataset.making import make_dataset, plan_dataset, split_of
from apt_evap.studies.dataset.set_description import verify_dataset

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


RUNS = {}  # files of runs that are done, by the keys of their points


def planned(folder, study=STUDY, base=BASE, runs=True):
    """The planned set of a study in a folder, whose runs are done if wanted."""
    folder.mkdir(exist_ok=True)
    (folder / "base.toml").write_text(base)
    (folder / "study.toml").write_text(study)
    plan = plan_dataset(folder / "study.toml")
    for key, state in [(point.key, state) for point, state in plan.sweep.states()]:
        if runs and state.name == "waiting":
            path = plan.sweep.folder_of(key) / "run.h5"
            if key in RUNS:
                path.write_bytes(RUNS[key])
            else:
                do(plan.sweep, key)
                RUNS[key] = path.read_bytes()
    return plan


def check_same(one, other):
    """Two folders have the same files, byte by byte."""
    names = sorted(path.name for path in one.iterdir())
    assert names == sorted(path.name for path in other.iterdir())
    assert filecmp.cmpfiles(one, other, names, shallow=False) == (names, [], [])


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A plan whose runs are done, and the folder of its set."""
    folder = tmp_path_factory.mktemp("made")
    plan = planned(folder)
    make_dataset(plan, folder / "set")
    return plan, folder / "set"


@pytest.mark.slow
def test_the_ions_are_those_that_the_instrument_records(made):
    plan, folder = made
    data = ae.load_dataset(folder)
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
    examples = [each for each in ae.load_dataset(made[1]) if each.about["run"] == made[0].sweep.keys[0]]
    assert [each.about["emission"]["name"] for each in examples] == ["Unperturbed", "RollUp", "RollUp"]
    energies = [each.about["emission"]["energy"] for each in examples[1:]]
    assert energies[0] != energies[1] and all(0.005 <= energy <= 0.01 for energy in energies)
    assert len({each.about["seed"] for each in examples}) == 3


def test_the_same_bytes_in_another_folder_and_after_a_second_time(made, tmp_path):
    plan = planned(tmp_path)
    make_dataset(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "set").glob("*.h5")}
    make_dataset(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")
    assert times == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "set").glob("*.h5")}


@pytest.mark.slow
def test_missing_files_are_made_again(made, tmp_path):
    plan = planned(tmp_path)
    make_dataset(plan, tmp_path / "set")
    (tmp_path / "set" / "SHA256SUMS").unlink()
    next((tmp_path / "set").glob("*.h5")).unlink()
    make_dataset(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")


def test_more_samples_do_not_move_the_first_ones(made, tmp_path):
    plan = planned(tmp_path, STUDY.replace("sample = 4", "sample = 40"), runs=False)
    before = {point.key: shard.split for shard in made[0].shards for point in shard.points}
    after = {point.key: shard.split for shard in plan.shards for point in shard.points}
    assert before.items() <= after.items()
    assert {shard.split for shard in plan.shards} == {"train", "validation", "test"}
    full = {shard.name: shard.key for shard in made[0].shards if len(shard.points) == 2}
    assert full and full.items() <= {shard.name: shard.key for shard in plan.shards}.items()


@pytest.mark.slow
def test_more_samples_after_an_interruption(made, tmp_path, monkeypatch):
    """Killed when the last file is replaced, but the checksums are those of the smaller set."""
    few = planned(tmp_path)
    make_dataset(few, tmp_path / "set")
    more = planned(tmp_path, STUDY.replace("sample = 4", "sample = 8"))
    assert any(shard.name == old.name and shard.key != old.key for shard in more.shards for old in few.shards)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("apt_evap.studies.dataset.making.finish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        make_dataset(more, tmp_path / "set")
    with pytest.raises(FileError, match="SHA256SUMS"):
        verify_dataset(tmp_path / "set")
    make_dataset(more, tmp_path / "set")
    make_dataset(more, tmp_path / "other")
    check_same(tmp_path / "set", tmp_path / "other")
    with pytest.raises(FileError, match="runs that this study does not have"):  # and fewer
        make_dataset(planned(tmp_path), tmp_path / "set")
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


@pytest.mark.slow
def test_the_split_follows_its_fractions(tmp_path):
    plan = planned(tmp_path, STUDY.replace("sample = 4", "sample = 400"), runs=False)
    numbers = [sum(len(shard.points) for shard in plan.shards if shard.split == name) for name in SPLITS]
    # five standard deviations of binomial numbers
    for number, fraction in zip(numbers, (0.5, 0.25, 0.25), strict=True):
        assert abs(number - 400 * fraction) < 5 * np.sqrt(400 * fraction * (1 - fraction))


@pytest.mark.slow
def test_poles_are_where_the_ions_around_them_arrive(tmp_path):
    """Ions that start within 10 degrees of a direction arrive around the position of its pole, for both projections."""
    base = BASE.replace("ions = 150", "ions = 3000").replace("6 a", "8 a")
    study = 'base = "base.toml"\nsample = 1\n[sweep]\n"tip.axis" = [[0, 0, 1]]\n[dataset]\nsplit = [1, 0, 0]\n'
    for projection in ("plane", "equidistant"):
        instrument = f'instrument = {{ distance = 50.0, field_of_view = 80.0, projection = "{projection}" }}\n'
        plan = planned(tmp_path, study + instrument, base)
        make_dataset(plan, tmp_path / projection)
        (example,) = ae.load_dataset(tmp_path / projection)
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
    make_dataset(plan, tmp_path / "set")
    verify_dataset(tmp_path / "set")
    path = next((tmp_path / "set").glob("train*.h5"))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    for use in (lambda: verify_dataset(tmp_path / "set"), lambda: make_dataset(plan, tmp_path / "set")):
        with pytest.raises(FileError, match=path.name):
            use()
    path.unlink()
    with pytest.raises(FileError, match=path.name):
        verify_dataset(tmp_path / "set")
    make_dataset(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")
    sums = (tmp_path / "set" / "SHA256SUMS").read_text().splitlines()
    for digest, name in (line.split() for line in sums):
        assert hashlib.sha256((tmp_path / "set" / name).read_bytes()).hexdigest() == digest


def test_runs_that_fail_are_named_or_left_out(tmp_path):
    plan = planned(tmp_path)
    key = plan.sweep.keys[0]
    folder = plan.sweep.folder_of(key)
    (folder / "run.h5").unlink()
    (folder / "work.json").write_text('{"seconds": 1.0, "error": "too few atoms"}')
    with pytest.raises(FileError, match=key):
        make_dataset(plan, tmp_path / "set")
    content = make_dataset(plan, tmp_path / "set", without_failed=True)
    assert list(content["left_out"]) == [key]
    assert key in (tmp_path / "set" / "README.md").read_text()
    assert key not in ae.load_dataset(tmp_path / "set").table("examples")["run"]
    assert make_dataset(plan, tmp_path / "set", without_failed=True) == content


@pytest.mark.slow
def test_tables_and_parts(made):
    data = ae.load_dataset(made[1])
    parts = [data.split(name) for name in SPLITS]
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


@pytest.mark.slow
def test_only_the_chosen_fields(tmp_path):
    plan = planned(tmp_path, STUDY + 'fields = ["y", "x", "poles"]\n')
    make_dataset(plan, tmp_path / "set")
    example = ae.load_dataset(tmp_path / "set")[0]
    assert list(example.ions) == ["x", "y"] and not example.cap and len(example.poles["x"])


def test_data_frames(made):
    pandas = pytest.importorskip("pandas")
    data = ae.load_dataset(made[1])
    frame, table = data.frame("ions"), data.table("ions")
    assert isinstance(frame, pandas.DataFrame) and np.array_equal(frame["site_2"], table["site"][:, 2])
    assert data.frame("examples")["orientation_8"][0] == data[0].about["orientation"][2, 2]
    assert frame.attrs["units"]["x"] == "mm"


def test_xarray(made):
    pytest.importorskip("xarray")
    data = ae.load_dataset(made[1])
    dataset = data.to_xarray()
    assert np.array_equal(dataset["ions_x"], data.table("ions")["x"]) and dataset["ions_x"].attrs["units"] == "mm"
    assert dataset["poles_normal"].shape == (len(data.table("poles")["x"]), 3)


@pytest.mark.slow
def test_parquet_has_the_same_content(made, tmp_path):
    pytest.importorskip("pyarrow")
    plan = planned(tmp_path, STUDY.replace("draws", 'format = "parquet"\ndraws'))
    for name in ("set", "again"):
        make_dataset(plan, tmp_path / name)
    check_same(tmp_path / "set", tmp_path / "again")
    one, other = ae.load_dataset(made[1]), ae.load_dataset(tmp_path / "set")
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
    data = ae.load_dataset(made[1])
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


def test_deep_tables_are_refused():
    table = {"name": "RollUp"}
    for _ in range(3000):
        table = {"a": table}
    for settings in ({"emissions": [table]}, {"instrument": table}):
        with pytest.raises(ValueError, match="hundreds of tables"):
            DatasetSettings(**settings)


def test_settings_come_back():
    settings = DatasetSettings(emissions=["Unperturbed"], draws=4)
    assert settings.per_run == 1  # nothing is drawn


# ---- wrong folders and files ---------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def other(tmp_path_factory):
    """Another data set, of another seed, with the same names of files: its plan and folder."""
    folder = tmp_path_factory.mktemp("other")
    plan = planned(folder, STUDY.replace("seed = 3", "seed = 5"))
    make_dataset(plan, folder / "set")
    return plan, folder / "set"


def replaced(target, source):
    """A data set in the place of another one."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)
    return target


def first(data):
    return data[0].about["name"], data[0].ions["x"].tolist()


@pytest.mark.slow
def test_two_sets_with_one_relative_name_are_two(made, other, tmp_path, monkeypatch):
    loaded = []
    for name, source in (("a", made[1]), ("b", other[1])):
        replaced(tmp_path / name / "set", source)
        monkeypatch.chdir(tmp_path / name)
        loaded.append(ae.load_dataset("set"))
        assert first(loaded[-1]) == first(ae.load_dataset(source))
    assert first(loaded[0]) == first(ae.load_dataset(made[1]))  # from another folder


def test_a_set_that_is_made_again_is_not_mixed_with_the_old_one(made, other, tmp_path):
    old = ae.load_dataset(replaced(tmp_path / "set", made[1]))
    assert first(old) == first(ae.load_dataset(made[1]))
    replaced(tmp_path / "set", other[1])
    for use in (lambda: old[0], lambda: old.split(old.shards[0]["split"])[0], lambda: old.table("ions")):
        with pytest.raises(FileError, match="the data set which was opened"):
            use()
    assert first(ae.load_dataset(tmp_path / "set")) == first(ae.load_dataset(other[1]))


def test_examples_are_copies(made):
    data = ae.load_dataset(made[1])
    arrays = [("about", "axis"), ("about", "orientation"), ("ions", "x"), ("poles", "x"), ("cap", "radius")]
    before = [getattr(data[0], table)[name].copy() for table, name in arrays]
    for table, name in arrays:
        getattr(data[0], table)[name][...] = 5
    for (table, name), values in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(getattr(data[0], table)[name], values)


def test_a_loaded_set_goes_to_another_process(made):
    data = ae.load_dataset(made[1])
    assert first(pickle.loads(pickle.dumps(data))) == first(data)


def flipped(path, random):
    """Flip one bit of a file."""
    content = bytearray(path.read_bytes())
    content[random.integers(len(content))] ^= 1 << int(random.integers(8))
    path.write_bytes(content)


def everything(folder):
    """All tables, and all examples."""
    data = ae.load_dataset(folder)
    tables = {f"{name} {column}": values for name in data.schema for column, values in data.table(name).items()}
    return tables | {
        f"{k} {column}": values for k, example in enumerate(data) for column, values in example.ions.items()
    }


def check_equal(one, other):
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["hdf5", "parquet"])
def test_no_flipped_bit_is_read(made, tmp_path, suffix):
    """Of 1,000 there was no other result (measured once); here a few."""
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    folder, random = tmp_path / "set", np.random.default_rng(1)
    make_dataset(planned(tmp_path, STUDY.replace("draws", f'format = "{suffix}"\ndraws')), folder)
    for path in sorted(folder.iterdir()) * 5:
        content = path.read_bytes()
        flipped(path, random)
        with pytest.raises(FileError):
            verify_dataset(folder)
        if path.name not in ("README.md", "SHA256SUMS"):  # their damage changes no example
            with pytest.raises(FileError):
                everything(folder)
        path.write_bytes(content)
    check_equal(everything(folder), everything(made[1]))


def with_right_checksums(folder):
    """Give a data set the checksums that its files have now, as whoever has made it could."""
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    names = [line.split("  ")[1] for line in lines]
    (folder / "SHA256SUMS").write_text("".join(f"{sha256_of(folder / name)}  {name}\n" for name in names))


VALUES = (None, True, -1, 3, 10**400, float("nan"), "", "../secret/x", [], {}, [[1]], {"a": 1}, 0.5, "a" * 5000)


def mutated(content, random):
    """A document with one part replaced, removed or renamed."""
    content = json.loads(json.dumps(content))
    table, depth = content, random.integers(5)
    while True:
        keys = list(table) if isinstance(table, dict) else range(len(table))
        key = keys[random.integers(len(keys))]
        if depth == 0 or not isinstance(table[key], dict | list) or not table[key]:
            break
        table, depth = table[key], depth - 1
    kind = random.integers(4)
    if kind == 0:
        del table[key]
    elif kind == 1 and isinstance(table, dict):
        table["x"] = table.pop(key)
    else:
        table[key] = VALUES[random.integers(len(VALUES))]
    return content


@pytest.mark.slow
def test_changed_descriptions_are_refused_or_change_no_ion(made, tmp_path):
    """Also with right checksums: a description of somebody else leads to no other column, file or traceback."""
    folder, random = replaced(tmp_path / "set", made[1]), np.random.default_rng(1)
    content, expected = json.loads((folder / "dataset.json").read_text()), everything(made[1])
    read = 0
    for _ in range(60):
        (folder / "dataset.json").write_text(json.dumps(mutated(content, random)))
        with_right_checksums(folder)
        try:
            check_equal(everything(folder), expected)
            read += 1
        except FileError:
            pass
    assert 0 < read < 30  # titles, studies and names of points are free
    for text in ("", "[]", "5", "[" * 100_000, "1" * 5000, '{"format": 1}', '{"format": "apt_evap dataset 2"}'):
        (folder / "dataset.json").write_text(text)
        with_right_checksums(folder)
        with pytest.raises(FileError, match=r"dataset\.json' is not the description of a data set"):
            ae.load_dataset(folder)


@pytest.mark.parametrize("what", ["name", "link", "pipe"])
def test_nothing_outside_the_folder_is_read(made, tmp_path, what):
    folder = replaced(tmp_path / "set", made[1])
    content = json.loads((folder / "dataset.json").read_text())
    shard = content["shards"][0]
    path = folder / f"{shard['name']}.h5"
    replaced(tmp_path / "secret", made[1])
    if what == "name":
        shard["name"], name = f"../secret/{shard['name']}", f"{shard['name']}.h5"
        shard["files"] = {f"../secret/{name}": shard["files"][name]}
    elif what == "link":
        with h5py.File(path) as old, h5py.File(tmp_path / "new.h5", "w") as new:
            for group in old.values():
                old.copy(group, new)
            del new["ions/x"]
            new["ions/x"] = h5py.ExternalLink(str(tmp_path / "secret" / path.name), "/ions/y")
        (tmp_path / "new.h5").replace(path)
        shard["files"] = {path.name: sha256_of(path)}
    else:
        path.unlink()
        os.mkfifo(path)
    (folder / "dataset.json").write_text(json.dumps(content))
    if what != "pipe":
        with_right_checksums(folder)
        message = "names of shards" if what == "name" else "is a link"
    else:
        (folder / "dataset.json").write_bytes((made[1] / "dataset.json").read_bytes())
        message = "Not a regular file"
    for table in ("examples", "ions"):
        with pytest.raises(FileError, match=message):
            ae.load_dataset(folder).table("ions" if what == "link" else table)


def test_a_link_in_a_set_is_not_written_through(tmp_path):
    """An unfinished set of somebody else, whose next file is a link to a file of this user."""
    plan = planned(tmp_path)
    make_dataset(plan, tmp_path / "set")
    path = next((tmp_path / "set").glob("train*.h5"))
    (tmp_path / "set" / "SHA256SUMS").unlink()
    path.unlink()
    (tmp_path / "mine").write_text("mine")
    path.symlink_to(tmp_path / "mine")
    with pytest.raises(FileError, match="is a link"):
        make_dataset(plan, tmp_path / "set")
    assert (tmp_path / "mine").read_text() == "mine"


@pytest.mark.slow
def test_a_damaged_file_of_an_unfinished_set_gets_no_new_checksum(made, tmp_path):
    plan = planned(tmp_path)
    make_dataset(plan, tmp_path / "set")
    (tmp_path / "set" / "SHA256SUMS").unlink()  # as if it was killed before its end
    path = max((tmp_path / "set").glob("*.h5"))
    flipped(path, np.random.default_rng(3))
    with pytest.raises(FileError, match=rf"{path.name}' is damaged"):
        make_dataset(plan, tmp_path / "set")
    assert not (tmp_path / "set" / "SHA256SUMS").exists()
    path.unlink()
    make_dataset(plan, tmp_path / "set")
    check_same(made[1], tmp_path / "set")


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    "names", [["README.md"], ["train-0000.h5"], ["dataset.json"], ["dataset.json", "train-0007.h5"]]
)
def test_a_folder_of_something_else_is_refused(tmp_path, names):
    plan = planned(tmp_path, runs=False)
    folder = tmp_path / "mine"
    folder.mkdir()
    for name in names:
        (folder / name).write_text('{"mine": 1}')
    before = contents(folder)
    with pytest.raises(FileError, match="mine"):
        make_dataset(plan, folder)
    assert contents(folder) == before
    with pytest.raises(FileError, match="is not a data set"):
        make_dataset(plan, tmp_path)


@pytest.mark.slow
def test_files_beside_those_of_a_set_are_left_alone(tmp_path):
    make_dataset(planned(tmp_path), tmp_path / "set")
    for name in ("notes.txt", "train-0777.h5"):
        (tmp_path / "set" / name).write_text("mine")
    more = planned(tmp_path, STUDY.replace("sample = 4", "sample = 6"))
    make_dataset(more, tmp_path / "set")
    assert [(tmp_path / "set" / name).read_text() for name in ("notes.txt", "train-0777.h5")] == ["mine", "mine"]
    new = {f"{shard.name}.h5" for shard in more.shards} - {path.name for path in (tmp_path / "set").iterdir()}
    assert not new
    (tmp_path / "set" / "train-0777.h5").unlink()


def test_a_file_in_the_place_of_a_new_one_is_not_replaced(made, tmp_path):
    folder = replaced(tmp_path / "set", made[1])
    more = planned(tmp_path, STUDY.replace("sample = 4", "sample = 12"), runs=False)
    names = {f"{shard.name}.h5" for shard in more.shards}
    (name, *_) = sorted(names - contents(folder).keys())
    (folder / name).write_text("mine")
    before = contents(folder)
    with pytest.raises(FileError, match=name):
        make_dataset(more, folder)
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("seed = 3", "seed = 4", "runs that this study does not have"),
        ("draws = 2", "draws = 3", "dataset.draws"),
        ("0.01] } }]", "0.02] } }]", "dataset.emissions"),
        ("field_of_view = 150.0", "field_of_view = 140.0", "dataset.instrument.field_of_view"),
        ("runs_per_file = 2", "runs_per_file = 4", "dataset.runs_per_file"),
        ("[0.5, 0.25, 0.25]", "[0.5, 0.5, 0.0]", "dataset.split"),
        ("draws = 2", 'draws = 2\nfields = ["x"]', "dataset.fields"),
    ],
)
@pytest.mark.parametrize("is_finished", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_set_of_another_study_is_not_replaced(made, tmp_path, old, new, word, is_finished):
    folder = replaced(tmp_path / "set", made[1])
    if not is_finished:
        (folder / "SHA256SUMS").unlink()
    before = contents(folder)
    with pytest.raises(FileError, match=f"'{folder}' .*{word}.* another folder"):
        make_dataset(planned(tmp_path, STUDY.replace(old, new), runs=False), folder)
    assert contents(folder) == before


def test_texts_of_a_set_can_change(made, tmp_path):
    folder = replaced(tmp_path / "set", made[1])
    times = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    make_dataset(planned(tmp_path, STUDY.replace('"Aluminium"', '"Aluminium 2"'), runs=False), folder)
    assert "# Aluminium 2" in (folder / "README.md").read_text() and verify_dataset(folder)["title"] == "Aluminium 2"
    assert times == {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}


@pytest.mark.slow
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_runs_that_a_disk_has_ended_are_made_again(made, tmp_path, monkeypatch, code):
    plan = planned(tmp_path)
    folder = plan.sweep.folder_of(plan.sweep.keys[0])
    (folder / "run.h5").unlink()
    real = os.replace
    calls = []

    def full(source, target, **options):
        if Path(target).name == "run.h5" and not calls:
            calls.append(target)
            raise OSError(code, os.strerror(code))
        real(source, target, **options)

    with monkeypatch.context() as patch, pytest.raises(FileError, match=os.strerror(code)):
        patch.setattr(os, "replace", full)
        make_dataset(plan, tmp_path / "set", without_failed=True)
    assert calls
    content = make_dataset(plan, tmp_path / "set", without_failed=True)
    assert not content["left_out"]
    check_same(made[1], tmp_path / "set")


@pytest.mark.slow
def test_runs_of_another_process_are_waited_for(made, tmp_path, monkeypatch):
    plan = planned(tmp_path)
    key = plan.sweep.keys[0]
    folder, notes = plan.sweep.folder_of(key), []
    run = (folder / "run.h5").rename(tmp_path / "run.h5")
    with open(folder / "lock", "w") as lock:  # as another process does
        assert try_lock(lock.fileno())

        def end(seconds):
            shutil.copy(run, folder / "run.h5")
            lock.close()

        monkeypatch.setattr("apt_evap.studies.dataset.making.time.sleep", end)
        make_dataset(plan, tmp_path / "set", note=notes.append)
    assert any("waiting for 1 runs of another process" in text for text in notes)
    check_same(made[1], tmp_path / "set")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("emissions = [{ name = 'RollUp', energy = { uniform = [0.1, 0.2] } }]\ndraws = 2000000000", "draws"),
        ("emissions = [{ name = 'RollUp', energy = { uniform = [0.1, 0.2] } }]\ndraws = 9000000", "examples"),
        (f"emissions = [{{ name = 'RollUp', energy = {{ uniform = [0, 1{'0' * 400}] }} }}]", "uniform"),
        (f"emissions = [{{ name = 'RollUp', energy = {{ log_uniform = [1, 1{'0' * 400}] }} }}]", "log_uniform"),
        (f"instrument = {{ field_of_view = {{ integer = [1, 1{'0' * 400}] }} }}", "integer"),
        ("instrument = { efficiency = { uniform = [-1e308, 1e308] } }", "uniform"),
        ("instrument = { integer = [0, 10] }", "instrument must be a table"),
        ("instrument = { uniform = [0.0, 1.0] }", "instrument must be a table"),
        ("instrument = { choice = [{ efficiency = 0.5 }, { efficiency = 5.0 }] }", "efficiency"),
        ("emissions = [{ choice = ['RollUp:0.1', 'RollUp:-1', 'Unperturbed'] }]", "energy"),
        ("emissions = [{ choice = ['Unperturbed', 5] }]", "perturbation"),
    ],
)
def test_ranges_out_of_range_are_named_at_once(tmp_path, text, name):
    study = 'base = "base.toml"\nsample = 2\n[sweep]\n"tip.axis" = "random"\n[dataset]\n'
    began = time.monotonic()
    with pytest.raises(FileError, match=name):
        planned(tmp_path, f"{study}{text}\n", runs=False)
    assert time.monotonic() - began < 30  # a list of 2e9 examples took longer, and the memory of the machine


# ---- the command ---------------------------------------------------------------------------------------------------


def test_the_command_foretells_makes_and_verifies(made, tmp_path, capsys):
    plan = planned(tmp_path)
    assert main(["dataset", str(tmp_path / "study.toml"), "--plan", "--json"]) == 0
    foretold = json.loads(capsys.readouterr().out)
    assert foretold["examples"] == 12 and not (tmp_path / "study_set").exists()
    assert main(["dataset", str(tmp_path / "study.toml")]) == 0
    check_same(made[1], tmp_path / "study_set")
    size = sum(shard["bytes"] for shard in ae.load_dataset(made[1]).shards)
    ions = sum(shard["ions"] for shard in ae.load_dataset(made[1]).shards)
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


@pytest.mark.slow
def test_two_commands_at_once_make_one_set(made, tmp_path):
    planned(tmp_path, runs=False)
    processes = [started(tmp_path / "study.toml", tmp_path / "set") for _ in range(2)]
    for process in processes:
        finished(process)
    check_same(made[1], tmp_path / "set")


@pytest.mark.slow
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
            process.communicate(timeout=random.uniform(0.3, 1.5) + 0.1 * killed)  # alone it takes 2 to 3 s
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
