"""Origin of a report: command, files with their checksums, warnings, versions."""

import datetime
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

from apt_evap._common.files import check_path, open_for_reading
from apt_evap._common.types import AnyPath
from apt_evap._common.version import __version__
from apt_evap.plot.report.html_page import Page, collapsed, escape, table, text_of
from apt_evap.simulation.provenance import system


def describe_file(path: AnyPath) -> dict[str, Any]:
    """Name, size and checksum of a file.

    Returns
    -------
    dict
        "name" without folders, "bytes" and "sha256".
    """
    path = check_path(path)
    with open_for_reading(path) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]  # an unbuffered file
        return {"name": path.name, "bytes": file.tell(), "sha256": digest}


def origin(files: Sequence[AnyPath] = (), command: str = "", messages: Sequence[str] = ()) -> dict[str, Any]:
    """Origin of a report of this process, for JSON: files that it was computed from, command line and its warnings."""
    return {
        "made_by": f"apt_evap {__version__}",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": command,
        "files": [describe_file(Path(path)) for path in files],
        "warnings": list(messages),
        "system": {**system(), "matplotlib": matplotlib.__version__},
    }


def add_origin(page: Page, content: Mapping[str, Any]) -> None:
    """Add command, files and versions to a page, and their data."""
    parts = []
    if content["command"]:
        parts.append(f"<pre>{escape(content['command'])}</pre>")
    if content["files"]:
        rows = [(file["name"], f"{file['bytes']:,}", file["sha256"]) for file in content["files"]]
        parts.append(table(rows, ("File", "Bytes", "SHA-256")))
    versions = {"written by": content["made_by"], "written at": content["created"], **content["system"]}
    parts.append(table((name, text_of(value)) for name, value in versions.items()))
    page.add(collapsed("Command, files and versions", "\n".join(parts)))
    page.data("origin", content)
