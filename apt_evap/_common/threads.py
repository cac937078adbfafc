"""How many threads to use."""

import os

from apt_evap._common.validation import check_count
from apt_evap._common.wording import argument

MAX_THREADS = 1024  # each has a copy of the surface; more is a slip of the keyboard


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
        if n_threads > MAX_THREADS:
            raise ValueError(f"{argument('n_threads')} must be at most {MAX_THREADS}, got {n_threads}")
        return n_threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
