"""Reading and writing of files: error messages of one sentence, and no incomplete files."""

import hashlib
import os
import re
import secrets
import socket
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from apt_evap._common.types import AnyPath

try:
    import fcntl
except ImportError:  # not on this system: temporary files of killed processes remain
    fcntl = None  # type: ignore[assignment]

_ABANDONED_AFTER = 60.0  # seconds: a new file may not be locked yet


class FileError(ValueError):
    """Error for a file that cannot be read or written; the message gives its name and the reason.

    Examples
    --------
    >>> try:
    ...     ae.read("missing.epos")
    ... except ae.FileError as error:
    ...     print(error)
    cannot read 'missing.epos': No such file or directory
    """


class TruncatedFile(FileError):
    """Error for a file that ends in the middle of an ion."""


def check_path(path: Any) -> Path:
    """Return `path` as a Path.

    Raises
    ------
    FileError
        If it is not a str or a path, or contains a character that names of files cannot have, here or in this locale.
    """
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        raise FileError(f"path must be a file name, got {path!r:.80}")
    try:
        os.fsencode(path)
    except UnicodeEncodeError:
        encoding = sys.getfilesystemencoding()
        raise FileError(
            f"path must be a file name in {encoding}, the encoding of this locale, got {path!a:.80}"
        ) from None
    return Path(path)


@contextmanager
def open_for_reading(path: AnyPath) -> Iterator[BinaryIO]:
    """Open a file for reading bytes.

    Parameters
    ----------
    path : str or path-like
        The file.

    Yields
    ------
    file
        Open for reading bytes, unbuffered.

    Raises
    ------
    FileError
        If it is missing, unreadable or not a regular file. Reading from a pipe could block forever.
    """
    path = check_path(path)
    try:
        with open(path, "rb", buffering=0, opener=_open_regular) as file:
            yield file
    except OSError as error:
        raise FileError(f"cannot read {str(path)!r}: {_reason(error)}") from error


def read_small_file(path: AnyPath, at_most: int, what: str) -> bytes:
    """Read a complete small file.

    Parameters
    ----------
    path : str or path-like
        The file.
    at_most : int
        Largest allowed size [bytes].
    what : str
        Expected content, for the message.

    Returns
    -------
    bytes

    Raises
    ------
    FileError
        If it is larger, or cannot be read.
    """
    parts, size = [], 0
    with open_for_reading(path) as file:
        while size <= at_most and (more := file.read(1 << 20)):
            parts.append(more)
            size += len(more)
    if size > at_most:
        raise FileError(f"{str(path)!r} has more than {at_most} bytes, expected {what}")
    return b"".join(parts)


def sha256_of(path: AnyPath) -> str:
    """SHA-256 of the content of a file, str; FileError if it cannot be read."""
    with open_for_reading(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]  # an unbuffered file


@contextmanager
def replace_file(path: AnyPath) -> Iterator[BinaryIO]:
    """Write a file under a temporary name in the same folder, and rename it when it is complete.

    A file that is overwritten keeps its mode. The temporary name is random and never that of an existing file or link.
    Temporary files of killed processes for the same file are removed.

    Parameters
    ----------
    path : str or path-like
        The file to write or overwrite.

    Yields
    ------
    file
        Open for writing and reading bytes.

    Raises
    ------
    FileError
        If the file cannot be written, or is not a regular file. The temporary file is then removed.
    """
    path = check_path(path)
    aside = None
    try:
        target = Path(os.path.realpath(path))
        mode = _mode_of(target)
        _remove_abandoned(target)
        name = target.with_name(f".{_stem(target)}.{_host()}.{secrets.token_hex(8)}.part")
        descriptor = os.open(name, _NEW_FILE, 0o666 if mode is None else 0o600)
        aside = name
        with open(descriptor, "w+b") as file:
            if mode is not None:
                os.fchmod(descriptor, mode)
            with suppress(OSError):
                _lock(descriptor)
            yield file
            file.flush()
            os.fsync(descriptor)  # the bytes must be on the disk before the name, in case of a power cut
            os.replace(name, target)
            aside = None
        flush_folder(target.parent)
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {_reason(error)}") from error
    finally:
        if aside is not None:
            with suppress(OSError):
                aside.unlink()


_NEW_FILE = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
_WAIT_FOR_NOBODY = getattr(os, "O_NONBLOCK", 0)
_UNFINISHED = re.compile(r"\..*\.[\w-]*\.[0-9a-f]{16}\.part")


def is_unfinished(name: str) -> bool:
    """Whether a name is that of a temporary file of `replace_file`."""
    return _UNFINISHED.fullmatch(name) is not None


def _open_regular(path, flags):
    descriptor = os.open(path, flags | _WAIT_FOR_NOBODY)
    try:
        check_regular(os.fstat(descriptor))
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def check_regular(status: os.stat_result) -> None:
    """Refuse folders, pipes and devices (OSError)."""
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(None, "Is a directory")
    if not stat.S_ISREG(status.st_mode):
        raise OSError(None, "Not a regular file")


def _mode_of(target):
    """Mode of a file, None if it does not exist; OSError if it is not a regular file."""
    try:
        status = os.stat(target)
    except FileNotFoundError:
        return None
    check_regular(status)
    return stat.S_IMODE(status.st_mode) & 0o777


def _stem(target):
    return target.name[:40]  # the complete temporary name must not be too long for the file system


def _host():
    return re.sub(r"[^\w-]", "-", socket.gethostname(), flags=re.ASCII)[:40]


def _lock(descriptor):
    """Lock a file until it is closed; OSError if another process has locked it."""
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_abandoned(target):
    """Remove temporary files of killed processes for a file: files of this user that are not locked."""
    if fcntl is None:
        return
    with suppress(OSError):
        for entry in os.scandir(target.parent):
            if entry.name.startswith(f".{_stem(target)}.") and is_unfinished(entry.name):
                with suppress(OSError):
                    _remove_if_abandoned(target.with_name(entry.name))


def _remove_if_abandoned(path):
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | _WAIT_FOR_NOBODY)
    try:
        status = os.fstat(descriptor)
        check_regular(status)
        if status.st_uid == os.geteuid() and time.time() - status.st_mtime > _ABANDONED_AFTER:
            _lock(descriptor)
            path.unlink()
    finally:
        os.close(descriptor)


def move_file(written: Path, target: Path) -> None:
    """Rename a complete file; if `target` exists, it is replaced and its mode is kept.

    Raises
    ------
    OSError
        If the file cannot be renamed, or `target` is not a regular file.
    """
    mode = _mode_of(target)
    if mode is not None:
        os.chmod(written, mode)
    os.replace(written, target)
    flush_folder(target.parent)


def flush_folder(folder: AnyPath) -> None:
    """Flush the names of new files to the disk, if the system supports it."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _reason(error):
    return getattr(error, "strerror", None) or str(error)
