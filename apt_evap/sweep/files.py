"""Files in the folder of a sweep: no link in it is followed, and no pipe is waited for."""

import os
from pathlib import Path
from typing import BinaryIO

from apt_evap._common.files import FileError, check_regular, replace_file

_APPEND = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


def unlinked(path: Path) -> Path:
    """Return a path in a sweep; FileError if it is a link, which may lead out of the folder."""
    if path.is_symlink():
        raise FileError(f"{str(path)!r} is a link; expected a file or folder, because a sweep follows no links")
    return path


def write(path: Path, text: str) -> None:
    """Write or replace a complete text file of a sweep; FileError if it is a link or cannot be written."""
    with replace_file(unlinked(path)) as file:
        file.write(text.encode())


def append_to(path: Path) -> BinaryIO:
    """Open a file of a sweep for appending; FileError if it is a link, has a second name, or is not a regular file."""

    def opened(name, flags):
        descriptor = os.open(name, _APPEND, 0o666)
        try:
            status = os.fstat(descriptor)
            check_regular(status)
            if status.st_nlink > 1:
                raise OSError(None, "it has a second name (hard link)")
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    try:
        return open(path, "ab", opener=opened)
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error
