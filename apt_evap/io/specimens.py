"""Specimens from files: LAMMPS, TAPSim, and all formats that ASE reads."""

import os
import warnings
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, check_path, open_for_reading
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice, check_kind
from apt_evap.io.lammps import Atoms, is_data, is_dump, read_data, read_dump
from apt_evap.io.tapsim_nodes import is_nodes, read_nodes
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.tip import Tip

SPECIMEN_FORMATS = ("lammps-dump", "lammps-data", "tapsim", "ase")
_HEAD = 1 << 14  # bytes that show the format
_OPTIONS = {"lammps-dump": ("units", "frame"), "lammps-data": ("units", "style"), "tapsim": (), "ase": ()}


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

    Text dumps and data files of LAMMPS and node files of TAPSim are recognised by their content. All other files are
    read by ASE, if it is installed.

    Parameters
    ----------
    path : str or path-like
        The file.
    types : mapping, optional
        Material of each type in the file, such as ``{1: "Al", 2: "Cu"}``. The types of LAMMPS and TAPSim are numbers,
        and a number without a name is an error. A type that is a chemical symbol in the file may be omitted.
    format : str, optional
        lammps-dump, lammps-data, tapsim or ase; by default recognised by the content.
    units : str, optional
        Units of LAMMPS: metal (the default), real, electron, nano, micro, cgs or si.
    frame : int, optional
        Frame of a dump, from 0; by default the last one.
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
    given = {key: value for key, value in (("units", units), ("frame", frame), ("style", style)) if value is not None}
    return tip_of(path, read_atoms(path, format, **given), names, **options)


def read_atoms(path: AnyPath, format: str | None = None, **given: Any) -> Atoms:
    """Read the atoms of a file as they are, with the options of `read_tip` for its format."""
    name, own = str(check_path(path)), specimen_format(path)
    kind = own if format is None else check_choice(format, "format", SPECIMEN_FORMATS)
    if kind == "ase" != own:  # ASE makes hydrogen of types without a name
        raise FileError(f"{name!r} is a file of the format {own}, which ASE reads without the names of its types")
    for key in given:
        if key not in _OPTIONS[kind]:
            takes = ", ".join(_OPTIONS[kind]) or "no such options"
            raise FileError(f"{name!r}: reading a specimen of format {kind} takes {takes}, got {key!r}")
    if kind == "ase":
        atoms = _read_ase(path)  # in Angstrom
        return Atoms(atoms.get_positions() / 10, atoms.get_chemical_symbols(), atoms.arrays.get("evaporable"))
    reader: Any = {"lammps-dump": read_dump, "lammps-data": read_data, "tapsim": read_nodes}[kind]
    return reader(path, **given)


def tip_of(path: AnyPath, atoms: Atoms, names: Mapping[str, Material | str], **options: Any) -> Tip:
    """Make a tip of the atoms of a file, with the materials of its types by name."""
    name = str(path)
    if atoms.evaporable is not None:
        options = {"evaporable": atoms.evaporable} | options
    kinds = [each for each, _ in Counter(atoms.types).most_common()]
    for key in names:
        if key not in kinds:
            raise FileError(f"{name!r} has no atoms of type {key!r}, only of {', '.join(kinds)!s:.100}")
    unnamed = [each for each in kinds if each not in names and not each[:1].isalpha()]
    if unnamed:
        raise FileError(
            f"{name!r} has types without a name, expected the element of each, such as types={{{unnamed[0]}: 'Al'}}, "
            f"got none for {', '.join(unnamed)!s:.100}"
        )
    number = {each: k for k, each in enumerate(kinds)}
    try:
        arguments: dict[str, Any] = {
            "positions": atoms.positions,
            "species": np.array([number[each] for each in atoms.types], np.int32),
            "elements": [as_material(names.get(each, each), "types") for each in kinds],
        }
        return Tip.from_positions(**(arguments | options))
    except ValueError as error:
        raise FileError(f"{name!r}: {error}") from error


def specimen_format(path: AnyPath) -> str:
    """Format of a file of a specimen by its content; "ase" if it is not one of the others, str."""
    with open_for_reading(path) as file:
        head = file.read(_HEAD).decode("latin-1")
    if is_dump(head):
        return "lammps-dump"
    if is_nodes(path):
        return "tapsim"
    return "lammps-data" if is_data(head) else "ase"


def _read_ase(path):
    read = optional_import("ase.io", "reading this specimen").read
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # neither "@" nor "-" in a name has a meaning of its own here
            atoms = read(os.path.abspath(path), do_not_split_by_at_sign=True)
        if not hasattr(atoms, "get_chemical_symbols"):
            raise ValueError("it contains no atoms")
    except Exception as error:  # every format of ASE has its own errors
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise FileError(f"cannot read {str(path)!r} as a specimen: {reason:.200}") from error
    return atoms
