"""Files of the commands: read by their options, and written only where nobody else's is lost."""

import argparse
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from apt_evap import plot
from apt_evap._files import FileError, check_path, replace_file
from apt_evap._types import AnyPath
from apt_evap._version import __version__
from apt_evap.hits import Hits
from apt_evap.io import read as read_file
from apt_evap.maps import DetectorMap
from apt_evap.run import Run

_MARK = f"apt_evap {__version__}"
_MARK_KEYS = {".png": "Software", ".pdf": "Creator", ".svg": "Creator"}


def read(options: argparse.Namespace) -> Hits | Run:
    wanted = {"partial": options.partial, "byte_order": options.byte_order}
    return read_file(
        options.file, format=options.format, **{key: value for key, value in wanted.items() if value is not None}
    )


def picture_path(path: AnyPath) -> Path:
    path = check_path(path)
    if path.suffix.lower() not in _MARK_KEYS:
        raise FileError(f"a picture is a {', '.join(_MARK_KEYS)} file, got {str(path)!r}")
    return path


def save_picture(path: Path, maps: Sequence[DetectorMap], titles: Sequence[str]) -> None:
    figure = plot.detector_maps(maps, titles, limits=plot.common_limits(maps))[0].figure
    suffix = path.suffix.lower()
    with replace_file(path) as file:
        figure.savefig(file, format=suffix[1:], dpi=200, metadata={_MARK_KEYS[suffix]: _MARK})


def check_output(path: AnyPath, is_ours: Callable[[Path], bool], force: bool) -> None:
    """Make sure that a file can be written, and that nobody else's is overwritten."""
    target = Path(os.path.realpath(path))
    try:
        if target.is_dir():
            raise IsADirectoryError(None, "Is a directory")
        with tempfile.TemporaryFile(dir=target.parent):
            pass
        if target.exists() and not force and not is_ours(target):
            raise FileError(f"{str(path)!r} exists and was not made by apt-evap: --force overwrites it")
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error


def is_picture(path: Path) -> bool:
    return b"apt_evap" in path.read_bytes()
