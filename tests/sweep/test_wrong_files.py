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
from sweeps import check_bits, do, planned, write_dump

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.cli.main import main
from apt_evap.config.simulation_file import key_of
from apt_evap.sweep.batch_system import scripts
from apt_evap.sweep.claims import Claims
from apt_evap.sweep.collection import collect
from apt_evap.sweep.overview import status
from apt_evap.sweep.planning import open_sweep, plan
from apt_evap.sweep.worker import retry, work

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


@pytest.fixture(scope="module")
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


def worker(sweep):
    command = [sys.executable, "-P", "-m", "apt_evap.cli", "sweep", "work", str(sweep.folder), "--quiet"]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def row_of(sweep, key):
    with open(sweep.folder / "index.csv", newline="") as file:
        return next(row for row in csv.DictReader(file) if row["key"] == key)


# ---- runs ----------------------------------------------------------------------------------------------------------


def test_the_run_of_another_point_is_not_collected(sweep):
    for one, other in ((1, 0), (2, 0)):
        path = sweep.folder_of(sweep.keys[one]) / "run.h5"
        shutil.copy(sweep.folder_of(sweep.keys[other]) / "run.h5", path)
        state = sweep.state(sweep.keys[one])
        assert state.name == "foreign" and sweep.keys[0] in state.message
    result = collect(sweep)
    assert result["done"] == 2 and set(result["wrong"]) == set(sweep.keys[1:3])
    row = row_of(sweep, sweep.keys[1])
    assert row["state"] == "foreign" and row["fingerprint"] == "" and sweep.keys[0] in row["message"]
    again = reopen(sweep, 1, 2)
    assert work(sweep)["done"] == 4  # its own runs are made again
    check_bits(sweep, again)


def test_a_run_that_waits_in_the_folder_of_another_point_is_not_taken_over(fresh, finished):
    shutil.copy(finished.folder_of(finished.keys[0]) / "run.h5", fresh.folder_of(fresh.keys[1]))
    assert [state.name for _, state in fresh.states()] == ["open", "foreign"]
    counts = work(fresh)
    assert counts["done"] == counts["foreign"] == 1


def test_changed_settings_of_a_point_are_refused(sweep):
    (key,) = reopen(sweep, 0)
    path = sweep.folder_of(key) / "settings.toml"
    text = path.read_text()
    path.write_text(text.replace("ions = 20", "ions = 5"))
    counts = work(sweep)
    assert counts["failed"] == 1 and counts["done"] == 3
    assert "settings.toml" in sweep.state(key).message
    assert not (sweep.folder_of(key) / "run.h5").exists()
    path.write_text(text)
    assert retry(sweep) == 1 and work(sweep)["done"] == 4
    check_bits(sweep, [key])


def test_a_run_of_unknown_origin_is_not_that_of_a_point(sweep):
    key = sweep.keys[0]
    path = sweep.folder_of(key) / "run.h5"
    run = ae.load(path)
    path.unlink()
    sweep.config_of(key).simulation(n_threads=1).run(len(run) - 3, progress=False).save(path)
    assert sweep.state(key).name == "failed"
    assert status(sweep)["table"][0]["ions"] == 17


def test_a_run_that_ended_early_shows_its_own_number_of_ions(tmp_path):
    write_dump(tmp_path / "tip.dump")
    base = SMALL[SMALL.index("[simulation]") :].replace("ions = 20", "ions = 100_000\nresponses = false")
    base = '[tip]\nfile = "tip.dump"\ntypes = {1 = "Ni"}\n' + base
    sweep = planned(tmp_path, 'base = "base.toml"\n[[points]]\n"simulation.seed" = 1\n', base)
    assert work(sweep)["done"] == 1
    row = status(sweep)["table"][0]
    assert row["state"] == "done" and row["n_ions"] == 100_000
    assert row["ions"] == len(ae.load(sweep.folder_of(sweep.keys[0]) / "run.h5")) < 1000


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")  # in true eV the limit is lower
def test_real_units_are_compared(tmp_path):
    base = SMALL + "[real_units]\nflight_charges = 1\n"
    study = 'base = "base.toml"\n[sweep]\n"real_units.flight_charges" = [1, 2]\n'
    sweep = planned(tmp_path, study, base)
    for key in sweep.keys:
        do(sweep, key)
    assert collect(sweep)["done"] == 2
    one, other = (sweep.folder_of(key) / "run.h5" for key in sweep.keys)
    shutil.copy(one, other)
    assert collect(sweep)["done"] == 1 and row_of(sweep, sweep.keys[1])["state"] == "foreign"
    replace(ae.load(one).simulated(), provenance={}).save(one)  # a kill between the last ion and the real units
    end = sorted((one.parent / "claims").glob("*.end.json"))[-1]
    end.write_text(end.read_text().replace('"code": 0', '"code": -9'))
    assert sweep.state(sweep.keys[0]).name == "open"
    assert work(sweep)["done"] == 1 and ae.load(one).units is not None


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
    result = collect(sweep)
    assert result["done"] == 3 and set(result["wrong"]) == {key}
    row = row_of(sweep, key)
    assert row["state"] == "damaged" and "run.h5" in row["message"] and "\n" not in row["message"]
    assert [row_of(sweep, each)["state"] for each in sweep.keys if each != key] == ["done"] * 3
    assert len(ae.report.read(sweep.folder / "report.html")["points"]) == 4


# ---- links and pipes -----------------------------------------------------------------------------------------------


def test_a_worker_does_not_wait_for_a_pipe(sweep):
    keys = reopen(sweep, 0, 1)
    names = ("settings.toml", "log.txt")
    for key, name in zip(keys, names, strict=True):
        (sweep.folder_of(key) / name).unlink(missing_ok=True)
        os.mkfifo(sweep.folder_of(key) / name)
    process = worker(sweep)
    try:
        assert process.wait(60) == 0, process.stderr.read()
    finally:
        process.kill()
    for key, name in zip(keys, names, strict=True):
        state = sweep.state(key)
        assert state.name == "failed" and name in state.message and state.claims[-1].end["code"] == 2


@pytest.mark.parametrize("moment", [0.1, 1.2])
def test_a_worker_ends_on_sigterm_at_any_time(fresh, moment):
    process = worker(fresh)
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(moment)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) in (143, -signal.SIGTERM, -signal.SIGINT)  # the latter before the first handlers
    finally:
        process.kill()
    assert {state.name for _, state in fresh.states()} <= {"open", "done"}


def test_links_in_the_folder_of_a_point_are_not_followed(sweep, tmp_path):
    (key,) = reopen(sweep, 0)
    victims = tmp_path / "victim", tmp_path / "folder"
    victims[0].write_text("mine")
    victims[1].mkdir()
    for name in ("log.txt", "run.h5", "run.png", "run.h5.unfinished", "settings.toml", "anything"):
        place, kept = sweep.folder_of(key) / name, tmp_path / "kept"
        if place.exists():
            place.rename(kept)
        place.symlink_to(victims[name.endswith("unfinished")])
        counts = work(sweep)
        assert counts["done"] == 3 and counts["failed"] + counts["damaged"] == 1
        assert name in sweep.state(key).message
        place.unlink()
        if kept.exists():
            kept.rename(place)
        retry(sweep)
    os.link(victims[0], sweep.folder_of(key) / "second")
    os.replace(sweep.folder_of(key) / "second", sweep.folder_of(key) / "log.txt")
    assert work(sweep)["failed"] == 1 and "log.txt" in sweep.state(key).message
    assert victims[0].read_text() == "mine" and os.listdir(victims[1]) == []


@pytest.mark.parametrize("name", ["", "claims"])
def test_a_folder_that_is_a_link_is_refused(sweep, tmp_path, name):
    (key,) = reopen(sweep, 0)
    place, victim = sweep.folder_of(key) / name, tmp_path / "victim"
    place.rename(victim)
    before = sorted(os.listdir(victim))
    place.symlink_to(victim)
    counts = work(sweep)
    assert counts["failed"] == 1 and counts["done"] == 3 and "link" in sweep.state(key).message
    assert status(sweep)["counts"]["failed"] == 1 and retry(sweep) == 0
    assert sorted(os.listdir(victim)) == before
    assert collect(sweep)["done"] == 3


def test_files_of_a_sweep_that_are_links_are_not_replaced(sweep, tmp_path):
    (tmp_path / "base.toml").write_text(SMALL)
    (tmp_path / "study.toml").write_text(FOUR)
    victim = tmp_path / "victim"
    key = sweep.keys[0]
    (sweep.folder_of(sweep.keys[1]) / "run.h5").unlink()  # so that a point is open
    for name, call in (
        ("index.csv", lambda: collect(sweep)),
        ("maps.h5", lambda: collect(sweep)),
        ("report.html", lambda: collect(sweep)),
        ("plan.json", lambda: plan(tmp_path / "study.toml")),
        ("points.csv", lambda: plan(tmp_path / "study.toml")),
        (f"points/{key}/settings.toml", lambda: plan(tmp_path / "study.toml")),
    ):
        victim.write_text("mine")
        (sweep.folder / name).unlink(missing_ok=True)
        (sweep.folder / name).symlink_to(victim)
        with pytest.raises(FileError, match=re.escape(name)):
            call()
        assert victim.read_text() == "mine"
        (sweep.folder / name).unlink()
        plan(tmp_path / "study.toml")
    (tmp_path / "elsewhere").mkdir()
    (sweep.folder / "jobs").symlink_to(tmp_path / "elsewhere")
    assert main(["sweep", "submit", str(sweep.folder), "--submit-command", "true"]) == 2
    assert os.listdir(tmp_path / "elsewhere") == []


# ---- claims --------------------------------------------------------------------------------------------------------

OWNER = {"host": "h", "machine": "m", "pid": 1, "birth": "1", "job": "", "restarts": 0, "version": "", "began": ""}
OWNER["ions"] = 0
END = {"code": 0, "ended": "", "seconds": 1.0, "ions": 0, "message": ""}
BAD_CLAIMS = [
    '{"a": 1}', '{"machine": 1}', "{}", "[]", "null", "3", '"x"', '{"code": 0}', '{"co', "\x00", "[" * 100_000,
    json.dumps(OWNER | {"pid": "1"}), json.dumps(OWNER | {"pid": 10**40}), json.dumps(OWNER | {"pid": True}),
    json.dumps(OWNER | {"birth": None}), json.dumps(OWNER | {"restarts": None}), json.dumps(OWNER | {"ions": []}),
]  # fmt: skip
BAD_ENDS = [
    "{}", "[]", '{"code": "x"}', '{"code": 0}', "1e999", "[" * 100_000,
    json.dumps(END | {"code": "x"}), json.dumps(END | {"code": None}), json.dumps(END | {"code": 1e400}),
    json.dumps(END | {"seconds": float("nan")}), json.dumps(END | {"seconds": float("inf")}),
    json.dumps(END | {"seconds": 10**400}), json.dumps(END | {"seconds": "1"}), json.dumps(END | {"message": 3}),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(BAD_CLAIMS)))
def test_a_claim_that_cannot_be_read_is_lost_after_a_while(fresh, number):
    key = fresh.keys[0]
    folder = fresh.folder_of(key) / "claims"
    folder.mkdir()
    path = folder / "0001.json"
    path.write_text(BAD_CLAIMS[number])
    assert fresh.state(key).name == "running"  # perhaps its owner is just writing it
    os.utime(path, (1e9, 1e9))
    assert fresh.state(key).name == "open"
    os.utime(path, (1e11, 1e11))  # in the far future
    assert fresh.state(key).name == "open"
    assert status(fresh)["counts"]["open"] == 2


def test_pipes_links_and_other_names_among_the_claims(fresh, tmp_path):
    key = fresh.keys[0]
    folder = fresh.folder_of(key) / "claims"
    folder.mkdir()
    for name in ("²001.json", "1.json", "00001.json", "x.json", ".json", "0001.json.json", "-001.json"):
        (folder / name).write_text(json.dumps(OWNER))
    assert Claims(fresh.folder_of(key)).all() == []
    os.mkfifo(folder / "0001.json")
    (folder / "0002.json").mkdir()
    (folder / "0003.json").symlink_to(tmp_path / "missing")
    (folder / "0004.end.json").symlink_to(tmp_path / "victim")
    assert len(Claims(fresh.folder_of(key)).all()) == 3
    assert fresh.state(key).name == "running"
    os.utime(folder / "0003.json", (1e9, 1e9), follow_symlinks=False)
    assert fresh.state(key).name == "failed"  # three tries in vain
    (folder / "0001.json").unlink()
    (fresh.folder_of(key) / "settings.toml").unlink()  # so that nothing is run
    (fresh.folder_of(fresh.keys[1]) / "settings.toml").unlink()
    with pytest.raises(FileError, match=r"0004\.end\.json"):
        work(fresh)
    assert not (tmp_path / "victim").exists()
    assert fresh.state(fresh.keys[1]).tries == 1  # the other point was tried all the same


@pytest.mark.parametrize("number", range(len(BAD_ENDS)))
def test_an_end_that_cannot_be_read_is_that_of_a_killed_try(fresh, number):
    key = fresh.keys[0]
    claims = Claims(fresh.folder_of(key))
    claims.take(0, 0)
    (claims.folder / "0001.end.json").write_text(BAD_ENDS[number])
    state = fresh.state(key)
    assert state.name == "open" and state.tries == 1 and state.claims[0].end["code"] == -9
    status(fresh)


def test_what_a_claim_says_is_printed_without_control_characters(fresh):
    claims = Claims(fresh.folder_of(fresh.keys[0]))
    claims.end(claims.take(0, 0), **END | {"code": 2, "message": "a\x1b[2J\nb"})
    assert fresh.state(fresh.keys[0]).message.isprintable()


# ---- plans and scripts ---------------------------------------------------------------------------------------------


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
    assert main(["sweep", "submit", str(fresh.folder), "--dry-run"]) == 2
    assert main(["sweep", "work", str(fresh.folder)]) == 2


@pytest.mark.parametrize(
    "values",
    [
        {"tip.offset_seed": 10**400},
        {"tip.offset_seed": 3},
        {"tip": 3},
        {"tip": {}},
        {"maps.bins": 1},
        {"x": 1},
        {"": 1},
        [],
        3,
    ],
)
def test_the_values_of_a_point_are_those_of_its_settings(fresh, values):
    path = fresh.folder / "plan.json"
    content = json.loads(path.read_text())
    content["points"][0]["values"] = values
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=r"plan\.json"):
        open_sweep(fresh.folder)


@pytest.mark.parametrize("end", ["\n", "\r", "\x0b", "\x1c", "\x85", "\u2028", "\x7f", "\x1b"])
def test_a_folder_whose_name_would_begin_a_new_line_is_refused(tmp_path, end):
    folder = tmp_path / f"odd{end}touch PWN #"
    folder.mkdir()
    with pytest.raises(FileError, match="control characters"):
        planned(folder, TWO, SMALL)
    assert sorted(os.listdir(folder)) == ["base.toml", "study.toml"]


@pytest.mark.parametrize(
    "name", ["a b", "p%A_%a", "$(touch PWN)", "`touch PWN`", "it's", "@KEYS@", "@COMMAND@", "#; x &"]
)
def test_a_script_has_the_name_of_its_folder_as_it_is(tmp_path, name):
    (tmp_path / name).mkdir()
    sweep = planned(tmp_path / name, TWO, SMALL)
    fake = tmp_path / "python"
    fake.write_text('#!/bin/sh\nfor each; do echo "$each"; done\n')
    fake.chmod(0o755)
    (script,) = scripts(sweep, sweep.keys)
    (output,) = re.findall(r'^#SBATCH --output="(.*)/jobs/%A_%a\.log"$', script, re.MULTILINE)
    assert output.replace("%%", "%") == str(sweep.folder) and "%" not in output.replace("%%", "")
    script = re.sub(r"exec \S+ -P", f"exec {fake} -P", script)
    environment = os.environ | {"SLURM_ARRAY_TASK_ID": "1"}
    done = subprocess.run(["bash", "-euc", script], env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.splitlines()[-5:] == ["work", str(sweep.folder), "--quiet", "--point", sweep.keys[1]]
    assert not list(tmp_path.rglob("PWN"))
    with pytest.raises(ValueError, match="folder"):
        scripts(sweep, sweep.keys, "pbs")
    template = tmp_path / "job.sh"
    template.write_text("cd @FOLDER@ && pwd\n")
    (script,) = scripts(sweep, sweep.keys, template=template)
    assert subprocess.run(["bash", "-euc", script], capture_output=True, text=True).stdout == f"{sweep.folder}\n"


@pytest.mark.parametrize("name", ['quo"te', "back\\slash"])
def test_names_for_which_slurm_has_no_quotes_are_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    sweep = planned(tmp_path / name, TWO, SMALL)
    with pytest.raises(ValueError, match="folder"):
        scripts(sweep, sweep.keys)


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
