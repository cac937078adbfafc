"""The .env format of the Groupe de Physique des Matériaux, Rouen: species and ranges among the data of an instrument.

Lines that start with # are comments. The numbers of species and of ranges are followed by one line for each species
(name, red, green, blue) and one for each range (name, bounds [Da], atomic volume [Angstrom^3], increment).
"""

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.io._texts import atoms_of, colour, count, number, read_text, species_name
from apt_evap.spectra.mass_ranges import Ranges

_NM3_PER_CUBIC_ANGSTROM = 1e-3


def read_env(path: AnyPath) -> Ranges:
    """Read the mass ranges of an .env file.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    Ranges
        In the order of the file. The composition is that of a formula such as "Mn2O"; it is empty for any other name.

    Raises
    ------
    FileError
        If the file is missing or unreadable, has no ranges, or contains an invalid line.
    """
    text = read_text(path, "the text of an .env file")
    lines = [
        (f"{str(path)!r}, line {at}", line.split())
        for at, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    starts = [
        k
        for k, (_, parts) in enumerate(lines)
        if len(parts) == 2 and all(map(str.isascii, parts)) and all(map(str.isdigit, parts))
    ]
    if not starts:
        raise FileError(f"{str(path)!r} has no line with the numbers of species and of ranges, as in an .env file")
    where, parts = lines[starts[0]]
    n_species, n_ranges = (count(part, "the numbers of species and of ranges", where) for part in parts)
    rest = lines[starts[0] + 1 :]
    if n_ranges == 0 or len(rest) < n_species + n_ranges:
        raise FileError(
            f"{where}: expected {n_species} species and {n_ranges} ranges (at least one) in the lines after it, "
            f"got {len(rest)} lines"
        )
    colours = {}
    for where, (name, *parts) in rest[:n_species]:
        if len(parts) < 3:
            raise FileError(f"{where}: expected a species and its colour, got {' '.join([name, *parts])!r:.60}")
        colours[species_name(name, (), where)] = colour(parts[:3], where)
    rows = [_range(where, parts, colours) for where, parts in rest[n_species : n_species + n_ranges]]
    names, low, high, volume = zip(*rows, strict=True)
    return Ranges(
        names,
        np.array(low),
        np.array(high),
        np.array(volume),
        tuple(colours.get(name, "") for name in names),
        tuple(atoms_of(name) for name in names),
        source=str(path),
    )


def _range(where, parts, species):
    if len(parts) < 3:
        raise FileError(f"{where}: expected a species and two bounds [Da], got {' '.join(parts)!r:.60}")
    name, *cells = parts
    low, high = (number(cell, "a bound [Da]", where) for cell in cells[:2])
    if not low < high:
        raise FileError(f"{where}: expected two bounds [Da], the lower one first, got {low:g} and {high:g}")
    volume = number(cells[2], "a volume [Angstrom^3]", where) * _NM3_PER_CUBIC_ANGSTROM if len(cells) > 2 else np.nan
    return species_name(name, species, where), low, high, volume
