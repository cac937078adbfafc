"""Files of ions: one module per format, and `read` and `write` that choose among them.

A further format is one module with a reader (and a writer, if it can be written) and one line in `FORMATS`.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

from apt_evap._files import FileError, TruncatedFile, check_path, open_for_reading
from apt_evap.io.epos import read_epos, write_epos
from apt_evap.io.pos import read_pos, write_pos

__all__ = ["FORMATS", "FileError", "Format", "TruncatedFile", "read", "write"]


@dataclass(frozen=True)
class Format:
    """A file format: its suffix (also its name), the bytes it begins with, its reader and its writer."""

    suffix: str
    signature: bytes | None
    read: Callable
    write: Callable | None = None


def _read_run(path):
    # a Run is loaded only on demand, so that reading a .pos does not import the simulation
    from apt_evap.run import load

    return load(path)


FORMATS = (
    Format(".h5", b"\x89HDF\r\n\x1a\n", _read_run),
    Format(".epos", None, read_epos, write_epos),
    Format(".pos", None, read_pos, write_pos),
)


def read(path, *, format=None, **options):
    """Read a file of ions; its first bytes tell the format where they can, its suffix otherwise.

    Parameters
    ----------
    path : str or path-like
        The file: .pos, .epos or .h5.
    format : str, optional
        Suffix of the format to read it as, such as ".pos", whatever the file is called.
    **options
        Passed to the reader of the format: ``partial=True`` reads the whole ions of a truncated .pos or
        .epos, ``byte_order="little"`` one written in the wrong byte order.

    Returns
    -------
    Hits
        The ions; for a simulation's .h5 the `Run`, whose ``hits`` method gives them.

    Raises
    ------
    FileError
        If the file is missing, unreadable, empty or of unknown format, or an option does not exist for it.
    TruncatedFile
        If it ends in the middle of an ion.
    """
    with open_for_reading(path) as file:
        head = file.read(64)
    chosen = _by_content(head) if format is None else None
    if chosen is None:
        chosen = _by_suffix(path, format)
        if format is None and chosen.signature is not None:
            raise FileError(
                f"{str(path)!r} does not begin as a {chosen.suffix} file does, "
                f"expected {chosen.signature!r}, got {head[: len(chosen.signature)]!r}"
            )
    known = [name for name in inspect.signature(chosen.read).parameters if name != "path"]
    for name in options:
        if name not in known:
            raise FileError(f"reading {chosen.suffix} files takes {', '.join(known) or 'no options'}, got {name!r}")
    return chosen.read(path, **options)


def write(path, hits, *, format=None):
    """Write ions to a file whose suffix tells the format; a warning counts the ions left out.

    Parameters
    ----------
    path : str or path-like
        The file, .pos or .epos; an existing one is replaced once the new one is complete.
    hits : Hits
        The ions; those that missed the detector or have values that are not finite are left out.
    format : str, optional
        Suffix of the format to write, such as ".pos", whatever the file is called.

    Raises
    ------
    FileError
        If the format is unknown or cannot be written, or the file cannot be written.
    ValueError
        If a column the format cannot do without is missing, or no ion is left to write.
    """
    chosen = _by_suffix(path, format)
    if chosen.write is None:
        raise FileError(f"hits cannot be written to {str(path)!r}: a {chosen.suffix} file holds a Run (run.save)")
    chosen.write(path, hits)


def _by_content(head):
    for candidate in FORMATS:
        if candidate.signature is not None and head.startswith(candidate.signature):
            return candidate
    return None


def _by_suffix(path, format):
    suffix = check_path(path).suffix if format is None else "." + str(format).lstrip(".")
    for candidate in FORMATS:
        if candidate.suffix == suffix.lower():
            return candidate
    known = ", ".join(candidate.suffix for candidate in FORMATS)
    raise FileError(
        f"the format of {str(path)!r} is not known from "
        f"{f'its suffix {suffix!r}' if format is None else f'format={format!r}'}, expected one of {known}"
    )
