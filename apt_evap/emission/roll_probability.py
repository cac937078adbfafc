"""Probabilities that atoms roll up before they evaporate, which depend on their places.

Both see the charge of the strongest neighbour over that of the atom. That is also what the electrostatics of a hop
depend on: see `Migration`.
"""

from __future__ import annotations  # `Migration.of` returns one

from typing import Protocol

import numpy as np

from apt_evap._common.codec import number, settings
from apt_evap._common.types import Floats
from apt_evap._core.elementary import exponential
from apt_evap.emission.emissions import Emissions
from apt_evap.specimen.materials import Material, as_material
from apt_evap.units import BOLTZMANN, ELEMENTARY_CHARGE

EVAPORATION_BARRIER = 28.0
"""Barrier of an evaporating atom over kT, ln(attempts/rate): 1e13 attempts and 10 ions in a second."""

AT_REST, BY_CHARGE = 1.27, 1.54
"""Charge of an atom after a roll-up over that before, as a line over the charge ratio of the strongest neighbour.

One patch solve each for 500 events of Ni[111] and of W[011], R = 80 a, constant potential, law of the field of others:
1.25 + 1.57 x and 1.28 + 1.52 x, RMS 0.05, correlation 0.94 and 0.97 (articles/three_metals/migration.py).
"""


class RollProbability(Protocol):
    """Interface of a probability that an ion rolls up."""

    def probabilities(self, emissions: Emissions) -> Floats:
        """Probability of each ion of a batch, from 0 to 1, shape (n,)."""
        ...


class _ByChargeRatio:
    """Base of the probabilities by the charge of the strongest neighbour over that of the atom."""

    def probabilities(self, emissions: Emissions) -> Floats:
        """Probability of each ion, shape (n,); 0 without a neighbour. ValueError if the emissions have no targets."""
        if emissions.charge_ratios is None:
            raise ValueError(
                f"{type(self).__name__} needs the `targets` and `charge_ratios` of the emissions, got none"
            )
        ratios = emissions.charge_ratios[:, 0]
        known = np.isfinite(ratios)
        return np.where(known, self._at(np.where(known, ratios, 0.0)), 0.0)

    def _at(self, ratios):
        raise NotImplementedError


def _fermi(excess, width):
    """1 / (1 + exp(-excess / width)); a step for a width of 0."""
    if width == 0.0:
        return (excess > 0).astype(float)
    return 1.0 / (1.0 + exponential(np.clip(-excess / width, -700.0, 700.0)))


@settings
class ChargeRatio(_ByChargeRatio):
    """Probability of a roll-up by the charge of the strongest neighbour over that of the atom.

    Notes
    -----
    p = 1 / (1 + exp(-(ratio - threshold) / width)).
    """

    threshold: float = number(
        "Ratio at which half of the atoms roll up. At a constant potential the median ratio is 0.73 to 0.83 (Ni, W).",
        at_least=0,
        at_most=10,
    )
    width: float = number("Width of the transition; 0 for a step.", default=0.0, at_least=0, at_most=10)

    def _at(self, ratios):
        return _fermi(ratios - self.threshold, self.width)


@settings
class Migration(_ByChargeRatio):
    r"""Probability of a roll-up by the barrier of a hop in the field.

    An atom hops before it leaves if that is easier. A hop onto a neighbour costs bonds, and gains polarisation energy,
    because the field is higher there. The gain increases with the square of the field, the cost with the cohesive
    energy: most atoms of tungsten roll, none of aluminium. The other constants are the same for all metals.

    Notes
    -----
    .. math::

       p = \frac{1}{1 + \exp\left((Q_h - Q_e)/kT\right)} , \qquad
       Q_h = b E_{\mathrm{coh}} - \tfrac12 \alpha F^2 (\varphi^2 - 1) , \qquad
       Q_e = 28 \, kT .

    :math:`\varphi` is the charge of the atom on its neighbour over that at its site. At a constant potential it is a
    linear function of the charge ratio x of the strongest neighbour, the same for fcc and bcc:
    :math:`\varphi = 1.27 + 1.54 x`. The barrier of evaporation :math:`Q_e` is that of a rate of about 10 ions per
    second. As kT is small, p is a step at the charge ratio `threshold`.

    :math:`b = 1/2` is the part of the bonds of a kink atom that an adatom of a close-packed facet has lost (3 of 6 on
    fcc {111}, 2 of 4 on bcc {110}). :math:`\alpha` is an effective polarisability, selected with a measured map of
    tungsten: see :doc:`/results/three_metals`. It stands for the energy of the charges, which by itself has 0.59e-40
    F m^2 for nickel and 0.86e-40 for tungsten, but does not let nickel roll: :ref:`hop-energy`. All atoms have the same
    numbers: an alloy is not described, and its run gives an ``EmissionWarning``.

    With Robin's charges the ratios are others, and other atoms would roll: 51 instead of 11 % of iron. A run with such
    charges then gives an ``EmissionWarning``.

    Examples
    --------
    The charge ratio above which atoms roll, and which part of the atoms has it on a small tip:

    >>> nickel, aluminium = ae.emission.Migration.of("Ni"), ae.emission.Migration.of("Al")
    >>> ae.RollUp(0.2, nickel)
    RollUp(0.2, Migration(4.44, 35.0))
    >>> print(f"{nickel.threshold:.2f} {aluminium.threshold:.2f}")
    0.81 1.63
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> run = ae.Simulation(tip, seed=1, rule=ae.ConstantPotential()).run(60)
    >>> round(float(nickel.probabilities(run.emissions).mean()), 2)
    0.4
    """

    cohesive_energy: float = number(
        "Of the metal: 4.44 for Ni, 8.90 for W, 3.39 for Al.", above=0, at_most=20, unit="eV"
    )
    field: float = number("Field at which the atoms leave.", above=0, at_most=200, unit="V/nm")
    temperature: float = number("Of the specimen.", default=80.0, above=0, at_most=2000, unit="K")
    bonds_lost: float = number(
        "Part of the bonds of a kink atom that the hop costs, b.", default=0.5, above=0, at_most=1
    )
    polarizability: float = number(
        "Effective polarisability of an atom on the surface.", default=1e-40, above=0, at_most=1e-30, unit="F m^2"
    )

    @classmethod
    def of(cls, material: Material | str, temperature: float = 80.0) -> Migration:
        """Make the rule of a metal, with its evaporation field.

        Parameters
        ----------
        material : Material or str
            With a cohesive energy; a str is looked up by `apt_evap.material`.
        temperature : float
            Of the specimen [K].

        Raises
        ------
        ValueError
            If the material has no cohesive energy.
        """
        crystal = as_material(material)
        if crystal.cohesive_energy is None:
            raise ValueError(f"material must have a cohesive_energy [eV], got {crystal!r}")
        return cls(crystal.cohesive_energy, crystal.evaporation_field, temperature)

    def _at(self, ratios):
        charges = AT_REST + BY_CHARGE * ratios
        gained = self.polarization * (charges * charges - 1.0)
        kt = BOLTZMANN * self.temperature
        return _fermi(gained - self.cost, kt)

    @property
    def polarization(self) -> float:
        """Polarisation energy of an atom at its site, alpha F^2 / 2 [eV]."""
        return 0.5 * self.polarizability / (1e-18 * ELEMENTARY_CHARGE) * self.field**2  # F m^2 to e nm^2/V

    @property
    def cost(self) -> float:
        """Bonds of the hop less the barrier of evaporation [eV]."""
        return self.bonds_lost * self.cohesive_energy - EVAPORATION_BARRIER * BOLTZMANN * self.temperature

    @property
    def gain_needed(self) -> float:
        """phi^2 - 1 above which an atom rolls up."""
        return self.cost / self.polarization

    @property
    def threshold(self) -> float:
        """Charge ratio of the strongest neighbour above which an atom rolls up; 0 if all do."""
        charge = max(self.gain_needed + 1.0, 0.0) ** 0.5
        return max((charge - AT_REST) / BY_CHARGE, 0.0)
