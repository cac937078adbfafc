"""Specimens to and from the Atoms objects of ASE, which need not be installed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import Floats
from apt_evap.specimen.materials import Material, as_material

if TYPE_CHECKING:
    import ase

_ANGSTROM_PER_NM = 10.0


def from_atoms(atoms: "ase.Atoms", materials: Mapping[str, Material] | None = None) -> dict[str, Any]:
    """What `Tip.from_positions` needs of an ASE Atoms object.

    Parameters
    ----------
    atoms : ase.Atoms
        Positions in Angstrom. Its cell and periodicity are not looked at.
    materials : mapping of str to Material, optional
        Materials by chemical symbol, for those that `material` does not know.

    Returns
    -------
    dict
        ``positions`` [nm], ``species``, ``elements``, the most frequent one first, and ``evaporable`` if the atoms have
        an array of this name.

    Raises
    ------
    ValueError
        If it is no Atoms object, a symbol has no material, or the atoms are a shell.
    """
    if not all(hasattr(atoms, name) for name in ("get_chemical_symbols", "get_positions", "arrays")):
        raise ValueError(f"atoms must be an ase.Atoms object, got {atoms!r:.80}")
    if np.any(atoms.arrays.get("support", False)):
        raise ValueError("atoms must be all of a specimen, got a shell, whose inner side would count as a surface")
    symbols = atoms.get_chemical_symbols()
    names = [name for name, _ in Counter(symbols).most_common()]
    known = dict(materials or {})
    numbers = {name: number for number, name in enumerate(names)}
    found = {
        "positions": atoms.get_positions() / _ANGSTROM_PER_NM,
        "species": np.array([numbers[symbol] for symbol in symbols], dtype=np.int32),
        "elements": [as_material(known.get(name, name)) for name in names],
    }
    if "evaporable" in atoms.arrays:
        found["evaporable"] = atoms.arrays["evaporable"]
    return found


def to_atoms(
    positions: Floats, elements: Sequence[Material], species: NDArray[np.integer], **arrays: NDArray[Any]
) -> "ase.Atoms":
    """Make an ASE Atoms object.

    Parameters
    ----------
    positions : ndarray
        Atoms [nm], shape (n, 3).
    elements : sequence of Material
        The species; one whose name is no chemical symbol becomes "X".
    species : ndarray of int
        Index of each atom into `elements`, shape (n,).
    **arrays
        Further arrays of the atoms by name, shape (n,) or (n, k).

    Returns
    -------
    ase.Atoms
        Positions in Angstrom, no cell.

    Raises
    ------
    ImportError
        If ASE is not installed.
    """
    numbers = optional_import("ase.data", "to_atoms").atomic_numbers
    of_species = np.array([numbers.get(element.name, 0) for element in elements])
    numbers = of_species[species]
    atoms = optional_import("ase", "to_atoms").Atoms(numbers=numbers, positions=positions * _ANGSTROM_PER_NM)
    for name, values in arrays.items():
        atoms.new_array(name, values)
    return atoms
