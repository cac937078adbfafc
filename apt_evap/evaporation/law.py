"""Evaporation laws: which atom leaves next."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.specimen.tip import Tip


class Law(Protocol):
    """What an evaporation law of one's own must have; `Extremal` is one."""

    def weights(self, tip: Tip) -> Floats:
        """Return what the field of each atom is multiplied by for the choice, 0 for those that may not leave, (n,)."""
        ...


@dataclass(frozen=True)
class Extremal:
    """The atom with the largest field over evaporation field leaves; equal ones go by their number.

    The limit of low temperature of the Arrhenius rate nu_0 exp(-C (1 - F/F_evap)/kT) (Vurpillot et al., 2013).
    """

    def weights(self, tip: Tip) -> Floats:
        """Return what the field of each atom is multiplied by for the choice.

        Parameters
        ----------
        tip : Tip
            The specimen.

        Returns
        -------
        ndarray, shape (n,)
            One over the evaporation field [nm/V]; 0 for atoms that may not leave.
        """
        return np.where(tip.evaporable, 1.0 / tip.evaporation_fields[tip.species], 0.0)
