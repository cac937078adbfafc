"""Files of ions: one module per format, and `read` and `write` that choose among them.

A further format is one module with a reader (and a writer, if it can be written) and one line in `FORMATS`.
"""

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from apt_evap._common.files import FileError, TruncatedFile, check_path, open_for_reading
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_kind, short_text
from apt_evap._common.wording import argument
from apt_evap.detection.hits import Hits
from apt_evap.io._apt_sections import SIGNATURE
from apt_evap.io.apt import chunk_apt, read_apt
from apt_evap.io.epos import chunk_epos, read_epos, write_epos
from apt_evap.io.npz import read_map
from apt_evap.io.pos import chunk_pos, read_pos, write_pos
from apt_evap.io.raw import chunk_raw, read_raw
from apt_evap.io.rrng import read_ranges
from apt_evap.io.vtp import write_vtp
from apt_evap.io.xyz import write_xyz

__all__ = ["FORMATS", "FileError", "Format", "TruncatedFile", "chunks", "read", "read_ranges", "write"]


@dataclass(frozen=True)
class Format:
    """A file format: its suffix (also its name), the bytes it begins with, its reader, its writer, its chunks."""

    suffix: str
    signature: bytes | None
    read: Callable | None = None
    write: Callable | None = None
    chunks: Callable | None = None


def _read_run(path):
    # a Run is loaded only on demand, so that reading a .pos does not import the simulation
    from apt_evap.simulation.run import load

    return load(path)


FORMATS = (
    Format(".h5", b"\x89HDF\r\n\x1a\n", _read_run),
    Format(".epos", None, read_epos, write_epos, chunk_epos),
    Format(".pos", None, read_pos, write_pos, chunk_pos),
    Format(".apt", SIGNATURE, read_apt, None, chunk_apt),
    Format(".raw", None, read_raw, None, chunk_raw),
    Format(".npz", b"PK", read_map),
    Format(".xyz", None, None, write_xyz),
    Format(".vtp", None, None, write_vtp),
)


def read(path: AnyPath, *, format: str | None = None, columns: Sequence[str] | None = None, **options: Any) -> Any:
    """Read a file of ions; its first bytes tell the format where they can, its suffix otherwise.

    Parameters
    ----------
    path : str or path-like
        The file: .pos, .epos, .apt, .raw, .h5 or .npz.
    format : str, optional
        Suffix of the format to read it as, such as ".pos", whatever the file is called.
    columns : sequence of str, optional
        Names of the columns to read, so that only these take up memory; all by default. Not for .h5 and
        .npz.
    **options
        Passed to the reader of the format: ``partial=True`` reads the whole ions of a truncated file (the whole
        sections of an .apt), ``byte_order="little"`` a .pos or .epos written in the wrong byte order; those of
        `read_map` for an .npz.

    Returns
    -------
    Hits
        The ions; for a simulation's .h5 the `Run`, whose ``hits`` method gives them; for an .npz the `DetectorMap`.

    Raises
    ------
    FileError
        If the file is missing, unreadable, empty or of unknown format, or an option or column does not exist for it.
    TruncatedFile
        If it ends in the middle of an ion.
    """
    chosen = _to_read(path, format)
    return chosen.read(path, **_options(path, chosen, chosen.read, columns, options))


def chunks(
    path: AnyPath, rows: int, *, format: str | None = None, columns: Sequence[str] | None = None, **options: Any
) -> Iterator[Hits]:
    """Read a file of ions that need not fit into memory, in whole pulses.

    The chunks joined are what `read` gives: pulse_id goes on from chunk to chunk, and what counts as absent is told by
    the whole file.

    Parameters
    ----------
    path : str or path-like
        The file: .pos, .epos, .apt or .raw.
    rows : int
        Most ions in a chunk; as many as the largest pulse has, at least.
    format, columns, **options
        As for `read`.

    Returns
    -------
    iterator of Hits
        The ions in the order of the file. Errors of the file are raised when the first chunk is asked for.

    Raises
    ------
    FileError
        As `read` does, and for a format that is not read in chunks.
    ValueError
        If `rows` is no whole number above 0, or less than the ions of one pulse.
    """
    rows = check_count(rows, "rows", at_least=1)
    chosen = _to_read(path, format)
    if chosen.chunks is None:
        raise FileError(f"{str(path)!r} cannot be read in chunks: a {chosen.suffix} file is read whole")
    return chosen.chunks(path, rows, **_options(path, chosen, chosen.chunks, columns, options))


def write(path: AnyPath, hits: Hits, *, format: str | None = None, **options: Any) -> None:
    """Write ions to a file whose suffix tells the format; a warning counts the ions left out.

    Parameters
    ----------
    path : str or path-like
        The file, .pos, .epos, .xyz or .vtp; an existing one is replaced once the new one is complete.
    hits : Hits
        The ions. Left out are, of a .pos or .epos, those that missed the detector or have values that are not finite;
        of an .xyz or .vtp, those whose positions are not finite.
    format : str, optional
        Suffix of the format to write, such as ".pos", whatever the file is called.
    **options
        Passed to the writer of the format: ``species`` names the ions of an .xyz.

    Raises
    ------
    FileError
        If the format is unknown or cannot be written, or the file cannot be written.
    ValueError
        If a column the format cannot do without is missing, or no ion is left to write.
    """
    chosen = _by_suffix(path, format, "write")
    if chosen.write is None:
        reason = "holds a Run (run.save)" if chosen.suffix == ".h5" else "is only read"
        raise FileError(f"hits cannot be written to {str(path)!r}: a {chosen.suffix} file {reason}")
    if not isinstance(hits, Hits):
        raise ValueError(f"hits must be Hits, such as run.hits(perturbation) gives, got {short_text(hits)}")
    _check_options(path, chosen, "writing", _known(chosen.write, "hits"), options)
    chosen.write(path, hits, **options)


def _to_read(path, format):
    with open_for_reading(path) as file:
        head = file.read(64)
    chosen = _by_content(head) if format is None else None
    if chosen is None:
        chosen = _by_suffix(path, format, "read")
        if chosen.read is None:
            known = _suffixes("read")
            raise FileError(
                f"{str(path)!r} cannot be read, only written, by its suffix {chosen.suffix!r}, expected one of {known}"
            )
        if format is None and chosen.signature is not None:
            if not head:
                raise FileError(f"{str(path)!r} is empty (0 bytes), expected a {chosen.suffix} file")
            raise FileError(
                f"{str(path)!r} does not begin as a {chosen.suffix} file does, "
                f"expected {chosen.signature!r}, got {head[: len(chosen.signature)]!r}"
            )
    return chosen


def _options(path, chosen, reader, columns, options):
    """Options for the reader, checked."""
    _check_options(path, chosen, "reading", [name for name in _known(reader, "rows") if name != "columns"], options)
    if columns is None:
        return options
    if "columns" not in _known(reader):
        raise FileError(f"{str(path)!r}: reading {chosen.suffix} files takes no columns, got {short_text(columns)}")
    return {**options, "columns": columns}


def _known(function, *others):
    return [name for name in inspect.signature(function).parameters if name not in ("path", *others)]


def _check_options(path, chosen, doing, known, options):
    for name in options:
        if name not in known:
            takes = f"{doing} {chosen.suffix} files takes {', '.join(known) or 'no options'}"
            raise FileError(f"{str(path)!r}: {takes}, got {name!r}")


def _by_content(head):
    for candidate in FORMATS:
        if candidate.signature is not None and head.startswith(candidate.signature):
            return candidate
    return None


def _suffixes(doing):
    return ", ".join(candidate.suffix for candidate in FORMATS if getattr(candidate, doing))


def _by_suffix(path, format, doing):
    if format is not None:
        check_kind(format, "format", str, "a suffix such as '.pos'")
    suffix = check_path(path).suffix if format is None else "." + format.lstrip(".")
    for candidate in FORMATS:
        if candidate.suffix == suffix.lower():
            return candidate
    told = f"its suffix {suffix!r}" if format is None else argument("format", format)
    raise FileError(f"the format of {str(path)!r} is not known from {told}, expected one of {_suffixes(doing)}")
