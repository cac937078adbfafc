"""Reading of ions and maps and writing of ions in all formats; `read` and `write` select the format.

A new format needs one module with a reader, a writer or both, and one line in `FORMATS`.
"""

import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.files import FileError, TruncatedFile, check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_kind, short_text
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.ion_blocks import ROWS, Field, IonBlocks
from apt_evap.io._apt_sections import SIGNATURE
from apt_evap.io._points import is_data
from apt_evap.io._texts import read_head, read_text, without_compression
from apt_evap.io.apt import chunk_apt, read_apt
from apt_evap.io.ato import read_ato
from apt_evap.io.csv import read_csv, write_csv
from apt_evap.io.env import read_env
from apt_evap.io.epos import WRITTEN as EPOS
from apt_evap.io.epos import EposBlocks, chunk_epos, read_epos, write_epos, write_epos_blocks
from apt_evap.io.npz import read_map
from apt_evap.io.pos import WRITTEN as POS
from apt_evap.io.pos import PosBlocks, chunk_pos, read_pos, write_pos, write_pos_blocks
from apt_evap.io.raw import chunk_raw, read_raw
from apt_evap.io.rng import read_rng
from apt_evap.io.rrng import read_rrng
from apt_evap.io.tapsim import SIGNATURE as TAPSIM
from apt_evap.io.tapsim import WRITTEN as TAPSIM_COLUMNS
from apt_evap.io.tapsim import read_tapsim, write_tapsim
from apt_evap.io.vtp import write_vtp
from apt_evap.io.xrng import read_xrng
from apt_evap.io.xyz import write_xyz
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.warnings import DataWarning, warn

__all__ = [
    "FORMATS",
    "RANGE_FORMATS",
    "FileError",
    "Format",
    "TruncatedFile",
    "chunks",
    "format_of",
    "read",
    "read_ranges",
    "write",
]


@dataclass(frozen=True)
class Format:
    """A file format: suffix (also its name), first bytes, reader, writer, readers in parts, and what is written.

    `fixed` are the columns that the writer always writes, as zeros if they are missing; empty if it writes those of the
    ions. `keeps` decides whether it writes a column, by its name and values.
    """

    suffix: str
    signature: bytes | None
    read: Callable | None = None
    write: Callable | None = None
    chunks: Callable | None = None
    blocks: type[EposBlocks] | type[PosBlocks] | None = None
    fixed: tuple[str, ...] = ()
    keeps: Callable[[str, NDArray[Any]], bool] = lambda name, values: True


# imported on demand, so that other formats do not import HDF5


def _read_hdf5(path, *, columns=None):
    from apt_evap.io.hdf5 import read_hdf5

    return read_hdf5(path, columns=columns)


def _write_nxapm(path, hits, *, elements=(), start_time=None):
    from apt_evap.io.nxapm import write_nxapm

    write_nxapm(path, hits, elements=elements, start_time=start_time)


def _write_pyccapt(path, hits):
    from apt_evap.io.pyccapt import write_pyccapt

    write_pyccapt(path, hits)


_GROUPING = ("pulse_id", "multiplicity")
_OF_PYCCAPT = (*EPOS, *_GROUPING, "start_counter", "laser_pulse", "calibrated_time_of_flight")
_OF_PYCCAPT += ("uncalibrated_mass_to_charge", "multi")
_WIDEST, _NARROWEST = 500.0, 1.0  # [mm]: of a detector; those of atom probes have 80 to 120
_ATOM = 0.1  # nm, smaller than any atom
_KEPT = 31 << 20
"""Bytes of an array that is freed before blocks are read: from then on the C library of Linux keeps freed memory below
this size for the arrays of the next block. Returning and clearing it takes 0.3 of the processor time of a map."""
_ENOUGH = 100  # ions: fewer may be near each other
LARGE = 1 << 26
"""Bytes of a file from which its ions are read in blocks: 1.5 million of an .epos. Smaller ones need 0.2 GB at most."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
FORMATS = (
    Format(".h5", _HDF5, _read_hdf5, _write_pyccapt, None, None, EPOS, lambda name, _: name in _OF_PYCCAPT),
    Format(".nxs", _HDF5, _read_hdf5, _write_nxapm, keeps=lambda name, values: values.dtype.kind in "biuf"),
    Format(
        ".epos", None, read_epos, write_epos, chunk_epos, EposBlocks, EPOS, lambda name, _: name in (*EPOS, *_GROUPING)
    ),
    Format(".pos", None, read_pos, write_pos, chunk_pos, PosBlocks, POS, lambda name, _: name in POS),
    Format(".apt", SIGNATURE, read_apt, None, chunk_apt),
    Format(".raw", None, read_raw, None, chunk_raw),
    Format(".ato", None, read_ato),
    Format(".npz", b"PK", read_map),
    Format(".xyz", None, None, write_xyz, keeps=is_data),
    Format(".vtp", None, None, write_vtp, keeps=is_data),
    Format(".csv", None, read_csv, write_csv),
    Format(".txt", None, read_csv),
    Format(".tapsim", TAPSIM, read_tapsim, write_tapsim, keeps=lambda name, _: name in TAPSIM_COLUMNS),
)

_BLOCK_WRITERS = {".epos": write_epos_blocks, ".pos": write_pos_blocks}
RANGE_FORMATS = {".rrng": read_rrng, ".rng": read_rng, ".env": read_env, ".xrng": read_xrng}
"""Readers of files of mass ranges, by suffix."""

_CAMECA = "raw files of CAMECA are not documented in public: export .epos or .apt from AP Suite"
_ADVICE = dict.fromkeys((".str", ".rhit", ".hits", ".root"), _CAMECA)
_ADVICE |= dict.fromkeys(RANGE_FORMATS, "it contains ranges of mass: read_ranges and --ranges read it")
_ADVICE |= {
    ".ops": "convert it to .epos, .pos or .apt",
}


def read(
    path: AnyPath,
    *,
    format: str | None = None,
    columns: Sequence[str] | None = None,
    ranges: AnyPath | Ranges | None = None,
    **options: Any,
) -> Any:
    """Read a file of ions or a map; `simulation.read_file.read` reads runs, too.

    Parameters
    ----------
    path : str or path-like
        The file.
    format : str, optional
        Suffix of the format, such as ".pos", for any name of the file.
    columns : sequence of str, optional
        Names of the columns to read.
    ranges : str, path-like or Ranges, optional
        Ranges of mass of the ions, or a file of these.
    **options
        Options of the reader of the format.

    Returns
    -------
    Hits or DetectorMap

    Raises
    ------
    FileError
        If the file is missing, unreadable, empty or of unknown format, or if an option or column does not exist.
    TruncatedFile
        If it ends in the middle of an ion.
    """
    chosen = format_of(path, format)
    assert chosen.read is not None
    content = chosen.read(path, **_options(path, chosen, chosen.read, columns, options))
    _warn_of_size(path, content)
    if ranges is None:
        return content
    if not isinstance(content, Hits):
        raise FileError(f"{str(path)!r}: ranges are for ions with m/n, got {content!r}")
    return replace(content, ranges=ranges if isinstance(ranges, Ranges) else read_ranges(ranges))


def chunks(
    path: AnyPath, rows: int, *, format: str | None = None, columns: Sequence[str] | None = None, **options: Any
) -> Iterator[Hits]:
    """Read a file of ions that is larger than the memory, in chunks of complete pulses.

    All chunks together are the same as the result of `read`: `pulse_id` continues from chunk to chunk, and a column is
    absent only if it is absent in the complete file.

    Parameters
    ----------
    path : str or path-like
        The file: .pos, .epos, .apt or .raw.
    rows : int
        Maximum number of ions in a chunk; not less than the number of ions in the largest pulse.
    format, columns, **options
        As for `read`.

    Returns
    -------
    iterator of Hits
        The ions in the order of the file. Errors of the file are raised when the first chunk is requested.

    Raises
    ------
    FileError
        As for `read`, and for a format that cannot be read in chunks.
    ValueError
        If `rows` is not an integer >= 1, or less than the number of ions of one pulse.
    """
    rows = check_count(rows, "rows", at_least=1)
    chosen = format_of(path, format)
    if chosen.chunks is None:
        name = format or without_compression(check_path(path)).suffix.lower() or chosen.suffix
        raise FileError(f"{str(path)!r} cannot be read in chunks: the format {name} does not support it")
    parts = chosen.chunks(path, rows, **_options(path, chosen, chosen.chunks, columns, options))
    return _with_warning_of_size(path, parts)


def ion_blocks(
    path: AnyPath,
    columns: Sequence[str] | None = None,
    *,
    format: str | None = None,
    further: tuple[str, ...] = (),
    progress: Callable[[int, int], object] = lambda ions, of: None,
    **options: Any,
) -> IonBlocks | None:
    """Blocks of the ions of a large file, for answers in memory that does not depend on their number.

    Parameters
    ----------
    path, columns, format, **options
        As for `read`.
    further : tuple of str
        Columns that are read if the file has them.
    progress : callable, optional
        Receives the number of ions of each block that is read, and of the file. Ions are read more than once.

    Returns
    -------
    IonBlocks or None
        None for a file that is to be read whole: smaller than `LARGE`, of another format than .epos and .pos, without
        one of these columns, or with a pulse that is larger than a block.
    """
    chosen = format_of(path, format)
    if chosen.blocks is None or os.stat(check_path(path)).st_size < LARGE:
        return None
    assert chosen.chunks is not None
    if columns is not None:
        if not set(columns) <= set(chosen.blocks.available):
            return None
        further = tuple(name for name in further if name in chosen.blocks.available)
    needed, fields = None if columns is None else (*columns, *further), []
    options = _options(path, chosen, chosen.chunks, needed, options)

    def watch(ions):
        fields.append(Field(ions))
        return fields[0].add

    np.empty(_KEPT, np.uint8)
    reader = chosen.blocks(path, watch=watch, progress=progress, **options)
    if not set(columns or ()) <= set(reader.columns) or reader.largest > ROWS:
        return None
    field = fields[0] if {"x", "y"} <= set(reader.columns) else None
    ions = IonBlocks(
        reader, field, str(path), lambda size, of_detected: _warn_of_extent(path, size, of_detected, reader.n)
    )
    ions.progress = progress
    return ions


def _with_warning_of_size(path, parts):
    warned = False
    for part in parts:
        warned = warned or _warn_of_size(path, part)
        yield part
        del part


def _warn_of_size(path, content):
    """Warn if a measured map or ions are farther apart than any detector is wide, or nearer than any is small.

    And of positions that are nearer to each other than atoms are.
    """
    if isinstance(content, Hits) and content.outcome is None and content.positions is not None:
        span = _span(content.positions[:_ENOUGH])  # of most files, these are far enough apart
        span = _span(content.positions) if span < _ATOM else span
        if 0 < span < _ATOM and len(content) >= _ENOUGH:
            warn(
                f"{str(path)!r} has positions within {span:.2g} nm, less than the size of an atom: are they in nm?",
                DataWarning,
            )
            return True
    if isinstance(content, Hits) and content.outcome is None and content.x is not None and content.y is not None:
        size = _size(content, np.isfinite(content.x) & np.isfinite(content.y))
        return _warn_of_extent(path, size, lambda: _size(content, content.detected), len(content))
    if not isinstance(content, DetectorMap):
        return False
    x_min, x_max, y_min, y_max = content.extent
    size = (x_max - x_min, y_max - y_min)
    return _warn_of_extent(path, size, lambda: size, _ENOUGH)


def _warn_of_extent(path, size, of_detected, number):
    """Warn if the extent of a map, or of a number of ions, is that of no detector."""
    if max(size) > _WIDEST:  # perhaps by strays alone, which have a warning of their own
        size = of_detected()
    if 0 < max(size) < _NARROWEST and number >= _ENOUGH:
        warn(
            f"{str(path)!r} has detector coordinates in {size[0]:.4g} x {size[1]:.4g} mm, no detector is narrower than "
            f"{_NARROWEST:g} mm: are they in mm?",
            DataWarning,
        )
        return True
    if max(size) > _WIDEST:
        warn(
            f"{str(path)!r} has detector coordinates in {size[0]:.4g} x {size[1]:.4g} mm, no detector is wider than "
            f"{_WIDEST:g} mm: are they in mm?",
            DataWarning,
        )
    return max(size) > _WIDEST


def _span(positions):
    """Largest extent of finite positions along an axis [nm]; 0 if there are none."""
    finite = positions[np.isfinite(positions).all(axis=1)]
    return float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0


def _size(hits, rows):
    """Extent of ions in x and y [mm]."""
    return tuple(
        float(values.max(where=rows, initial=-np.inf)) - float(values.min(where=rows, initial=np.inf))
        for values in (hits.x, hits.y)
    )


def write(path: AnyPath, hits: Hits, *, format: str | None = None, **options: Any) -> None:
    """Write ions to a file; the suffix selects the format.

    Parameters
    ----------
    path : str or path-like
        The file, .pos, .epos, .nxs, .tapsim, .csv, .xyz, .vtp or .h5 (of PyCCAPT); an existing one is replaced when the
        new one is complete.
    hits : Hits
        The ions. A .pos, .epos or .h5 does not contain ions that did not hit the detector or have values that are not
        finite; an .xyz or .vtp does not contain ions whose positions are not finite. A warning gives the number of
        ions left out. The other formats contain all ions. For measured ions, a warning names the columns for which the
        format has no place.
    format : str, optional
        Suffix of the format, such as ".pos", for any name of the file.
    **options
        Options of the writer of the format: ``species`` gives the species of the ions in an .xyz, ``elements`` (needed)
        and ``start_time`` are for an .nxs, ``binary=True`` for a .tapsim, ``decimals`` and ``separator`` ("comma",
        "semicolon" or "tab") for a .csv.

    Raises
    ------
    FileError
        If the format is unknown or cannot be written, or the file cannot be written.
    ValueError
        If a column that the format requires is missing, or there is no ion to write.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> hits = run.hits(ae.RollUp(0.2)).window(x=(-40, 40), y=(-40, 40))  # mm
    >>> ae.write("ni.pos", hits)
    >>> ae.read("ni.pos")
    <Hits: 20 ions, 20 detected from 'ni.pos'; mass_to_charge, positions>
    """
    chosen = _by_suffix(path, format, "write")
    if chosen.write is None:
        raise FileError(
            f"hits cannot be written to {str(path)!r}: a {chosen.suffix} file is a format that can only be read"
        )
    if not isinstance(hits, Hits):
        raise ValueError(f"hits must be Hits, such as run.hits(perturbation), got {short_text(hits)}")
    _check_options(path, chosen, "writing", _known(chosen.write, "hits"), options)
    chosen.write(path, hits, **options)
    lost, _ = left_out(path, hits, format=format)
    if hits.outcome is None and hits.ion is None:
        _warn_of_lost(path, chosen, lost)


def write_blocks(path: AnyPath, ions: IonBlocks) -> tuple[int, tuple[str, ...], tuple[str, ...]]:
    """Write the detected ions of a large file block by block, with the same bytes as `write`.

    Returns
    -------
    detected : int
        Number of detected ions.
    left_out, zeros : tuple of str
        As of `left_out`.
    """
    chosen = _by_suffix(path, None, "write")
    detected = _BLOCK_WRITERS[chosen.suffix](path, ions)
    lost = tuple(name for name in ions.columns if not chosen.keeps(name, np.empty(0)))
    _warn_of_lost(path, chosen, lost)
    return detected, lost, tuple(name for name in chosen.fixed if name not in ions.columns)


def writes_blocks(path: AnyPath) -> bool:
    """Whether a file of this name can be written block by block."""
    return check_path(path).suffix.lower() in _BLOCK_WRITERS


def _warn_of_lost(path, chosen, lost):
    if lost:
        warn(
            f"{str(path)!r} is without the columns {', '.join(lost)}, for which a {chosen.suffix} file has no place",
            DataWarning,
        )


def left_out(path: AnyPath, hits: Hits, *, format: str | None = None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Columns that a file of this format does not contain, and missing ones that it contains as zeros.

    Returns
    -------
    left_out, zeros : tuple of str
    """
    chosen = _by_suffix(path, format, "write")
    columns = {name: getattr(hits, name) for name in hits.columns} | hits.extra
    lost = tuple(name for name, values in columns.items() if not chosen.keeps(name, values))
    return lost, tuple(name for name in chosen.fixed if name not in columns)


def read_ranges(path: AnyPath, *, format: str | None = None) -> Ranges:
    """Read a file of mass ranges; the suffix selects the format.

    Parameters
    ----------
    path : str or path-like
        The file: .rrng, .rng, .env or .xrng. A file with another suffix is read as .xrng if it is XML, else as .rrng.
    format : str, optional
        Suffix of the format, such as ".rng", for any name of the file.

    Returns
    -------
    Ranges
        In the order of the file.

    Raises
    ------
    FileError
        If the file is missing or unreadable, or has no ranges, or the format is unknown.

    Warns
    -----
    DataWarning
        Of lines that cannot be read, with their numbers: they are left out.
    """
    suffix = without_compression(path).suffix.lower()
    if format is not None:
        suffix = "." + check_kind(format, "format", str, "a suffix such as '.rng'").lower().lstrip(".")
        if suffix not in RANGE_FORMATS:
            raise FileError(f"format of {str(path)!r} must be one of {', '.join(RANGE_FORMATS)}, got format={format!r}")
    if suffix in RANGE_FORMATS:
        return _ranges_of(path, RANGE_FORMATS[suffix])
    known = f"expected one of {', '.join(RANGE_FORMATS)}, got suffix {suffix!r}"
    head = read_head(path, 64).lstrip()
    if head.startswith(_HDF5.lstrip()):
        raise FileError(f"{str(path)!r} is an HDF5 file, no file of mass ranges: {known}")
    try:
        return _ranges_of(path, read_xrng if head.startswith(b"<") else read_rrng)
    except FileError as error:
        raise FileError(f"{error}; {known}") from error


def _ranges_of(path, read):
    """Ranges of a file; what they refuse, such as a control character in a name, is an error of the file."""
    try:
        return read(path)
    except FileError:
        raise
    except ValueError as error:
        lines = enumerate(read_text(path, "ranges of mass").split("\n"), 1)
        odd = [at for at, line in lines if not line.replace("\t", " ").rstrip("\r").isprintable()]
        where = f"{str(path)!r}, line {odd[0]}" if odd else f"{str(path)!r}"
        raise FileError(f"{where}: {error}") from error


def format_of(path: AnyPath, format: str | None = None) -> Format:
    """Format of a file, by its first bytes if possible, otherwise by its suffix."""
    head = read_head(path, 64)
    chosen = _by_content(head) if format is None else None
    if chosen is None:
        chosen = _by_suffix(path, format, "read")
        if chosen.read is None:
            known = _suffixes("read")
            raise FileError(
                f"{str(path)!r} cannot be read: suffix {chosen.suffix!r} can only be written, expected one of {known}"
            )
        if format is None and chosen.signature is not None:
            if not head:
                raise FileError(f"{str(path)!r} is empty (0 bytes), expected a {chosen.suffix} file")
            raise FileError(
                f"{str(path)!r} does not begin like a {chosen.suffix} file, "
                f"expected {chosen.signature!r}, got {head[: len(chosen.signature)]!r}"
            )
    return chosen


def _options(path, chosen, reader, columns, options):
    """Check the options of the reader and return them."""
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
    if format is None and doing == "read" and (inner := without_compression(path)) != check_path(path):
        raise FileError(f"{str(path)!r} is compressed: decompress it to read it as {inner.name!r}")
    if format is None and doing == "read" and suffix.lower() in _ADVICE:
        raise FileError(f"{str(path)!r} cannot be read as ions; {_ADVICE[suffix.lower()]}")
    source = f"suffix {suffix!r}" if format is None else f"format={format!r}"
    raise FileError(f"format of {str(path)!r} must be one of {_suffixes(doing)}, got {source}")
