"""Checkpoints: a run is kept in a folder beside its file while it goes on, so that nothing done is lost.

The folder NAME.h5.unfinished holds the ions in parts, each a run file of its own, and the state of the emitter. Every
file is written aside, flushed to the disk and renamed: it is there whole or not at all, whenever the process is killed.
A part comes before the state that goes with it. Once the run has ended, NAME.h5 is written in the same way, and then
the folder goes: renamed first, so that no half of it is taken for an unfinished run.
"""

import contextlib
import errno
import os
import re
import secrets
import shutil
import socket
import stat
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, check_path, check_regular, is_unfinished, move_file
from apt_evap._common.interrupts import uninterrupted
from apt_evap._common.validation import check_count, check_number, check_switch
from apt_evap._common.warnings import DataWarning, RunWarning
from apt_evap._common.wording import argument
from apt_evap.evaporation.state import EmitterState
from apt_evap.simulation.ending import Ending
from apt_evap.simulation.run import PART_NAME, Run, load, part_paths
from apt_evap.simulation.run_hdf5 import count_ions, described, is_run, plain, read_state, write_state

try:
    import fcntl
except ImportError:  # not on this system: two processes on one file are not noticed
    fcntl = None


STATE_NAME, WHOLE_NAME, LOCK_NAME = "state.h5", "whole.h5", "lock"
_OWNER = "process "  # what a lock begins with
_OPEN_LOCK = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_TRIES = 1000  # times that other processes may take the folder away while this one locks it


@dataclass(frozen=True)
class Checkpoint:
    """Where a run is kept while it goes on, and how often.

    Parameters
    ----------
    path : str or path-like
        File of the run, .h5, written once it has ended; until then the run is in the folder of this name with
        ".unfinished" after it.
    minutes : float
        Time between two checkpoints [min]; 0 for one after every batch of events.
    ions : int, optional
        Ions after which there is a checkpoint in any case.
    resume : bool
        Whether to go on with what is there: an unfinished run, or the file of one that ended. If nothing is there, the
        run begins.
    overwrite : bool
        Whether to begin anew over an unfinished run, over the file of one that was interrupted, is longer or has other
        settings, and over a file that is no run.
    """

    path: str | os.PathLike
    minutes: float = 10.0
    ions: int | None = None
    resume: bool = False
    overwrite: bool = False

    def __post_init__(self):
        object.__setattr__(self, "path", check_path(self.path))
        if self.path.suffix.lower() != ".h5":
            raise FileError(f"a run is saved in an HDF5 file whose name ends in .h5, got {str(self.path)!r}")
        check_number(self.minutes, "minutes", at_least=0, unit="min")
        if self.ions is not None:
            check_count(self.ions, "ions", at_least=1)
        for name in ("resume", "overwrite"):
            check_switch(getattr(self, name), name)

    @property
    def folder(self) -> Path:
        """Folder of the unfinished run."""
        target = Path(os.path.realpath(self.path))
        return target.with_name(target.name + ".unfinished")

    def ions_there(self) -> int:
        """Ions of the unfinished run, or else of the file; 0 if there is neither."""
        paths = part_paths(self.folder) or [path for path in (self.path,) if path.exists()]
        return sum(map(count_ions, paths))


class Keeper:
    """Keeps one run on the disk; locked against other processes from `open` to `close`.

    Parameters
    ----------
    checkpoint : Checkpoint
        Where and how often.
    settings : dict
        Settings of the run that is about to go on or begin.
    perturbations : tuple
        Flown in it.
    responses : bool
        Whether it has responses.
    n_ions : int
        Ions it is to have in the end.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        settings: dict[str, Any],
        perturbations: tuple[Any, ...],
        responses: bool,
        n_ions: int,
    ) -> None:
        self._checkpoint, self._folder = checkpoint, checkpoint.folder
        self._target = Path(os.path.realpath(checkpoint.path))
        self._lock, self._is_ours = None, False
        self._written_at, self._written_to = time.monotonic(), 0
        self.done = None  # what is there already
        self._in_file = False  # whether that is in the file only, and not yet in the folder
        self.complete = False  # whether it is in the file, with nothing left to do
        self._here = dict(
            _flat(plain(settings)), responses=responses, flown=[described(each) for each in perturbations]
        )
        try:
            self._open()
            self._prepare(n_ions)
        except BaseException:
            self.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    # ---- the lock --------------------------------------------------------------------------------------------------

    def _open(self):
        # The lock may be on a folder that its last owner has just taken away: then once more.
        for _ in range(_TRIES):
            try:
                self._make_folder()
                lock = open(self._folder / LOCK_NAME, "r+", encoding="utf-8", errors="replace", opener=_open_lock)
            except FileNotFoundError as error:
                if self._folder.parent.is_dir():
                    continue
                raise self._error(error) from error
            except OSError as error:
                raise self._error(error) from error
            try:
                self._take(lock)
                if os.path.samestat(os.fstat(lock.fileno()), os.lstat(self._folder / LOCK_NAME)):
                    self._sign(lock)
                    self._lock = lock
                    return
            except FileNotFoundError:
                pass
            except OSError as error:
                raise self._error(error) from error
            finally:
                if self._lock is None:
                    lock.close()
        raise FileError(f"cannot write {str(self._folder)!r}: other processes take it away")

    def _sign(self, lock):
        """Write into a lock whose it is, over what another process has written."""
        lock.seek(0)
        if (written := lock.read(100)) and not written.startswith(_OWNER):
            raise FileError(f"{str(self._folder / LOCK_NAME)!r} is not a lock of a run: it reads {written!r:.40}")
        lock.seek(0)
        lock.truncate()
        lock.write(f"{_OWNER}{os.getpid()} on {socket.gethostname()}")
        lock.flush()

    def _make_folder(self):
        try:
            self._folder.mkdir()
            self._is_ours = True
        except FileExistsError:
            if not stat.S_ISDIR(os.lstat(self._folder).st_mode):
                raise OSError(None, "Not a folder") from None
            self._is_ours = self._is_ours or bool(os.listdir(self._folder))

    def _take(self, lock):
        if fcntl is None:
            return
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                lock.seek(0)
                owner = lock.read(100) or "another process"
                raise FileError(
                    f"{str(self._checkpoint.path)!r} is being written by {owner}; wait for it or choose another file"
                ) from None
            warnings.warn(
                f"no lock on {str(self._folder)!r} ({error.strerror}): make sure that no other process writes there",
                RunWarning,
                stacklevel=6,
            )

    @uninterrupted()
    def close(self) -> None:
        """Let go of the files; a folder without ions is removed if this run has made it."""
        with contextlib.suppress(OSError):
            if self._lock is None:
                if self._is_ours:
                    self._folder.rmdir()  # made, and not locked yet; one that somebody else has locked is not empty
            elif self._folder.is_dir() and not part_paths(self._folder):
                self._remove_folder()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _remove_folder(self):
        names = os.listdir(self._folder)
        if self._is_ours and all(map(_is_known, names)):
            # renamed first: a folder with some of its files gone is not an unfinished run
            gone = self._folder.with_name(f".{self._folder.name}.{secrets.token_hex(8)}.gone")
            os.replace(self._folder, gone)
            shutil.rmtree(gone, ignore_errors=True)
            return
        # somebody else's folder or files stay; the last part goes first, as what is left of a run is then a run
        parts = [path.name for path in part_paths(self._folder)]
        for name in (WHOLE_NAME, STATE_NAME, *filter(is_unfinished, names), *reversed(parts), LOCK_NAME):
            (self._folder / name).unlink(missing_ok=True)

    def _error(self, error):
        return FileError(f"cannot write {str(self._folder)!r}: {error.strerror or error}")

    # ---- what is there ---------------------------------------------------------------------------------------------

    def _prepare(self, n_ions):
        checkpoint, folder = self._checkpoint, self._folder
        try:
            if self._target.exists():
                check_regular(os.stat(self._target))
            for rest in (*folder.glob(".*.part"), *folder.glob(WHOLE_NAME)):
                rest.unlink()
            gone = re.compile(rf"\.{re.escape(folder.name)}\.[0-9a-f]+\.gone")
            for entry in os.scandir(folder.parent):
                if gone.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
        except OSError as error:
            raise self._error(error) from error
        parts = part_paths(folder)
        if checkpoint.resume:
            if parts or self._target.exists():
                self._go_on(parts, n_ions)
            return
        if not checkpoint.overwrite:
            self._refuse_a_loss(parts, n_ions)
        for path in (folder / STATE_NAME, *parts[::-1]):
            path.unlink(missing_ok=True)

    def _go_on(self, parts, n_ions):
        """Take up what is there."""
        name, done = str(self._checkpoint.path), load(self._folder if parts else self._target)
        if differing := self._differing(done):
            raise FileError(f"the run in {name!r} cannot be resumed with other settings: {differing}")
        if not np.array_equal(done.emissions.ions, done.emissions.ions[0] + np.arange(len(done))):
            raise FileError(f"the run in {name!r} cannot be resumed: some of its ions are missing")
        if len(done) > n_ions:
            raise FileError(
                f"{argument('n_ions')} must be at least the {len(done):,} that are done already, got {n_ions:,}"
            )
        if not parts and done.state is None:
            raise FileError(f"the run in {name!r} cannot be resumed: the file holds no state")
        self.done, self._in_file, self._written_to = done, not parts, len(done)
        self.complete = not parts and not done.ended and len(done) == n_ions
        if parts:
            self.done = self._with_state(done)

    def _refuse_a_loss(self, parts, n_ions):
        """Refuse to begin anew over what this run would not give again."""
        name, replaces = str(self._checkpoint.path), f"{argument('overwrite', True)} replaces it"
        anew = f"{argument('resume', True)} goes on with it, {argument('overwrite', True)} begins anew"
        if parts:
            ions = sum(map(count_ions, parts))
            raise FileError(
                f"{name!r} has an unfinished run of {ions:,} ions beside it, in {self._folder.name!r}: {anew}"
            )
        if not self._target.exists():
            return
        if not is_run(self._target):
            raise FileError(f"{name!r} exists and is no run: {replaces}")
        try:
            done = load(self._target)
        except FileError as error:
            raise FileError(f"{error}; {replaces}") from error
        if differing := self._differing(done):
            raise FileError(f"{name!r} holds a run with other settings ({differing}): {replaces}")
        if done.ended not in (Ending.COMPLETE, Ending.EXHAUSTED):
            raise FileError(f"{name!r} holds a run of {len(done):,} ions that is not complete ({done.ended}): {anew}")
        if len(done) > n_ions:
            raise FileError(
                f"{name!r} holds a run of {len(done):,} ions, more than the {n_ions:,} asked for: {replaces}"
            )

    def _with_state(self, run):
        """The unfinished run with the state beside its parts; without one its events begin at the first."""
        path = self._folder / STATE_NAME
        try:
            if path.exists():
                state, first_event = read_state(path)
            else:  # killed after a part and before its state; a part that was a whole run has one of its own
                last = load(part_paths(self._folder)[-1])
                state, first_event = last.state, last.first_event
        except FileError as error:
            warnings.warn(f"{error}: all events are computed again", DataWarning, stacklevel=7)
            state, first_event = None, 0
        return replace(run, state=state, first_event=first_event)

    def _differing(self, done):
        """The settings in which a run differs from this one, in words; "" if there are none."""
        here, there = (
            self._here,
            dict(
                _flat(done.settings),
                responses=done.responses is not None,
                flown=[described(each) for each in done.perturbations],
            ),
        )
        differing = [
            f"{key} is {there.get(key)!r:.60} there and {here.get(key)!r:.60} here"
            for key in dict.fromkeys((*there, *here))
            if there.get(key) != here.get(key)
        ]
        return "; ".join(differing[:3]) + (f", and {len(differing) - 3} more" if len(differing) > 3 else "")

    # ---- writing ---------------------------------------------------------------------------------------------------

    def due(self, ions: int) -> bool:
        """Whether it is time for a checkpoint once the run has so many ions."""
        new = ions - self._written_to
        often = self._checkpoint.ions is not None and new >= self._checkpoint.ions
        return new > 0 and (often or time.monotonic() - self._written_at >= 60 * self._checkpoint.minutes)

    @uninterrupted()
    def write(self, part: Run, state: EmitterState, first_event: int) -> bool:
        """Write the next part of the run, then the state it ends in; if that fails, a warning says so.

        Returns
        -------
        bool
            Whether the part is on the disk; if not, it has to come again with the next one.
        """
        self._written_at = time.monotonic()  # not at once again if it fails
        written = False
        try:
            if self._in_file:
                self._write_part(self.done)
                write_state(self._folder / STATE_NAME, self.done.state, self.done.first_event)
                self._in_file = False
            self._write_part(part)
            self._written_to += len(part)
            written = True
            if len(state.sites) <= first_event + self._written_to:  # else its ions are not on the disk yet
                write_state(self._folder / STATE_NAME, state, first_event)
        except FileError as error:
            warnings.warn(f"no checkpoint: {error}; the run goes on and tries again", RunWarning, stacklevel=4)
        return written

    def _write_part(self, part):
        part.save(self._folder / PART_NAME.format(int(part.emissions.ions[0])))

    @uninterrupted()
    def finish(self, run: Run) -> None:
        """Write the file of the run and take the folder away."""
        whole = self._folder / WHOLE_NAME
        run.save(whole)
        try:
            move_file(whole, self._target)
            self._remove_folder()
        except OSError as error:
            raise FileError(f"cannot write {str(self._checkpoint.path)!r}: {error.strerror or error}") from error


def _open_lock(path, flags):
    descriptor = os.open(path, _OPEN_LOCK, 0o666)
    try:
        status = os.fstat(descriptor)
        check_regular(status)
        if status.st_nlink > 1:
            raise OSError(None, f"its {LOCK_NAME} is another file, too")
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _is_known(name):
    """Whether a file of a folder is one that this module has written."""
    return name in (STATE_NAME, WHOLE_NAME, LOCK_NAME) or _PART.fullmatch(name) is not None or is_unfinished(name)


_PART = re.compile(r"ions-[0-9]{12,}\.h5")


def _flat(settings, before=""):
    """Settings in one dict, the names of the tables before those of the keys."""
    flat = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return flat
