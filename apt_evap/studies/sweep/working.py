"""Work on all points of a sweep, by processes of this machine or the workers of a Dask cluster."""

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from apt_evap._common.optional_imports import optional_import
from apt_evap._common.processes import die_with
from apt_evap._common.validation import check_count
from apt_evap.studies.sweep.planning import Sweep
from apt_evap.studies.sweep.point_folder import PointState, run_point

_KILLED = PointState("waiting", "its process was killed, perhaps for lack of memory", None)
_MOST_KILLED = 3  # processes in succession: something is wrong on this machine


def run_sweep(sweep: Sweep, keys: Sequence[str] | None = None, workers: int | None = None) -> dict[str, PointState]:
    """Run all waiting points.

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    keys : sequence of str, optional
        Keys of the points; all by default.
    workers : int, optional
        Number of points that run at a time, each in a process of its own. If it is killed, the other points go on, and
        the next call continues the point from its last checkpoint. A script needs ``if __name__ == "__main__":``, as
        for all uses of `multiprocessing`. By default the points run in this process.

    Returns
    -------
    dict
        `PointState` of each point that was waiting, by its key.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, when all runs have saved their ions. A second Ctrl-C ends them at their last checkpoints.
    ValueError
        If three processes in succession were killed.
    """
    keys = [key for key in (sweep.keys if keys is None else keys) if sweep.state(key).name == "waiting"]
    job = sweep.job.threads, sweep.job.checkpoint
    if workers is None:
        return {key: run_point(sweep.folder_of(key), *job) for key in keys}
    check_count(workers, "workers", at_least=1)
    states, killed = {}, 0
    with _stopped_by_interrupts() as stop, _threads_of_libraries(job[0]), ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(_in_a_process, stop, sweep.folder_of(key), *job): key for key in keys}
        try:
            for future in as_completed(futures):
                try:
                    state, killed = future.result(), 0
                except BrokenProcessPool:
                    state, killed = _KILLED, killed + 1
                if state is not None:
                    states[futures[future]] = state
                if killed == _MOST_KILLED:
                    raise ValueError(
                        f"the last {killed} processes of the sweep {str(sweep.folder)!r} were killed, perhaps for lack "
                        "of memory: with fewer workers, the same command continues"
                    )
        finally:
            is_interrupted = stop.is_set()
            stop.set()
    if is_interrupted:
        raise KeyboardInterrupt
    return states


def _in_a_process(stop, folder, threads, checkpoint):
    """Run a point in a process of its own; None if the work was stopped before."""
    if stop.is_set():
        return None
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        if hasattr(signal, "pthread_sigmask"):  # inherited: an early Ctrl-C waits until the process can handle it
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        return process.submit(_as_a_process, os.getpid(), folder, threads, checkpoint).result()


def _as_a_process(parent, folder, threads, checkpoint):
    """Run a point in this process, which ends with its parent, and which the parent alone interrupts (by SIGINT).

    A terminal and a batch system send their signals to all processes: two of them would be a second Ctrl-C.
    """
    die_with(parent)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if hasattr(os, "setpgrp"):
        os.setpgrp()
    warnings.showwarning = lambda message, *_, **__: print(
        f"apt-evap: warning: point {folder.name}: {message}", file=sys.stderr, flush=True
    )
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    return run_point(folder, threads, checkpoint)


@contextmanager
def _stopped_by_interrupts() -> Iterator[threading.Event]:
    """Set a flag at Ctrl-C, and pass it on to the processes; only in the main thread, others are not interrupted."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def interrupt(number, frame):
        stop.set()
        if sys.platform != "win32":  # there, the console sends Ctrl-C to them, and os.kill would end them at once
            for process in multiprocessing.active_children():
                os.kill(process.pid, signal.SIGINT)

    previous = signal.signal(signal.SIGINT, interrupt)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def _threads_of_libraries(number: int) -> Iterator[None]:
    """Let the numerical libraries of new processes use this number of threads, unless the user has set another one."""
    if "OMP_NUM_THREADS" in os.environ:
        yield
        return
    os.environ["OMP_NUM_THREADS"] = str(number)
    try:
        yield
    finally:
        del os.environ["OMP_NUM_THREADS"]


def run_sweep_with_dask(sweep: Sweep, address: str | Any) -> dict[str, PointState]:
    """Run all waiting points by the workers of a Dask cluster, which see the folder of the sweep.

    Dask gives the point of a killed worker to another one, which continues from the last checkpoint.

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    address : str or distributed.Client
        Address of the scheduler, such as "tcp://10.0.0.1:8786", or a client.

    Returns
    -------
    dict
        `PointState` of each point that was waiting, by its key.

    Raises
    ------
    ValueError
        If a worker cannot work, for example because this package is missing there.
    """
    distributed = optional_import("distributed", "a sweep with Dask")
    keys = [point.key for point, state in sweep.states() if state.name == "waiting"]
    client = distributed.Client(address) if isinstance(address, str) else address
    try:
        folders = [str(sweep.folder_of(key)) for key in keys]
        tasks = client.map(run_point, folders, threads=sweep.job.threads, checkpoint=sweep.job.checkpoint, pure=False)
        distributed.wait(tasks)
        states = {}
        for key, task in zip(keys, tasks, strict=True):
            error = task.exception()
            if error is not None and not isinstance(error, distributed.KilledWorker):
                raise ValueError(f"a worker of Dask cannot work on point {key}: {error}") from error
            states[key] = task.result() if error is None else _KILLED
        return states
    finally:
        if isinstance(address, str):
            client.close()
