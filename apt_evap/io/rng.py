"""The .rng format: ranges of mass over charge state as a table with one column for each species.

Miller, Atom Probe Tomography (Kluwer, 2000), and Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013),
appendix A. A second table, the polyatomic extension, may give molecular ions names and colours.
"""

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.io._texts import atoms_in, colour, count, formula, number, read_text, species_name
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.warnings import DataWarning, warn


def read_rng(path: AnyPath) -> Ranges:
    """Read the mass ranges of an .rng file.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    Ranges
        In the order of the file. A range has the name and colour of the polyatomic extension if this contains the same
        bounds. Otherwise its name is its formula, such as "CrO2", and a range of one species has its colour. Ranges
        without any species are left out, with a warning.

    Raises
    ------
    FileError
        If the file is missing or unreadable, has no ranges, or contains an invalid line.
    """
    text = read_text(path, "the text of an .rng file")
    lines = [
        (at, line.strip())
        for at, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    extension = [k for k, (_, line) in enumerate(lines) if line.startswith("--") and "polyatomic" in line.casefold()]
    split = extension[0] if extension else len(lines)
    rows, colours = _table(lines[:split], path)
    names, molecules = {}, []
    if extension:
        molecules, their_colours = _table(lines[split + 1 :], path)
        names = {bounds: (formula(atoms), their_colours.get(formula(atoms), "")) for bounds, atoms in molecules}
    known = {bounds for bounds, _ in rows}
    rows += [row for row in molecules if row[0] not in known]
    n_empty = sum(not atoms for _, atoms in rows)
    rows = [row for row in rows if row[1]]
    if not rows:
        raise FileError(f"{str(path)!r} has no range with a species, expected at least one")
    if n_empty:
        warn(f"{str(path)!r}: {n_empty} range{'' if n_empty == 1 else 's'} without species, left out", DataWarning)
    named = [names.get(bounds, ("", "")) for bounds, _ in rows]
    species = [formula(atoms) for _, atoms in rows]
    return Ranges(
        tuple(name or species_name for (name, _), species_name in zip(named, species, strict=True)),
        np.array([low for (low, _), _ in rows]),
        np.array([high for (_, high), _ in rows]),
        None,
        tuple(paint or colours.get(species_name, "") for (_, paint), species_name in zip(named, species, strict=True)),
        tuple(atoms_in(atoms) for _, atoms in rows),
        source=str(path),
    )


def _table(lines, path):
    """Bounds and species of each range, and the colour of each species."""
    where = f"{str(path)!r}"
    if not lines:
        raise FileError(f"{where} ends before a table of ranges")
    at, first = lines[0]
    counts = first.split()
    if len(counts) != 2:
        raise FileError(f"{where}, line {at}: expected the numbers of species and of ranges, got {first!r:.60}")
    n_species, n_ranges = (
        count(word, "the numbers of species and of ranges", f"{where}, line {at}") for word in counts
    )
    if len(lines) < 2 * n_species + 2:
        raise FileError(f"{where}: expected {n_species} species and then a line of dashes, the file ends before it")
    colours, shorts = {}, []
    for at, line in lines[2 : 2 * n_species + 1 : 2]:
        short, *parts = line.split()
        if len(parts) < 3:
            raise FileError(f"{where}, line {at}: expected a species and its colour, got {line!r:.60}")
        shorts.append(species_name(short, (), f"{where}, line {at}"))
        colours[shorts[-1]] = colour(parts[:3], f"{where}, line {at}")
    at, line = lines[2 * n_species + 1]
    if not line.startswith("-"):
        raise FileError(f"{where}, line {at}: expected a line of dashes with the species, got {line!r:.60}")
    columns = [species_name(name, shorts, f"{where}, line {at}") for name in line.split()[1:]] or shorts
    if len(columns) != n_species:
        raise FileError(f"{where}, line {at}: expected {n_species} species after the dashes, got {len(columns)}")
    rows, n_rows = {}, 0
    for at, line in lines[2 * n_species + 2 :]:
        if line.split(maxsplit=1)[0] != ".":
            break
        n_rows += 1
        if line not in rows:  # `Ranges` ignores a repeated one
            rows[line] = _row(line.split()[1:], columns, f"{where}, line {at}")
    if n_rows != n_ranges:
        warn(f"{where} states {n_ranges} ranges but contains {n_rows}", DataWarning)
    return list(rows.values()), colours


def _row(cells, columns, where):
    if len(cells) != 2 + len(columns):
        raise FileError(f"{where}: expected two bounds and {len(columns)} numbers of atoms, got {len(cells)} values")
    low, high = (number(cell, "a bound [Da]", where) for cell in cells[:2])
    if not low < high:
        raise FileError(f"{where}: expected two bounds [Da], the lower one first, got {low:g} and {high:g}")
    atoms = {}
    for name, cell in zip(columns, cells[2:], strict=True):
        if n := count(cell, "a number of atoms", where):
            atoms[name] = atoms.get(name, 0) + n
    return (low, high), atoms
