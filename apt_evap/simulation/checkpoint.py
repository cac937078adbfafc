"""Checkpoints: a run in progress is stored in a folder beside its file, so that no results are lost.

The folder NAME.h5.unfinished contains the ions in parts, each a complete run file, and the state of the emitter. Every
file is written under a temporary name, flushed to the disk and renamed. So it is either complete or absent, whenever
the process is killed. A part is written before the state at its end. When the run has ended, NAME.h5 is written in the
same way. Then the folder is removed: it is renamed first, so that its remains are never taken for an unfinished run.
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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, check_path, check_regular, is_unfinished, move_file
from apt_evap._common.interrupts import uninterrupted
from apt_evap._common.validation import check_count, check_number, check_switch
from apt_evap.emission.perturbations import described
from apt_evap.evaporation.state import EmitterState
from apt_evap.simulation.run import PART_NAME, Run, load, part_paths
from apt_evap.simulation.run_hdf5 import count_ions, is_run, read_state, write_state
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.warnings import DataWarning, RunWarning, warn

try:
    import fcntl
except ImportError:  # not on this system: two processes that write the same file are not detected
    fcntl = None


STATE_NAME, WHOLE_NAME, LOCK_NAME = "state.h5", "whole.h5", "lock"
_OWNER = "process "  # first word of a lock file
_OPEN_LOCK = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_TRIES = 1000  # how often other processes may remove the folder while this one locks it


@dataclass(frozen=True)
class Checkpoint:
    """Where and how often a run in progress is stored.

    Parameters
    ----------
    path : str or path-like
        File of the run, .h5, written when it has ended; until then the run is in a folder of this name with
        ".unfinished" appended.
    minutes : float
        Time between two checkpoints [min]; 0 for a checkpoint after every batch of events.
    ions : int, optional
        Largest number of ions between two checkpoints, for any time between them.
    resume : bool
        Whether to continue an unfinished run, or the run in an existing file. If there is neither, a new run begins.
    overwrite : bool
        Whether a new run may replace an unfinished run, the file of a run that was interrupted, is longer or has other
        settings, or a file that is not a run.
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
        """Number of ions in the unfinished run, otherwise in the file; 0 if there is neither."""
        paths = part_paths(self.folder) or [path for path in (self.path,) if path.exists()]
        return sum(map(count_ions, paths))


class Keeper:
    """Storage of one run on the disk, locked against other processes until `close`.

    Parameters
    ----------
    checkpoint : Checkpoint
        Path and interval.
    settings : dict
        Settings of the run to continue or begin.
    perturbations : tuple
        Perturbations flown in the run.
    responses : bool
        Whether the run has responses.
    n_ions : int
        Requested number of ions.
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
        self.previous = None  # the ions so far of a resumed run
        self._in_file = False  # whether these are in the file only, and not yet in the folder
        self.complete = False  # whether all requested ions are in the file
        self._setup = dict(_flat(settings), responses=responses, flown=[described(each) for each in perturbations])
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
        # If the previous owner has just removed the locked folder, repeat.
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
        raise FileError(f"cannot write {str(self._folder)!r}: other processes keep removing it")

    def _sign(self, lock):
        """Write the owner into the lock file, in place of the previous owner."""
        lock.seek(0)
        if (owner := lock.read(100)) and not owner.startswith(_OWNER):
            raise FileError(
                f"{str(self._folder / LOCK_NAME)!r} is not the lock file of a run: it contains {owner!r:.40}"
            )
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
            warn(
                f"cannot lock {str(self._folder)!r} ({error.strerror}): make sure that no other process writes to it",
                RunWarning,
            )

    @uninterrupted()
    def close(self) -> None:
        """Release the lock; remove a folder without ions if this run has created it."""
        with contextlib.suppress(OSError):
            if self._lock is None:
                if self._is_ours:
                    self._folder.rmdir()  # created, but not locked yet; fails if another process has locked it
            elif self._folder.is_dir() and not part_paths(self._folder):
                self._remove_folder()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _remove_folder(self):
        names = os.listdir(self._folder)
        if self._is_ours and all(map(_is_known, names)):
            # rename first: a folder without some of its files is not an unfinished run
            trash = self._folder.with_name(f".{self._folder.name}.{secrets.token_hex(8)}.gone")
            os.replace(self._folder, trash)
            shutil.rmtree(trash, ignore_errors=True)
            return
        # a folder or files of others stay; the last part is removed first, so that the remaining parts are a run
        parts = [path.name for path in part_paths(self._folder)]
        for name in (WHOLE_NAME, STATE_NAME, *filter(is_unfinished, names), *reversed(parts), LOCK_NAME):
            (self._folder / name).unlink(missing_ok=True)

    def _error(self, error):
        return FileError(f"cannot write {str(self._folder)!r}: {error.strerror or error}")

    # ---- existing files --------------------------------------------------------------------------------------------

    def _prepare(self, n_ions):
        checkpoint, folder = self._checkpoint, self._folder
        try:
            if self._target.exists():
                check_regular(os.stat(self._target))
            for rest in (*folder.glob(".*.part"), *folder.glob(WHOLE_NAME)):
                rest.unlink()
            trash = re.compile(rf"\.{re.escape(folder.name)}\.[0-9a-f]+\.gone")
            for entry in os.scandir(folder.parent):
                if trash.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
        except OSError as error:
            raise self._error(error) from error
        parts = part_paths(folder)
        if checkpoint.resume:
            if parts or self._target.exists():
                self._resume(parts, n_ions)
            return
        if not checkpoint.overwrite:
            self._refuse_loss(parts, n_ions)
        for path in (folder / STATE_NAME, *parts[::-1]):
            path.unlink(missing_ok=True)

    def _resume(self, parts, n_ions):
        """Load the run to continue."""
        name, run = str(self._checkpoint.path), load(self._folder if parts else self._target).simulated()
        if differences := self._differences(run):
            raise FileError(f"the run in {name!r} cannot be resumed with other settings: {differences}")
        if not np.array_equal(run.emissions.ions, run.emissions.ions[0] + np.arange(len(run))):
            raise FileError(f"the run in {name!r} cannot be resumed: some of its ions are missing")
        if len(run) > n_ions:
            raise FileError(
                f"n_ions (--ions) must be >= {len(run):,}, the number of ions of the run so far, got {n_ions:,}"
            )
        if not parts and run.state is None:
            raise FileError(f"the run in {name!r} cannot be resumed: the file contains no state")
        self.previous, self._in_file, self._written_to = run, not parts, len(run)
        self.complete = not parts and not run.ended and len(run) == n_ions
        if parts:
            self.previous = self._with_state(run)

    def _refuse_loss(self, parts, n_ions):
        """Refuse to replace ions that the new run would not contain."""
        name, replaces = str(self._checkpoint.path), "overwrite=True (--force) replaces it"
        choices = f"resume=True (--resume) continues it, {replaces}"
        if parts:
            ions = sum(map(count_ions, parts))
            raise FileError(
                f"{name!r} has an unfinished run of {ions:,} ions beside it, in {self._folder.name!r}: {choices}"
            )
        if not self._target.exists():
            return
        if not is_run(self._target):
            raise FileError(f"{name!r} exists and is not a run: {replaces}")
        try:
            run = load(self._target)
        except FileError as error:
            raise FileError(f"{error}; {replaces}") from error
        if differences := self._differences(run):
            raise FileError(f"{name!r} contains a run with other settings ({differences}): {replaces}")
        if run.ended not in (StopReason.COMPLETE, StopReason.EXHAUSTED):
            raise FileError(f"{name!r} contains an incomplete run of {len(run):,} ions ({run.ended}): {choices}")
        if len(run) > n_ions:
            raise FileError(
                f"{name!r} contains a run of {len(run):,} ions, more than the requested {n_ions:,}: {replaces}"
            )

    def _with_state(self, run):
        """The unfinished run with the state beside its parts; without a state, all its events are recomputed."""
        path = self._folder / STATE_NAME
        try:
            if path.exists():
                state, first_event = read_state(path)
            else:  # killed after a part and before its state; a part that was a complete run contains a state
                last = load(part_paths(self._folder)[-1])
                state, first_event = last.state, last.first_event
        except FileError as error:
            warn(f"{error}: all events are recomputed", DataWarning)
            state, first_event = None, 0
        return replace(run, state=state, first_event=first_event)

    def _differences(self, run):
        """Text on the settings in which a stored run differs from this one; "" if there are none."""
        new, stored = (
            self._setup,
            dict(
                _flat(run.settings),
                responses=run.responses is not None,
                flown=[described(each) for each in run.perturbations],
            ),
        )
        differences = [
            f"{key} is {stored.get(key)!r:.60} in the stored run, {new.get(key)!r:.60} in the new one"
            for key in dict.fromkeys((*stored, *new))
            if stored.get(key) != new.get(key)
        ]
        return "; ".join(differences[:3]) + (f", and {len(differences) - 3} more" if len(differences) > 3 else "")

    # ---- writing ---------------------------------------------------------------------------------------------------

    def due(self, ions: int) -> bool:
        """Whether a checkpoint is due after this number of ions."""
        new = ions - self._written_to
        often = self._checkpoint.ions is not None and new >= self._checkpoint.ions
        return new > 0 and (often or time.monotonic() - self._written_at >= 60 * self._checkpoint.minutes)

    @uninterrupted()
    def write(self, part: Run, state: EmitterState, first_event: int) -> bool:
        """Write the next part of the run, then the state at its end; warn if this fails.

        Returns
        -------
        bool
            Whether the part is on the disk; if not, the next call must include it.
        """
        self._written_at = time.monotonic()  # after a failure, wait before the next attempt
        on_disk = False
        try:
            if self._in_file:
                self._write_part(self.previous)
                write_state(self._folder / STATE_NAME, self.previous.state, self.previous.first_event)
                self._in_file = False
            self._write_part(part)
            self._written_to += len(part)
            on_disk = True
            if len(state.sites) <= first_event + self._written_to:  # otherwise its ions are not on the disk yet
                write_state(self._folder / STATE_NAME, state, first_event)
        except FileError as error:
            warn(f"no checkpoint: {error}; the run continues and will try again", RunWarning)
        return on_disk

    def _write_part(self, part):
        part.save(self._folder / PART_NAME.format(int(part.emissions.ions[0])))

    @uninterrupted()
    def finish(self, run: Run) -> None:
        """Write the file of the run and remove the folder."""
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
            raise OSError(None, f"its {LOCK_NAME} has a second name (hard link)")
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _is_known(name):
    """Whether a file has a name that this module uses."""
    return name in (STATE_NAME, WHOLE_NAME, LOCK_NAME) or _PART.fullmatch(name) is not None or is_unfinished(name)


_PART = re.compile(r"ions-[0-9]{12,}\.h5")


def _flat(settings, before=""):
    """Settings in one dict, with keys such as "table.key"."""
    flat = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return flat
