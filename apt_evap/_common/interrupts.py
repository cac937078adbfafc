"""Handling of Ctrl-C in the main thread."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Set a flag at the first Ctrl-C, so that the current batch is completed; the second one interrupts."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return

    def set_flag(number, frame):
        flag.set()
        signal.signal(signal.SIGINT, previous)

    previous = signal.signal(signal.SIGINT, set_flag)
    try:
        yield flag
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C until the block, such as the replacement of a file, is complete."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    calls = []
    previous = signal.signal(signal.SIGINT, lambda *arguments: calls.append(arguments))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
        for arguments in calls:
            handler = signal.getsignal(signal.SIGINT)  # the first call may have changed it
            if callable(handler):
                handler(*arguments)
