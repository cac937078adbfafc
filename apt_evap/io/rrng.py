"""The .rrng format: ranges of mass over charge state as INI text.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), appendix A. The order of sections, lines and
parts of a line, upper or lower case, and spaces do not matter. Volume and colour may be missing, and the decimal
separator may be a comma.
"""

import re

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.detection.mass_ranges import Ranges
from apt_evap.io._texts import formula, number, read_text
from apt_evap.warnings import DataWarning, warn


def read_rrng(path: AnyPath) -> Ranges:
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
    lines = _lines(read_text(path, "the text of an .rrng file"))
    elements = {}
    for section, _, key, value in lines:
        if section == "ions" and re.fullmatch(r"ion\s*[0-9]+", key) and value:
            element = value.split()[0]
            elements.setdefault(element.casefold(), element)
    parts = [
        _range(value, elements, f"{str(path)!r}, line {at}")
        for section, at, key, value in lines
        if section == "ranges" and re.fullmatch(r"range\s*[0-9]+", key)
    ]
    if not parts:
        raise FileError(f"{str(path)!r} has no lines Range1=... in a section [Ranges], expected at least one")
    numbers = [value for section, _, key, value in lines if section == "ranges" and key == "number"]
    if numbers and numbers[0] != str(len(parts)):
        warn(
            f"{str(path)!r} states {numbers[0]:.20} ranges but contains {len(parts)}",
            DataWarning,
        )
    names, low, high, volume, colour, composition = zip(*parts, strict=True)
    return Ranges(names, np.array(low), np.array(high), np.array(volume), colour, composition, source=str(path))


def _lines(text):
    """(section, line number, key, value) of every assignment, section and key in lower case."""
    section = ""
    assignments = []
    for at, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if line.startswith("[") and "]" in line:
            section = line[1 : line.index("]")].strip().casefold()
        elif "=" in line and not line.startswith((";", "#")):
            key, _, value = line.partition("=")
            assignments.append((section, at, key.strip().casefold(), value.strip()))
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
            bounds.append(number(part, "a bound [Da]", where))
        elif word == "vol":
            volume = number(value, "a volume [nm^3]", where) if value else np.nan
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
    if not (name or composition):
        raise FileError(f"{where}: expected an element such as Si:1, or Name:..., got {text!r:.60}")
    return name or formula(composition), *bounds, volume, colour, composition
