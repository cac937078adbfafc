"""Specimens in .xyz files, plain or extended: a number of atoms, a comment, and one line per atom, in Angstrom.

LAMMPS writes the numbers of its types where a chemical symbol is expected, other programs any name: both are names of
types here. https://github.com/libAtoms/extxyz describes the extended format, whose comment names the columns.
"""

import re

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.io._texts import SYMBOLS, read_text
from apt_evap.io.lammps import Atoms, atom_table, checked_frame, length_unit

_MAX_BYTES = 1 << 32
_COUNT = re.compile(r"\s*[0-9]{1,10}\s*")
_PROPERTIES = re.compile(r"\bProperties=\"?([\w.:-]+)", re.IGNORECASE)
_NAMES = ("species", "element", "symbol", "type", "z")  # columns of the types; z: atomic numbers


def is_xyz(suffix: str, head: str) -> bool:
    """Whether a file with this suffix (without that of a compression) is an .xyz file, by its first line."""
    return suffix in (".xyz", ".extxyz") and _COUNT.fullmatch(head.partition("\n")[0]) is not None


def read_xyz(path: AnyPath, *, units: str = "metal", frame: int = -1) -> Atoms:
    """Read one frame of an .xyz file.

    Parameters
    ----------
    units : str
        Units of LAMMPS, if it has written the file in others than Angstrom.
    frame : int
        Number of the frame, from 0; negative numbers count from the end.
    """
    where = f"{str(path)!r}"
    lines = read_text(path, "the text of an .xyz file", _MAX_BYTES).splitlines()
    starts, at = [], 0
    while at < len(lines) and (lines[at].strip() or not starts):
        if _COUNT.fullmatch(lines[at]) is None:
            raise FileError(f"{where}, line {at + 1}: expected the number of atoms, got {lines[at].strip()!r:.60}")
        starts.append(at)
        at += int(lines[at]) + 2
    start = starts[checked_frame(frame, len(starts), where)]
    n = int(lines[start])
    rows = [line for line in lines[start + 2 : start + 2 + n] if line.strip()]
    if len(rows) != n or n == 0:
        raise FileError(
            f"{where} states {n} atoms but contains {len(rows)} in the frame that begins in line {start + 1}"
        )
    columns = {"species": (0, 1), "pos": (1, 3)}
    if match := _PROPERTIES.search(lines[start + 1]):
        columns = _columns(match[1], where)
    name = next((name for name in _NAMES if name in columns), None)
    place, width = columns.get("pos", columns.get("position", (0, 0)))
    if name is None or width != 3:
        raise FileError(f"{where}: expected columns species and pos of each atom, got {', '.join(columns)!s:.100}")
    texts_of = [columns[key][0] for key in (name, "evaporable") if key in columns]
    texts, values = atom_table(rows, texts_of, range(place, place + 3), where, lines, start + 2)
    types, evaporable = texts[0], None
    if name == "z":
        symbols = dict(zip(map(str, range(1, len(SYMBOLS) + 1)), SYMBOLS, strict=True))
        types = [symbols.get(text, text) for text in types]
    if "evaporable" in columns:
        evaporable = np.array([text in ("T", "True", "1") for text in texts[1]])
    return Atoms(values * length_unit(units, where), types, evaporable)


def _columns(properties, where):
    """First column and width of each property of "species:S:1:pos:R:3", names in lower case."""
    parts = properties.split(":")
    columns, at = {}, 0
    for name, width in zip(parts[::3], parts[2::3], strict=False):
        if not re.fullmatch(r"[1-9][0-9]{0,3}", width):
            raise FileError(f"{where}: expected Properties=species:S:1:pos:R:3 or similar, got {properties!r:.80}")
        columns[name.lower()] = (at, int(width))
        at += int(width)
    return columns
