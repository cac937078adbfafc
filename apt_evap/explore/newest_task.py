"""A worker thread for the newest of many tasks, such as the maps of a slider that moves."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


class NewestTaskRunner:
    """A worker thread that calls the newest of many tasks.

    While a task is running, newer ones replace each other. Only the last one is called next.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: Callable[[], None] | None = None
        self._busy = False
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="explorer")

    def submit(self, task: Callable[[], None]) -> None:
        """Set the newest task, which handles its own errors; returns at once."""
        with self._lock:
            self._waiting = task
            if self._busy:
                return
            self._busy = True
            self._pool.submit(self._run)

    @property
    def has_newer(self) -> bool:
        """Whether a newer task waits for the end of the current one."""
        return self._waiting is not None

    def close(self) -> None:
        """Drop the waiting task, and wait for the end of the current one."""
        with self._lock:
            self._waiting = None
        self._pool.shutdown()

    def _run(self):
        while True:
            with self._lock:
                task, self._waiting = self._waiting, None
                if task is None:
                    self._busy = False
                    return
            try:
                task()
            except BaseException:
                with self._lock:
                    self._busy = False  # the next task starts the thread again
                raise
