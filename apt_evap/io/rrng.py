"""The .rrng format: ranges of mass over charge state as INI text.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), appendix A. The order of sections, lines and
parts of a line, and spaces do not matter, upper or lower case only where several names differ by it, such as Co and CO.
Volume and colour may be missing, and the decimal separator may be a comma.
"""

import re

import numpy as np

from apt_evap._common.files import FileError, check_path, replace_file
from apt_evap._common.types import AnyPath
from apt_evap.io._texts import (
    OddLines,
    atoms_of,
    check_bounds,
    composition_of,
    ion_of_name,
    isotope_masses,
    number,
    read_text,
    species_name,
)
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.warnings import DataWarning, warn


def read_rrng(path: AnyPath) -> Ranges:
    """Read the mass ranges of an .rrng file.

    Returns
    -------
    Ranges
        In the order of the file. The name of a range is its ``Name`` or, if missing, its atoms, such as "CrO2".
        Molecules such as ``SiO2:1`` count with their atoms, and isotopes such as ``Ni58:1`` as one: the mass decides
        between them. A volume of 0 is unknown.

    Warns
    -----
    DataWarning
        Of lines that cannot be read, which are left out.
    """
    lines = _lines(read_text(path, "the text of an .rrng file"))
    odd = OddLines(path)
    # by their keys, whatever the section is called
    ions = [value.split()[0] for _, _, key, value in lines if re.fullmatch(r"ion\s*[0-9]+", key) and value]
    parts, numbers = [], []
    for section, at, key, value in lines:
        if re.fullmatch(r"range\s*[0-9]+", key):
            with odd.leave_out(at):
                parts.append(_range(value, ions, odd, at))
        elif section == "ranges" and key == "number":
            numbers.append((at, value))
        elif section == "ranges" and not re.fullmatch(r"ion\s*[0-9]+", key):
            odd.add(at, f"expected Range1=..., got {f'{key}={value}'!r:.60}")
    n_lines = sum(bool(re.fullmatch(r"range\s*[0-9]+", key)) for _, _, key, _ in lines)
    if numbers and numbers[0][1] != str(n_lines):
        odd.add(numbers[0][0], f"states {numbers[0][1]:.20} ranges but contains {n_lines}", "all are read")
    if not numbers:
        given = [int(key[5:]) for _, _, key, _ in lines if re.fullmatch(r"range\s*[0-9]+", key)]
        if missing := sorted(set(range(1, max(given, default=0))) - set(given))[:3]:
            last = max(at for _, at, key, _ in lines if key.startswith("range"))
            odd.add(last, f"the ranges end here, without Range{missing[0]} and without Number=", "all are read")
    odd.report(len(parts), "has no lines Range1=... with a range, as in an .rrng file")
    names, low, high, volume, colour, composition, species = zip(*parts, strict=True)
    _warn_of_charges(path, low, high, species)
    return Ranges(names, np.array(low), np.array(high), np.array(volume), colour, composition, source=str(path))


def write_rrng(path: AnyPath, ranges: Ranges) -> None:
    """Write an .rrng file of ranges of mass.

    Parameters
    ----------
    path : str or path-like
        The file.
    ranges : Ranges
        Ranges whose ions have a composition. Each line has a volume, which other programs need: 0 if it is not known.

    Raises
    ------
    FileError
        If it cannot be written.
    ValueError
        If a range has no composition.
    """
    assert ranges.composition is not None and ranges.colour is not None
    for name, atoms in zip(ranges.names, ranges.composition, strict=True):
        if not atoms:
            raise ValueError(f"ranges must have a composition for an .rrng file, got none for {name!r}")
    elements = list(dict.fromkeys(element for atoms in ranges.composition for element in atoms))
    lines = ["[Ions]", f"Number={len(elements)}"]
    lines += [f"Ion{at}={element}" for at, element in enumerate(elements, 1)]
    lines += ["[Ranges]", f"Number={len(ranges)}"]
    for at, (low, high, volume, atoms, colour) in enumerate(
        zip(ranges.low, ranges.high, ranges.volume, ranges.composition, ranges.colour, strict=True),  # type: ignore[arg-type]
        1,
    ):
        parts = [f"{low:.4f} {high:.4f}"]
        parts += [f"Vol:{volume if np.isfinite(volume) else 0:.5f}"]
        parts += [f"{element}:{count}" for element, count in atoms.items()]
        parts += [f"Color:{colour.lstrip('#').upper()}"] if colour else []
        lines.append(f"Range{at}={' '.join(parts)}")
    with replace_file(check_path(path)) as file:
        file.write(("\n".join(lines) + "\n").encode())


def _lines(text):
    """(section, line number, key, value) of every line with a meaning, section and key in lower case."""
    section = ""
    assignments = []
    for at, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if line.startswith("[") and "]" in line:
            section = line[1 : line.index("]")].strip().casefold()
        elif line and not line.startswith((";", "#")):
            key, _, value = line.partition("=")
            assignments.append((section, at, key.strip().casefold(), value.strip()))
    return assignments


def _range(text, ions, odd, at):
    """Read "13.8745 14.2410 Vol:0.02003 Si:1 Color:CCCCCC"."""
    where = odd.where(at)
    bounds = []
    name, volume, colour, species, word = None, np.nan, "", {}, ""
    # "Vol : 0.02" is "Vol:0.02", but the value may also be missing; a pattern for spaces before a colon would need
    # quadratic time for many spaces
    compact = ":".join([part.rstrip() for part in text.split(":")])
    for part in re.sub(r":\s+(?=[^\s:]+(\s|$))", ":", compact).split():
        key, colon, value = part.partition(":")
        if not colon:
            if word == "name" and (len(bounds) == 2 or not re.fullmatch(r"[-+0-9.,eE]+", part)):
                name = f"{name} {part}".strip()  # with blanks
            else:
                bounds.append(number(part, "a bound [Da]", where))
            continue
        word = key.casefold()
        if word == "vol":
            volume = number(value, "a volume [nm^3]", where) if value else np.nan
        elif word in ("color", "colour"):
            colour = "#" + value.upper() if re.fullmatch(r"#?[0-9A-Fa-f]{6}", value) else ""
            colour = colour.replace("##", "#")
        elif word == "name":
            name = value
        elif word == "charge":
            continue
        elif re.fullmatch(r"[0-9]{1,4}([.,]0{0,6})?", value):
            ion = species_name(key, ions, where)
            if ion not in ions and not atoms_of(ion):
                odd.add(at, f"{key!r:.40} is neither an element nor an ion of the file", "kept as its name")
            if ion in species:
                odd.add(at, f"{ion!r:.40} is listed twice", "both are added")
            species[ion] = species.get(ion, 0) + int(re.split("[.,]", value)[0])
        else:
            raise FileError(f"{where}: expected a number of atoms such as {key}:1, got {part!r:.60}")
    if len(bounds) != 2:
        raise FileError(f"{where}: expected two bounds [Da], got {bounds!s:.60} in {text!r:.60}")
    low, high = check_bounds(*bounds, where)
    species = {ion: count for ion, count in species.items() if count}
    if not (name or species):
        raise FileError(f"{where}: expected an element such as Si:1, or Name:..., got {text!r:.60}")
    if not species and (ion := ion_of_name(name, low, high)):
        species = {ion: 1}
    composition, formula = composition_of(species, low, high)
    return name or formula, low, high, volume or np.nan, colour, composition, species


def _warn_of_charges(path, low, high, species):
    """Warn if numbers of atoms are charge states, as one program writes them: "Co:2" at half the mass of cobalt.

    An ion of n atoms and charge n squared, which has the same mass-to-charge ratio, does not exist.
    """
    singles = {}
    for first, last, ions in zip(low, high, species, strict=True):
        if len(ions) == 1:
            ((name, n),) = ions.items()
            singles.setdefault(name, []).append((n, n * first, n * last))
    for name, ranges in singles.items():
        masses = isotope_masses(name)
        for n, first, last in ranges:
            others = [0.5 * (start + end) for m, start, end in ranges if m != n]
            if n > 1 and any(first <= mass <= last for mass in masses + others):
                warn(
                    f"{str(path)!r}: {name}:{n} from {first / n:g} to {last / n:g} Da has the mass of {name} with "
                    f"{n} charges, but is read as {n} atoms: the number must be that of the atoms",
                    DataWarning,
                )
                return
