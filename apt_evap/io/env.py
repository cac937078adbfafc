"""The .env format of the Groupe de Physique des Matériaux, Rouen: species and ranges among the data of an instrument.

Lines that start with # are comments. The numbers of species and of ranges are followed by one line for each species
(name, red, green, blue) and one for each range (name, bounds [Da], atomic volume [Angstrom^3], increment).
"""

import re

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.io._texts import (
    OddLines,
    atoms_of,
    check_bounds,
    colour,
    composition_of,
    count,
    number,
    read_text,
    species_name,
)
from apt_evap.spectra.mass_ranges import Ranges

_NM3_PER_CUBIC_ANGSTROM = 1e-3


def read_env(path: AnyPath) -> Ranges:
    """Read the mass ranges of an .env file.

    Returns
    -------
    Ranges
        In the order of the file. The composition is that of a formula such as "Mn2O", or of an isotope such as "Mg26";
        it is empty for any other name.

    Warns
    -----
    DataWarning
        Of lines that cannot be read, which are left out.
    """
    text = read_text(path, "the text of an .env file")
    odd = OddLines(path)
    lines = [
        (at, line.split())
        for at, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    starts = [
        k
        for k, (_, parts) in enumerate(lines)
        if len(parts) == 2 and all(map(str.isascii, parts)) and all(map(str.isdigit, parts))
    ]
    if not starts:
        before = [k for k, (_, parts) in enumerate(lines[1:]) if _is_species(parts)]
        place = f", line {lines[before[0]][0]}: {' '.join(lines[before[0]][1])!r:.60} is" if before else " has"
        raise FileError(f"{str(path)!r}{place} no line with the numbers of species and of ranges, as in an .env file")
    at, parts = lines[starts[0]]
    n_species, n_ranges = (count(part, "the numbers of species and of ranges", odd.where(at)) for part in parts)
    rest = lines[starts[0] + 1 :]
    if n_ranges == 0 or len(rest) < n_species + n_ranges:
        raise FileError(
            f"{odd.where(at)}: expected {n_species} species and {n_ranges} ranges (at least one) in the lines after "
            f"it, got {len(rest)} lines"
        )
    colours = {}
    for line, (name, *parts) in rest[:n_species]:
        name = species_name(name, (), odd.where(line))
        colours[name] = ""
        with odd.leave_out(line, "read without its colour"):
            if len(parts) < 3:
                raise FileError(
                    f"{odd.where(line)}: expected a species and its colour, got {' '.join([name, *parts])!r:.60}"
                )
            colours[name] = colour(parts[:3], odd.where(line))
    rows = []
    rest = rest[n_species:]
    n_rows = n_ranges
    # the data of the instrument follow: more ranges than stated begin with a species
    while n_rows < len(rest) and rest[n_rows][1][0] in colours and len(rest[n_rows][1]) > 2:
        n_rows += 1
    if n_rows > n_ranges:
        odd.add(at, f"states {n_ranges} ranges but contains {n_rows}", "all are read")
    for line, parts in rest[:n_rows]:
        with odd.leave_out(line):
            rows.append(_range(odd, line, parts, colours))
    odd.report(len(rows), "has no range")
    names, low, high, volume = zip(*rows, strict=True)
    return Ranges(
        names,
        np.array(low),
        np.array(high),
        np.array(volume),
        tuple(colours.get(name, "") for name in names),
        tuple(
            composition_of({name: 1}, *bounds)[0] if atoms_of(name) else {}
            for name, *bounds in zip(names, low, high, strict=True)
        ),
        source=str(path),
    )


def _is_species(parts):
    """Whether words are a name and the parts of a colour."""
    return len(parts) == 4 and all(re.fullmatch("[0-9.,]+", part) for part in parts[1:])


def _range(odd, line, parts, species):
    where = odd.where(line)
    if len(parts) < 3:
        raise FileError(f"{where}: expected a species and two bounds [Da], got {' '.join(parts)!r:.60}")
    name, *cells = parts
    low, high = check_bounds(*(number(cell, "a bound [Da]", where) for cell in cells[:2]), where)
    volume = number(cells[2], "a volume [Angstrom^3]", where) * _NM3_PER_CUBIC_ANGSTROM if len(cells) > 2 else np.nan
    name = species_name(name, species, where)
    if name not in species:
        odd.add(line, f"{name!r:.40} is not in the list of species", "kept as its name")
    return name, low, high, volume
