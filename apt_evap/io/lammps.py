"""Specimens from LAMMPS: text dumps and data files.

https://docs.lammps.org/dump.html and https://docs.lammps.org/read_data.html. Types are numbers there. They need names,
from the file (a column ``element``, or type labels) or from the user.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath, Booleans, Floats
from apt_evap._common.validation import check_choice, short_text
from apt_evap.io._texts import read_text

_MAX_BYTES = 1 << 32
_NM = {"metal": 0.1, "real": 0.1, "electron": 0.052917721, "nano": 1.0, "micro": 1e3, "cgs": 1e7, "si": 1e9}
"""Length unit of each style of units [nm]; electron: the Bohr radius (CODATA 2022)."""
# columns before x in the section Atoms: those of the type, and all of them
_STYLES = {"atomic": (1, 2), "charge": (1, 3), "molecular": (2, 3), "bond": (2, 3), "angle": (2, 3), "full": (2, 4)}
_SECTION = re.compile(r"[A-Z][A-Za-z]*(?: [A-Z][A-Za-z]*)*")


@dataclass(frozen=True)
class Atoms:
    """Atoms in a file: positions [nm], shape (n, 3), and the name of the type of each, a number as text if unnamed."""

    positions: Floats
    types: Sequence[str]
    evaporable: Booleans | None = None


def is_dump(head: str) -> bool:
    """Whether a text begins like a LAMMPS dump."""
    return head.startswith(("ITEM: TIMESTEP", "ITEM: UNITS", "ITEM: TIME"))


def is_data(head: str) -> bool:
    """Whether a text begins like a LAMMPS data file: a line "100 atoms" and one with the bounds of the box in x."""
    return bool(re.search(r"^[ \t]*[0-9]+[ \t]+atoms[ \t\r]*(#.*)?$", head, re.M) and re.search(r"\bxlo\s+xhi\b", head))


def read_dump(path: AnyPath, *, units: str = "metal", frame: int = -1) -> Atoms:
    """Read one frame of a text dump of LAMMPS.

    Parameters
    ----------
    path : str or path-like
        The file.
    units : str
        Units of LAMMPS: metal, real (Angstrom), electron, nano, micro, cgs or si. A file that states its units is read
        in these.
    frame : int
        Number of the frame, from 0; negative numbers count from the end.

    Returns
    -------
    Atoms

    Raises
    ------
    FileError
        If the file is missing, unreadable or not such a file, or has no such frame.
    ValueError
        If `frame` is not an integer.
    """
    where = f"{str(path)!r}"
    if not isinstance(frame, Integral) or isinstance(frame, bool):
        raise ValueError(f"frame must be an integer, got {short_text(frame)}")
    lines = read_text(path, "the text of a LAMMPS dump", _MAX_BYTES).splitlines()
    heads = [at for at, line in enumerate(lines) if line[:6] == "ITEM: "]
    starts = [at for at in heads if lines[at].startswith("ITEM: TIMESTEP")]
    if not starts:
        raise FileError(f"{where} has no line ITEM: TIMESTEP, as in a LAMMPS dump")
    if not -len(starts) <= frame < len(starts):
        raise FileError(f"{where} has {len(starts)} frames, there is no frame {frame}")
    for at in heads:
        if lines[at].startswith("ITEM: UNITS") and at + 1 < len(lines):
            units = lines[at + 1].strip()
    unit = _unit(units, where)
    at = starts[frame]
    stop = next((start for start in starts if start > at), len(lines))
    items = {" ".join(lines[k].split()[1:3]): k for k in heads if at <= k < stop}
    for name in ("NUMBER OF", "BOX BOUNDS"):
        if name not in items:
            raise FileError(f"{where} has no line ITEM: {name} in a frame, as in a LAMMPS dump")
    first = next((k for k in heads if at <= k < stop and lines[k].startswith("ITEM: ATOMS")), None)
    if first is None:
        raise FileError(f"{where} has no line ITEM: ATOMS in a frame, as in a LAMMPS dump")
    n = _integer(lines, items["NUMBER OF"] + 1, "the number of atoms", where)
    columns = lines[first].split()[2:]
    rows = lines[first + 1 : min(first + 1 + n, stop)]
    if len(rows) != n or n == 0:
        raise FileError(f"{where} states {n} atoms but contains {len(rows)} in a frame")
    name = "element" if "element" in columns else "type"
    if name not in columns:
        raise FileError(f"{where} has neither a column type nor a column element, only {' '.join(columns):.100}")
    for suffix in ("", "u", "s", "su"):
        names = [f"{axis}{suffix}" for axis in "xyz"]
        if set(names) <= set(columns):
            break
    else:
        raise FileError(f"{where} has no columns x y z (or xs, xu, xsu, ...), only {' '.join(columns):.100}")
    types, values = _table(rows, columns.index(name), [columns.index(each) for each in names], where)
    if "s" in suffix:
        values = _unscaled(values, lines, items["BOX BOUNDS"], where)
    return Atoms(values * unit, types)


def _unscaled(values, lines, box, where):
    """Positions from fractions of the box, whose bounds include its tilt."""
    words = lines[box].split()[3:]
    if "abc" in words:
        raise FileError(f"{where} has scaled coordinates in a general triclinic box, expected columns x y z")
    if len(lines) < box + 4:
        raise FileError(f"{where} ends in the bounds of the box")
    bounds = [_floats(lines[box + 1 + k].split()[:3], where) for k in range(3)]
    tilted = words[:3] == ["xy", "xz", "yz"]
    if any(len(row) != (3 if tilted else 2) and len(row) < 2 for row in bounds) or (
        tilted and any(len(row) < 3 for row in bounds)
    ):
        raise FileError(f"{where}: expected two bounds of the box in each direction (and a tilt)")
    xy, xz, yz = (row[2] for row in bounds) if tilted else (0.0, 0.0, 0.0)
    low = np.array([row[0] for row in bounds]) - [min(0, xy, xz, xy + xz), min(0, yz), 0]
    high = np.array([row[1] for row in bounds]) - [max(0, xy, xz, xy + xz), max(0, yz), 0]
    cell = np.diag(high - low)
    cell[1, 0], cell[2, 0], cell[2, 1] = xy, xz, yz
    return low + values @ cell


def read_data(path: AnyPath, *, units: str = "metal", style: str | None = None) -> Atoms:
    """Read the atoms of a LAMMPS data file.

    Parameters
    ----------
    path : str or path-like
        The file.
    units : str
        As for `read_dump`.
    style : str, optional
        Style of the section Atoms: atomic, charge, molecular, bond, angle or full. By default the one in the comment
        of this line, or atomic if the number of columns fits.

    Returns
    -------
    Atoms

    Raises
    ------
    FileError
        If the file is missing, unreadable or not such a file, or the style is unknown.
    """
    where = f"{str(path)!r}"
    lines = read_text(path, "the text of a LAMMPS data file", _MAX_BYTES).splitlines()
    match = re.search(r"\bunits = ([a-z]+)", lines[0]) if lines else None
    unit = _unit(match[1] if match else units, where)
    header = next(
        (
            re.fullmatch(r"\s*([0-9]{1,12})\s+atoms\s*(#.*)?", line)
            for line in lines
            if re.fullmatch(r"\s*[0-9]{1,12}\s+atoms\s*(#.*)?", line)
        ),
        None,
    )
    sections = {}
    for at, line in enumerate(lines[1:], 1):
        if not line.lstrip()[:1].isupper():
            continue
        title, _, comment = line.partition("#")
        if _SECTION.fullmatch(title.strip()):
            sections.setdefault(title.strip(), (at, comment))
    if header is None or "Atoms" not in sections:
        raise FileError(f"{where} has no line such as '100 atoms' or no section Atoms, as in a LAMMPS data file")
    n = int(header[1])
    at, comment = sections["Atoms"]
    rows = _section_rows(lines, at, n)
    if len(rows) != n or n == 0:
        raise FileError(f"{where} states {n} atoms but contains {len(rows)} in its section Atoms")
    if style is not None:
        check_choice(style, "style", _STYLES)
    width = len(rows[0].split())
    given = comment.split()[:1]
    if style is None and given:
        style = given[0] if given[0] in _STYLES else ""
    if style is None and width in (5, 8):  # without or with the numbers of the periodic images
        style = "atomic"
    if not style:
        raise FileError(
            f"{where} does not state the style of its section Atoms ({width} columns); style= must be one of "
            f"{', '.join(_STYLES)}"
        )
    of_type, first = _STYLES[style]
    if width not in (first + 3, first + 6):
        raise FileError(f"{where}: the style {style} has {first + 3} columns or {first + 6}, got {width}")
    labels = {}
    if "Atom Type Labels" in sections:
        pairs = (row.split() for row in _section_rows(lines, sections["Atom Type Labels"][0], n))
        labels = {pair[0]: pair[1] for pair in pairs if len(pair) > 1}
    types, positions = _table(rows, of_type, range(first, first + 3), where)
    return Atoms(positions * unit, [labels.get(each, each) for each in types])


def _table(rows, of_type, of_places, where):
    """Types of the atoms as texts, and their coordinates, from the columns with these numbers."""
    try:
        types = np.loadtxt(rows, str, comments=None, usecols=of_type, ndmin=1).tolist()
        places = np.loadtxt(rows, float, comments=None, usecols=of_places, ndmin=2)
    except ValueError as error:
        raise FileError(f"{where}: expected numbers for the coordinates of each atom, got {error!s:.100}") from error
    if len(types) != len(rows):
        raise FileError(f"{where} states {len(rows)} atoms but contains {len(types)}")
    return types, _finite(places, where)


def _section_rows(lines, at, n):
    """At most n rows of a section whose title is in line `at`, without comments."""
    rows = []
    for line in lines[at + 1 :]:
        text = line.partition("#")[0].strip()
        if not text:
            continue
        if len(rows) == n or (text[0].isupper() and _SECTION.fullmatch(text)):
            break
        rows.append(text)
    return rows


def _unit(units, where):
    if not isinstance(units, str) or units not in _NM:
        raise FileError(f"{where}: units must be one of {', '.join(_NM)}, got {short_text(units)}")
    return _NM[units]


def _integer(lines, at, what, where):
    text = lines[at].strip() if at < len(lines) else ""
    if not re.fullmatch(r"[0-9]{1,12}", text):
        raise FileError(f"{where}, line {at + 1}: expected {what}, got {text!r:.60}")
    return int(text)


def _floats(cells, where):
    try:
        values = np.array(cells, float)
    except ValueError as error:
        raise FileError(f"{where}: expected numbers for the bounds of the box, got {error!s:.80}") from error
    return _finite(values, where)


def _finite(values, where):
    if not np.isfinite(values).all():
        raise FileError(f"{where}: expected finite coordinates, got {values[~np.isfinite(values)][0]}")
    return values
