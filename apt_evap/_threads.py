"""How many threads to use."""

import os

from apt_evap._arrays import check_count


def thread_count(n_threads=None):
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
        return check_count(n_threads, "n_threads", at_least=1)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
