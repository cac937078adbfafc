"""Work on all points by processes of this machine, which may be interrupted or killed."""

import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from sweeps import Killer, check_bits, check_done, command, has_begun, living_children, planned, poison

from apt_evap._common.files import FileError
from apt_evap.cli.main import main
from apt_evap.studies.sweep.planning import open_sweep, sweep_status
from apt_evap.studies.sweep.point_folder import run_point
from apt_evap.studies.sweep.working import run_sweep

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
LONG = SMALL.replace("ions = 60", "ions = 1000")
TWO_LONG = TWO.replace("checkpoint = 0", "checkpoint = 0.001")


def until(condition, seconds=60):
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it has not come true"
        time.sleep(0.02)


def runs_of(process):
    """Numbers of the processes in which another one runs points."""
    numbers = []
    for number in living_children(process.pid):
        try:
            if b"spawn_main" in Path(f"/proc/{number}/cmdline").read_bytes():
                numbers.append(number)
        except OSError:
            pass
    return numbers


def victims_of(process):
    return [*runs_of(process), process.pid]


def is_alive(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def before(folder):
    """PYTHONPATH with a folder at its beginning; without an empty entry, which would be the current folder."""
    return os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))


@pytest.mark.slow
def test_two_points_by_two_processes(tmp_path):
    sweep = planned(tmp_path, TWO, SMALL)
    assert {state.name for state in run_sweep(sweep, workers=2).values()} == {"done"}
    check_done(sweep)
    assert run_sweep(sweep, workers=2) == {}  # nothing to do
    content = sweep_status(sweep)
    assert content["counts"]["done"] == 2 and all(0 < row["seconds"] < 60 for row in content["table"])


@pytest.mark.slow
def test_a_failed_point_does_not_stop_the_others(tmp_path, capsys):
    sweep = planned(tmp_path, TWO, SMALL)
    bad, good = sweep.keys
    poison(sweep, bad)
    assert main(["sweep", "work", str(tmp_path / "study.toml")]) == 0
    assert sweep.state(good).name == "done" and sweep.state(bad).name == "failed"
    out, err = capsys.readouterr()
    assert "2 points: 1 done, 0 running, 0 waiting, 1 failed" in out
    assert bad in err and "Unobtainium" in err and good not in err and "--retry" in err
    assert main(["sweep", "work", str(tmp_path / "study.toml"), "--quiet"]) == 0  # it is not tried again
    assert "Unobtainium" in capsys.readouterr().err
    planned(tmp_path, TWO, SMALL)
    assert main(["sweep", "work", str(tmp_path / "study.toml"), "--retry", "--quiet"]) == 0
    check_done(sweep)


@pytest.mark.slow
def test_an_interrupt_saves_all_ions_and_the_next_call_continues(tmp_path):
    """A batch system sends SIGTERM to all processes."""
    sweep = planned(tmp_path, TWO_LONG, LONG)
    process = command(sweep, "--workers", "2")
    until(lambda: has_begun(sweep, *sweep.keys))
    for number in (*runs_of(process), process.pid):
        os.kill(number, signal.SIGTERM)
    assert process.wait(60) == 143, process.stderr.read()
    assert "Traceback" not in process.stderr.read()
    for row in sweep_status(sweep)["table"]:
        assert row["state"] == "waiting" and 0 < row["ions"] < 1000 and row["seconds"] > 0
        assert (sweep.folder_of(row["key"]) / "run.h5").exists()  # not only the last checkpoint
    run_sweep(sweep, workers=2)
    check_done(sweep)


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0.3, 1.5])
def test_an_interrupt_ends_the_work_at_any_time(tmp_path, moment):
    sweep = planned(tmp_path, TWO_LONG, LONG.replace("1000", "5000"))  # of 6,600 atoms: 10 s of one core for each
    process = command(sweep, "--workers", "2")
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(moment)
    process.send_signal(signal.SIGINT)
    # -2: before the first handlers of Python
    assert process.wait(60) in (130, -signal.SIGINT)
    assert {state.name for _, state in sweep.states()} <= {"waiting", "done"}


@pytest.mark.slow
def test_a_terminal_interrupts_each_run_once(tmp_path):
    """A second interrupt would lose the ions since the last checkpoint."""
    sweep = planned(tmp_path, TWO_LONG, LONG)
    words = [sys.executable, "-P", "-m", "apt_evap", "sweep", "work", str(sweep.folder), "--workers", "2"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True)
    until(lambda: has_begun(sweep, *sweep.keys))
    # two signals in succession are often one: the group of the terminal does not contain the runs
    assert process.pid not in map(os.getpgid, runs_of(process))
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(60) == 130
    assert all((sweep.folder_of(key) / "run.h5").exists() for key in sweep.keys)


@pytest.mark.slow
def test_a_killed_process_does_not_stop_the_others(tmp_path):
    sweep = planned(tmp_path, TWO_LONG, LONG)
    process = command(sweep)  # one after the other
    until(lambda: has_begun(sweep, sweep.keys[0]))
    (number,) = runs_of(process)
    os.kill(number, signal.SIGKILL)
    assert process.wait(60) == 0
    error = process.stderr.read()
    assert f"point {sweep.keys[0]} will continue: its process was killed" in error and "Traceback" not in error
    states = {point.key: state for point, state in sweep.states()}
    assert [state.name for state in states.values()] == ["waiting", "done"]
    assert states[sweep.keys[0]].seconds is None and sweep_status(sweep)["table"][0]["ions"] > 0
    assert {state.name for state in run_sweep(sweep).values()} == {"done"}
    check_done(sweep)


@pytest.mark.slow
def test_the_runs_end_with_a_killed_command(tmp_path):
    sweep = planned(tmp_path, TWO_LONG, LONG)
    process = command(sweep, "--workers", "2")
    until(lambda: has_begun(sweep, *sweep.keys))
    numbers = runs_of(process)
    assert len(numbers) == 2 and {state.name for _, state in sweep.states()} == {"running"}
    process.kill()
    process.wait()
    until(lambda: not any(map(is_alive, numbers)), 5)
    until(lambda: {state.name for _, state in sweep.states()} == {"waiting"}, 5)  # locks may end a moment later


def test_a_run_whose_command_ended_before_it_began_ends_at_once():
    program = "import sys\nfrom apt_evap._common.processes import die_with\ndie_with(int(sys.argv[1]))\nprint('lives')"
    done = subprocess.run([sys.executable, "-P", "-c", program, "1"], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL and done.stdout == ""


@pytest.mark.slow
def test_processes_that_are_always_killed_end_the_command(tmp_path):
    sweep = planned(tmp_path, TWO.replace("[1, 2]", "[1, 2, 3, 4, 5]"), SMALL)
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "sitecustomize.py").write_text(
        "import os, sys\nif '--multiprocessing-fork' in sys.orig_argv: os.kill(os.getpid(), 9)\n"
    )
    process = command(sweep, PYTHONPATH=before(tmp_path / "killed"))
    assert process.wait(60) == 2
    error = process.stderr.read()
    assert "the last 3 processes" in error and error.count("\n") == 1
    assert {state.name for _, state in sweep.states()} == {"waiting"}


@pytest.mark.slow
def test_two_commands_share_a_sweep(tmp_path):
    sweep = planned(tmp_path, TWO.replace("[1, 2]", "[1, 2, 3, 4]"), SMALL)
    commands = [command(sweep) for _ in range(2)]
    for process in commands:
        assert process.wait(120) == 0 and process.stderr.read() == ""
    check_done(sweep)


@pytest.mark.slow
def test_work_where_no_locks_are(tmp_path):
    """Some file systems of clusters have no flock."""
    (tmp_path / "no_flock").mkdir()
    (tmp_path / "no_flock" / "sitecustomize.py").write_text(
        "import errno, fcntl\n\n"
        "def flock(*arguments):\n"
        '    raise OSError(errno.ENOTSUP, "Operation not supported")\n\n'
        "fcntl.flock = flock\n"
    )
    sweep = planned(tmp_path, TWO, SMALL)
    process = command(sweep, PYTHONPATH=before(tmp_path / "no_flock"))
    assert process.wait(60) == 0
    assert f"warning: point {sweep.keys[0]}: cannot lock" in process.stderr.read()
    check_done(sweep)


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
    with pytest.raises(ValueError, match="workers must be an integer >= 1, got 0"):
        run_sweep(sweep, workers=0)
    (tmp_path / "base.toml").write_text(SMALL.replace("60", "70"))
    with pytest.raises(FileError, match="has changed since it was planned"):
        open_sweep(study)
    (sweep.folder / "plan.json").write_text('{"format": "apt_evap sweep 9"}')
    with pytest.raises(FileError, match="is not the plan of a sweep: format must be 'apt_evap sweep"):
        open_sweep(sweep.folder)


@pytest.mark.slow
def test_twelve_points_by_processes_that_are_killed(tmp_path):
    sweep = planned(tmp_path)
    assert len(sweep.keys) == 12
    killed, calls = [], 0
    while {state.name for _, state in sweep.states()} != {"done"}:
        process, calls = command(sweep, "--workers", "3"), calls + 1
        with Killer(sweep, partial(victims_of, process), most=10 - len(killed), seed=calls) as killer:
            assert process.wait(300) in (0, 2, -signal.SIGKILL)
        killed += killer.killed
        assert calls <= 11
    print(f"{len(killed)} processes killed, {calls} calls")
    assert len(killed) >= 3 and run_point(sweep.folder_of(sweep.keys[0])).name == "done"
    check_bits(sweep)
