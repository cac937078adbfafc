"""Locks, of which every process has its own files."""

import subprocess
import sys
import threading
import time

import pytest

from apt_evap._common.files import FileError
from apt_evap.simulation.locks import FileLock, open_lock, try_lock

HOLD = (
    "import sys; from pathlib import Path; from apt_evap.simulation.locks import FileLock\n"
    "lock = FileLock(Path(sys.argv[1]), 'something'); print('locked', flush=True); sys.stdin.read(); lock.release()"
)


@pytest.fixture
def holder(tmp_path):
    """Another process that holds a lock until its standard input is closed."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "lock")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()
    process.stdin.close()


def test_a_lock_of_another_process(holder, tmp_path):
    with pytest.raises(FileError, match=rf"'it' is being written by process {holder.pid} on .*; wait for it or choose"):
        FileLock(tmp_path / "lock", "it")
    with open(tmp_path / "lock") as file:  # also through another way of opening it
        assert not try_lock(file.fileno()) and not try_lock(file.fileno(), shared=True)


def test_the_end_of_another_process_is_waited_for(holder, tmp_path):
    calls = []
    threading.Timer(1.0, holder.stdin.close).start()
    began = time.monotonic()
    lock = FileLock(tmp_path / "lock", "it", wait=lambda: calls.append(True))
    assert time.monotonic() - began > 0.5 and calls == [True]  # called once
    lock.release()
    assert list(tmp_path.iterdir()) == []


def test_the_lock_of_a_killed_process_is_none(holder, tmp_path):
    holder.kill()
    holder.wait()
    assert (tmp_path / "lock").exists()
    FileLock(tmp_path / "lock", "it").release()
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_no_lock(tmp_path):
    (tmp_path / "lock").write_text("my notes")
    with pytest.raises(FileError, match=r"is not the lock of a run: it contains 'my notes'"):
        FileLock(tmp_path / "lock", "it")
    assert (tmp_path / "lock").read_text() == "my notes"
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileError, match=r"cannot write .*folder"):
        FileLock(tmp_path / "folder", "it")
    with pytest.raises(OSError):
        open_lock(tmp_path / "folder")
