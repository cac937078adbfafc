"""Work on one point: claim it, run it in a process of its own, write how it ended."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError, open_for_reading
from apt_evap.sweep.claims import HEARTBEAT, Claims
from apt_evap.sweep.files import append_to, unlinked
from apt_evap.sweep.planning import (
    INTERRUPTED,
    LOG,
    RETRY,
    RUN,
    SETTINGS,
    STATES,
    PointState,
    Sweep,
    ions_of,
    open_sweep,
)

_MESSAGE = 2_000  # bytes of the log that are searched for the reason of a failure
_POLLING = 0.1  # seconds between two looks at a run
_REFUSED = 2  # exit code of apt-evap for wrong input; here of a point that is not even started

# A process of a worker: with the modules of the worker; it ends with its worker, and is interrupted by the worker only
# (by SIGINT). A batch system sends SIGTERM to all processes of a job: two signals would be a second Ctrl-C, which does
# not save the ions.
_PROGRAM = """
import json, signal, sys
sys.path[:] = json.loads(sys.argv[1])
from apt_evap._common.processes import die_with
die_with(int(sys.argv[2]))
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
from apt_evap.cli.main import main
sys.exit(main(sys.argv[3:]))
"""


def start(arguments: Sequence[str], **options: Any) -> subprocess.Popen:
    """Start `apt-evap` with these arguments, in a process that ends with this one and that SIGINT interrupts."""
    program = [sys.executable, "-P", "-c", _PROGRAM, json.dumps(sys.path), str(os.getpid()), *arguments]
    return subprocess.Popen(program, stdin=subprocess.DEVNULL, start_new_session=True, **options)


@contextmanager
def forwarded(interrupt: Any) -> Iterator[threading.Event]:
    """Call a function at each Ctrl-C, and set a flag; only in the main thread, others are not interrupted."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return

    def handle(number, frame):
        flag.set()
        interrupt()

    previous = signal.signal(signal.SIGINT, handle)
    try:
        yield flag
    finally:
        signal.signal(signal.SIGINT, previous)


def work_on(sweep: Sweep | Path | str, key: str) -> PointState:
    """Run a point, unless it is done, failed, or another process works on it.

    The run is `apt-evap run settings.toml --resume` in a process of its own, with the log in ``log.txt``. It continues
    from the last checkpoint of an earlier try. This is the same for workers of one machine, jobs of a batch system
    and Dask.

    Parameters
    ----------
    sweep : Sweep or path
        The sweep, or its folder.
    key : str
        Key of the point.

    Returns
    -------
    PointState
        Afterwards.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, when the run has saved its ions.
    FileError
        If a file cannot be written.
    """
    sweep = sweep if isinstance(sweep, Sweep) else open_sweep(sweep)
    folder, state = sweep.folder_of(key), sweep.state(key)
    if state.name != "open":
        return state
    claims = Claims(folder)
    claim = claims.take(state.claims[-1].number if state.claims else 0, ions_of(folder))
    if claim is None:
        return sweep.state(key)
    began, code, message, interrupted = time.monotonic(), INTERRUPTED[0], "", None
    try:
        _check(sweep, key, folder)
        code, interrupted = _run(sweep, folder, claims, claim)
        if code not in (0, None, *INTERRUPTED):
            message = _reason(folder / LOG, code)
    except FileError as error:
        code, message = _REFUSED, str(error)
    finally:
        if code is not None:
            seconds = round(time.monotonic() - began, 3)
            claims.end(claim, code=code, seconds=seconds, ions=ions_of(folder), message=message)
    if interrupted is not None and interrupted.is_set():
        raise KeyboardInterrupt
    return sweep.state(key)


def _check(sweep, key, folder):
    """Check that the run of a point would write into its folder only, with the settings of the plan."""
    for name in os.listdir(folder):
        unlinked(folder / name)
    sweep.check_settings(key)


def _run(sweep, folder, claims, claim):
    """Run the point; return the exit code, None if the claim was lost, and whether this process was interrupted."""
    each = sweep.each
    command = ["run", str(folder / SETTINGS), "-o", str(folder / RUN), "--resume", "--quiet"]
    command += ["--threads", str(each.threads), "--checkpoint", str(each.checkpoint)]
    process = None

    def interrupt():
        if process is not None:  # not started yet
            process.send_signal(signal.SIGINT)

    with forwarded(interrupt) as interrupted:
        with append_to(folder / LOG) as log:
            log.write(f"-- try {claim.number}, {claim.who}, {claim.owner['began']}\n".encode())
            log.flush()
            process = start(command, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": str(each.threads)})
        if interrupted.is_set():  # before it was started
            interrupt()
        beat = time.monotonic()
        while process.poll() is None:
            time.sleep(_POLLING)
            if time.monotonic() - beat >= HEARTBEAT:
                beat = time.monotonic()
                if not claims.renew(claim):  # this process was suspended, and another one has taken over
                    process.kill()
                    process.wait()
                    return None, interrupted
    return process.returncode, interrupted


def _reason(log, code):
    """Last line of a log that apt-evap has written."""
    with open_for_reading(log) as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - _MESSAGE))
        lines = file.read().decode(errors="replace").splitlines()
    signal_text = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
    said = [line for line in lines if line and not line.startswith("--")]
    return said[-1].removeprefix("apt-evap: error: ") if said and code > 0 else signal_text


def work(sweep: Sweep, keys: Sequence[str] | None = None) -> dict[str, int]:
    """Work on all open points one after the other, until none is left.

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    keys : sequence of str, optional
        Keys of the points to work on; all by default.

    Returns
    -------
    dict
        Number of points by state.

    Raises
    ------
    FileError
        After the other points, if the claims of a point cannot be written.
    """
    refused: dict[str, FileError] = {}
    while True:
        counts = dict.fromkeys(STATES, 0)
        worked = False
        for key in sweep.keys if keys is None else keys:
            state = sweep.state(key)
            if state.name == "open" and key not in refused:
                worked = True
                try:
                    state = work_on(sweep, key)
                except FileError as error:
                    refused[key] = error
            counts[state.name] += 1
        if not worked:
            for error in refused.values():
                raise error
            return counts


def retry(sweep: Sweep) -> int:
    """Make all failed points open again.

    Parameters
    ----------
    sweep : Sweep
        The sweep.

    Returns
    -------
    int
        Number of these points.
    """
    number = 0
    for point, state in sweep.states():
        if state.name == "failed" and state.claims:
            claims = Claims(sweep.folder_of(point.key))
            if claim := claims.take(state.claims[-1].number, 0):
                claims.end(claim, code=RETRY, seconds=0.0, ions=0, message="")
                number += 1
    return number
