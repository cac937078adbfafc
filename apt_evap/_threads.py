"""How many threads to use, and what Ctrl-C does to the main one."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from apt_evap._arrays import check_count

MOST_THREADS = 1024  # each has a copy of the surface; more is a slip of the keyboard


def thread_count(n_threads: int | None = None) -> int:
    """Return the number of threads to use.

    Parameters
    ----------
    n_threads : int, optional
        What the user asked for; by default the processors this process may use.

    Returns
    -------
    int

    Raises
    ------
    ValueError
        If it is not a whole number of at least 1.
    """
    if n_threads is not None:
        n_threads = check_count(n_threads, "n_threads", at_least=1)
        if n_threads > MOST_THREADS:
            raise ValueError(f"n_threads must be at most {MOST_THREADS}, got {n_threads}")
        return n_threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into a flag, so that the batch under way is kept; the second one interrupts."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return

    def note(number, frame):
        flag.set()
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield flag
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let Ctrl-C wait until what is under way, such as putting files in order, is done."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came = []
    before = signal.signal(signal.SIGINT, lambda *arguments: came.append(arguments))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        for arguments in came:
            handler = signal.getsignal(signal.SIGINT)  # the first one may have changed it
            if callable(handler):
                handler(*arguments)
