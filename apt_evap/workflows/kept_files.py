"""Files that a workflow keeps in a folder, with what they were made from."""

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from apt_evap._common.codec import to_plain
from apt_evap._common.files import FileError, read_small_file, replace_file, sha256_of
from apt_evap._common.kept import check_made_from
from apt_evap._common.validation import short_text
from apt_evap._common.version import __version__

RECORD = "twin.json"
_LARGEST = 1 << 24  # bytes
_ELSEWHERE = "give another folder with -o (folder=... in Python)"


class KeptFiles:
    """Files of a folder, and their record: the SHA-256 of each, and what they were made from.

    The digest of a file is recorded before the file is written. So a file is missing, or as recorded, or of another
    program.

    Raises
    ------
    FileError
        If the folder cannot be written, has files of other programs with these names, or was made from something else.
    """

    def __init__(self, folder: Path, made_from: Mapping[str, Any], names: Sequence[str]) -> None:
        self.folder = folder
        self._made_from = to_plain(made_from)
        self._digests: dict[str, str] = {}
        if os.path.lexists(folder) and not folder.is_dir():
            raise FileError(f"cannot write to {str(folder)!r}: it is not a folder")
        try:
            with tempfile.TemporaryFile(dir=folder if folder.is_dir() else folder.parent):
                pass
        except OSError as error:
            raise FileError(f"cannot write to {str(folder)!r}: {error.strerror or error}") from error
        if os.path.lexists(folder / RECORD):
            self._read()
            return
        for name in names:
            if os.path.lexists(folder / name):
                self._refuse(name, "was not made by this command")

    def _read(self):
        """Read and check the record."""
        path = self.folder / RECORD
        content = read_small_file(path, _LARGEST, "a record of files")
        try:
            record = json.loads(content)
            made_from, digests = record["made_from"], record["files"]
            if not all(isinstance(part, dict) for part in (made_from, digests)):
                raise ValueError(f"made_from and files must be objects, got {short_text(record)}")
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise FileError(f"{str(path)!r} is not a record of this command, {_ELSEWHERE}: {error!r:.80}") from None
        check_made_from(self.folder, made_from, self._made_from, _ELSEWHERE)
        self._digests = digests

    def _refuse(self, name, why) -> NoReturn:
        raise FileError(f"{str(self.folder / name)!r} {why}: remove it, or {_ELSEWHERE}")

    def has(self, name: str) -> bool:
        """Whether a file is complete; FileError if it is not the file that was written."""
        path = self.folder / name
        if not os.path.lexists(path):
            return False
        if path.is_symlink() or name not in self._digests:
            self._refuse(name, "was not made by this command")
        if sha256_of(path) != self._digests[name]:
            self._refuse(name, "is not as this command has written it")
        return True

    def read(self, name: str) -> bytes:
        """Content of a small file."""
        return read_small_file(self.folder / name, _LARGEST, "a file of this command")

    def write(self, files: Mapping[str, bytes], others: Sequence[str] = ()) -> None:
        """Write files, and record them and `others`, which exist already."""
        for name in files:
            self.has(name)  # not a file of another program
        self._digests |= {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        self._digests |= {name: sha256_of(self.folder / name) for name in others}
        self._save()
        for name, content in files.items():
            with replace_file(self.folder / name) as file:
                file.write(content)

    def forget(self, *names: str) -> None:
        """Remove files that are to be made again."""
        for name in names:
            if name in self._digests and self.has(name):
                (self.folder / name).unlink()
        self._digests = {name: digest for name, digest in self._digests.items() if name not in names}
        if os.path.lexists(self.folder / RECORD):
            self._save()

    def _save(self):
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise FileError(f"cannot write to {str(self.folder)!r}: {error.strerror or error}") from error
        record = {"made_by": f"apt_evap {__version__}", "made_from": self._made_from, "files": self._digests}
        with replace_file(self.folder / RECORD) as file:
            file.write((json.dumps(record, indent=1) + "\n").encode())
