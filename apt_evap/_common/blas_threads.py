"""Products of small matrices with one thread of BLAS: a second thread of OpenBLAS waits in a loop and only heats."""

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import scipy

_PREFIXES, _SUFFIXES = ("scipy_openblas", "openblas"), ("", "64_", "_64")
_LOCK = threading.Lock()
_users: list[int] = [0]  # searches that run now
_before: list[int] = []  # threads of every library before the first of them


@cache
def _libraries():
    """Functions that read and set the number of threads, of every OpenBLAS that numpy and scipy brought with them."""
    found = []
    for package in (np, scipy):
        folder = Path(package.__file__).parent
        folders = (folder.parent / f"{package.__name__}.libs", folder / ".dylibs")
        for path in sorted(path for folder in folders if folder.is_dir() for path in folder.glob("*openblas*")):
            try:
                library = ctypes.CDLL(str(path))
            except OSError:
                continue
            for prefix in _PREFIXES:
                for suffix in _SUFFIXES:
                    names = (f"{prefix}_{verb}_num_threads{suffix}" for verb in ("get", "set"))
                    functions = [getattr(library, name, None) for name in names]
                    if all(functions):
                        found.append(functions)
    return tuple(found)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Run a block with one thread of the OpenBLAS of numpy and scipy; other libraries of BLAS are left as they are.

    The number of threads is that of the process, so blocks that run at the same time are counted,
    and the last one restores what was before the first one.
    """
    libraries = _libraries()
    with _LOCK:
        if not _users[0]:
            _before[:] = [get() for get, _ in libraries]
            for _, put in libraries:
                put(1)
        _users[0] += 1
    try:
        yield
    finally:
        with _LOCK:
            _users[0] -= 1
            if not _users[0]:
                for (_, put), threads in zip(libraries, _before, strict=True):
                    put(threads)
