"""Text files: decompression and decoding, tables, numbers with decimal commas, formulas of molecular ions."""

import bz2
import codecs
import gzip
import io
import lzma
import math
import re
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, check_path, open_for_reading, read_small_file
from apt_evap._common.types import AnyPath, Floats
from apt_evap.specimen.nuclides import ISOTOPES
from apt_evap.warnings import DataWarning, warn

_MAX_BYTES = 1 << 22
SYMBOLS = tuple(
    "H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb "
    "Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au "
    "Hg Tl Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts "
    "Og".split()
)
"""Chemical symbols in the order of the atomic numbers."""
ELEMENTS = frozenset(SYMBOLS)
_NAMED = {symbol: number for number, symbol in enumerate(SYMBOLS, 1)} | {"D": 1}  # in names of ions


def read_bytes(path: AnyPath, what: str, at_most: int = _MAX_BYTES) -> bytes:
    """Read a complete file, decompressed if it is compressed by gzip, bzip2 or xz, and texts of UTF-16 in UTF-8.

    `what` is the expected content, for messages, `at_most` the largest allowed size [bytes], also after decompression.
    """
    data = read_small_file(path, at_most, what)
    if not data:
        raise FileError(f"{str(path)!r} is empty (0 bytes), expected {what}")
    kind = _compression(data)
    if kind:
        limit = min(at_most, max(_SMALL, _EXPANSION * len(data)))
        try:
            data = _opened(kind, io.BytesIO(data)).read(limit + 1)
        except (OSError, EOFError, ValueError, zlib.error, lzma.LZMAError) as error:
            raise FileError(f"{str(path)!r} cannot be decompressed by {kind}: {error}, expected {what}") from error
        if len(data) > limit:
            raise FileError(f"{str(path)!r} has more than {limit:,} bytes after decompression, expected {what}")
    return _in_utf8(data)


def read_head(path: AnyPath, size: int) -> bytes:
    """First bytes of a file, as `read_bytes` would return them; those of the file if it cannot be decompressed."""
    with open_for_reading(path) as file:
        head = file.read(size)
        kind = _compression(head)
        if kind in _OPENERS:
            file.seek(0)
            with suppress(OSError, EOFError, ValueError, zlib.error, lzma.LZMAError):
                head = _opened(kind, file).read(size)
    return _in_utf8(head)


_SMALL = 1 << 24  # bytes that any compressed file may have after decompression
_EXPANSION = 200  # of text by compression; measured: 3 to 10 for coordinates, 1,000 for zeros
_MAGIC = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\0": "xz", b"(\xb5/\xfd": "zstd", b"PK\3\4": "zip"}
_SUFFIXES = (".gz", ".bz2", ".xz", ".zst", ".zip")
_OPENERS: dict[str, Callable[[Any], Any]] = {
    "gzip": lambda file: gzip.GzipFile(fileobj=file),
    "bzip2": bz2.BZ2File,
    "xz": lzma.LZMAFile,
}
_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",  # before UTF-16, whose mark it begins with
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}


def _compression(head):
    """Name of the compression of a file by its first bytes, "" for none."""
    return next((name for magic, name in _MAGIC.items() if head.startswith(magic)), "")


def foreign(head: bytes) -> str:
    """What a file is that begins like no file of numbers: compressed, a page or a pointer; "" for any other."""
    kind = _compression(head)
    # numbers may begin with the two or three bytes of these
    sure = {"gzip": head[2:3] == b"\x08" and head[3:4] < b" ", "bzip2": head[4:10] == b"1AY&SY"}
    if kind and sure.get(kind, True):
        return f"compressed by {kind}: decompress it"
    text = head.lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return "a page of the web: download the file itself"
    if text.startswith(b"version https://git-lfs"):
        return "a pointer of Git LFS: git lfs pull gets the file itself"
    return ""


def is_compressed(path: AnyPath) -> bool:
    """Whether a file begins like a compressed one."""
    with open_for_reading(path) as file:
        return bool(_compression(file.read(8)))


def without_compression(path: AnyPath) -> Path:
    """Path without the suffix of a compression: "a.dump" of "a.dump.gz"."""
    path = check_path(path)
    return path.with_suffix("") if path.suffix.lower() in _SUFFIXES else path


def _opened(kind, file):
    if kind not in _OPENERS:
        raise ValueError(f"only {', '.join(_OPENERS)} are supported")
    return _OPENERS[kind](file)


def _in_utf8(data):
    """Bytes without a byte order mark; UTF-16 and UTF-32 become UTF-8, all others stay."""
    encoding = next((name for mark, name in _MARKS.items() if data.startswith(mark)), "")
    if not encoding and len(data) >= 8:  # UTF-16 without a mark: every second byte of ASCII is zero
        for start, name in ((1, "utf-16-le"), (0, "utf-16-be")):
            if not any(data[start:32:2]) and all(data[1 - start : 32 : 2]):
                encoding = name
    return data.decode(encoding, "replace").encode() if encoding else data


def read_text(path: AnyPath, what: str, at_most: int = _MAX_BYTES) -> str:
    """Read a complete text file in UTF-8, UTF-16 or Latin-1, which may be compressed, see `read_bytes`."""
    data = read_bytes(path, what, at_most)
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def plain_float(text: str) -> float:
    """Number in a cell, as NumPy reads it; ValueError also for 1_0 and digits of other scripts, which `float` takes."""
    if "_" in text or not text.isascii():
        raise ValueError(f"no number: {text!r:.60}")
    return float(text)


def read_numbers(path: AnyPath, what: str, names: Sequence[str], at_most: int = _MAX_BYTES) -> dict[str, Floats]:
    """Read a text table of numbers, one row per line, separated by spaces, tabulators, semicolons or commas.

    Returns float64 columns by name. Empty lines and lines that begin with # are left out; a line with fewer or more
    numbers than names is an error.
    """
    rows = []
    for at, line in enumerate(read_text(path, what, at_most).splitlines(), 1):
        cells = re.split(r"[\s;,]+", line.strip())
        if cells == [""] or cells[0].startswith("#"):
            continue
        try:
            row = [plain_float(cell) for cell in cells]
        except ValueError:
            row = []
        if len(row) != len(names) or not all(map(math.isfinite, row)):
            expected = f"{len(names)} numbers ({', '.join(names)})"
            raise FileError(f"{str(path)!r}, line {at}: expected {expected} as in {what}, got {line.strip()!r:.60}")
        rows.append(row)
    if not rows:
        raise FileError(f"{str(path)!r} has no numbers, expected {what}")
    return dict(zip(names, np.ascontiguousarray(np.array(rows).T), strict=True))


def number(text: str, what: str, where: str) -> float:
    """Return a finite number whose decimal separator may be a comma; a FileError names the place otherwise."""
    try:
        value = float(text.replace(",", ".")) if re.fullmatch(r"[-+0-9.,eE]+", text) else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise FileError(f"{where}: expected {what}, got {text!r:.60}")
    return value


def count(text: str, what: str, where: str) -> int:
    """Return an integer of at most six digits, also written as "2.000"; a FileError names the place otherwise."""
    if not re.fullmatch(r"[0-9]{1,6}([.,]0*)?", text):
        raise FileError(f"{where}: expected {what}, got {text!r:.60}")
    return int(re.split("[.,]", text)[0])


def check_bounds(low: float, high: float, where: str) -> tuple[float, float]:
    """Return the two bounds of a range [Da], 0 <= low < high; a FileError names the place otherwise."""
    if low < 0:
        raise FileError(f"{where}: expected two bounds >= 0 [Da], got {low:g} and {high:g}")
    if not low < high:
        raise FileError(f"{where}: expected two bounds [Da], the lower one first, got {low:g} and {high:g}")
    return low, high


class OddLines:
    """Lines of a file that cannot be read: they are left out, and one warning names them.

    Parameters
    ----------
    path : str or path-like
        The file.
    """

    def __init__(self, path: AnyPath) -> None:
        self._path, self._problems = repr(str(path)), dict[int, str]()

    def where(self, line: int) -> str:
        """File and line, for the message of an error."""
        return f"{self._path}, line {line}"

    @contextmanager
    def leave_out(self, line: int, instead: str = "left out") -> Iterator[None]:
        """Keep the FileError of a line, with what is done instead."""
        try:
            yield
        except FileError as error:
            stated = re.match(re.escape(self._path) + ", line ([0-9]+): ", str(error))  # maybe one after it
            problem = str(error)[stated.end() :] if stated else str(error)
            self.add(int(stated[1]) if stated else line, problem, instead)

    def add(self, line: int, problem: str, instead: str = "left out") -> None:
        """Keep a problem of a line, and what is done instead."""
        self._problems.setdefault(line, f"{problem}: {instead}")

    def report(self, rows: int, nothing: str) -> None:
        """Warn of these lines; raise a FileError if no row is left, of the first of them or that there is nothing."""
        problems = sorted(self._problems.items())
        if not rows:
            reason = f", line {problems[0][0]}: {problems[0][1]}; {nothing}" if problems else f" {nothing}"
            raise FileError(f"{self._path}{reason:.400}")
        if problems:
            text = "; ".join(f"line {line}: {problem}" for line, problem in problems[:_SHOWN])
            others = ", ".join(str(line) for line, _ in problems[_SHOWN : 4 * _SHOWN])
            more = ", ..." if len(problems) > 4 * _SHOWN else ""
            warn(f"{self._path}, {text}{f'; also lines {others}{more}' if others else ''}", DataWarning)


_SHOWN = 4  # odd lines in full


def colour(parts: list[str], where: str) -> str:
    """Colour such as "#FF0000" from its red, green and blue parts between 0 and 1."""
    values = [number(part, "a part of a colour from 0 to 1", where) for part in parts]
    return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0)):02X}" for value in values)


def formula(species: Mapping[str, int]) -> str:
    """Formula of a molecular ion, such as "CrO2"; a name that ends with a digit is repeated: "N15N15"."""
    text = ""
    for name, n in species.items():
        if name[-1].isdigit():
            text += name * n if n < 4 else f"({name}){n}"
        else:
            text += name + (str(n) if n > 1 else "")
    return text


def atoms_of(name: str) -> dict[str, int]:
    """Number of atoms of each element in a formula such as "Mn2O"; an empty dict for any other name.

    Numbers are those of atoms, never those of isotopes: see `composition_of` for a range, whose mass decides.
    """
    atoms: dict[str, int] = {}
    for element, digits in _parts(name):
        atoms[element] = atoms.get(element, 0) + int(digits or 1)
    return {element: n for element, n in atoms.items() if n}


def _parts(name):
    """Elements of a formula, each with the digits after it; none for any other name."""
    parts = re.findall(r"([A-Z][a-z]?)([0-9]{0,3})", name)
    is_formula = "".join(map("".join, parts)) == name and all(element in _NAMED for element, _ in parts)
    return parts if is_formula else []


def isotope_mass(element: str, number: int) -> float | None:
    """Mass of an isotope of an element [Da]; None if no isotope can have this mass number."""
    natural = [mass for mass, _ in ISOTOPES.get(element, ()) if round(mass) == number]
    z = _NAMED[element]
    return natural[0] if natural else float(number) if element != "D" and z <= number <= 3 * z else None


def isotope_masses(name: str) -> list[float]:
    """Masses of the natural isotopes of an element, or of an isotope such as "Ni58" [Da]."""
    element, digits = (*_parts(name), ("", ""))[0]
    if element + digits != name:
        return []
    return [mass for mass, _ in ISOTOPES.get(element, ()) if not digits or round(mass) == int(digits)]


def composition_of(species: Mapping[str, int], low: float, high: float) -> tuple[dict[str, int], str]:
    """Number of atoms of each element in the ion of a range, whose species may be molecules or isotopes; its formula.

    "Ti46" is one atom and "C60" sixty: the number after an element is that of an isotope or of atoms, whichever gives a
    mass within the range [Da] for a charge from 1 to 4. If both or neither do, it is that of a natural isotope, but
    that of atoms after hydrogen. Names that are not formulas stay.
    """
    parts = []  # of all species: element, digits, number of the species
    certain = set()  # parts that are isotopes, such as "28Si"
    for name, n in species.items():
        first = re.fullmatch(r"([0-9]{1,3})([A-Z][a-z]?)", name)
        if first and first[2] in _NAMED and isotope_mass(first[2], int(first[1])):
            certain.add(len(parts))
            parts.append((first[2], first[1], n))
        else:
            parts += [(element, digits, n) for element, digits in _parts(name)] or [(name, "", n)]
    # parts whose number may be that of an isotope
    doubtful = [
        k
        for k, (element, digits, _) in enumerate(parts)
        if digits and k not in certain and isotope_mass(element, int(digits))
    ]
    if len(doubtful) > _MOST_DOUBTFUL:
        doubtful = []
    choices = []
    for bits in range(1 << len(doubtful)):
        isotopes = certain | {k for at, k in enumerate(doubtful) if bits >> at & 1}
        unusual = sum((k in isotopes) != _is_usual_isotope(*parts[k][:2]) for k in doubtful)
        choices.append((not _fits(parts, isotopes, low, high), unusual, bits, isotopes))
    isotopes = min(choices)[3]
    atoms: dict[str, int] = {}
    named: dict[str, int] = {}
    for k, (element, digits, n) in enumerate(parts):
        label = element + digits if k in isotopes else element
        n *= 1 if k in isotopes else int(digits or 1)
        if n:
            atoms[element] = atoms.get(element, 0) + n
            named[label] = named.get(label, 0) + n
    return atoms, formula(named)


_CHARGE_SIGNS = str.maketrans("⁺¹²³⁴", "+1234")


def ion_of_name(name: str, low: float, high: float) -> str:
    """Formula in the name of a range, without a charge such as that of "AlO+", "Al++" or "Al2+"; "" for none.

    Digits before the sign are those of the formula or of the charge, whichever gives a mass within the range.
    """
    if atoms_of(name):
        return name
    match = re.fullmatch(r"(.*?)([1-4]?)(\++)([1-4]?)", name.translate(_CHARGE_SIGNS).replace("^", "").replace(" ", ""))
    if match is None:
        return ""
    formula, before, signs, after = match.groups()
    ways = [(formula, int(before or len(signs)))] if not after else []
    if before or after:
        ways.append((formula + before, int(after or len(signs))))
    for ion, charge in ways:
        parts = [(element, digits, 1) for element, digits in _parts(ion)] if atoms_of(ion) else []
        usual = {k for k, (element, digits, _) in enumerate(parts) if digits and _is_usual_isotope(element, digits)}
        if parts and any(_fits(parts, isotopes, low, high, (charge,)) for isotopes in (set(), usual)):
            return ion
    return ""


_MOST_DOUBTFUL = 8  # numbers of one range that may be those of isotopes: all 256 choices are compared
_CHARGES = range(1, 5)
_NEAR = 0.1  # [Da]: masses of isotopes differ from integers by up to 0.1


def _is_usual_isotope(element, digits):
    natural = [round(mass) for mass, _ in ISOTOPES.get(element, ())]
    return element != "H" and (int(digits) in natural or not natural)


def _fits(parts, isotopes, low, high, charges=_CHARGES):
    """Whether an ion of these parts, some of which are isotopes, may have a mass over charge state in the range."""
    lightest = heaviest = 0.0
    for k, (name, digits, n) in enumerate(parts):
        if k in isotopes:
            masses = [isotope_mass(name, int(digits))]
        elif name in _NAMED:
            n *= int(digits or 1)
            z = _NAMED[name]
            masses = [2.014] if name == "D" else [mass for mass, _ in ISOTOPES.get(name, ())] or [2 * z, 3 * z]
        else:
            return False
        lightest, heaviest = lightest + n * min(masses), heaviest + n * max(masses)
    return any(lightest / charge - _NEAR < high and heaviest / charge + _NEAR > low for charge in charges)


def species_name(word: str, known: Collection[str], where: str) -> str:
    """Name of a species that a file may write in upper or lower case.

    The text itself if it is one of the names in the file, otherwise the only one that differs in case, a formula such
    as "CO", or a chemical symbol in upper or lower case: "CO" is never cobalt if the file has both.

    Warns
    -----
    DataWarning
        If several names differ from the text in their case only.
    """
    if word in known:
        return word
    similar = [name for name in known if name.casefold() == word.casefold()]
    if len(set(similar)) == 1:
        return similar[0]
    symbol = word.capitalize()
    name = word if atoms_of(word) or symbol not in ELEMENTS else symbol
    if similar:
        warn(f"{where}: {word!r} may be any of {', '.join(similar)}, it is read as {name}", DataWarning)
    return name
