"""Evaporation laws: the choice of the next atom to evaporate."""

import math
from collections.abc import Mapping
from typing import Any, Protocol, TypeGuard

import numpy as np

from apt_evap._common.codec import part, settings
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import short_text
from apt_evap._core.law import LawKernel, PythonLaw, WeightedField
from apt_evap.emission.roll_probability import AT_REST, BY_CHARGE, Migration
from apt_evap.evaporation.bonds import BondField, bond_table, bonds_field
from apt_evap.evaporation.voltage import ThermalLaw, VoltageControl
from apt_evap.specimen.lattice import COORDINATION
from apt_evap.specimen.tip import Tip

_SAME_FIELD = 0.01  # relative; the barrier of another metal differs by more


class Law(Protocol):
    """Interface of an evaporation law.

    A law in Python has a method `keys`, which is called after every event for the about 300 atoms around the hole. A
    law that also has a method ``kernel(tip)``, which returns a compiled `LawKernel`, runs at full speed.
    """

    def keys(self, tip: Tip, atoms: Integers, fields: Floats, bonds: Integers) -> Floats:
        """Return the key of each atom: the atom with the largest key evaporates next.

        Parameters
        ----------
        tip : Tip
            The specimen.
        atoms : ndarray of int64, shape (n,)
            Indices of surface atoms in the specimen.
        fields : ndarray, shape (n,)
            Field just outside each atom [V/nm].
        bonds : ndarray of int32, shape (n,)
            Number of remaining nearest neighbours of each atom.

        Returns
        -------
        ndarray, shape (n,)
            Keys; <= 0 for atoms that cannot evaporate. Equal keys are ordered by the index of the atom.
        """
        ...


@settings
class Extremal:
    """Extremal law: the atom with the largest ratio of field to evaporation field evaporates next.

    Equal ratios are ordered by the index of the atom. This is the low-temperature limit of the Arrhenius rate nu_0
    exp(-C (1 - F/F_evap)/kT) (Vurpillot et al., 2013).

    Notes
    -----
    With `hop`, an atom leaves as soon as it can hop onto its strongest neighbour, from where it evaporates at once. The
    hop of a kink atom (up to half of the bonds of the bulk) needs the field F sqrt(g / (phi^2 - 1)): F, phi and g are
    those of `Migration`. The atom leaves at this field or at F_evap, whichever is lower. Where strong neighbours are
    near, atoms leave at lower fields. `bonds` change F_evap only.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> run = ae.Simulation(tip, law=ae.Extremal()).run(3)
    >>> run.site  # index of each atom, in the sequence of evaporation
    array([8101, 8099, 7922])
    """

    bonds: BondField | None = bonds_field()
    hop: Migration | None = part(
        "Barrier of a hop in the field, after which an atom leaves; by default atoms leave by evaporation only.",
        Migration,
        default=None,
    )

    def _check(self):
        if self.hop is not None and not self.hop.gain_needed > 0:
            raise ValueError(f"hop must have a barrier above that of evaporation, got {self.hop!r}")

    def kernel(self, tip: Tip) -> LawKernel:
        """Return the compiled law for a specimen: F / F_evap, 0 for atoms that cannot evaporate.

        Raises
        ------
        ValueError
            If `hop` is not the barrier of the metal of the specimen, or the specimen is not of one metal.
        """
        weight = np.where(tip.evaporable, 1.0 / tip.evaporation_fields[tip.species], 0.0)
        table = (None, None, None) if self.bonds is None else bond_table(self.bonds, tip)
        return WeightedField(weight, *table, None if self.hop is None else self._hop_of(self.hop, tip))

    def _hop_of(self, hop, tip):
        """Most bonds of an atom that can hop, and the constants of its field."""
        metals = [tip.elements[species] for species in np.unique(tip.species[tip.evaporable])]
        if len(metals) != 1:
            names = ", ".join(metal.name for metal in metals) or "no metal"
            raise ValueError(f"hop is the barrier of one metal, but atoms of {names} can evaporate")
        (metal,) = metals
        if not math.isclose(hop.field, metal.evaporation_field, rel_tol=_SAME_FIELD):
            raise ValueError(
                f"hop must have the evaporation field of {metal.name}, {metal.evaporation_field:g} V/nm, got "
                f"{hop.field:g} V/nm; ae.emission.Migration.of(material) has it"
            )
        return COORDINATION[metal.structure][0] // 2, AT_REST, BY_CHARGE, hop.gain_needed, hop.field

    def keys(self, tip: Tip, atoms: Integers, fields: Floats, bonds: Integers) -> Floats:
        """Return the ratio of field to evaporation field of the species of each atom, without hops: see `Law.keys`."""
        return np.where(tip.evaporable[atoms], fields / tip.evaporation_fields[tip.species[atoms]], 0.0)


def check_law(law: object) -> None:
    """Raise a ValueError if `law` is not an evaporation law."""
    if isinstance(law, type | Mapping) or not any(callable(getattr(law, name, None)) for name in ("kernel", "keys")):
        expected = "an evaporation law with a method keys, such as Extremal()"
        raise ValueError(f"law must be {expected}, got {short_text(law)}")


def has_temperature(law: Any) -> TypeGuard[ThermalLaw]:
    """Whether the law is a `ThermalLaw` with a temperature above 0."""
    return isinstance(law, ThermalLaw) and law.peak_temperature > 0


def kernel_of(law: Any, tip: Tip, control: VoltageControl | None = None) -> LawKernel:
    """Return the compiled kernel of a law for a specimen; for a law in Python, a kernel that calls it."""
    make = getattr(law, "kernel", None)
    if make is None:
        return PythonLaw(law, tip)
    return make(tip, control) if has_temperature(law) else make(tip)
