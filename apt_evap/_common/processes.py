"""Identity of processes on a cluster, and the end of a process with its parent."""

import ctypes
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path

_PR_SET_PDEATHSIG = 1  # of linux/prctl.h
_POLLING = 1.0  # seconds
_SYNCHRONIZE = 0x00100000  # of winnt.h


def machine() -> str:
    """Name under which the process numbers of this system are unique.

    Nodes of a cluster may have equal host names in containers. So on Linux the name also contains the identity of the
    boot and of the process namespace.
    """
    parts = [socket.gethostname()]
    try:
        parts += [Path("/proc/sys/kernel/random/boot_id").read_text().strip(), os.readlink("/proc/self/ns/pid")]
    except OSError:
        pass  # not a Linux system
    return " ".join(parts)


def birth(pid: int) -> str | None:
    """Start of a living process, "" where the system does not tell; None if there is no such process.

    A process number is used again after a while; together with the start it is unique. A process that has ended but was
    not waited for does not count.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        if Path("/proc/self/stat").exists():
            return None
        if os.name == "nt":
            return ""  # there os.kill(pid, 0) would be Ctrl-C
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return None
        except OSError:
            pass  # a process of another user
        return ""
    return None if fields[0] in "ZX" else fields[19]


def die_with(parent: int) -> None:
    """End this process when its parent ends, also if the parent is killed.

    Without it, a computation would outlive its killed worker and write on while another worker repeats it.

    Parameters
    ----------
    parent : int
        Process number of the parent; if it has already ended, this process ends at once.
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
