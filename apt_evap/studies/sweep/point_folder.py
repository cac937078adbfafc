"""One point of a sweep: a folder with the settings of a simulation and its run.

The state of a point is read off its files: ``settings.toml``, ``run.h5`` (``run.h5.unfinished`` before), ``lock``,
which is locked while a process works on the point, and ``work.json`` with the time so far and the error of a failed
point.
"""

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from apt_evap._common.checked_hdf5 import label_of
from apt_evap._common.files import FileError, check_path, read_small_file, replace_file
from apt_evap._common.types import AnyPath
from apt_evap.simulation.checkpoint import Checkpoint
from apt_evap.simulation.config.simulation_file import config_of, key_of, read_document
from apt_evap.simulation.locks import open_lock, try_lock

SETTINGS, RUN, WORK, LOCK = "settings.toml", "run.h5", "work.json", "lock"
"""Files of a point."""
STATES = ("done", "running", "waiting", "failed", "wrong")
"""States of a point."""
_AT_WORK = "a process works on it"
_MAX_BYTES = 1 << 20
_LOCK_TRIES, _LOCK_WAIT = 10, 0.05  # `state_of` locks for an instant [s]


@dataclass(frozen=True)
class PointState:
    """State of a point of a sweep.

    Parameters
    ----------
    seconds : float or None
        Time of all work on the point [s]; None if it is not known, because a process was killed.
    """

    name: str
    message: str = ""
    seconds: float | None = 0.0


def unlinked(path: Path) -> Path:
    """Return a path in a sweep; FileError if it is a link, which may lead out of the folder."""
    if path.is_symlink():
        raise FileError(f"{str(path)!r} must be a file or folder, got a link: a sweep follows no links")
    return path


def write_text(path: Path, text: str) -> None:
    """Write or replace a complete text file of a sweep; FileError if it is a link or cannot be written."""
    with replace_file(unlinked(path)) as file:
        file.write(text.encode())


def state_of(folder: Path) -> PointState:
    """State of a point, from the files in its folder."""
    state = _stored_state(folder)
    if state.name != "waiting":
        return state
    if _is_locked(folder):
        return replace(state, name="running", message=_AT_WORK)
    return _stored_state(folder)  # again: a process that worked on it may have ended in between


def _stored_state(folder):
    """State without the lock."""
    notes, path = _notes(folder), folder / RUN
    seconds = notes["seconds"]
    if os.path.lexists(path):
        try:
            label = label_of(unlinked(path))
        except FileError as error:
            return PointState("wrong", str(error), seconds)
        if label is None or label.kind != "run":
            return PointState("wrong", f"{str(path)!r} is not a complete file of a run", seconds)
        if label.note == folder.name:
            return PointState("done", "", seconds)
        if label.note:  # otherwise an unfinished run
            return PointState("wrong", f"{str(path)!r} is the run of other settings: {label.note}", seconds)
    return PointState("failed" if notes["error"] else "waiting", notes["error"], seconds)


def ions_of(folder: Path) -> int:
    """Number of ions that the run of a point has on the disk; 0 if a file is damaged."""
    try:
        return Checkpoint(folder / RUN).ions_there()
    except FileError:
        return 0


def run_point(folder: AnyPath, threads: int = 1, checkpoint: float = 10.0) -> PointState:
    """Run a point of a sweep in this process, unless it is done, has failed, or another process works on it.

    The run continues from the last checkpoint of an earlier one. An error of the settings makes the point "failed".
    After an error of the system, such as a full disk, it is "waiting" with a message.

    Parameters
    ----------
    folder : str or path-like
        Folder of the point.
    threads : int
        Threads of the run.
    checkpoint : float
        Time between two checkpoints [min].

    Returns
    -------
    PointState
        Afterwards.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, when the ions are saved.
    """
    folder, message = check_path(folder).absolute(), ""
    try:
        with _locked(unlinked(folder)) as is_free:
            if not is_free:
                return PointState("running", _AT_WORK)
            state = _stored_state(folder)
            if state.name != "waiting":
                return state
            began, error = time.monotonic(), ""
            _write_notes(folder, None)
            try:
                _run(folder, threads, checkpoint)
            except Exception as problem:
                message = str(problem) if isinstance(problem, ValueError) else f"{type(problem).__name__}: {problem}"
                error = "" if _is_of_the_system(problem) else message
            finally:
                with suppress(FileError):
                    _write_notes(
                        folder, None if state.seconds is None else state.seconds + time.monotonic() - began, error
                    )
    except FileError as problem:
        message = str(problem)
    state = _stored_state(folder)
    return replace(state, message=state.message or message)


def _run(folder, threads, checkpoint):
    for name in os.listdir(folder):
        unlinked(folder / name)
    path = folder / SETTINGS
    config = config_of(_planned(path), path)
    run = config.simulation(n_threads=threads).run(
        config.n_ions,
        config.emissions,
        responses=config.responses,
        progress=False,
        checkpoint=Checkpoint(folder / RUN, checkpoint, resume=True),
    )
    config.as_saved(run.unless_interrupted()).save(folder / RUN)


def _planned(path):
    """Content of the settings of a point; FileError, before anything of it is used, if it is not that of the plan."""
    document = read_document(path)
    try:
        key = key_of(document)
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error
    if key != path.parent.name:
        raise FileError(f"{str(path)!r} has other settings than the plan: apt-evap sweep plan writes it again")
    return document


def _is_of_the_system(error):
    """Whether an error, or one that it was raised for, is that of a file, a lock or the memory."""
    while error is not None and not isinstance(error, OSError | MemoryError):
        error = error.__cause__ or error.__context__
    return error is not None


def try_again(folder: Path) -> None:
    """Forget the error of a failed point; FileError if this cannot be written."""
    _write_notes(folder, _notes(folder)["seconds"])


def _write_notes(folder, seconds, error=""):
    write_text(folder / WORK, json.dumps({"seconds": seconds, "error": error}) + "\n")


def _notes(folder):
    """Content of ``work.json``; what is missing or has the wrong type is not known."""
    notes: dict[str, Any] = {"seconds": None, "error": ""}
    if not os.path.lexists(folder / WORK):
        return notes | {"seconds": 0.0}
    try:
        content = json.loads(read_small_file(unlinked(folder / WORK), _MAX_BYTES, "notes on a point"))
        seconds, error = content["seconds"], content["error"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return notes
    if isinstance(seconds, float) and 0 <= seconds < float("inf"):
        notes["seconds"] = seconds
    if isinstance(error, str):  # it is printed
        notes["error"] = "".join(letter if letter.isprintable() else " " for letter in error)
    return notes


# ---- the lock --------------------------------------------------------------------------------------------------------


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a point until the end of the block; False if another process has locked it."""
    try:
        descriptor = open_lock(folder / LOCK)
    except OSError as error:
        raise FileError(f"cannot write {str(folder / LOCK)!r}: {error.strerror or error}") from error
    try:
        for _ in range(_LOCK_TRIES):
            if is_free := _is_free(descriptor, shared=False):
                break
            time.sleep(_LOCK_WAIT)
        yield is_free
    finally:
        os.close(descriptor)


def _is_locked(folder):
    try:
        descriptor = open_lock(folder / LOCK, os.O_RDONLY)
    except OSError:
        return False
    try:
        return not _is_free(descriptor, shared=True)
    finally:
        os.close(descriptor)


def _is_free(descriptor, shared):
    """Lock an open file; return whether it was free, also where the file system has no locks."""
    try:
        return try_lock(descriptor, shared)
    except OSError:
        return True
