"""Number of threads to use, and their use."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from apt_evap._common.validation import check_count

MAX_THREADS = 1024  # each has a copy of the surface; more is a typing error

_state = {"several": False, "forked": False}  # whether several threads were used here, and in the parent process


def _after_fork() -> None:
    _state["forked"] = _state["several"]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def usable_threads(n_threads: int) -> int:
    """Return the number of threads that OpenMP can use: 1 in a process that was forked after its parent used several.

    The threads of the parent do not exist in the child, and OpenMP of GCC would wait for them forever. The results
    do not depend on the number of threads.
    """
    _state["several"] |= n_threads > 1
    return 1 if _state["forked"] else n_threads


def thread_count(n_threads: int | None = None) -> int:
    """Return the number of threads to use."""
    if n_threads is not None:
        n_threads = check_count(n_threads, "n_threads", at_least=1)
        if n_threads > MAX_THREADS:
            raise ValueError(f"n_threads (--threads) must be <= {MAX_THREADS}, got {n_threads}")
        return n_threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def map_of_threads(n_threads: int) -> Iterator[Callable[..., Any]]:
    """Function like `map` that calls by this number of threads; of one thread, it is `map`, and starts none."""
    if n_threads == 1:
        yield map
        return
    with ThreadPoolExecutor(n_threads) as pool:
        yield pool.map
