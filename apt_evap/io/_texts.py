"""Text files: reading and decoding, numbers with decimal commas, formulas of molecular ions."""

import re

import numpy as np

from apt_evap._common.files import FileError, read_small_file
from apt_evap._common.types import AnyPath

_MAX_BYTES = 1 << 22
ELEMENTS = frozenset(
    "H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb "
    "Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au "
    "Hg Tl Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts "
    "Og".split()
)
"""Chemical symbols."""


def read_text(path: AnyPath, what: str, at_most: int = _MAX_BYTES) -> str:
    """Read a complete text file in UTF-8, UTF-16 or Latin-1.

    Parameters
    ----------
    path : str or path-like
        The file.
    what : str
        Expected content, for messages.
    at_most : int
        Largest allowed size [bytes].

    Returns
    -------
    str

    Raises
    ------
    FileError
        If it is missing, unreadable, empty or too large.
    """
    data = read_small_file(path, at_most, what)
    if not data:
        raise FileError(f"{str(path)!r} is empty (0 bytes), expected {what}")
    try:
        return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


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
    """Return an integer of at most six digits; a FileError names the place otherwise."""
    if not re.fullmatch(r"[0-9]{1,6}", text):
        raise FileError(f"{where}: expected {what}, got {text!r:.60}")
    return int(text)


def colour(parts: list[str], where: str) -> str:
    """Colour such as "#FF0000" from its red, green and blue parts between 0 and 1."""
    values = [number(part, "a part of a colour from 0 to 1", where) for part in parts]
    return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0)):02X}" for value in values)


def formula(atoms: dict[str, int]) -> str:
    """Formula of a molecular ion, such as "CrO2"."""
    return "".join(element + (str(n) if n > 1 else "") for element, n in atoms.items())


def atoms_of(name: str) -> dict[str, int]:
    """Number of atoms of each element in a formula such as "Mn2O"; an empty dict for any other name."""
    parts = re.findall(r"([A-Z][a-z]?)([0-9]{0,2})", name)  # U235 is an isotope
    if "".join(map("".join, parts)) != name or not all(element in ELEMENTS for element, _ in parts):
        return {}
    atoms: dict[str, int] = {}
    for element, n in parts:
        atoms[element] = atoms.get(element, 0) + int(n or 1)
    return {element: n for element, n in atoms.items() if n}
