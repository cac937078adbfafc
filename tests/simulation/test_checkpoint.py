"""Runs that are killed, interrupted, out of disk or damaged, and go on with the same bits."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import traceback
import warnings
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from systems import FORK, LINKS, MODES, PIPES
from tqdm.auto import tqdm

import apt_evap as ae
from apt_evap.simulation.locks import FileLock

ENERGY = ae.TruncatedNormal(0.155, 0.155)
HERE = str(Path(ae.__file__).parents[1])  # the package under test, installed or not


class Processes:
    """Functions of this file in processes of their own, forked from one that has imported all they need."""

    def __init__(self):
        self._parent = subprocess.Popen(
            [sys.executable, "-P", __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join((HERE, str(Path(__file__).parents[1])))},
        )

    def run(self, function, *arguments, kill_after=None):
        """Exit code of a function in a new process, which is killed if it takes longer [s]."""
        line = json.dumps([function.__name__, kill_after, *map(str, arguments)])
        self._parent.stdin.write(line.encode() + b"\n")
        self._parent.stdin.flush()
        return int(self._parent.stdout.readline())

    def close(self):
        self._parent.communicate()  # closes its pipes and waits


@pytest.fixture(scope="session")
def processes():
    processes = Processes()
    yield processes
    processes.close()


FIXED = ae.evaporation.ChargeSettings(potential_bound=1.0)  # no relaxation before an interval ends


def simulation(**options):
    """A shell that deepens within the run, watched from its first relaxation."""
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), depth=3.5 * nickel.a)
    monitor = ae.simulation.Monitor(interval=150)
    return ae.Simulation(tip, **{"seed": 5, "n_threads": 1, "monitor": monitor, "charge_settings": FIXED} | options)


def small(**options):
    tip = ae.Tip("Ni", apex_radius=1.5, axis=(1, 1, 1), shank_length=1.5)
    return ae.Simulation(tip, **{"seed": 5, "n_threads": 1, "charge_settings": FIXED} | options)


def run_small(path, n_ions=90, resume=False, **options):
    checkpoint = ae.simulation.Checkpoint(path, minutes=0, resume=resume)
    return small(**options).run(n_ions, responses=False, progress=False, batch_size=30, checkpoint=checkpoint)


def datasets(path):
    """Every dataset of a file but its time and provenance, by name: its type, its shape and its bytes."""
    found = {}

    def note(name, item):
        if isinstance(item, h5py.Dataset) and name not in ("entry1/start_time", "entry1/simulation/provenance"):
            values = np.asarray(item[()])
            found[name] = (values.dtype.str, values.shape, values.tobytes())

    with h5py.File(path) as file:
        file.visititems(note)
    return found


def differing(path, other):
    one, two = datasets(path), datasets(other)
    assert one.keys() == two.keys()
    return [name for name in one if one[name] != two[name]]


# ---- killed --------------------------------------------------------------------------------------------------------

N_IONS = 300


def work(path):
    tqdm.set_lock(threading.RLock())  # one of this process alone: its own would outlive a kill
    simulation().run(
        N_IONS,
        [ae.RollUp(ENERGY)],
        progress=False,
        batch_size=20,
        checkpoint=ae.simulation.Checkpoint(path, minutes=0, resume=True),
    )


@FORK
@pytest.mark.slow
def test_killed_at_random_moments_and_resumed_it_has_the_same_bits(tmp_path, processes):
    """SIGKILL at random moments; whenever the run comes to its end before, another one begins."""
    simulation().run(N_IONS, [ae.RollUp(ENERGY)], progress=False).save(tmp_path / "uninterrupted.h5")
    n_kills, random = 20, np.random.default_rng(3)
    kills, whole, shortest, over = [], 0, None, False
    while len(kills) < n_kills or whole < 3 or over or any("unfinished" in name for name in os.listdir(tmp_path)):
        path = tmp_path / f"{whole}.h5"
        unfinished = Path(f"{path}.unfinished")
        spared = shortest is None or over or (len(kills) >= n_kills and unfinished.exists())
        began = time.monotonic()
        code = processes.run(work, path, kill_after=None if spared else random.uniform(0, 0.6 * shortest))
        if code == -signal.SIGKILL:
            kills.append(ae.simulation.Checkpoint(path).ions_there())
            over = path.exists() and not unfinished.exists()  # hit after its end: another one begins
            continue
        assert code == 0
        shortest = time.monotonic() - began if shortest is None else shortest
        assert differing(path, tmp_path / "uninterrupted.h5") == []
        assert not unfinished.exists()
        whole, over = whole + 1, False
    print(f"ions there at each of {len(kills)} kills: {kills}; {whole} runs to the end, alone {shortest:.1f} s")
    assert whole >= 3  # the first, which is not killed, and two that were
    assert max(kills) > N_IONS // 6  # they hit runs that had come some way
    assert sorted(os.listdir(tmp_path)) == sorted([*(f"{k}.h5" for k in range(whole)), "uninterrupted.h5"])


def crash(path, number, late):
    """Leave at once, as if killed, at one of the renames that complete a file."""
    count, replace = 0, os.replace

    def replace_or_leave(*names):
        nonlocal count
        count += 1
        if late:
            replace(*names)
        if count > number:
            os._exit(9)
        if not late:
            replace(*names)

    os.replace = replace_or_leave
    tqdm.set_lock(threading.RLock())
    run_small(path, resume=True)


@FORK
@pytest.mark.parametrize("late", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_killed_at_every_rename(tmp_path, processes, late):
    run_small(tmp_path / "uninterrupted.h5")
    for number in range(20):
        path = tmp_path / f"{number}.h5"
        code = processes.run(crash, path, number, int(late))
        assert code in (0, 9)
        left = code == 9
        run_small(path, resume=True)
        assert differing(path, tmp_path / "uninterrupted.h5") == []
        if not left:
            break
    assert not left
    assert number == 3 + 1  # three checkpoints and the whole file
    assert not [name for name in os.listdir(tmp_path) if "unfinished" in name]


# ---- interrupted ---------------------------------------------------------------------------------------------------


class Interrupting(ae.Unperturbed):
    """Raises SIGINT while ions launch."""

    at = (40, 70)

    def launch(self, emissions, random):
        for ion in self.at:
            if emissions.ions[0] <= ion < emissions.ions[0] + len(emissions):
                signal.raise_signal(signal.SIGINT)
        return super().launch(emissions, random)


def interrupted(path, at, **options):
    flown = Interrupting()
    object.__setattr__(flown, "at", at)
    checkpoint = ae.simulation.Checkpoint(path, **options)
    return small().run(90, [flown], responses=False, progress=False, batch_size=30, checkpoint=checkpoint)


def test_ctrl_c_saves_the_run_which_can_be_resumed(tmp_path):
    run = interrupted(tmp_path / "run.h5", (40,))
    assert (run.ended, len(run)) == ("interrupted", 60)
    assert [item.name for item in tmp_path.iterdir()] == ["run.h5"]
    interrupted(tmp_path / "run.h5", (), resume=True)
    interrupted(tmp_path / "whole.h5", ())
    assert ae.load(tmp_path / "run.h5").ended == ""
    assert differing(tmp_path / "run.h5", tmp_path / "whole.h5") == []


def test_a_run_whose_time_is_over_has_the_first_ions_and_can_be_resumed(tmp_path):
    options = {"responses": False, "progress": False, "batch_size": 30}
    run = small().run(90, checkpoint=tmp_path / "run.h5", seconds=0, **options)  # a batch is never cut
    assert (run.ended, len(run)) == ("its time was over", 30)
    small().run(90, checkpoint=ae.simulation.Checkpoint(tmp_path / "run.h5", resume=True), seconds=1000, **options)
    whole = small().run(90, checkpoint=tmp_path / "whole.h5", **options)
    assert whole.ended == "" and differing(tmp_path / "run.h5", tmp_path / "whole.h5") == []
    assert small().run(30, seconds=0, **options).ended == ""  # nothing was left to do
    assert len(small().run(90, seconds=lambda ions: 1000 if ions < 60 else 0, **options)) == 60
    for wrong in (-1, float("nan"), "1 min"):
        with pytest.raises(ValueError, match="seconds"):
            small().run(90, seconds=wrong, **options)


def test_a_second_ctrl_c_keeps_what_is_done(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "run.h5", (40, 50))
    assert len(ae.load(tmp_path / "run.h5.unfinished")) == 30  # the batch before the one that was cut off
    interrupted(tmp_path / "run.h5", (), resume=True)
    interrupted(tmp_path / "whole.h5", ())
    assert differing(tmp_path / "run.h5", tmp_path / "whole.h5") == []


def test_a_run_that_ended_can_be_made_longer(tmp_path):
    short = run_small(tmp_path / "run.h5", 60)
    assert len(run_small(tmp_path / "run.h5", 90, resume=True)) == 90
    run_small(tmp_path / "whole.h5", 90)
    assert differing(tmp_path / "run.h5", tmp_path / "whole.h5") == []
    short.save(tmp_path / "saved.h5")  # also one that was saved without checkpoints
    run_small(tmp_path / "saved.h5", 90, resume=True)
    assert differing(tmp_path / "saved.h5", tmp_path / "whole.h5") == []


def test_resuming_what_is_not_there_begins(tmp_path):
    assert len(run_small(tmp_path / "run.h5", resume=True)) == 90


def test_an_error_keeps_what_is_done(tmp_path):
    class Breaking(ae.Unperturbed):
        def launch(self, emissions, random):
            if emissions.ions[-1] > 60:
                raise RuntimeError("broken on purpose")
            return super().launch(emissions, random)

    with pytest.raises(ae.simulation.RunInterrupted, match="on purpose") as caught:
        small().run(90, [Breaking()], responses=False, progress=False, batch_size=30, checkpoint=tmp_path / "run.h5")
    assert len(caught.value.run) == 60
    assert len(ae.load(tmp_path / "run.h5.unfinished")) == 60


# ---- files that do not let themselves be written -------------------------------------------------------------------


def test_a_full_disk_loses_nothing(tmp_path):
    """A limit on the size of files, as they meet a full disk: writing fails part of the way."""
    resource = pytest.importorskip("resource")  # not on Windows
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, before[1]))
    try:
        with (
            pytest.warns(UserWarning, match=r"no checkpoint: cannot write .*File too large; the run continues"),
            pytest.raises(ae.simulation.RunNotSaved, match=r"cannot write .*File too large") as caught,
        ):
            run_small(tmp_path / "run.h5")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(caught.value.run) == 90
    caught.value.run.save(tmp_path / "saved.h5")
    run_small(tmp_path / "run.h5", resume=True)
    assert differing(tmp_path / "run.h5", tmp_path / "saved.h5") == []


@MODES
def test_a_read_only_folder_is_refused_before_the_run(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    (tmp_path / "folder").mkdir(mode=0o500)
    with pytest.raises(ae.FileError, match=r"cannot write .*run\.h5.*Permission denied"):
        run_small(tmp_path / "folder" / "run.h5")


def test_a_folder_that_is_not_there_is_refused_before_the_run(tmp_path):
    with pytest.raises(ae.FileError, match=r"cannot write .*No such file"):
        run_small(tmp_path / "nowhere" / "run.h5")


def test_a_file_of_somebody_else_is_not_overwritten(tmp_path):
    (tmp_path / "run.h5").write_text("my only copy")
    with pytest.raises(ae.FileError, match=r"run\.h5' exists and is not a run"):
        run_small(tmp_path / "run.h5")
    assert (tmp_path / "run.h5").read_text() == "my only copy"
    assert [item.name for item in tmp_path.iterdir()] == ["run.h5"]


def hold(path):
    """Take the lock of a run, say so, and keep it until killed."""
    lock = FileLock(Path(f"{path}.lock"), "run.h5")
    path.with_name("held").touch()
    time.sleep(100)
    lock.release()


@pytest.mark.slow
@FORK
def test_one_process_at_a_time(tmp_path, processes):
    path = tmp_path / "run.h5"
    threading.Thread(target=processes.run, args=(hold, path), kwargs={"kill_after": 5}).start()
    while not (tmp_path / "held").exists():
        time.sleep(0.01)
    with pytest.raises(ae.FileError, match=r"run\.h5' is being written by process \d+ on .*; wait for it or choose"):
        run_small(path)
    assert not path.exists()
    while True:  # the lock of a killed process is none
        try:
            assert len(run_small(path)) == 90
            break
        except ae.FileError:
            time.sleep(0.1)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["held", "run.h5"]


def test_one_thread_at_a_time(tmp_path):
    lock = FileLock(tmp_path / "run.h5.lock", "run.h5")
    with pytest.raises(ae.FileError, match=rf"run\.h5' is being written by process {os.getpid()} on "):
        run_small(tmp_path / "run.h5")
    lock.release()
    assert len(run_small(tmp_path / "run.h5")) == 90


def test_a_lock_that_its_owner_just_removed_is_not_taken(tmp_path, monkeypatch):
    """The second opens the file, the first removes it and a third makes another: the second must see the third."""
    first, path = FileLock(tmp_path / "lock", "run.h5"), tmp_path / "lock"
    take, others = FileLock._lock, []

    def late(lock, *arguments):
        if not others:
            others.append(None)
            first.release()
            others.append(FileLock(path, "run.h5"))
        return take(lock, *arguments)

    monkeypatch.setattr(FileLock, "_lock", late)
    with pytest.raises(ae.FileError, match="is being written by"):
        FileLock(path, "run.h5")
    others[1].release()
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def unfinished(tmp_path):
    """A run with 60 of its ions."""
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "run.h5", (70, 75))
    assert len(ae.load(tmp_path / "run.h5.unfinished")) == 60
    return tmp_path / "run.h5"


def test_an_unfinished_run_is_not_thrown_away_unasked(unfinished):
    with pytest.raises(ae.FileError, match=r"unfinished run of 60 ions beside it.*\(--resume\) continues it"):
        interrupted(unfinished, ())
    run = interrupted(unfinished, (), overwrite=True)
    assert len(run) == len(ae.load(unfinished)) == 90
    assert not Path(f"{unfinished}.unfinished").exists()


def test_other_settings_are_refused(unfinished):
    checkpoint = ae.simulation.Checkpoint(unfinished, resume=True)
    options = {"responses": False, "progress": False, "checkpoint": checkpoint}
    with pytest.raises(ae.FileError, match=r"detector\.distance is 100\.0 in the stored run, 50\.0 in the new"):
        small(detector=ae.Detector(distance=50.0)).run(90, [Interrupting()], **options)
    with pytest.raises(ae.FileError, match=r"flown is .*Interrupting.* in the stored run, .*RollUp.* in the new"):
        small().run(90, [ae.RollUp(0.2)], **options)
    with pytest.raises(ValueError, match="n_ions"):
        small().run(50, [Interrupting()], **options)
    used = small()
    used.run(5, responses=False, progress=False)
    with pytest.raises(ValueError, match="resume"):
        used.run(90, [Interrupting()], **options)
    assert len(interrupted(unfinished, (), resume=True)) == 90


@pytest.mark.slow
@pytest.mark.parametrize(
    ("there", "message"),
    [
        ({"n_ions": 90}, "contains a run of 90 ions, more than the requested 60: overwrite=True .* replaces it"),
        (
            {"n_ions": 60, "voltage": 900.0},
            r"other settings \(voltage is 900\.0 in the stored run, 1000\.0 in the new one\): overwrite",
        ),
        (
            {"n_ions": 60, "ended": "interrupted"},
            r"an incomplete run of 60 ions \(interrupted\): resume=True \(--resume\) continues it",
        ),
    ],
)
def test_a_run_that_would_not_come_out_again_is_not_replaced(tmp_path, there, message):
    ended = there.pop("ended", "")
    run_small(tmp_path / "run.h5", **there).ended_by(ended).save(tmp_path / "run.h5")
    before = (tmp_path / "run.h5").read_bytes()
    with pytest.raises(ae.FileError, match=message):
        run_small(tmp_path / "run.h5", 60)
    assert (tmp_path / "run.h5").read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["run.h5"]
    small().run(
        60, responses=False, progress=False, checkpoint=ae.simulation.Checkpoint(tmp_path / "run.h5", overwrite=True)
    )
    assert len(run_small(tmp_path / "run.h5", 60)) == 60  # the same again, and a longer one, may take its place
    assert len(run_small(tmp_path / "run.h5", 90)) == 90


def test_a_refused_resume_leaves_nothing_behind(tmp_path):
    run_small(tmp_path / "run.h5", 90)
    with pytest.raises(ae.FileError, match="n_ions"):
        run_small(tmp_path / "run.h5", 60, resume=True)
    used = small()
    used.run(5, responses=False, progress=False)
    with pytest.raises(ValueError, match="resume"):
        used.run(
            120, responses=False, progress=False, checkpoint=ae.simulation.Checkpoint(tmp_path / "run.h5", resume=True)
        )
    assert [item.name for item in tmp_path.iterdir()] == ["run.h5"]


def test_a_complete_run_is_not_written_again_by_resume(tmp_path):
    run_small(tmp_path / "run.h5", 90)
    before = os.stat(tmp_path / "run.h5")
    simulation = small()
    checkpoint = ae.simulation.Checkpoint(tmp_path / "run.h5", resume=True)
    assert checkpoint.ions_there() == 90
    assert len(simulation.run(90, responses=False, progress=False, checkpoint=checkpoint)) == 90
    after = os.stat(tmp_path / "run.h5")
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    more = simulation.run(20, responses=False, progress=False)  # continues with the next atoms
    assert more.emissions.ions[0] == 90


@pytest.mark.parametrize(("at", "kept"), [((5, 6), 0), ((40, 50), 30)])
def test_ctrl_c_waits_for_files(tmp_path, monkeypatch, at, kept):
    """Pressed once more at every rename: nothing is left half way, and no folder without ions."""

    def pressing(*names):
        signal.raise_signal(signal.SIGINT)
        replace(*names)

    replace = os.replace
    monkeypatch.setattr(os, "replace", pressing)
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "run.h5", at)
    assert ae.simulation.Checkpoint(tmp_path / "run.h5").ions_there() == kept
    assert [item.name for item in tmp_path.iterdir()] == (["run.h5.unfinished"] if kept else [])


def test_the_progress_may_be_told_to_a_function():
    told = []
    small().run(50, responses=False, progress=lambda done, n_ions: told.append((done, n_ions)), batch_size=20)
    assert told == [(20, 50), (40, 50), (50, 50)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "run.txt"}, r"ends in \.h5, got 'run\.txt'"),
        ({"path": "run.h5", "minutes": -1}, "minutes must be a finite number"),
        ({"path": "run.h5", "ions": 0}, "ions must be an integer"),
    ],
)
def test_settings_that_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ae.simulation.Checkpoint(**options)


# ---- files and folders of others -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["run.h5.lock", "run.h5.unfinished"])
@pytest.mark.parametrize(
    "kind", [pytest.param("link", marks=LINKS), "folder", pytest.param("pipe", marks=PIPES), "text"]
)
def test_only_files_of_this_program_are_replaced(tmp_path, name, kind):
    place, victim = tmp_path / name, tmp_path / "victim.txt"
    victim.write_text("precious")
    {
        "link": lambda: place.symlink_to(victim),
        "folder": place.mkdir,
        "pipe": lambda: os.mkfifo(place),
        "text": lambda: place.write_text("precious"),
    }[kind]()
    with pytest.raises(ae.FileError, match=re.escape(name)):
        run_small(tmp_path / "run.h5")
    assert victim.read_text() == "precious" and os.path.lexists(place)
    assert kind != "text" or place.read_text() == "precious"


@PIPES
def test_an_output_that_is_a_pipe_is_refused_before_the_run(tmp_path):
    os.mkfifo(tmp_path / "run.h5")
    with pytest.raises(ae.FileError, match="Not a regular file"):
        run_small(tmp_path / "run.h5")
    assert [item.name for item in tmp_path.iterdir()] == ["run.h5"]


@MODES
def test_a_run_that_is_overwritten_keeps_its_mode(tmp_path):
    run_small(tmp_path / "run.h5")
    (tmp_path / "run.h5").chmod(0o640)
    run_small(tmp_path / "run.h5")
    assert (tmp_path / "run.h5").stat().st_mode & 0o777 == 0o640


# ---- what does not belong together ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"isolated": np.array([10**9]), "isolated_normals": np.eye(3)[:1]}, "isolated must be surface atoms"),
        ({"isolated": np.array([-1]), "isolated_normals": np.eye(3)[:1]}, "isolated must be surface atoms"),
        ({"sites": np.array([10**9])}, "atoms to remove must be in the specimen"),
        ({"charges": np.ones(3)}, "start must have the charges of"),
        ({"rule_state": {}}, "potential_point"),
        ({"rule_state": {"potential_point": np.zeros(4)}}, "reshape"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(tmp_path, change, reason):
    run = run_small(tmp_path / "run.h5", 60)
    replace(run, state=replace(run.state, **change)).save(tmp_path / "run.h5")
    with pytest.raises(ae.FileError, match=rf"cannot be resumed, its state does not fit: .*{reason}"):
        run_small(tmp_path / "run.h5", 90, resume=True)


def test_a_run_knows_all_systems_it_was_computed_on(tmp_path):
    run = run_small(tmp_path / "run.h5", 60)
    (system,) = run.provenance["systems"]
    assert {"processor", "machine", "numpy", "scipy", "h5py", "hdf5"} <= set(system)
    other = dict(system, processor="of another machine")
    replace(run, provenance=run.provenance | {"systems": [other]}).save(tmp_path / "run.h5")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run_small(tmp_path / "run.h5", 90, resume=True)
    assert ae.load(tmp_path / "run.h5").provenance["systems"] == [other, system]


# ---- damaged files -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("place", [0.001, 0.5])
def test_a_damaged_checkpoint_is_named(unfinished, place):
    path = Path(f"{unfinished}.unfinished")
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1
    path.write_bytes(content)
    for action in (lambda: ae.load(path), lambda: interrupted(unfinished, (), resume=True)):
        with pytest.raises(ae.FileError, match=r"run\.h5\.unfinished' is damaged"):
            action()
    assert path.read_bytes() == content
    assert len(interrupted(unfinished, (), overwrite=True)) == 90


def serve():
    """Run every function asked for in a child, and say how it ended."""
    small(), simulation()  # names are loaded when they are first used
    for line in sys.stdin:
        name, kill_after, path, *numbers = json.loads(line)
        child = os.fork()
        if child == 0:
            try:
                {"work": work, "crash": crash, "hold": hold}[name](Path(path), *map(int, numbers))
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        began = time.monotonic()
        while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0):
            if kill_after is not None and time.monotonic() - began > kill_after:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.0005)
        print(os.waitstatus_to_exitcode(ended[1]), flush=True)


if __name__ == "__main__":
    serve()
