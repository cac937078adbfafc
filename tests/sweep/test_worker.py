import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest
from sweeps import Killer, check_bits, check_journal, living_children, no_flock, planned, poison

from apt_evap._common.files import FileError
from apt_evap.cli.main import main
from apt_evap.sweep import worker as worker_module
from apt_evap.sweep.claims import Claims
from apt_evap.sweep.overview import status
from apt_evap.sweep.planning import open_sweep, plan
from apt_evap.sweep.pool import work_locally
from apt_evap.sweep.worker import retry, start, work, work_on

SMALL = """
[tip]
material = "Ni"
apex_radius = "6 a"
shank_length = "6 a"

[simulation]
ions = 60

[maps]
bins = 32
"""
TWO = 'base = "base.toml"\neach = { checkpoint = 0 }\n[sweep]\n"tip.offset_seed" = [1, 2]\n'
LONG = SMALL.replace("ions = 60", "ions = 600")


def until(condition, seconds=60):
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def worker(sweep, *options, **environment):
    """`apt-evap sweep work` as a process."""
    command = [sys.executable, "-P", "-m", "apt_evap.cli", "sweep", "work", str(sweep.folder), "--quiet", *options]
    return subprocess.Popen(command, env=os.environ | environment, stderr=subprocess.PIPE, text=True)


def test_two_points_are_run_by_two_workers_and_have_the_bits_of_single_runs(tmp_path):
    sweep = planned(tmp_path, TWO, SMALL)
    work_locally(sweep, 2)
    check_journal(sweep, {})
    check_bits(sweep)
    for key in sweep.keys:
        folder = sweep.folder_of(key)
        assert {path.name for path in folder.iterdir()} == {"settings.toml", "run.h5", "run.png", "log.txt", "claims"}
        assert "-- try 1, process" in (folder / "log.txt").read_text()
    work_locally(sweep, 2)  # nothing to do: no new claim
    assert [state.tries for _, state in sweep.states()] == [1, 1]
    assert main(["sweep", "work", str(sweep.folder), "--quiet"]) == 0
    sweep.folder_of(sweep.keys[0]).joinpath("run.h5").unlink()
    assert sweep.state(sweep.keys[0]).name == "open"


def test_a_point_is_the_same_as_apt_evap_run_with_its_settings(tmp_path):
    sweep = planned(tmp_path, TWO, SMALL)
    key = sweep.keys[1]
    assert work_on(sweep.folder, key).name == "done"
    folder = sweep.folder_of(key)
    assert main(["run", str(folder / "settings.toml"), "-o", str(folder / "run.h5"), "--resume", "--json"]) == 0


def test_a_poisoned_point_is_reported_and_the_others_are_done(tmp_path, capsys):
    sweep = planned(tmp_path, TWO, SMALL)
    bad, good = sweep.keys
    poison(sweep, bad)
    assert main(["sweep", "work", str(tmp_path / "study.toml")]) == 0
    assert sweep.state(good).name == "done"
    state = sweep.state(bad)
    assert state.name == "failed" and state.tries == 1  # not tried a second time
    assert "Unobtainium" in state.message and "settings.toml" in state.message
    out, err = capsys.readouterr()
    assert "2 points: 1 done, 0 running, 0 open, 1 failed" in out
    assert bad in err and good not in err and "--retry" in err
    assert main(["sweep", "work", str(tmp_path / "study.toml"), "--point", bad]) == 2  # the job of a cluster fails
    plan(tmp_path / "study.toml")  # writes correct settings
    assert sweep.state(bad).name == "failed"
    assert main(["sweep", "work", str(tmp_path / "study.toml"), "--retry", "--quiet"]) == 0
    assert sweep.state(bad).name == "done" and sweep.state(bad).tries == 2


def killed_at_once(*arguments, **options):
    return subprocess.Popen(["/bin/sh", "-c", "kill -9 $$"])


def test_a_point_that_kills_its_run_again_and_again_is_given_up(tmp_path, monkeypatch):
    sweep = planned(tmp_path, TWO, SMALL)
    key = sweep.keys[0]
    monkeypatch.setattr(worker_module, "start", killed_at_once)
    assert [work_on(sweep, key).name for _ in range(4)] == ["open", "open", "failed", "failed"]
    state = sweep.state(key)
    assert state.tries == 3 and state.message == "killed 3 times without a new checkpoint"
    assert [claim.end["code"] for claim in state.claims] == [-9, -9, -9]
    assert retry(sweep) == 1
    assert sweep.state(key).name == "open" and sweep.state(key).tries == 3
    assert [work_on(sweep, key).name for _ in range(3)] == ["open", "open", "failed"]


def test_tries_that_make_progress_do_not_count(tmp_path, monkeypatch):
    sweep = planned(tmp_path, TWO, SMALL)
    key = sweep.keys[0]
    monkeypatch.setattr(worker_module, "start", killed_at_once)
    ions = iter(range(1000))
    monkeypatch.setattr(worker_module, "ions_of", lambda folder: next(ions))
    for _ in range(10):
        assert work_on(sweep, key).name == "open"


def test_interrupted_work_saves_its_ions_and_continues_with_the_same_bits(tmp_path):
    sweep = planned(tmp_path, 'base = "base.toml"\n[[points]]\n"tip.offset_seed" = 1\n', LONG)
    (key,) = sweep.keys
    folder = sweep.folder_of(key)
    process = worker(sweep)
    until(lambda: (folder / "run.h5.lock").exists())
    time.sleep(0.3)  # so that some ions have evaporated; with none it is the same test
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    state = sweep.state(key)
    assert state.name == "open" and state.claims[0].end["code"] == 130
    ions = state.claims[0].end["ions"]
    assert 0 < ions < 600
    assert status(sweep)["table"][0]["ions"] == ions
    work(sweep)
    assert sweep.state(key).claims[1].owner["ions"] == ions
    check_journal(sweep, {})
    check_bits(sweep)


def test_a_run_ends_with_its_killed_worker(tmp_path):
    sweep = planned(tmp_path, 'base = "base.toml"\n[[points]]\n"tip.offset_seed" = 1\n', LONG)
    (key,) = sweep.keys
    process = worker(sweep)
    until(lambda: (sweep.folder_of(key) / "run.h5.lock").exists())
    (child,) = living_children(process.pid)
    process.kill()
    process.wait()
    until(lambda: not os.path.exists(f"/proc/{child}") or sweep.state(key).name == "open", 5)
    with pytest.raises(ProcessLookupError):
        for _ in range(500):  # the system needs a moment to remove it
            os.kill(child, 0)
            time.sleep(0.01)
    assert sweep.state(key).name == "open"


def test_a_run_whose_worker_ended_before_it_began_ends_at_once():
    program = (
        "import os, subprocess, sys\n"
        "from apt_evap._common.processes import die_with\n"
        "die_with(int(sys.argv[1]))\n"
        "print('lives')"
    )
    done = subprocess.run([sys.executable, "-c", program, "1"], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL and done.stdout == ""


def test_a_suspended_worker_gives_up_a_point_that_was_taken(tmp_path, monkeypatch):
    sweep = planned(tmp_path, TWO, SMALL)
    key = sweep.keys[0]
    monkeypatch.setattr(worker_module, "HEARTBEAT", 0.1)
    runs = []

    def endless(*arguments, **options):
        runs.append(subprocess.Popen(["sleep", "1000"]))
        return runs[-1]

    monkeypatch.setattr(worker_module, "start", endless)
    thread = threading.Thread(target=work_on, args=(sweep, key))
    thread.start()
    until(lambda: runs)
    Claims(sweep.folder_of(key)).take(1, 0)  # of another worker
    thread.join(10)
    assert not thread.is_alive() and runs[0].returncode == -signal.SIGKILL
    assert sweep.state(key).claims[0].end is None  # nothing is written about a point of others


def test_a_worker_has_the_modules_of_its_parent(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "own")])
    process = start(["--version"], stdout=subprocess.PIPE, text=True)
    assert process.communicate()[0].startswith("apt-evap ") and process.returncode == 0
    assert json.loads(process.args[4]) == sys.path


def test_mistakes_are_explained(tmp_path, capsys):
    sweep = planned(tmp_path, TWO, SMALL)
    study = str(tmp_path / "study.toml")
    for arguments, message in (
        (["work", study, "--point", "7"], "a point must be a key of points.csv or a number below 2, got '7'"),
        (["work", study, "--address", "tcp://x"], "--address is only for --scheduler dask"),
        (["work", study, "--scheduler", "dask"], "needs --address"),
        (["work", study, "--workers", "2", "--point", "0"], "not allowed with argument"),
        (["collect", study], "no point of .* is done"),
        (["status", str(tmp_path / "other.toml")], "is not planned yet"),
        (["status", str(tmp_path / "other")], "neither a study file"),
    ):
        assert main(["sweep", *arguments]) == 2
        assert re.search(message, capsys.readouterr().err), message
    (tmp_path / "base.toml").write_text(SMALL.replace("60", "70"))
    with pytest.raises(FileError, match="has changed since it was planned"):
        open_sweep(study)
    (sweep.folder / "plan.json").write_text('{"format": "apt_evap sweep 9"}')
    with pytest.raises(FileError, match="is not the plan of a sweep: expected 'apt_evap sweep 1'"):
        open_sweep(sweep.folder)


def test_a_new_plan_keeps_the_runs(tmp_path):
    sweep = planned(tmp_path, TWO, SMALL)
    work_on(sweep, sweep.keys[0])
    again = planned(tmp_path, TWO.replace("[1, 2]", "[3, 1]"), SMALL + "smoothing = 5.0\n")
    assert again.keys[1] == sweep.keys[0]
    assert [state.name for _, state in again.states()] == ["open", "done"]


@pytest.mark.slow
@pytest.mark.parametrize("has_flock", [True, False])
def test_twelve_points_by_workers_and_runs_that_are_killed(tmp_path, monkeypatch, has_flock):
    if not has_flock:
        monkeypatch.setenv("PYTHONPATH", f"{no_flock(tmp_path)}:{os.environ.get('PYTHONPATH', '')}")
    sweep = planned(tmp_path)
    assert len(sweep.keys) == 12
    with Killer(sweep, 2.0, kinds=("worker", "run", "SIGTERM")) as killer:
        work_locally(sweep, 3)
    lost = check_journal(sweep, killer.killed)
    print(f"killed {killer.count}, {lost} tries lost")
    assert min(killer.count.values()) >= 1
    assert 1 <= lost <= killer.count["worker"]  # a worker may write the end of its try just before it is killed
    check_bits(sweep)
    logs = "".join((sweep.folder_of(key) / "log.txt").read_text() for key in sweep.keys)
    assert ("cannot lock" in logs) is not has_flock
