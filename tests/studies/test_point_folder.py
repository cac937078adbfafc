"""One point of a sweep: its state, and its run in this process."""

import json
import os
import shutil
import signal
import subprocess
import sys

import pytest
from sweeps import check_bits, check_done, do, planned, poison

from apt_evap.cli.main import main
from apt_evap.simulation.locks import try_lock
from apt_evap.studies.sweep import point_folder
from apt_evap.studies.sweep.planning import plan_sweep, retry, sweep_status
from apt_evap.studies.sweep.point_folder import run_point

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


@pytest.fixture
def sweep(tmp_path):
    """A sweep of two points, none of them done."""
    return planned(tmp_path, TWO, SMALL)


@pytest.mark.slow
def test_a_point_is_the_same_as_apt_evap_run_with_its_settings(sweep):
    one, other = (sweep.folder_of(key) for key in sweep.keys)
    assert sweep.state(one.name).name == "waiting"
    assert run_point(one).name == "done"
    assert {path.name for path in one.iterdir()} == {"settings.toml", "run.h5", "lock", "work.json"}
    before = (one / "run.h5").stat().st_mtime_ns
    assert run_point(one).name == "done" and (one / "run.h5").stat().st_mtime_ns == before
    assert main(["run", str(other / "settings.toml"), "-o", str(other / "run.h5"), "--quiet"]) == 0
    check_done(sweep)  # also without any work on the second one
    (one / "run.h5").unlink()
    assert sweep.state(one.name).name == "waiting"


def test_a_point_on_which_a_process_works_is_left_to_it(sweep):
    folder = sweep.folder_of(sweep.keys[0])
    with open(folder / "lock", "w") as file:
        assert try_lock(file.fileno())
        assert [state.name for _, state in sweep.states()] == ["running", "waiting"]
        assert sweep_status(sweep)["counts"]["running"] == 1
        assert run_point(folder).name == "running"
    assert not (folder / "run.h5").exists() and sweep.state(folder.name).name == "waiting"
    with open(folder / "lock") as file:  # of a status, at this very moment
        assert try_lock(file.fileno(), shared=True)
        assert sweep.state(folder.name).name == "waiting"
    assert run_point(folder).name == "done"


def test_a_point_that_ends_while_its_state_is_read_is_done(sweep, monkeypatch):
    """It was "waiting": without a run before, and without a lock after, the process that worked on it had ended."""
    folder = sweep.folder_of(sweep.keys[0])
    assert run_point(folder).name == "done"
    os.rename(folder / "run.h5", folder / "elsewhere")

    def ended(folder):
        os.rename(folder / "elsewhere", folder / "run.h5")
        return False

    monkeypatch.setattr(point_folder, "_is_locked", ended)
    assert sweep.state(folder.name).name == "done"


@pytest.mark.slow
def test_a_run_that_another_program_writes_is_no_failure(sweep):
    """`apt-evap run`, started by Snakemake, locks its run but not the point."""
    folder = sweep.folder_of(sweep.keys[0])
    program = (
        "import sys; from apt_evap.simulation.config.simulation_file import read_config\n"
        "config = read_config(sys.argv[1] + '/settings.toml')\n"
        "def wait(ions, all_ions): print('runs', flush=True); sys.stdin.read()\n"
        "config.simulation().run(60, progress=wait, checkpoint=sys.argv[1] + '/run.h5')"
    )
    other = subprocess.Popen(
        [sys.executable, "-P", "-c", program, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "runs\n"
    state = run_point(folder)
    assert state.name == "waiting" and "run.h5" in state.message
    other.communicate("")
    assert other.returncode == 0 and run_point(folder).name == "done"
    check_bits(sweep, [folder.name])


@pytest.mark.slow
def test_a_failed_point_waits_for_retry(sweep, tmp_path, capsys):
    bad, good = sweep.keys
    poison(sweep, bad)
    state = run_point(sweep.folder_of(bad))
    assert state.name == "failed" and "Unobtainium" in state.message and "settings.toml" in state.message
    plan_sweep(tmp_path / "study.toml")  # writes the settings of the plan
    assert run_point(sweep.folder_of(bad)).name == "failed" and sweep.state(good).name == "waiting"
    assert main(["sweep", "work", str(tmp_path / "study.toml"), "--point", bad]) == 2  # the job of a cluster fails
    assert "Unobtainium" in capsys.readouterr().err
    assert retry(sweep) == 1 and sweep.state(bad).name == "waiting" and retry(sweep) == 0
    assert main(["sweep", "work", str(tmp_path / "study.toml"), "--point", "0", "--point", good]) == 0
    check_done(sweep)


def test_an_error_that_is_not_expected_fails_the_point_too(sweep, monkeypatch):
    monkeypatch.setattr(point_folder, "config_of", lambda document, path: {}["tip"])
    state = run_point(sweep.folder_of(sweep.keys[0]))
    assert state.name == "failed" and state.message == "KeyError: 'tip'"


@pytest.mark.slow
def test_a_full_disk_is_no_failure(sweep):
    """Files larger than a limit are errors of the system, as on a full disk."""
    folder = sweep.folder_of(sweep.keys[0])
    resource = pytest.importorskip("resource")  # not on Windows
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8000, limits[1]))
    try:
        with pytest.warns(Warning, match="no checkpoint"):
            state = run_point(folder, checkpoint=0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, previous)
    assert state.name == "waiting" and os.strerror(27) in state.message
    assert sweep.state(folder.name).name == "waiting" and not (folder / "run.h5").exists()
    assert run_point(folder).name == "done"
    check_bits(sweep, [folder.name])


def test_too_little_memory_is_no_failure(sweep, monkeypatch):
    def read(path):
        raise MemoryError("too little memory")

    monkeypatch.setattr(point_folder, "read_document", read)
    state = run_point(sweep.folder_of(sweep.keys[0]))
    assert state.name == "waiting" and "too little memory" in state.message


def test_a_new_plan_keeps_the_runs(sweep, tmp_path):
    do(sweep, sweep.keys[0])
    again = planned(tmp_path, TWO.replace("[1, 2]", "[3, 1]"), SMALL + "smoothing = 5.0\n")
    assert again.keys[1] == sweep.keys[0]
    assert [state.name for _, state in again.states()] == ["waiting", "done"]


def test_the_time_of_a_point_is_that_of_all_work(sweep):
    folder = sweep.folder_of(sweep.keys[0])
    (folder / "work.json").write_text('{"seconds": 100.0, "error": ""}')
    assert 100 < run_point(folder).seconds < 200
    (folder / "run.h5").unlink()
    (folder / "work.json").write_text('{"seconds": null, "error": ""}')  # a process was killed
    assert run_point(folder).seconds is None


@pytest.mark.parametrize(
    "text",
    [
        "", "{}", "[]", "3", "\x00", "[" * 100_000, '{"seconds": 1.0}', '{"seconds": NaN, "error": 3}',
        '{"seconds": -1.0, "error": null}', '{"seconds": 1e999, "error": []}', '{"seconds": true, "error": {}}',
    ],
)  # fmt: skip
def test_notes_that_cannot_be_read_are_not_known(sweep, text):
    folder = sweep.folder_of(sweep.keys[0])
    (folder / "work.json").write_text(text)
    state = sweep.state(folder.name)
    assert (state.name, state.message, state.seconds) == ("waiting", "", None)
    json.dumps(sweep_status(sweep), allow_nan=False)


def test_a_message_is_printed_without_control_characters(sweep):
    folder = sweep.folder_of(sweep.keys[0])
    (folder / "work.json").write_text('{"seconds": 1.0, "error": "a\\u001b[2J\\nb"}')
    state = sweep.state(folder.name)
    assert state.name == "failed" and state.message.isprintable()


def test_a_moved_folder_is_not_another_point(sweep):
    """The name of the folder is the key: a folder under another name is refused, whatever is in it."""
    one, other = (sweep.folder_of(key) for key in sweep.keys)
    do(sweep, one.name)
    shutil.rmtree(other)
    one.rename(other)
    assert sweep.state(other.name).name == "wrong"
    (other / "run.h5").unlink()
    state = run_point(other)
    assert state.name == "failed" and "other settings" in state.message
