"""What every reader and writer shares: errors in one sentence, whole files or none."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from apt_evap._common.types import AnyPath


class FileError(ValueError):
    """A file that cannot be read or written; the message names it and says why."""


class TruncatedFile(FileError):
    """A file that ends in the middle of an ion."""


def check_path(path: Any) -> Path:
    """Return `path` as a Path.

    Raises
    ------
    FileError
        If it is not a str or a path, or holds a null character.
    """
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        raise FileError(f"path must be a file name, got {path!r:.80}")
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
        If it is missing, unreadable or a directory.
    """
    path = check_path(path)
    try:
        with open(path, "rb", buffering=0) as file:
            yield file
    except OSError as error:
        raise FileError(f"cannot read {str(path)!r}: {_reason(error)}") from error


@contextmanager
def replace_file(path: AnyPath) -> Iterator[BinaryIO]:
    """Write a file aside, in the same folder, and put it in its place only once it is complete.

    Parameters
    ----------
    path : str or path-like
        The file to write or overwrite.

    Yields
    ------
    file
        Open for writing bytes.

    Raises
    ------
    FileError
        If the file cannot be written; nothing is left behind then.
    """
    path = check_path(path)
    target = Path(os.path.realpath(path))
    aside = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        if target.is_dir():
            raise IsADirectoryError(None, "Is a directory")
        with open(aside, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # a name must not come before the bytes, should the power fail
        os.replace(aside, target)
        flush_folder(target.parent)
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {_reason(error)}") from error
    finally:
        aside.unlink(missing_ok=True)


def flush_folder(folder: AnyPath) -> None:
    """Make sure that the names of new files are on the disk too, where the system can do that."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _reason(error):
    return getattr(error, "strerror", None) or str(error)
