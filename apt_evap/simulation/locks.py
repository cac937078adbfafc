"""Locks against other processes, which the system releases when a process ends."""

import errno
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError, open_regular
from apt_evap._common.types import AnyPath
from apt_evap.warnings import RunWarning, warn

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
    import msvcrt

_OWNER = "process "  # first word of a lock file
_LOCKED_BYTE = 1 << 20  # behind the text: nobody can read a locked byte on Windows
_LOCKED_BY_ANOTHER = (errno.EAGAIN, errno.EACCES, 0)  # Linux and macOS, Windows, Windows by Wine
_PAUSE = 0.2  # seconds between two tries


def open_lock(path: AnyPath, flags: int = os.O_RDWR | os.O_CREAT) -> int:
    """Open a lock file, with the flags of `os.open`; OSError if it is a link or not a regular file."""
    return open_regular(path, flags | getattr(os, "O_NOFOLLOW", 0))


def try_lock(descriptor: int, shared: bool = False) -> bool:
    """Lock an open file until it is closed; return whether it was free."""
    try:
        if fcntl is None:
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _LOCKED_BY_ANOTHER:
            raise
        return False
    return True


class FileLock:
    """A locked file beside another one. It is removed by `release`, and remains unlocked if this process is killed."""

    def __init__(self, path: Path, of: str, wait: Callable[[], object] | None = None) -> None:
        self._path, self._of = path, of
        self._file: Any = None
        try:
            while self._file is None:  # again if its owner has just removed it
                file = open(path, "r+", encoding="utf-8", errors="replace", opener=_opened)
                try:
                    if not self._lock(file, wait):
                        wait = _say_nothing
                        time.sleep(_PAUSE)
                        continue
                    with suppress(FileNotFoundError):
                        if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                            self._sign(file)
                            self._file = file
                finally:
                    if self._file is None:
                        file.close()
        except OSError as error:
            raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error

    def _lock(self, file, wait):
        """Whether the file is locked now, or cannot be. If another has locked it, `wait` or raise an error."""
        try:
            is_free = try_lock(file.fileno())
        except OSError as error:
            warn(
                f"cannot lock {self._of!r} ({error.strerror}): make sure that no other process writes it",
                RunWarning,
            )
            return True
        if not is_free:
            if wait is None:
                file.seek(0)
                owner = file.read(100) or "another process"
                raise FileError(
                    f"{self._of!r} is being written by {owner}; wait for it or choose another file"
                ) from BlockingIOError()
            wait()
        return is_free

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
    return open_lock(path, flags | os.O_CREAT)


def _say_nothing():
    pass
