"""Conversion of specimens to and from Atoms objects of ASE, an optional package."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import Floats
from apt_evap.specimen.materials import Material, as_material
from apt_evap.warnings import SpecimenWarning, warn

if TYPE_CHECKING:
    import ase

_ANGSTROM_PER_NM = 10.0


def from_atoms(atoms: "ase.Atoms", materials: Mapping[str, Material] | None = None) -> dict[str, Any]:
    """Arguments of `Tip.from_positions` from an ASE Atoms object.

    Parameters
    ----------
    atoms : ase.Atoms
        Positions in Angstrom. Its cell and periodicity are ignored.
    materials : mapping of str to Material, optional
        Materials by chemical symbol, for symbols that `material` does not know.

    Returns
    -------
    dict
        ``positions`` [nm], ``species``, ``elements`` (the most frequent one first), and ``evaporable`` if the atoms
        have an array of this name.

    Raises
    ------
    ValueError
        If it is not an Atoms object, if a symbol has no material, or if the atoms are a shell.

    Warns
    -----
    SpecimenWarning
        If sites are occupied partially.
    """
    if not all(hasattr(atoms, name) for name in ("get_chemical_symbols", "get_positions", "arrays")):
        raise ValueError(f"atoms must be an ase.Atoms object, got {atoms!r:.80}")
    warn_of_occupancy(atoms)
    if np.any(atoms.arrays.get("support", False)):
        raise ValueError("atoms must be a complete specimen, got a shell: its inner side would count as a surface")
    symbols = atoms.get_chemical_symbols()
    names = [name for name, _ in Counter(symbols).most_common()]
    known = dict(materials or {})
    numbers = {name: number for number, name in enumerate(names)}
    arguments = {
        "positions": atoms.get_positions() / _ANGSTROM_PER_NM,
        "species": np.array([numbers[symbol] for symbol in symbols], dtype=np.int32),
        "elements": [as_material(known.get(name, name)) for name in names],
    }
    if "evaporable" in atoms.arrays:
        arguments["evaporable"] = atoms.arrays["evaporable"]
    return arguments


def warn_of_occupancy(atoms: "ase.Atoms") -> None:
    """Warn of sites that are occupied partially, as in a CIF of a disordered crystal: ASE keeps one atom on each.

    Warns
    -----
    SpecimenWarning
        Names the occupancy of one of the sites.
    """
    sites = (getattr(atoms, "info", None) or {}).get("occupancy")  # of a CIF: a mapping for each kind of site
    sites = [site for site in (sites.values() if isinstance(sites, Mapping) else ()) if isinstance(site, Mapping)]
    sites += [{"an atom": share} for share in np.unique(atoms.arrays.get("occupancy", ()))]  # of a PDB
    for site in sites:
        if any(isinstance(share, float) and 0 < share < 1 for share in site.values()):
            shares = ", ".join(f"{name} {share:g}" for name, share in site.items())
            warn(
                f"the structure has sites that are occupied partially ({shares}), which become ordered and complete: "
                "place atoms and vacancies at random before",
                SpecimenWarning,
            )
            return


def to_atoms(
    positions: Floats, elements: Sequence[Material], species: NDArray[np.integer], **arrays: NDArray[Any]
) -> "ase.Atoms":
    """Make an ASE Atoms object.

    Parameters
    ----------
    positions : ndarray
        Atoms [nm], shape (n, 3).
    elements : sequence of Material
        The species; a name that is not a chemical symbol becomes "X".
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
    species_numbers = np.array([numbers.get(element.name, 0) for element in elements])
    numbers = species_numbers[species]
    atoms = optional_import("ase", "to_atoms").Atoms(numbers=numbers, positions=positions * _ANGSTROM_PER_NM)
    for name, values in arrays.items():
        atoms.new_array(name, values)
    return atoms
