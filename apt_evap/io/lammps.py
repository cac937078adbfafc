"""Specimens from LAMMPS: text dumps and data files.

https://docs.lammps.org/dump.html and https://docs.lammps.org/read_data.html. Types are numbers there. They need names,
from the file (a column ``element``, or type labels) or from the user.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from operator import itemgetter

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath, Booleans, Floats
from apt_evap._common.validation import check_choice, short_text
from apt_evap.io._texts import ELEMENTS, plain_float, read_text

_MAX_BYTES = 1 << 32
_SAMPLE = 200  # rows that show how many columns there are
_NM = {"metal": 0.1, "real": 0.1, "electron": 0.052917721, "nano": 1.0, "micro": 1e3, "cgs": 1e7, "si": 1e9}
"""Length unit of each style of units [nm]; electron: the Bohr radius (CODATA 2022)."""
# columns before x in the section Atoms: those of the type, and all of them
_STYLES = {"atomic": (1, 2), "charge": (1, 3), "dpd": (1, 3), "sphere": (1, 4), "ellipsoid": (1, 4), "peri": (1, 4)}
_STYLES |= {"molecular": (2, 3), "bond": (2, 3), "angle": (2, 3), "full": (2, 4), "bpm/sphere": (2, 5)}
_SECTION = re.compile(r"[A-Z][A-Za-z]*(?: [A-Z][A-Za-z]*)*")


@dataclass(frozen=True)
class Atoms:
    """Atoms in a file: positions [nm], shape (n, 3), and the name of the type of each, a number as text if unnamed.

    If the types have names, `numbers` may be their numbers, as text.
    """

    positions: Floats
    types: Sequence[str]
    evaporable: Booleans | None = None
    numbers: Sequence[str] | None = None


def is_dump(head: str) -> bool:
    """Whether a text begins like a LAMMPS dump."""
    return head.startswith(("ITEM: TIMESTEP", "ITEM: UNITS", "ITEM: TIME"))


def is_data(head: str) -> bool:
    """Whether a text begins like a LAMMPS data file: a line "100 atoms" and one with the bounds of the box in x."""
    return bool(re.search(r"^[ \t]*[0-9]+[ \t]+atoms[ \t\r]*(#.*)?$", head, re.M) and re.search(r"\bxlo\s+xhi\b", head))


def read_dump(path: AnyPath, *, units: str = "metal", frame: int = -1) -> Atoms:
    """Read one frame of a text dump of LAMMPS.

    Positions are unwrapped by the numbers of the periodic images (ix, iy, iz) if the dump has them.

    Parameters
    ----------
    units : str
        Units of LAMMPS: metal, real (Angstrom), electron, nano, micro, cgs or si. A file that states its units is read
        in these.
    frame : int
        Number of the frame, from 0; negative numbers count from the end.
    """
    where = f"{str(path)!r}"
    lines = read_text(path, "the text of a LAMMPS dump", _MAX_BYTES).splitlines()
    heads = [at for at, line in enumerate(lines) if line[:6] == "ITEM: "]
    starts = [at for at in heads if lines[at].startswith("ITEM: TIMESTEP")]
    if not starts:
        raise FileError(f"{where} has no line ITEM: TIMESTEP, as in a LAMMPS dump")
    frame = checked_frame(frame, len(starts), where)
    for at in heads:
        if lines[at].startswith("ITEM: UNITS") and at + 1 < len(lines):
            units = lines[at + 1].strip()
    unit = length_unit(units, where)
    at = starts[frame]
    stop = next((start for start in starts if start > at), len(lines))
    items = {" ".join(lines[k].split()[1:3]): k for k in heads if at <= k < stop}
    before = f"; the frame before is frame={frame - 1}" if frame else ""
    for name in ("NUMBER OF", "BOX BOUNDS"):
        if name not in items:
            raise FileError(f"{where} has no line ITEM: {name} in frame {frame}, as in a LAMMPS dump{before}")
    first = next((k for k in heads if at <= k < stop and lines[k].startswith("ITEM: ATOMS")), None)
    if first is None:
        raise FileError(f"{where} has no line ITEM: ATOMS in frame {frame}, as in a LAMMPS dump{before}")
    n = _integer(lines, items["NUMBER OF"] + 1, "the number of atoms", where)
    columns = lines[first].split()[2:]
    rows = lines[first + 1 : min(first + 1 + n, stop)]
    if len(rows) != n or n == 0:
        raise FileError(f"{where} states {n} atoms but contains {len(rows)} in frame {frame}{before}")
    kinds = [name for name in ("element", "typelabel", "type") if name in columns]
    if not kinds:
        raise FileError(f"{where} has no column type, typelabel or element, only {' '.join(columns):.100}")
    for suffix in ("u", "", "su", "s"):
        names = [f"{axis}{suffix}" for axis in "xyz"]
        if set(names) <= set(columns):
            break
    else:
        raise FileError(f"{where} has no columns x y z (or xs, xu, xsu, ...), only {' '.join(columns):.100}")
    images = [f"i{axis}" for axis in "xyz" if f"i{axis}" in columns and "u" not in suffix]
    texts, values = atom_table(
        rows,
        [columns.index(name) for name in kinds],
        [columns.index(name) for name in names + images],
        where,
        lines,
        first + 1,
        len(columns),
    )
    flags = np.zeros((n, 3))
    flags[:, ["xyz".index(name[1]) for name in images]] = _whole(values[:, 3:], where)
    values = values[:, :3]
    if "s" in suffix or flags.any():
        cell, low = _box_of_dump(lines, items["BOX BOUNDS"], where)
        values = low + (values + flags) @ cell if "s" in suffix else values + flags @ cell
    return Atoms(values * unit, texts[0], numbers=texts[-1] if kinds[0] != "type" == kinds[-1] else None)


def _whole(flags, where):
    """Numbers of periodic images, which must be integers."""
    if (flags != np.round(flags)).any():
        raise FileError(f"{where}: expected integers for the periodic images, got {flags[flags != np.round(flags)][0]}")
    return flags


def _box_of_dump(lines, box, where):
    """Edge vectors of the box, and its corner, from bounds that include the tilt."""
    words = lines[box].split()[3:]
    if len(lines) < box + 4:
        raise FileError(f"{where} ends in the bounds of the box")
    rows = [_floats(lines[box + 1 + k].split()[:4], where) for k in range(3)]
    general, tilted = "abc" in words, words[:3] == ["xy", "xz", "yz"]
    width = 4 if general else 3 if tilted else 2
    if any(len(row) < width for row in rows):
        raise FileError(f"{where}: expected {width} numbers in each of the three lines of the box")
    if general:
        return np.array([row[:3] for row in rows]), np.array([row[3] for row in rows])
    xy, xz, yz = (row[2] for row in rows) if tilted else (0.0, 0.0, 0.0)
    low = np.array([row[0] for row in rows]) - [min(0, xy, xz, xy + xz), min(0, yz), 0]
    high = np.array([row[1] for row in rows]) - [max(0, xy, xz, xy + xz), max(0, yz), 0]
    return _cell(high - low, xy, xz, yz), low


def _cell(lengths, xy, xz, yz):
    cell = np.diag(lengths)
    cell[1, 0], cell[2, 0], cell[2, 1] = xy, xz, yz
    return cell


def _box_of_data(lines, where):
    """Edge vectors of the box from the header of a data file."""
    entries = {}
    for line in lines:
        *cells, name = re.split(r"\s+(?=[A-Za-z])", line.partition("#")[0].strip(), maxsplit=1)
        if cells and name in ("xlo xhi", "ylo yhi", "zlo zhi", "xy xz yz", "avec", "bvec", "cvec"):
            entries.setdefault(name, _floats(cells[0].split(), where))
    names = ("avec", "bvec", "cvec") if "avec" in entries else ("xlo xhi", "ylo yhi", "zlo zhi")
    rows = [entries.get(name, ()) for name in names]
    tilt = entries.get("xy xz yz", np.zeros(3))
    if any(len(row) != (3 if "avec" in entries else 2) for row in rows) or len(tilt) != 3:
        raise FileError(f"{where} has numbers of periodic images, but not the bounds of its box ({', '.join(names)})")
    return np.array(rows) if "avec" in entries else _cell(np.diff(rows)[:, 0], *tilt)


def read_data(path: AnyPath, *, units: str = "metal", style: str | None = None) -> Atoms:
    """Read the atoms of a LAMMPS data file.

    Positions are unwrapped by the numbers of the periodic images, if the file has them. Names of the types are the type
    labels or, without these, chemical symbols in the comments of the section Masses.

    Parameters
    ----------
    units : str
        As for `read_dump`.
    style : str, optional
        Style of the section Atoms, such as atomic, charge, sphere, molecular or full. By default the one in the comment
        of this line, or atomic if the number of columns fits.
    """
    where = f"{str(path)!r}"
    lines = read_text(path, "the text of a LAMMPS data file", _MAX_BYTES).splitlines()
    match = re.search(r"\bunits = ([a-z]+)", lines[0]) if lines else None
    unit = length_unit(match[1] if match else units, where)
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
    width = _usual_width(rows)
    hint = comment.split()[:1]
    if style is None and hint:
        style = hint[0] if hint[0] in _STYLES else ""
    if style is None and width in (5, 8):  # without or with the numbers of the periodic images
        style = "atomic"
    if not style:
        problem = "does not state the style of its section Atoms"
        if hint:
            problem = f"states the style {hint[0]!r} of its section Atoms, which is not read"
        raise FileError(f"{where} {problem} ({width} columns); style= must be one of {', '.join(_STYLES)}")
    of_type, first = _STYLES[style]
    if width not in (first + 3, first + 6):
        raise FileError(f"{where}: the style {style} has {first + 3} columns or {first + 6}, got {width}")
    (types,), values = atom_table(rows, [of_type], range(first, width), where, lines, at + 1, width)
    positions = values[:, :3]
    if width == first + 6 and (flags := _whole(values[:, 3:], where)).any():
        positions = positions + flags @ _box_of_data(lines[: min(at for at, _ in sections.values())], where)
    labels = {}
    if "Atom Type Labels" in sections:
        pairs = (row.split() for row in _section_rows(lines, sections["Atom Type Labels"][0], n))
        labels = {pair[0]: pair[1] for pair in pairs if len(pair) > 1}
    elif "Masses" in sections:
        labels = _names_of_masses(lines, sections["Masses"][0])
    numbers = {label: number for number, label in labels.items()}
    return Atoms(
        positions * unit,
        [labels.get(name, name) for name in types],
        numbers=[numbers.get(name, name) for name in types] if labels else None,
    )


def _names_of_masses(lines, at):
    """Chemical symbols in the comments of the section Masses, by the number of the type: "1 58.69 # Ni"."""
    names = {}
    for line in lines[at + 1 :]:
        text, _, comment = line.partition("#")
        if text.strip()[:1].isalpha():
            break
        symbol = re.match(r"[\s(]*([A-Z][a-z]?)\b", comment)
        if symbol and symbol[1] in ELEMENTS and text.strip():
            names[text.split()[0]] = symbol[1]
    return names


def atom_table(
    rows: Sequence[str],
    of_texts: Sequence[int],
    of_numbers: Sequence[int],
    where: str,
    lines: Sequence[str],
    at: int,
    width: int | None = None,
) -> tuple[list[list[str]], Floats]:
    """Columns of the rows of the atoms with these numbers: lists of texts, and finite numbers, shape (n, k).

    The rows are in `lines` of the file from `at`: an error names the line. All have `width` columns; None: enough.
    """
    least = max(*of_texts, *of_numbers) + 1
    widths = range(least, 1 << 20) if width is None else range(width, width + 1)
    try:
        if any(len(row.split()) not in widths for row in rows):
            raise ValueError("a row of another width")
        texts = np.loadtxt(rows, str, comments=None, usecols=tuple(of_texts), ndmin=2).T.tolist()
        numbers = np.loadtxt(rows, float, comments=None, usecols=tuple(of_numbers), ndmin=2)
        good = bool(np.isfinite(numbers).all())
    except ValueError:
        good = False
    if not good:
        row = next(row for row in rows if not _is_atom(row.split(), widths, of_numbers))
        line = next(k for k in range(at, len(lines)) if row in (lines[k], lines[k].partition("#")[0].strip()))
        raise FileError(
            f"{where}, line {line + 1}: expected {widths[0]} columns with finite coordinates of an atom, got "
            f"{short_text(row)}"
        )
    return texts, numbers


def _usual_width(rows):
    """Number of columns of most of the first rows."""
    return max(Counter(len(row.split()) for row in rows[:_SAMPLE]).items(), key=itemgetter(1))[0]


def _is_atom(cells, widths, of_numbers):
    """Whether a row has as many columns, and finite numbers in some of them."""
    try:
        return len(cells) in widths and all(np.isfinite(plain_float(cells[k])) for k in of_numbers)
    except ValueError:
        return False


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


def length_unit(units: str, where: str) -> float:
    """Length unit of a style of units of LAMMPS [nm]."""
    if not isinstance(units, str) or units not in _NM:
        raise FileError(f"{where}: units must be one of {', '.join(_NM)}, got {short_text(units)}")
    return _NM[units]


def checked_frame(frame: int, n: int | None, where: str) -> int:
    """Number of a frame from 0 to n - 1, negative ones count from the end; the number itself if n is not known."""
    if not isinstance(frame, Integral) or isinstance(frame, bool):
        raise ValueError(f"frame must be an integer, got {short_text(frame)}")
    if n is None:
        return int(frame)
    if not -n <= frame < n:
        raise FileError(f"{where} has {n} frames, there is no frame {frame}")
    return int(frame) % n


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
