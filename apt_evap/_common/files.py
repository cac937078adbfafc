"""Reading and writing of files: error messages of one sentence, and no incomplete files."""

import hashlib
import os
import re
import shutil
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from apt_evap._common.types import AnyPath

_UNFINISHED = re.compile(r"\..{0,40}\.[0-9a-f]{16}\.part", re.DOTALL)  # names of temporary files
_ABANDONED_AFTER = 3600.0  # seconds since the last byte was written
_TRIES, _PAUSE = 500, 0.01  # to open or rename a file on Windows, and seconds between them
_WAIT_FOR_NOBODY = getattr(os, "O_NONBLOCK", 0)


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
    """Return `path` as a Path."""
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        raise FileError(f"path must be a file name, got {path!r:.80}")
    try:
        os.fsencode(path)
    except UnicodeEncodeError:
        encoding = sys.getfilesystemencoding()
        raise FileError(
            f"path must be a file name in {encoding}, the encoding of this locale, got {path!a:.80}"
        ) from None
    return _without_tilde(Path(path))


def _without_tilde(path):
    """The path, with the home folder for a leading ~, as a shell has it."""
    if path.parts[:1] and path.parts[0].startswith("~") and not path.exists():
        with suppress(RuntimeError):  # of a user that does not exist
            return path.expanduser()
    return path


@contextmanager
def open_for_reading(path: AnyPath) -> Iterator[BinaryIO]:
    """Open a file for reading bytes."""
    path = check_path(path)
    try:
        with open(path, "rb", buffering=0, opener=open_regular) as file:
            yield file
    except OSError as error:
        raise FileError(f"cannot read {str(path)!r}: {_reason(error)}") from error


def read_small_file(path: AnyPath, at_most: int, what: str) -> bytes:
    """Read a complete small file of at most so many bytes."""
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

    A file that is overwritten keeps its mode. What killed processes left of the same file is removed after an hour.
    """
    path = check_path(path)
    part = None
    try:
        target = Path(os.path.realpath(path))
        mode = _mode_of(target)
        remove_abandoned(target)
        name = target.with_name(f"{_before(target)}{os.urandom(8).hex()}.part")
        with open(name, "x+b") as file:
            part = name
            yield file
            file.flush()
            os.fsync(file.fileno())  # the bytes must be on the disk before the name, in case of a power cut
        if mode is not None:
            part.chmod(mode)
        _when_free(os.replace, part, target)
        part = None
        flush_folder(target.parent)
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {_reason(error)}") from error
    finally:
        if part is not None:
            with suppress(OSError):
                part.unlink()


@contextmanager
def new_file(path: AnyPath) -> Iterator[BinaryIO]:
    """Write a file as `replace_file`, but replace nothing: FileError if there is something of this name at the end."""
    path = check_path(path)
    part = path.with_name(f"{_before(path)}{os.urandom(8).hex()}.part")
    try:
        with replace_file(part) as file:
            yield file
        try:
            os.link(part, path)
        except FileExistsError:
            raise FileError(f"{str(path)!r} exists: it is not replaced") from None
        except OSError:  # a file system without links
            _copy_to_new(part, path)
    finally:
        with suppress(OSError):
            part.unlink()


def _copy_to_new(part, path):
    """Copy a file to one that does not exist yet."""
    try:
        with open(path, "xb") as file, open(part, "rb") as source:
            shutil.copyfileobj(source, file)
    except FileExistsError:
        raise FileError(f"{str(path)!r} exists: it is not replaced") from None
    except OSError as error:
        path.unlink(missing_ok=True)
        raise FileError(f"cannot write {str(path)!r}: {_reason(error)}") from error


def _when_free(function, path, *arguments):
    """Open or rename a file; Windows refuses that while another process reads or renames it, which is waited for."""
    for _ in range(_TRIES if sys.platform == "win32" and not os.path.isdir(path) else 0):
        with suppress(PermissionError):
            return function(path, *arguments)
        time.sleep(_PAUSE)
    return function(path, *arguments)


def open_regular(path: AnyPath, flags: int) -> int:
    """Open a regular file as `os.open` does; OSError for folders, pipes and devices."""
    try:
        descriptor = _when_free(os.open, path, flags | _WAIT_FOR_NOBODY, 0o666)
    except PermissionError:
        check_regular(os.stat(path))  # Windows opens no folders, and says no more
        raise
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


def remove_abandoned(target: Path, after: float = _ABANDONED_AFTER) -> None:
    """Remove the temporary files of killed processes for a file, to which nothing was written for some time [s]."""
    before = _before(target)
    with suppress(OSError):
        for name in os.listdir(target.parent):
            if name.startswith(before) and len(name) == len(before) + 21 and name.endswith(".part"):
                part = target.with_name(name)
                with suppress(OSError):
                    if time.time() - part.stat().st_mtime > after:
                        part.unlink()


def is_unfinished(name: str) -> bool:
    """Whether a name is that of a temporary file of `replace_file`."""
    return _UNFINISHED.fullmatch(name) is not None


def _before(target):
    """Beginning of the names of temporary files, which must not be too long for the file system."""
    return f".{target.name[:40]}."


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
