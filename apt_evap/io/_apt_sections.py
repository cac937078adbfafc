"""Header of an .apt file and headers of its sections."""

import os
import struct
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np

from apt_evap._common.files import FileError, TruncatedFile
from apt_evap._common.types import AnyPath
from apt_evap.warnings import DataWarning, warn

SIGNATURE = b"APT\0"
_SECTION = b"SEC\0"
_HEADER_SIZE = 540
_SECTION_SIZE = 148
_PADDING = 1 << 16
_MAX_PADDING = 1 << 24  # bytes; sections begin at multiples of 4 kB, so that more zeros than this are not padding
_KINDS = {1: "i", 2: "u", 3: "f"}
_BITS = {"i": (8, 16, 32, 64), "u": (8, 16, 32, 64), "f": (16, 32, 64)}


@dataclass(frozen=True)
class Section:
    """A section with one fixed record per ion: position and type of its data."""

    name: str
    unit: str
    data: int
    record_size: int
    dtype: np.dtype
    values: int


def read_sections(file: BinaryIO, path: AnyPath, partial: bool) -> tuple[int, list[Section]]:
    """Read the headers of an .apt file."""
    size = os.fstat(file.fileno()).st_size
    if size == 0:
        raise FileError(f"{str(path)!r} is empty (0 bytes), expected an .apt file, beginning with {SIGNATURE!r}")
    head = _at(file, 0, _HEADER_SIZE)
    if not head.startswith(SIGNATURE):
        raise FileError(f"{str(path)!r} does not begin like an .apt file, expected {SIGNATURE!r}, got {head[:4]!r}")
    if len(head) < _HEADER_SIZE:
        raise TruncatedFile(f"{str(path)!r} ends in its header, after {size} of {_HEADER_SIZE} bytes")
    header_size, version = struct.unpack_from("<2i", head, 4)
    (n,) = struct.unpack_from("<Q", head, 532)
    if header_size < _HEADER_SIZE:
        raise FileError(f"{str(path)!r} has a header size of {header_size}, expected >= {_HEADER_SIZE}")
    if version != 2:
        warn(f"{str(path)!r} has version {version} of .apt, read as version 2", DataWarning)
    if n == 0:
        raise FileError(f"{str(path)!r} has 0 ions according to its header, expected >= 1")

    sections = []
    end = None
    at = header_size
    while (at := _skip_padding(file, path, at, size)) < size:
        head = _at(file, at, _SECTION_SIZE)
        end = size + 1
        name = ""
        if len(head) == _SECTION_SIZE:
            name = _text(head[12:76])
            section, end = _section(head, at, n, size, path)
        if end > size:
            problem = f"{str(path)!r} ends in its section {name!r}, which begins at byte {at}: {size} bytes"
            problem += f" of {end}" if name else ""
            if not partial:
                raise TruncatedFile(
                    f"{problem}; partial=True (--partial) reads the {len(sections)} complete sections before it"
                )
            warn(f"{problem}; only the {len(sections)} sections before it are read", DataWarning)
            break
        if section:
            sections.append(section)
        at = end
    if not sections:
        kind = TruncatedFile if end is None or end > size else FileError
        raise kind(f"{str(path)!r} has no complete section with a value for every ion, expected at least one")
    return n, _distinct(sections, path)


def _section(head, at, n, size, path):
    """Read the header of a section; return the section, or None with a warning if unreadable, and its end."""
    (header_size,) = struct.unpack_from("<i", head, 4)
    relationship, record_type, kind, bits, record_size = struct.unpack_from("<3I2i", head, 80)
    name, unit = _text(head[12:76]), _text(head[100:132])
    records, length = struct.unpack_from("<2q", head, 132)
    where = f"{str(path)!r}, section {name!r} at byte {at}:"
    if header_size < _SECTION_SIZE:
        raise FileError(f"{where} header size must be >= {_SECTION_SIZE}, got {header_size}")
    if length < 0:
        raise FileError(f"{where} byte count must be >= 0, got {length}")
    end = at + header_size + length
    problem = ""
    if relationship != 1:
        problem = f"relationship {relationship} to the ions (supported: 1, one to one)"
    elif record_type != 1:
        problem = f"record type {record_type} (supported: 1, fixed)"
    elif kind == 4 and bits == 8 and record_size > 0:
        dtype, values = np.dtype(f"S{record_size}"), 1
    elif kind not in _KINDS or bits not in _BITS[_KINDS[kind]]:
        problem = f"data type {kind} of {bits} bits"
    elif record_size <= 0 or record_size % (bits // 8):
        problem = f"records of {record_size} bytes for values of {bits} bits"
    else:
        dtype, values = np.dtype(f"<{_KINDS[kind]}{bits // 8}"), record_size // (bits // 8)
    if problem:
        warn(f"{where} skipped, because it has {problem}", DataWarning)
        return None, end
    if records != n:
        raise FileError(f"{where} has {records} records, expected one for each of the {n} ions")
    if length < n * record_size:
        raise FileError(f"{where} has {length} bytes, expected {n} records of {record_size} bytes")
    return Section(name, unit, at + header_size, record_size, dtype, values), end


def _skip_padding(file, path, at, size):
    """Position of the next section; the size of the file if there is none."""
    start = at
    while at < size:
        if at - start > _MAX_PADDING:
            raise FileError(f"{str(path)!r}: expected a section ({_SECTION!r}) at byte {start}, got only zeros")
        block = _at(file, at, _PADDING)
        rest = block.lstrip(b"\0")
        at += len(block) - len(rest)
        if rest.startswith(_SECTION) or (len(rest) < 4 and at + len(rest) == size and _SECTION.startswith(rest)):
            # fewer than four remaining bytes are a truncated section, none are the end of the file
            return at
        if rest and (len(rest) >= 4 or at + len(rest) == size):
            raise FileError(f"{str(path)!r}: expected a section ({_SECTION!r}) at byte {start}, got {rest[:4]!r}")
    return at


def _distinct(sections, path):
    """Add a number to the names of further sections with the same name, with a warning."""
    names = set()
    distinct = []
    for section in sections:
        name, count = section.name, 1
        while name in names:
            count += 1
            name = f"{section.name} ({count})"
        if count > 1:
            warn(
                f"{str(path)!r}: another section {section.name!r} is called {name!r}",
                DataWarning,
            )
        names.add(name)
        distinct.append(replace(section, name=name))
    return distinct


def _at(file, offset, size):
    file.seek(offset)
    data = b""
    while len(data) < size and (more := file.read(size - len(data))):
        data += more
    return data


def _text(data):
    """Text up to the first null character."""
    return data.decode("utf-16-le", "replace").split("\0")[0].strip()
