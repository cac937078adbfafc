"""Specimens from files: LAMMPS, TAPSim, and all formats that ASE reads."""

import os
import tempfile
import warnings
from collections import Counter
from collections.abc import Mapping
from itertools import islice, takewhile
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, check_path
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice, check_kind, short_text
from apt_evap.io._texts import SYMBOLS, is_compressed, read_bytes, read_head, without_compression
from apt_evap.io.lammps import Atoms, checked_frame, is_data, is_dump, read_data, read_dump
from apt_evap.io.tapsim_nodes import is_nodes, read_nodes
from apt_evap.io.xyz_atoms import is_xyz, read_xyz
from apt_evap.specimen.ase_atoms import warn_of_occupancy
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.tip import Tip

SPECIMEN_FORMATS = ("lammps-dump", "lammps-data", "tapsim", "xyz", "ase")
_READERS: dict[str, Any] = {"lammps-dump": read_dump, "lammps-data": read_data, "tapsim": read_nodes, "xyz": read_xyz}
_HEAD = 1 << 14  # bytes that show the format
_MAX_BYTES = 1 << 32
_OPTIONS = {
    "lammps-dump": ("units", "frame"),
    "lammps-data": ("units", "style"),
    "tapsim": (),
    "xyz": ("units", "frame"),
    "ase": ("frame",),
}


def read_tip(
    path: AnyPath,
    types: Mapping[Any, Material | str] | None = None,
    *,
    format: str | None = None,
    units: str | None = None,
    frame: int | None = None,
    style: str | None = None,
    **options: Any,
) -> Tip:
    r"""Read a specimen from a file, with its axis along +z.

    Text dumps and data files of LAMMPS and node files of TAPSim are recognised by their content, also if they are
    compressed by gzip, bzip2 or xz. Files .xyz are read, too, and all others by ASE, if it is installed.

    Parameters
    ----------
    path : str or path-like
        The file.
    types : mapping, optional
        Material of each type in the file, such as ``{1: "Al", 2: "Cu"}``. The types of LAMMPS and TAPSim are numbers,
        and a number without a name is an error. A type that is a chemical symbol in the file may be omitted. If the
        file of LAMMPS has names and numbers, both may be used.
    format : str, optional
        lammps-dump, lammps-data, tapsim, xyz or ase; by default recognised by the content.
    units : str, optional
        Units of LAMMPS: metal (the default), real, electron, nano, micro, cgs or si.
    frame : int, optional
        Frame of a dump or trajectory, from 0; by default the last one.
    style : str, optional
        Style of the section Atoms of a data file, if the file does not state it.
    **options
        Passed to `Tip.from_positions`.

    Returns
    -------
    Tip
        Its `elements` begin with the most frequent one.

    Raises
    ------
    FileError
        If the file is missing, unreadable or of unknown format, or if a type has no name.
    ValueError
        As in `Tip.from_positions`.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0)
    >>> with open("tip.dump", "w") as file:  # a dump of LAMMPS, in units of 0.1 nm
    ...     print("ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS", len(tip), sep="\n", file=file)
    ...     print("ITEM: BOX BOUNDS ff ff ff", *["-100 100"] * 3, "ITEM: ATOMS type x y z", sep="\n", file=file)
    ...     np.savetxt(file, np.column_stack([tip.species + 1, 10 * tip.positions]), fmt="%d %.4f %.4f %.4f")
    >>> ae.read_tip("tip.dump", {1: "Ni"})
    <Tip: 8,179 atoms of Ni from positions>
    """
    names = {str(key): value for key, value in check_kind(types or {}, "types", Mapping, "a mapping").items()}
    options_given = {
        key: value for key, value in (("units", units), ("frame", frame), ("style", style)) if value is not None
    }
    return tip_of(path, read_atoms(path, format, **options_given), names, **options)


def read_atoms(path: AnyPath, format: str | None = None, **reader_options: Any) -> Atoms:
    """Read the atoms of a file as they are, with the options of `read_tip` for its format."""
    name, detected = str(check_path(path)), specimen_format(path)
    kind = detected if format is None else check_choice(format, "format", SPECIMEN_FORMATS)
    if kind == "ase" != detected:  # ASE makes hydrogen of types without a name
        raise FileError(f"{name!r} is a file of the format {detected}, which ASE reads without the names of its types")
    for key in reader_options:
        if key not in _OPTIONS[kind]:
            takes = ", ".join(_OPTIONS[kind]) or "no such options"
            raise FileError(f"{name!r}: reading a specimen of format {kind} takes {takes}, got {key!r}")
    if kind == "ase":
        atoms = _read_ase(path, **reader_options)  # in Angstrom
        return Atoms(atoms.get_positions() / 10, atoms.get_chemical_symbols(), atoms.arrays.get("evaporable"))
    return _READERS[kind](path, **reader_options)


def types_of(atoms: Atoms, names: Mapping[str, Any]) -> list[str]:
    """Type of each atom: its number if `names` has one for this number, otherwise the name in the file."""
    if atoms.numbers is None or not any(key in names for key in set(atoms.numbers)):
        return list(atoms.types)
    return [number if number in names else name for number, name in zip(atoms.numbers, atoms.types, strict=True)]


def tip_of(path: AnyPath, atoms: Atoms, names: Mapping[str, Material | str], **options: Any) -> Tip:
    """Make a tip of the atoms of a file, with the materials of its types by name."""
    name = str(path)
    if atoms.evaporable is not None:
        options = {"evaporable": atoms.evaporable} | options
    types = types_of(atoms, names)
    kinds = [kind for kind, _ in Counter(types).most_common()]
    for key in names:
        if key not in kinds:
            raise FileError(f"{name!r} has no atoms of type {key!r}, only of {', '.join(kinds)!s:.100}")
    if kinds == ["C"] and "C" not in names and atoms.numbers is not None:
        raise FileError(
            f"{name!r} has the element C for all atoms, as LAMMPS writes it without names of elements: give those of "
            "the column type, such as types={1: 'Al'}"
        )
    unnamed = [kind for kind in kinds if kind not in names and not kind[:1].isalpha()]
    if unnamed:
        raise FileError(
            f"{name!r} has types without a name, expected the element of each, such as types={{{unnamed[0]}: 'Al'}}, "
            f"got none for {', '.join(unnamed)!s:.100}"
        )
    odd = {kind: kind.capitalize() for kind in kinds if kind not in (*names, *SYMBOLS)}
    odd = {kind: symbol for kind, symbol in odd.items() if symbol in SYMBOLS}
    if odd:
        shown = dict(list(odd.items())[:8])
        raise FileError(f"{name!r} has types that are no chemical symbols: name their elements, such as types={shown}")
    number = {kind: k for k, kind in enumerate(kinds)}
    try:
        arguments: dict[str, Any] = {
            "positions": atoms.positions,
            "species": np.array([number[kind] for kind in types], np.int32),
            "elements": [as_material(names.get(kind, kind), "types") for kind in kinds],
        }
        return Tip.from_positions(**(arguments | options))
    except ValueError as error:
        raise FileError(f"{name!r}: {error}") from error


def specimen_format(path: AnyPath) -> str:
    """Format of a file of a specimen by its content; "ase" if it is not one of the others, str."""
    head = read_head(path, _HEAD).decode("latin-1")
    if is_dump(head):
        return "lammps-dump"
    if is_nodes(path):
        return "tapsim"
    if is_data(head):
        return "lammps-data"
    return "xyz" if is_xyz(without_compression(path).suffix.lower(), head) else "ase"


def _check_counts(path, source):
    """Refuse more atoms than the bytes of a POSCAR can describe: ASE lists their symbols before it reads a place."""
    size = os.path.getsize(source)
    with open(source, errors="replace") as file:
        lines = list(islice(file, 7))
    for number, line in enumerate(lines[5:], 6):  # the second one after a line of symbols
        atoms = sum(int(word) for word in takewhile(str.isdecimal, line.split()))
        if atoms > size:
            raise FileError(
                f"{str(path)!r}, line {number}: expected the numbers of the atoms, got {short_text(line.strip())} in a "
                f"file of {size:,} bytes"
            )


def _read_ase(path, frame=-1):
    """Atoms of ASE, from a file of any format that it reads."""
    head = read_head(path, 64)
    if head.startswith(b"---") and b"LAMMPS" in head:
        raise FileError(f"{str(path)!r} is a LAMMPS dump in YAML, expected one of style custom or atom, or a data file")
    frame = checked_frame(frame, None, f"{str(path)!r}")
    read = optional_import("ase.io", "reading this specimen").read
    filetype = optional_import("ase.io.formats", "reading this specimen").filetype
    kind = "no format"
    with tempfile.TemporaryDirectory() as folder:
        source = os.path.abspath(path)
        if is_compressed(path):
            source = os.path.join(folder, without_compression(path).name)
            with open(source, "wb") as file:
                file.write(read_bytes(path, "a file of atoms", _MAX_BYTES))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kind = filetype(source)
                if kind.startswith("lammps"):
                    raise FileError(
                        f"{str(path)!r} is a file of the format {kind}, whose types ASE reads as atomic numbers, "
                        "expected a text dump or a data file of LAMMPS"
                    )
                if kind in ("vasp", "vasp-xdatcar"):
                    _check_counts(path, source)
                # neither "@" nor "-" in a name has a meaning of its own here
                atoms = read(source, index=frame, do_not_split_by_at_sign=True)
            if not hasattr(atoms, "get_chemical_symbols"):
                raise ValueError("it contains no atoms")
        except FileError:
            raise
        except Exception as error:  # every format of ASE has its own errors
            if frame != -1 and isinstance(error, IndexError | StopIteration):
                raise FileError(f"{str(path)!r} has no frame {frame}") from error
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise FileError(
                f"cannot read {str(path)!r} as a specimen: expected a dump or data file of LAMMPS, nodes of TAPSim, "
                f".xyz, or a format of ASE with chemical symbols, which takes it for {kind} and says: {reason:.150}"
            ) from error
    warn_of_occupancy(atoms)
    return atoms
