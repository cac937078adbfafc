"""One computation at a time, always for the newest wish: those that are overtaken are left out."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


class Latest:
    """A worker thread for the newest of many wishes, such as the positions of a slider that moves.

    While a wish is being computed, newer ones replace each other. Only the last one is computed next.

    Parameters
    ----------
    work : callable
        Function of a wish, called in the worker thread. It handles its own errors.
    """

    def __init__(self, work: Callable[[Any], None]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._wishes: list[Any] = []  # none or one
        self._busy = False
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="explorer")

    def ask(self, wish: Any) -> None:
        """Set the newest wish; returns at once."""
        with self._lock:
            self._wishes = [wish]
            if self._busy:
                return
            self._busy = True
            self._pool.submit(self._run)

    @property
    def overtaken(self) -> bool:
        """Whether a newer wish waits for the end of the current computation."""
        return bool(self._wishes)

    def close(self) -> None:
        """Leave out the waiting wish, and wait for the end of the current computation."""
        with self._lock:
            self._wishes = []
        self._pool.shutdown()

    def _run(self):
        while True:
            with self._lock:
                if not self._wishes:
                    self._busy = False
                    return
                (wish,), self._wishes = self._wishes, []
            try:
                self._work(wish)
            except BaseException:
                with self._lock:
                    self._busy = False  # the next wish starts a new round
                raise
