"""Damaged sweep folders, and those of others: nothing is executed or written elsewhere, and no wrong run is kept."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import pytest
from sweeps import check_done, command, do, planned, write_dump

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.cli.main import main
from apt_evap.plot.report.html_page import read_report
from apt_evap.simulation.checkpoint import Checkpoint
from apt_evap.simulation.config.simulation_file import key_of
from apt_evap.studies.sweep.collection import collect_sweep
from apt_evap.studies.sweep.planning import open_sweep, plan_sweep, retry, sweep_status
from apt_evap.studies.sweep.point_folder import run_point
from apt_evap.studies.sweep.working import run_sweep

SMALL = """
[tip]
material = "Ni"
apex_radius = "4 a"
shank_length = "4 a"

[simulation]
ions = 20

[maps]
bins = 16
"""
FOUR = 'base = "base.toml"\n[sweep]\n"tip.offset_seed" = [1, 2]\n"simulation.seed" = [0, 1]\n'
TWO = 'base = "base.toml"\n[sweep]\n"tip.offset_seed" = [1, 2]\n'


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A sweep of four points, all done."""
    sweep = planned(tmp_path_factory.mktemp("finished"), FOUR, SMALL)
    for key in sweep.keys:
        do(sweep, key)
    return sweep


@pytest.fixture
def sweep(finished, tmp_path):
    """A copy of it."""
    shutil.copytree(finished.folder, tmp_path / "study")
    return open_sweep(tmp_path / "study")


@pytest.fixture
def fresh(tmp_path):
    """A sweep of two points, none of them done."""
    return planned(tmp_path, TWO, SMALL)


def reopen(sweep, *numbers):
    """Keys of points whose runs are removed, so that they are open again."""
    for number in numbers:
        (sweep.folder_of(sweep.keys[number]) / "run.h5").unlink()
    return [sweep.keys[number] for number in numbers]


def row_of(sweep, key):
    with open(sweep.folder / "index.csv", newline="") as file:
        return next(row for row in csv.DictReader(file) if row["key"] == key)


# ---- runs ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_run_of_another_point_is_not_collected(sweep):
    for one, other in ((1, 0), (2, 0)):
        path = sweep.folder_of(sweep.keys[one]) / "run.h5"
        shutil.copy(sweep.folder_of(sweep.keys[other]) / "run.h5", path)
        state = sweep.state(sweep.keys[one])
        assert state.name == "wrong" and sweep.keys[0] in state.message
        assert run_point(path.parent) == state and path.exists()
    result = collect_sweep(sweep)
    assert result["done"] == 2 and set(result["wrong"]) == set(sweep.keys[1:3])
    row = row_of(sweep, sweep.keys[1])
    assert row["state"] == "wrong" and row["fingerprint"] == "" and sweep.keys[0] in row["message"]
    for key in reopen(sweep, 1, 2):
        do(sweep, key)  # the point is run again
    check_done(sweep)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["run.h5", "run.h5.unfinished"])
def test_the_unfinished_run_of_another_point_is_not_continued(fresh, part):
    """It names no settings of a point yet: its own settings are compared."""
    one, other = (fresh.folder_of(key) for key in fresh.keys)
    run = fresh.config_of(other.name).simulation(n_threads=1)
    run.run(15, responses=True, progress=False, checkpoint=Checkpoint(other / "run.h5"))
    if part == "run.h5":
        (other / part).rename(one / part)
    else:
        program = (
            "import sys; from apt_evap.simulation.config.simulation_file import read_config\n"
            "from apt_evap.simulation.checkpoint import Checkpoint; import os\n"
            "simulation = read_config(sys.argv[1] + '/settings.toml').simulation(n_threads=1)\n"
            "def kill(ions, all_ions): ions < 10 or os.kill(os.getpid(), 9)\n"
            "simulation.run(20, responses=True, progress=kill, batch_size=4,\n"
            "               checkpoint=Checkpoint(sys.argv[1] + '/run.h5', 0, overwrite=True))"
        )
        killed = subprocess.run([sys.executable, "-P", "-c", program, str(other)], capture_output=True)
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        (other / "run.h5").unlink()
        (other / part).rename(one / part)
    state = run_point(one)
    assert state.name == "failed" and "other settings" in state.message
    assert fresh.state(one.name).name == "failed" and collect_sweep(fresh)["done"] == 0


def test_changed_settings_of_a_point_are_refused(sweep):
    (key,) = reopen(sweep, 0)
    path = sweep.folder_of(key) / "settings.toml"
    text = path.read_text()
    path.write_text(text.replace("ions = 20", "ions = 5"))
    state = run_point(path.parent)
    assert state.name == "failed" and "settings.toml" in state.message
    assert not (sweep.folder_of(key) / "run.h5").exists()
    path.write_text(text)
    assert retry(sweep) == 1
    do(sweep, key)
    check_done(sweep)


@pytest.mark.slow
def test_a_run_of_unknown_origin_is_not_that_of_a_point(sweep):
    key = sweep.keys[0]
    path = sweep.folder_of(key) / "run.h5"
    path.unlink()
    sweep.config_of(key).simulation(n_threads=1).run(17, progress=False).save(path)
    assert sweep.state(key).name == "waiting"
    assert sweep_status(sweep)["table"][0]["ions"] == 17 and collect_sweep(sweep)["done"] == 3
    do(sweep, key)  # continues it, because its settings are those of the point
    check_done(sweep)


@pytest.mark.slow
def test_a_run_that_ended_early_shows_its_own_number_of_ions(tmp_path):
    write_dump(tmp_path / "tip.dump")
    base = SMALL[SMALL.index("[simulation]") :].replace("ions = 20", "ions = 100_000\nresponses = false")
    base = '[tip]\nfile = "tip.dump"\ntypes = {1 = "Ni"}\n' + base
    sweep = planned(tmp_path, 'base = "base.toml"\n[[points]]\n"simulation.seed" = 1\n', base)
    with pytest.warns(Warning, match="the run will be shorter"):
        run = do(sweep, sweep.keys[0])
    row = sweep_status(sweep)["table"][0]
    assert row["state"] == "done" and row["n_ions"] == 100_000 and row["ions"] == len(run) < 1000


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")  # in true eV the limit is lower
def test_real_units_are_compared(tmp_path):
    base = SMALL + '[real_units]\nflight_charges = 1\nfield_reference = "site"\n'  # too few atoms for a cap
    study = 'base = "base.toml"\n[sweep]\n"real_units.flight_charges" = [1, 2]\n'
    sweep = planned(tmp_path, study, base)
    for key in sweep.keys:
        do(sweep, key)
    assert collect_sweep(sweep)["done"] == 2
    one, other = (sweep.folder_of(key) / "run.h5" for key in sweep.keys)
    shutil.copy(one, other)
    assert collect_sweep(sweep)["done"] == 1 and row_of(sweep, sweep.keys[1])["state"] == "wrong"
    replace(ae.load(one).simulated(), provenance={}).save(one)  # a kill between the last ion and the real units
    assert sweep.state(sweep.keys[0]).name == "waiting"
    assert do(sweep, sweep.keys[0]).units is not None


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["bit of the data", "bit of the settings", "cut", "pipe", "folder", "text"])
def test_one_damaged_run_does_not_stop_the_others(sweep, damage):
    key = sweep.keys[2]
    path = sweep.folder_of(key) / "run.h5"
    content = bytearray(path.read_bytes())
    path.unlink()
    if damage == "pipe":
        os.mkfifo(path)
    elif damage == "folder":
        path.mkdir()
    else:
        place = content.index(b'"offset_seed"') if damage == "bit of the settings" else len(content) // 2
        content[place] ^= 1
        path.write_bytes(b"no run" if damage == "text" else content[: 1000 if damage == "cut" else None])
    result = collect_sweep(sweep)
    assert result["done"] == 3 and set(result["wrong"]) == {key}
    row = row_of(sweep, key)
    assert row["state"] == "wrong" and "run.h5" in row["message"] and "\n" not in row["message"]
    assert [row_of(sweep, each)["state"] for each in sweep.keys if each != key] == ["done"] * 3
    assert len(read_report(sweep.folder / "report.html")["points"]) == 4


# ---- links and pipes -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_does_not_wait_for_a_pipe(sweep):
    keys = reopen(sweep, 0, 1, 2)
    for key, name in zip(keys, ("settings.toml", "work.json", "lock"), strict=True):
        (sweep.folder_of(key) / name).unlink()
        os.mkfifo(sweep.folder_of(key) / name)
    process = command(sweep)
    try:
        assert process.wait(60) == 0, process.stderr.read()
    finally:
        process.kill()
    for key in keys:
        assert sweep.state(key).name in ("waiting", "done")


def test_links_in_the_folder_of_a_point_are_not_followed(sweep, tmp_path):
    (key,) = reopen(sweep, 0)
    victims = tmp_path / "victim", tmp_path / "folder"
    victims[0].write_text("mine")
    victims[1].mkdir()
    for name in ("run.h5", "run.png", "run.h5.unfinished", "settings.toml", "work.json", "lock", "anything"):
        place, kept = sweep.folder_of(key) / name, tmp_path / "kept"
        if place.exists():
            place.rename(kept)
        place.symlink_to(victims[name.endswith("unfinished")])
        state = run_point(sweep.folder_of(key))
        assert state.name in ("failed", "wrong", "waiting") and name in state.message
        place.unlink()
        if kept.exists():
            kept.rename(place)
        retry(sweep)
    assert victims[0].read_text() == "mine" and os.listdir(victims[1]) == []
    assert run_point(sweep.folder_of(key)).name == "done"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["points", "points/KEY"])
def test_a_folder_that_is_a_link_is_refused(sweep, tmp_path, name):
    (key,) = reopen(sweep, 0)
    place, victim = sweep.folder / name.replace("KEY", key), tmp_path / "victim"
    place.rename(victim)
    before = sorted(os.listdir(victim))
    place.symlink_to(victim)
    state = sweep.state(key)
    assert state.name == "wrong" and "link" in state.message
    assert run_sweep(sweep) == {} and retry(sweep) == 0
    assert sorted(os.listdir(victim)) == before
    assert sweep_status(sweep)["counts"]["wrong"] == collect_sweep(sweep)["points"] - collect_sweep(sweep)["done"] > 0


@pytest.mark.slow
def test_files_of_a_sweep_that_are_links_are_not_replaced(sweep, tmp_path):
    (tmp_path / "base.toml").write_text(SMALL)
    (tmp_path / "study.toml").write_text(FOUR)
    victim = tmp_path / "victim"
    key = sweep.keys[0]
    for name, call in (
        ("index.csv", lambda: collect_sweep(sweep)),
        ("maps.h5", lambda: collect_sweep(sweep)),
        ("report.html", lambda: collect_sweep(sweep)),
        ("plan.json", lambda: plan_sweep(tmp_path / "study.toml")),
        ("points.csv", lambda: plan_sweep(tmp_path / "study.toml")),
        (f"points/{key}/settings.toml", lambda: plan_sweep(tmp_path / "study.toml")),
    ):
        victim.write_text("mine")
        (sweep.folder / name).unlink(missing_ok=True)
        (sweep.folder / name).symlink_to(victim)
        with pytest.raises(FileError, match=re.escape(name)):
            call()
        assert victim.read_text() == "mine"
        (sweep.folder / name).unlink()
        plan_sweep(tmp_path / "study.toml")


# ---- plans ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "key", ["$(touch${IFS}PWN)", "../../outside", "", "0" * 12, "ABCDEF012345", "0" * 13, 12, None, ["0" * 12], "a\nb"]
)
def test_a_key_is_that_of_its_settings(fresh, key):
    path = fresh.folder / "plan.json"
    content = json.loads(path.read_text())
    content["points"][0]["key"] = key
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match="key"):
        open_sweep(fresh.folder)
    assert main(["sweep", "work", str(fresh.folder)]) == 2


@pytest.mark.parametrize(
    "paths", [["maps.bins"], [""], ["tip..axis"], ["tip.axis"], ["tip.offset_seed.more"], ["x"], [3], 3, None]
)
def test_the_values_of_a_point_are_those_of_its_settings(fresh, paths):
    path = fresh.folder / "plan.json"
    content = json.loads(path.read_text())
    content["points"][0]["paths"] = ["tip.offset_seed"]
    path.write_text(json.dumps(content))
    assert open_sweep(fresh.folder).points[0].values == {"tip.offset_seed": 1}
    content["points"][0]["paths"] = paths
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=r"plan\.json"):
        open_sweep(fresh.folder)


@pytest.mark.parametrize(
    "text",
    [
        '[sweep]\n"tip.axis" = [1979-05-27]',
        '[[points]]\n"simulation.seed" = 12:00:00',
        '[[points]]\n"tip.types" = 1979-05-27T00:00:00',
        '[[points]]\n"tip.solutes" = {Cu = [1979-05-27]}',
        '[sweep]\n"simulation" = [3]',
        '[sweep]\n"tip" = ["x"]',
        '[sweep]\n"simulation.voltage" = [inf, nan]',
    ],
)
def test_values_that_are_no_settings_are_errors_of_the_study(tmp_path, text):
    with pytest.raises(FileError, match=r"study\.toml"):
        planned(tmp_path, f'base = "base.toml"\n{text}\n', SMALL)
    assert not (tmp_path / "study").exists()


def test_dates_have_no_key():
    with pytest.raises(ValueError, match="settings"):
        key_of({"tip": {"material": "Ni"}, "simulation": {"ions": object()}})
