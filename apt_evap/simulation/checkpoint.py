"""Checkpoints: a run in progress is stored in a file beside its own, so that no results are lost.

NAME.h5.unfinished is a run file with all ions so far and the state of the emitter, which every checkpoint replaces as a
whole. When the run has ended, NAME.h5 is written in the same way, and the unfinished one is removed. NAME.h5.lock is
locked by the process that writes them.
"""

import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.codec import check_itself
from apt_evap._common.files import FileError, check_path, check_regular, remove_abandoned
from apt_evap._common.interrupts import uninterrupted
from apt_evap._common.validation import check_count, check_number, check_switch
from apt_evap.emission.perturbations import described
from apt_evap.simulation.locks import FileLock
from apt_evap.simulation.run import Run, load
from apt_evap.simulation.run_hdf5 import count_ions, is_run
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.warnings import RunWarning, warn

_RATIO = 50  # least ratio of the time between two checkpoints to the time that one takes, unless `minutes` is 0


@dataclass(frozen=True)
class Checkpoint:
    """Where and how often a run in progress is stored.

    Parameters
    ----------
    path : str or path-like
        File of the run, .h5, written when it has ended; until then the run is in a file of this name with
        ".unfinished" appended.
    minutes : float
        Time between two checkpoints [min], longer if they would take more than 2 % of the time; 0 for a checkpoint
        after every batch of events.
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
        check_itself(self)

    def _check(self):
        path = check_path(self.path)
        if path.suffix.lower() != ".h5":
            raise FileError(f"a run is saved in an HDF5 file whose name ends in .h5, got {str(path)!r}")
        check_number(self.minutes, "minutes", at_least=0, unit="min")
        if self.ions is not None:
            check_count(self.ions, "ions", at_least=1)
        for name in ("resume", "overwrite"):
            check_switch(getattr(self, name), name)
        return {"path": path}

    @property
    def unfinished(self) -> Path:
        """File of the unfinished run."""
        return self._beside(".unfinished")

    def _beside(self, suffix):
        target = Path(os.path.realpath(self.path))
        return target.with_name(target.name + suffix)

    def ions_there(self) -> int:
        """Number of ions in the unfinished run, otherwise in the file; 0 if there is neither."""
        paths = [path for path in (self.unfinished, self.path) if path.exists()]
        return count_ions(paths[0]) if paths else 0


class CheckpointWriter:
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
        self._checkpoint, self._name = checkpoint, str(checkpoint.path)
        self._due_at, self._n_written = time.monotonic() + 60 * checkpoint.minutes, 0
        self.previous: Run | None = None  # the ions so far of a resumed run
        self.complete = False  # whether all requested ions are in the file
        self._setup = dict(
            _flat(settings), responses=responses, flown=[described(perturbation) for perturbation in perturbations]
        )
        self._lock = FileLock(checkpoint._beside(".lock"), self._name)
        try:
            self._prepare(n_ions)
        except BaseException:
            self.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    @uninterrupted()
    def close(self) -> None:
        """Release the lock."""
        self._lock.release()

    # ---- existing files --------------------------------------------------------------------------------------------

    def _prepare(self, n_ions):
        unfinished, target = self._checkpoint.unfinished, self._checkpoint.path
        try:
            for path, status in ((target, os.stat), (unfinished, os.lstat)):  # no link leads to somewhere else
                if os.path.lexists(path):
                    check_regular(status(path))
        except OSError as error:
            raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error
        for path in (target, unfinished):
            remove_abandoned(Path(os.path.realpath(path)), after=-math.inf)  # nobody else writes them now
        if self._checkpoint.resume:
            if unfinished.exists() or target.exists():
                self._resume(n_ions)
            return
        if not self._checkpoint.overwrite:
            self._refuse_loss(n_ions)
        unfinished.unlink(missing_ok=True)

    def _resume(self, n_ions):
        """Load the run to continue."""
        name, is_unfinished = self._name, self._checkpoint.unfinished.exists()
        replaces = "overwrite=True (--force) replaces it"
        run = load(self._checkpoint.unfinished if is_unfinished else self._checkpoint.path).simulated()
        if differences := self._differences(run):
            raise FileError(f"the run in {name!r} cannot be resumed with other settings ({differences}): {replaces}")
        if not np.array_equal(run.emissions.ions, run.emissions.ions[0] + np.arange(len(run))):
            raise FileError(f"the run in {name!r} cannot be resumed, some of its ions are missing: {replaces}")
        if len(run) > n_ions:
            raise FileError(
                f"n_ions (--ions) must be >= {len(run):,}, the number of ions of the run in {name!r}, got {n_ions:,}: "
                f"{replaces}"
            )
        if not is_unfinished and run.state is None:
            raise FileError(f"the run in {name!r} cannot be resumed, the file contains no state: {replaces}")
        self.previous, self._n_written = run, len(run)
        self.complete = not is_unfinished and not run.ended and len(run) == n_ions

    def _refuse_loss(self, n_ions):
        """Refuse to replace ions that the new run would not contain."""
        name, replaces = self._name, "overwrite=True (--force) replaces it"
        choices = f"resume=True (--resume) continues it, {replaces}"
        unfinished, target = self._checkpoint.unfinished, self._checkpoint.path
        try:
            if unfinished.exists():
                raise FileError(
                    f"{name!r} has an unfinished run of {count_ions(unfinished):,} ions beside it, in "
                    f"{unfinished.name!r}: resume=True (--resume) continues it"
                )
            if not target.exists():
                return
            if not is_run(target):
                raise FileError(f"{name!r} exists and is not a run")
            run = load(target)
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

    def _differences(self, run):
        """Text on the settings in which a stored run differs from this one; "" if there are none."""
        new, stored = (
            self._setup,
            dict(
                _flat(run.settings),
                responses=run.responses is not None,
                flown=[described(perturbation) for perturbation in run.perturbations],
            ),
        )
        differences = [
            f"{key} is {stored.get(key)!r:.60} in the stored run, {new.get(key)!r:.60} in the new one"
            for key in dict.fromkeys((*stored, *new))
            if stored.get(key) != new.get(key)
        ]
        return "; ".join(differences[:3]) + (f", and {len(differences) - 3} more" if len(differences) > 3 else "")

    # ---- writing ---------------------------------------------------------------------------------------------------

    def due(self, n_ions: int) -> bool:
        """Whether a checkpoint is due after this number of ions."""
        n_new = n_ions - self._n_written
        often = self._checkpoint.ions is not None and n_new >= self._checkpoint.ions
        return n_new > 0 and (often or time.monotonic() >= self._due_at)

    @uninterrupted()
    def write(self, run: Run) -> None:
        """Replace the unfinished run by all ions so far, if there are new ones; warn if this fails."""
        if len(run) == self._n_written:
            return
        began = time.monotonic()
        try:
            run.ended_by(StopReason.UNFINISHED).save(self._checkpoint.unfinished)
            self._n_written = len(run)
        except FileError as error:
            warn(f"no checkpoint: {error}; the run continues and will try again", RunWarning)
        ended, pause = time.monotonic(), 60 * self._checkpoint.minutes
        self._due_at = ended + (max(pause, _RATIO * (ended - began)) if pause else 0)

    @uninterrupted()
    def finish(self, run: Run) -> None:
        """Write the file of the run and remove the unfinished one."""
        run.save(self._checkpoint.path)
        try:
            self._checkpoint.unfinished.unlink(missing_ok=True)
        except OSError as error:
            raise FileError(f"cannot remove {str(self._checkpoint.unfinished)!r}: {error.strerror}") from error


def _flat(settings, before=""):
    """Settings in one dict, with keys such as "table.key"."""
    flat = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return flat
