"""The .ato format of the atom probes of Rouen, version 3: 8 bytes, then 14 float32 per ion.

The second integer of the header is the version, which also shows the byte order. Positions are in Angstrom, as in
ifes-apt-tc-data-modeling, which was compared with examples. The units of the further columns, and those of other
versions, are not documented in public: the former are not read, the latter are refused.
"""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, TruncatedFile, open_for_reading
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_switch
from apt_evap.detection.hits import Hits
from apt_evap.io._records import check_columns, fill

_VERSION = 3
_HEADER = 8  # bytes
_WORDS = 14  # of an ion: x, y, z [0.1 nm], m/n [Da], and others
_CHUNK = 1 << 14
_NM_PER_ANGSTROM = np.float32(0.1)


def read_ato(path: AnyPath, *, columns: Sequence[str] | None = None, partial: bool = False) -> Hits:
    """Read the positions and masses of an .ato file of version 3."""
    check_switch(partial, "partial")
    chosen = check_columns(columns, ("positions", "mass_to_charge"), path)
    with open_for_reading(path) as file:
        header = file.read(_HEADER)
        versions = [int(np.frombuffer(header, f"{order}u4")[1]) if len(header) == _HEADER else 0 for order in "<>"]
        if _VERSION not in versions:
            found = f"version {min(versions)}" if 0 < min(versions) < 100 else "none"
            raise FileError(
                f"{str(path)!r} must have the version {_VERSION} of .ato in its header, got {found}: the units of "
                "others are not documented in public, convert it to .epos"
            )
        n, tail = divmod(os.fstat(file.fileno()).st_size - _HEADER, 4 * _WORDS)
        if n == 0 or (tail and not partial):
            raise TruncatedFile(
                f"{str(path)!r} ends in the middle of an ion: {n} complete ions of {4 * _WORDS} bytes as in an .ato "
                f"and {tail} further bytes; partial=True (--partial) reads the complete ions"
            )
        values = np.empty((n, 4), np.float32)
        buffer = np.empty((min(n, _CHUNK), _WORDS), f"{'<>'[versions.index(_VERSION)]}f4")
        for start in range(0, n, _CHUNK):
            rows = buffer[: n - start]
            if fill(file, rows) < rows.nbytes:
                raise TruncatedFile(f"{str(path)!r} became shorter during reading, expected {n} ions")
            values[start : start + len(rows)] = rows[:, :4]
    read: dict[str, Any] = {"positions": values[:, :3] * _NM_PER_ANGSTROM, "mass_to_charge": values[:, 3].copy()}
    return Hits(**{name: read[name] for name in chosen}, source=str(path))
