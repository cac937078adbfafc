"""Files that were opened last, in a small file of the user."""

import contextlib
import os
from pathlib import Path

from apt_evap._common.files import replace_file

_MOST = 8


def recent_files() -> list[str]:
    """Absolute paths of the files that were opened last, the newest first."""
    try:
        return _list().read_text(encoding="utf-8").splitlines()[:_MOST]
    except (OSError, ValueError):
        return []


def remember_file(path: str) -> None:
    """Put a file at the head of the list; a list that cannot be written is left as it is."""
    name = str(Path(path).absolute())
    if not name.isprintable():  # a line break would be two paths
        return
    paths = [name, *(other for other in recent_files() if other != name)][:_MOST]
    with contextlib.suppress(OSError, ValueError):
        _list().parent.mkdir(parents=True, exist_ok=True)
        with replace_file(_list()) as file:
            file.write("\n".join(paths).encode("utf-8"))


def _list():
    """The file of the list."""
    if folder := os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA"):
        return Path(folder) / "apt_evap" / "recent_files.txt"
    return Path.home() / ".local" / "state" / "apt_evap" / "recent_files.txt"
