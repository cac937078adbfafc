"""The .rrng format: ranges of mass over charge state as INI text.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), appendix A. The order of sections, lines and
parts of a line, upper or lower case, and spaces do not matter. Volume and colour may be missing, and the decimal
separator may be a comma.
"""

import re
import warnings

import numpy as np

from apt_evap._common.files import FileError, read_small_file
from apt_evap._common.types import AnyPath
from apt_evap._common.warnings import DataWarning
from apt_evap.detection.mass_ranges import Ranges

_MAX_BYTES = 1 << 22


def read_ranges(path: AnyPath) -> Ranges:
    """Read the mass ranges of an .rrng file.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    Ranges
        In the order of the file. The name of a range is its ``Name`` or, if missing, its elements, such as "CrO2".

    Raises
    ------
    FileError
        If the file is missing or unreadable, has no ranges, or contains an invalid line.
    """
    data = read_small_file(path, _MAX_BYTES, "the text of an .rrng file")
    if not data:
        raise FileError(f"{str(path)!r} is empty (0 bytes), expected the text of an .rrng file")
    lines = _lines(data)
    elements = {}
    for section, _, key, value in lines:
        if section == "ions" and re.fullmatch(r"ion\s*[0-9]+", key) and value:
            element = value.split()[0]
            elements.setdefault(element.casefold(), element)
    parts = [
        _range(value, elements, f"{str(path)!r}, line {number}")
        for section, number, key, value in lines
        if section == "ranges" and re.fullmatch(r"range\s*[0-9]+", key)
    ]
    if not parts:
        raise FileError(f"{str(path)!r} has no lines Range1=... in a section [Ranges], expected at least one")
    numbers = [value for section, _, key, value in lines if section == "ranges" and key == "number"]
    if numbers and numbers[0] != str(len(parts)):
        warnings.warn(
            f"{str(path)!r} states {numbers[0]:.20} ranges but contains {len(parts)}", DataWarning, stacklevel=2
        )
    names, low, high, volume, colour, composition = zip(*parts, strict=True)
    return Ranges(names, np.array(low), np.array(high), np.array(volume), colour, composition, source=str(path))


def _lines(data):
    """(section, line number, key, value) of every assignment, section and key in lower case."""
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    section = ""
    assignments = []
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if line.startswith("[") and "]" in line:
            section = line[1 : line.index("]")].strip().casefold()
        elif "=" in line and not line.startswith((";", "#")):
            key, _, value = line.partition("=")
            assignments.append((section, number, key.strip().casefold(), value.strip()))
    return assignments


def _range(text, elements, where):
    """Read "13.8745 14.2410 Vol:0.02003 Si:1 Color:CCCCCC"."""
    bounds = []
    name, volume, colour, composition = "", np.nan, "", {}
    # "Vol : 0.02" is "Vol:0.02", but the value may also be missing; a pattern for spaces before a colon would need
    # quadratic time for many spaces
    compact = ":".join([part.rstrip() for part in text.split(":")])
    for part in re.sub(r":\s+(?=[^\s:]+(\s|$))", ":", compact).split():
        key, colon, value = part.partition(":")
        word = key.casefold()
        if not colon:
            bounds.append(_number(part, "a bound [Da]", where))
        elif word == "vol":
            volume = _number(value, "a volume [nm^3]", where) if value else np.nan
        elif word in ("color", "colour"):
            colour = "#" + value.upper() if re.fullmatch(r"#?[0-9A-Fa-f]{6}", value) else ""
            colour = colour.replace("##", "#")
        elif word == "name":
            name = value
        elif re.fullmatch(r"[0-9]{1,4}", value):
            element = elements.get(word, key.capitalize())
            composition[element] = composition.get(element, 0) + int(value)
        else:
            raise FileError(f"{where}: expected a number of atoms such as {key}:1, got {part!r:.60}")
    if len(bounds) != 2 or not bounds[0] < bounds[1]:
        raise FileError(f"{where}: expected two bounds [Da], the lower one first, got {bounds!s:.60} in {text!r:.60}")
    composition = {element: count for element, count in composition.items() if count}
    formula = "".join(element + (str(count) if count > 1 else "") for element, count in composition.items())
    if not (name or formula):
        raise FileError(f"{where}: expected an element such as Si:1, or Name:..., got {text!r:.60}")
    return name or formula, *bounds, volume, colour, composition


def _number(text, what, where):
    try:
        number = float(text.replace(",", ".")) if re.fullmatch(r"[-+0-9.,eE]+", text) else np.nan
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise FileError(f"{where}: expected {what}, got {text!r:.60}")
    return number
