"""The recorder of a run: collects, monitors and stores the parts of a run, and joins them into one."""

from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Any

from apt_evap._common.files import FileError
from apt_evap._common.progress import progress_bar
from apt_evap._core.evaporation import EXHAUSTED, SWEEP_DUE
from apt_evap.evaporation.emitter import Batch, Emitter
from apt_evap.simulation.checkpoint import CheckpointWriter
from apt_evap.simulation.monitor import Monitor, MonitorState
from apt_evap.simulation.packed_parts import PackedParts
from apt_evap.simulation.run import Run
from apt_evap.simulation.stop_reason import StopReason

TOGETHER = 64
"""Number of parts that are joined at a time. Many small arrays between large temporary ones fragment the memory.
Measured for 100,000 ions of R = 20 a: 540 bytes per ion without joining, 155 with it, of which 144 are results."""


class RunInterrupted(RuntimeError):
    """Error that ended a run after its first ions; raised from the original error.

    Parameters
    ----------
    message : str
        Description of the error.
    run : Run
        The ions before the error.
    """

    def __init__(self, message: str, run: Run) -> None:
        super().__init__(message)
        self.run = run

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.run)  # by default the message only: a process pool would wait forever


class RunNotSaved(FileError):
    """Error for a completed run that cannot be written.

    Parameters
    ----------
    message : str
        Reason.
    run : Run
        The complete run.
    """

    def __init__(self, message: str, run: Run) -> None:
        super().__init__(message)
        self.run = run

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.run)  # by default the message only: a process pool would wait forever


class Recorder:
    """The parts of a run, in memory and, with a `CheckpointWriter`, on the disk.

    A context manager. At its end, even after an error, it waits for pending flights and stores the ions in `run`.

    Parameters
    ----------
    emitter : Emitter
        The surface, whose state is stored with the parts.
    settings : Monitor
        Monitoring of the run.
    n_ions : int
        Requested number of ions.
    n_evaporated : int
        Ions evaporated so far, including those before the run.
    progress : bool or callable, optional
        As in `Simulation.run`.
    writer : CheckpointWriter or None
        Storage of the parts, with the ions so far of a resumed run.
    """

    def __init__(
        self,
        emitter: Emitter,
        settings: Monitor,
        n_ions: int,
        n_evaporated: int,
        progress: bool | Callable[[int, int], object] | None,
        writer: CheckpointWriter | None,
    ) -> None:
        self._emitter, self._n_ions, self._writer = emitter, n_ions, writer
        self._parts, self._latest, self._flying = PackedParts(), [], []
        previous = [writer.previous] if writer and writer.previous else []
        for run in previous:
            self._parts.add(run)
        self._state = previous[0].state if previous else None
        self._first_event = previous[0].first_event if previous else emitter.counts["events"]
        self._started = len(self)
        interval = settings.interval or 10 * emitter.sweep_interval
        self._monitor = MonitorState(settings, interval, n_evaporated - len(self), previous)
        if writer:
            writer.previous = None  # its ions are in the parts
        self._ending = StopReason.COMPLETE
        self._report = progress if callable(progress) else None
        self._bar = progress_bar(
            total=n_ions,
            initial=len(self),
            unit=" ions",
            smoothing=0.1,
            disable=True if self._report else None if progress is None else not progress,
            mininterval=0.5,
        )
        self.run: Run | None = None

    def __len__(self) -> int:
        return len(self._parts) + sum(map(len, self._latest))

    @property
    def missing(self) -> int:
        """Ions whose atoms have not evaporated yet."""
        return self._n_ions - self._started

    def add(self, batch: Batch, part: Callable[[], Run], ions: int, backlog: int = 0) -> None:
        """Take the next batch.

        Parameters
        ----------
        batch : Batch
            The events.
        part : callable
            Waits for the flights of the batch and returns them as a Run.
        ions : int
            Ions evaporated so far, including those before the run.
        backlog : int
            Batches whose flights may be pending.
        """
        self._started += len(batch)
        self._flying.append(part)
        self._land(backlog)
        if batch.status == EXHAUSTED:
            self._ending = StopReason.EXHAUSTED
        if batch.status == SWEEP_DUE and self._monitor.due(ions):
            self._land()
            self._monitor.look(self._emitter, ions)
        if self._writer and self._writer.due(self._started):
            self._land()
            self._store()

    def end_early(self, reason: StopReason) -> None:
        """Record that the run ends before its last ion, and why."""
        if self._ending == StopReason.COMPLETE and self.missing:
            self._ending = reason

    def _land(self, backlog=0):
        while len(self._flying) > backlog:
            part = self._flying.pop(0)()
            self._latest.append(part)
            if len(self._latest) == TOGETHER:
                self._gather()
            self._monitor.count(part)
            self._bar.set_postfix(self._monitor.latest, refresh=False)
            self._bar.update(len(part))
            if self._report:
                self._report(len(self), self._n_ions)

    def _gather(self):
        if self._latest:
            self._parts.add(Run.join(self._latest))
            self._latest = []

    def _all(self, ended, last=False):
        """All ions so far as one run, with the last state whose events are all among them; the parts end if `last`."""
        self._gather()
        self._parts.add_history(self._monitor.pop_history())  # each check is returned once
        run = self._parts.run(last=last)
        state = self._emitter.state()
        if len(state.sites) <= self._first_event + len(run):
            self._state = state
        return replace(run, state=self._state, first_event=self._first_event, ended=str(ended))

    def _store(self, last=False):
        if self._writer and len(self):
            self._writer.write(self._all(self._ending, last))

    # ---- the context -----------------------------------------------------------------------------------------------

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is None:
                try:
                    self._land()
                except Exception as late:  # in a pending flight
                    self._fail(late)
                    raise
                self._finish()
            elif isinstance(error, Exception):
                self._fail(error)
            else:  # the second Ctrl-C: write a last checkpoint
                self._store(last=True)
        finally:
            self._bar.close()

    def _finish(self):
        self.run = self._all(self._ending, last=True)
        if self._writer and not self._writer.complete:
            try:
                self._writer.finish(self.run)
            except FileError as error:
                raise RunNotSaved(str(error), self.run) from error

    def _fail(self, error: Any) -> None:
        """Store the ions so far and raise the error with them; an error before the first ion is not changed."""
        try:
            self._land()
        except Exception:  # the same error, or one that follows from it: later ions are lost
            self._flying.clear()
        if not len(self):
            return
        self.run = self._all(f"{type(error).__name__}: {error}", last=True)
        if self._writer:
            self._writer.write(self.run)
        raise RunInterrupted(
            f"{type(error).__name__}: {error}; the attribute `run` contains the {len(self.run):,} ions before it",
            self.run,
        ) from error
