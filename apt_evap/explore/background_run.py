"""The run of a settings file in a process of its own, which can be stopped and continued."""

import atexit
import contextlib
import multiprocessing
import signal
import threading
import time
import warnings
from pathlib import Path
from typing import Any

from apt_evap.explore.search_process import sentence_of
from apt_evap.simulation.checkpoint import Checkpoint
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.warnings import ResponseWarning

_MINUTES = 1.0  # between checkpoints


class BackgroundRun:
    """A run as of ``apt-evap run SETTINGS -o OUTPUT --resume``; it starts at once."""

    def __init__(self, settings: Path, output: Path) -> None:
        self.settings, self.output = settings, output
        self.ions, self.n_ions = 0, 0
        self.message = "building the specimen"
        """State of the run, or why it ended."""
        self.active = True
        self.finished = False
        """Whether the file has all ions."""
        self._first: tuple[float, int] | None = None
        self._pipe, pipe = multiprocessing.Pipe()
        context: Any = multiprocessing.get_context("spawn")
        self._process = context.Process(target=_simulate, args=(settings, output, pipe))
        self._process.start()
        pipe.close()  # the pipe then ends with the process
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        atexit.register(self.stop, wait=True)

    def stop(self, wait: bool = False) -> None:
        """End the run after its current batch; its ions are saved."""
        if self.active:
            self.message = "stopping"
            with contextlib.suppress(OSError):  # it has just ended
                self._pipe.send("stop")
        if wait:
            self._reader.join()

    @property
    def seconds_left(self) -> float | None:
        """Time until the end [s], None if it is not known yet."""
        if self._first is None or self.ions <= self._first[1]:
            return None
        began, first = self._first
        return (time.monotonic() - began) / (self.ions - first) * (self.n_ions - self.ions)

    def _read(self):
        ended = "the process of the run was killed; start it again to continue"
        while True:
            try:
                received = self._pipe.recv()
            except (EOFError, OSError):
                break
            if isinstance(received, str):
                ended, self.finished = received, not received
                continue
            self.ions, self.n_ions = received
            if self._first is None:
                self._first = time.monotonic(), self.ions
            if self.message != "stopping":
                self.message = ""
        self._process.join()
        self.message, self.active = ended, False
        atexit.unregister(self.stop)


def _simulate(settings, output, pipe):
    """Simulate in this process; sends (ions, all ions), at the end why it ended early."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the explorer, which then stops this process

    def progress(ions, n_ions):
        if pipe.poll():  # "stop", which stays there, or the end of the other process
            signal.raise_signal(signal.SIGINT)  # for `interruptible`
        else:
            pipe.send((ions, n_ions))

    # its text names a setting that the page has chosen; the file of the run has the number of inexact ions
    warnings.simplefilter("ignore", ResponseWarning)
    try:
        config = read_config(settings)
        simulation = config.simulation()
        checkpoint = Checkpoint(output, minutes=_MINUTES, resume=True)
        progress(checkpoint.ions_there(), config.n_ions)
        run = simulation.run(
            config.n_ions, config.emissions, responses=config.responses, progress=progress, checkpoint=checkpoint
        )
        config.as_saved(run).save(output)
        why = f"the run ended early ({run.ended}) with {len(run):,} ions"
        ended = why if run.ended else ""
        if run.ended == StopReason.INTERRUPTED:
            ended = f"stopped with {len(run):,} of {config.n_ions:,} ions; start it again to continue"
    except Exception as error:
        ended = sentence_of(error)
    with contextlib.suppress(OSError):  # the other process has died
        pipe.send(ended)
