"""The .rng format: ranges of mass over charge state as a table with one column for each species.

Miller, Atom Probe Tomography (Kluwer, 2000), and Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013),
appendix A. A second table, the polyatomic extension, may give molecular ions names and colours.
"""

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
    formula,
    number,
    read_text,
    species_name,
)
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.warnings import DataWarning, warn


def read_rng(path: AnyPath) -> Ranges:
    """Read the mass ranges of an .rng file.

    Returns
    -------
    Ranges
        In the order of the file. A range has the name and colour of the polyatomic extension if this contains the same
        bounds. Otherwise its name is its formula, such as "CrO2", and a range of one species has its colour. Ranges
        without any species are left out, with a warning.

    Warns
    -----
    DataWarning
        Of lines that cannot be read, which are left out.
    """
    text = read_text(path, "the text of an .rng file")
    lines = [
        (at, line.strip())
        for at, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    odd = OddLines(path)
    rows, colours, rest = _table(lines, path, odd)
    names, molecules = {}, []
    if rest and rest[0][1].startswith("--"):  # "--- polyatomic extension"
        molecules, their_colours, rest = _table(rest[1:], path, odd)
        names = {bounds: (formula(atoms), their_colours.get(formula(atoms), "")) for bounds, atoms in molecules}
    for at, line in rest:
        odd.add(at, f"expected a range, got {line!r:.60}")
    known = {bounds for bounds, _ in rows}
    rows += [row for row in molecules if row[0] not in known]
    n_empty = sum(not atoms for _, atoms in rows)
    rows = [row for row in rows if row[1]]
    odd.report(len(rows), "has no range with a species, expected at least one")
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
        tuple(composition_of(atoms, *bounds)[0] for bounds, atoms in rows),
        source=str(path),
    )


def _table(lines, path, odd):
    """Bounds and species of each range, the colour of each species, and the lines after the ranges."""
    where = f"{str(path)!r}"
    if not lines:
        raise FileError(f"{where} ends before a table of ranges")
    at, first = start = lines[0]
    counts = first.split()
    if len(counts) != 2:
        raise FileError(f"{where}, line {at}: expected the numbers of species and of ranges, got {first!r:.60}")
    n_species, n_ranges = (
        count(word, "the numbers of species and of ranges", f"{where}, line {at}") for word in counts
    )
    if len(lines) < 2 * n_species + 2:
        raise FileError(
            f"{where}, line {at}: expected {n_species} species and then a line of dashes, the file ends before it"
        )
    colours, shorts = {}, []
    for at, line in lines[2 : 2 * n_species + 1 : 2]:
        short, *parts = line.split()
        shorts.append(species_name(short, (), f"{where}, line {at}"))
        with odd.leave_out(at, "read without its colour"):
            if len(parts) < 3:
                raise FileError(f"{where}, line {at}: expected a species and its colour, got {line!r:.60}")
            colours[shorts[-1]] = colour(parts[:3], f"{where}, line {at}")
    at, line = lines[2 * n_species + 1]
    if not line.startswith("-"):
        raise FileError(
            f"{where}, line {at}: expected a line of dashes after the {n_species} species that line {start[0]} states, "
            f"got {line!r:.60}"
        )
    columns = _columns(line, shorts, odd, at)
    rows, n_rows, read = {}, 0, 2 * n_species + 2
    for at, line in lines[2 * n_species + 2 :]:
        cells = line.split()
        # ". 10 11 1 0", "3 10 11 1 0", and without the first word; a table ends at other texts
        if line.startswith("--") or (n_rows >= n_ranges and not _may_be_range(cells, len(columns))):
            break
        n_rows, read = n_rows + 1, read + 1
        if line not in rows:  # `Ranges` ignores a repeated one
            with odd.leave_out(at):
                rows[line] = _row(cells, columns, f"{where}, line {at}")
    if n_rows != n_ranges:
        odd.add(start[0], f"states {n_ranges} ranges but contains {n_rows}", "all are read")
    return list(rows.values()), colours, lines[read:]


def _columns(line, shorts, odd, at):
    """Species of the columns, from the line of dashes; those of the list of species where it is odd."""
    columns = [species_name(name, shorts, odd.where(at)) for name in line.lstrip("-").split()]
    if not columns:
        return shorts
    if len(columns) != len(shorts):
        odd.add(
            at, f"expected {len(shorts)} species after the dashes, got {len(columns)}", "those of the list are taken"
        )
        return shorts
    for k, name in enumerate(columns):
        if name not in shorts:
            columns[k] = name if atoms_of(name) else shorts[k]
            odd.add(at, f"{name!r:.40} is not in the list of species", f"read as {columns[k]}")
    return columns


def _may_be_range(cells, n_species):
    """Whether the words of a line are as many as those of a range, or begin like one."""
    return cells[0].startswith(".") or len(cells) in (2 + n_species, 3 + n_species)


def _row(cells, columns, where):
    if cells[0] != "." and cells[0][0] == "." and len(cells) == 2 + len(columns):
        cells = [cells[0][1:], *cells[1:]]  # the point is glued to the bound
    elif cells[0] == "." or len(cells) == 3 + len(columns):
        cells = cells[1:]  # a point, or the number of the range
    if len(cells) != 2 + len(columns):
        raise FileError(f"{where}: expected two bounds and {len(columns)} numbers of atoms, got {len(cells)} values")
    bounds = check_bounds(*(number(cell, "a bound [Da]", where) for cell in cells[:2]), where)
    atoms = {}
    for name, cell in zip(columns, cells[2:], strict=True):
        if n := count(cell, "a number of atoms", where):
            atoms[name] = atoms.get(name, 0) + n
    return bounds, atoms
