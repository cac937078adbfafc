"""Locks against other processes, which the system releases when a process ends."""

import os
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError, check_regular
from apt_evap.warnings import RunWarning, warn

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
    import msvcrt

_OWNER = "process "  # first word of a lock file
_FLAGS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_LOCKED_BYTE = 1 << 20  # behind the text: nobody can read a locked byte on Windows


class FileLock:
    """A locked file beside another one. It is removed by `release`, and remains unlocked if this process is killed.

    Parameters
    ----------
    path : Path
        The lock file.
    of : str
        Name of what it protects, for messages.

    Raises
    ------
    FileError
        If another process has locked it, or if it cannot be written.
    """

    def __init__(self, path: Path, of: str) -> None:
        self._path, self._of = path, of
        self._file: Any = None
        try:
            while self._file is None:  # again if its owner has just removed it
                file = open(path, "r+", encoding="utf-8", errors="replace", opener=_opened)
                try:
                    self._lock(file)
                    with suppress(FileNotFoundError):
                        if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                            self._sign(file)
                            self._file = file
                finally:
                    if self._file is None:
                        file.close()
        except OSError as error:
            raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error

    def _lock(self, file):
        try:
            if fcntl is None:
                os.lseek(file.fileno(), _LOCKED_BYTE, os.SEEK_SET)
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            file.seek(0)
            owner = file.read(100) or "another process"
            raise FileError(f"{self._of!r} is being written by {owner}; wait for it or choose another file") from None
        except OSError as error:
            warn(
                f"cannot lock {self._of!r} ({error.strerror}): make sure that no other process writes it",
                RunWarning,
            )

    def _sign(self, file):
        """Write this process into the file, in place of an earlier one."""
        file.seek(0)
        if (owner := file.read(100)) and not owner.startswith(_OWNER):
            raise FileError(f"{str(self._path)!r} is not the lock of a run: it contains {owner!r:.40}")
        file.seek(0)
        file.truncate()
        file.write(f"{_OWNER}{os.getpid()} on {socket.gethostname()}")
        file.flush()

    def release(self) -> None:
        """Remove the file, then unlock it; Windows removes no open file."""
        with suppress(OSError):
            self._path.unlink()
        self._file.close()
        if fcntl is None:
            with suppress(OSError):
                self._path.unlink()


def _opened(path, flags):
    descriptor = os.open(path, flags | os.O_CREAT | _FLAGS, 0o666)
    try:
        check_regular(os.fstat(descriptor))
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
