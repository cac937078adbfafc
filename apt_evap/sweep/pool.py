"""Workers on this machine, and workers of a Dask cluster."""

import signal
import subprocess
import time
from functools import partial
from typing import Any

from apt_evap._common.optional_imports import optional_import
from apt_evap.sweep.planning import Sweep
from apt_evap.sweep.worker import forwarded, start, work_on

_POLLING = 0.1  # seconds
_WAIT = 5.0  # seconds between two looks at points that others work on
_FAILURES = 3  # processes in succession that end without work: something is wrong on this machine


def work_locally(sweep: Sweep, n_workers: int) -> None:
    """Work on all open points with several processes on this machine.

    A worker that is killed is replaced, and its point continues from the last checkpoint.

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    n_workers : int
        Number of processes.

    Raises
    ------
    ValueError
        If workers cannot start.
    KeyboardInterrupt
        After Ctrl-C, when all runs have saved their ions.
    """
    workers: list[subprocess.Popen] = []

    def interrupt():
        for worker in workers:
            worker.send_signal(signal.SIGINT)

    failures = 0
    with forwarded(interrupt) as interrupted:
        while True:
            ended = [worker for worker in workers if worker.poll() is not None]
            workers[:] = [worker for worker in workers if worker not in ended]
            failures = failures + 1 if any(worker.returncode == 2 for worker in ended) else failures * (not ended)
            if failures > _FAILURES:
                raise ValueError(f"the workers of {str(sweep.folder)!r} end at once, see their messages")
            if ended or not workers:
                n_open = 0 if interrupted.is_set() else sum(state.name == "open" for _, state in sweep.states())
                for _ in range(min(n_open, n_workers - len(workers))):
                    workers.append(start(["sweep", "work", str(sweep.folder), "--quiet"]))
                if not workers:
                    break
            time.sleep(_POLLING)
    if interrupted.is_set():
        raise KeyboardInterrupt


def work_with_dask(sweep: Sweep, address: str | Any) -> None:
    """Work on all open points with the workers of a Dask cluster, which see the folder of the sweep.

    Each task is `work_on` of one point. A point whose worker was killed is given to another one. The scheduler of Dask
    gives up a task after several killed workers (``distributed.scheduler.allowed-failures``); it is then submitted
    again, until the tries of the point are used up.

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    address : str or distributed.Client
        Address of the scheduler, such as "tcp://10.0.0.1:8786", or a client.
    """
    distributed = optional_import("distributed", "a sweep with Dask")
    client = distributed.Client(address) if isinstance(address, str) else address
    try:
        while True:
            states = {point.key: state.name for point, state in sweep.states()}
            keys = [key for key, name in states.items() if name == "open"]
            if not keys:
                if "running" not in states.values():
                    return
                time.sleep(_WAIT)  # another process may be killed, and leave its point to this one
                continue
            tasks = client.map(partial(work_on, str(sweep.folder)), keys, pure=False, retries=0)
            distributed.wait(tasks)
            for key, task in zip(keys, tasks, strict=True):
                error = task.exception()
                if error is not None and not isinstance(error, distributed.KilledWorker):
                    raise ValueError(f"a worker of Dask cannot work on point {key}: {error}") from error
    finally:
        if isinstance(address, str):
            client.close()
