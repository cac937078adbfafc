"""The end of a process with its parent."""

import ctypes
import os
import signal
import sys
import threading
import time

_PR_SET_PDEATHSIG = 1  # of linux/prctl.h
_POLLING = 1.0  # seconds
_SYNCHRONIZE = 0x00100000  # of winnt.h


def die_with(parent: int) -> None:
    """End this process when its parent ends, also if the parent is killed.

    Without it, a computation would outlive its killed parent and write on while another process repeats it.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    if os.getppid() != parent:
        _end()


def _end():
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))  # on Windows both end it at once


def _watch(parent):
    if sys.platform == "win32":  # where getppid does not change
        kernel = ctypes.windll.kernel32
        kernel.WaitForSingleObject(kernel.OpenProcess(_SYNCHRONIZE, False, parent), -1)
    else:
        while os.getppid() == parent:
            time.sleep(_POLLING)
    _end()
