"""Energy distributions: any object with a method `quantile(u)`."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from functools import lru_cache
from numbers import Real
from typing import Any, Protocol

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import number, settings
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_number, short_text
from apt_evap._core.elementary import logarithm, normal_quantile
from apt_evap.units import BOLTZMANN

HIGHEST_ENERGY = 100.0  # [eV]: ten times any bond energy; finds wrong units, such as 155 (meV)


_PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534")


class Distribution(Protocol):
    """Interface of an energy distribution, such as `TruncatedNormal` and `Thermal`."""

    def quantile(self, u: Floats) -> Floats:
        """Energy [eV] below which the fraction `u` (in (0, 1), any shape) of the distribution lies."""
        ...


@lru_cache(maxsize=1024)
def normal_probability(x: float) -> float:
    """Probability below `x` of the standard normal distribution, correctly rounded; 0 below -12 and 1 above 12.

    Decimal numbers have the same digits on every machine, which the error function of the C library has not.
    """
    if abs(x) > 12.0:  # 2e-33
        return float(x > 0.0)
    with localcontext() as context:
        context.prec = 90  # the sum cancels to 33 digits
        exact = Decimal(x)
        term = total = exact
        order = 1
        while abs(term) > Decimal("1e-60"):  # x + x^3 / 3 + x^5 / (3 * 5) + ...
            order += 2
            term *= exact * exact / order
            total += term
        density = (-exact * exact / 2).exp() / (2 * _PI).sqrt()
        return float(Decimal("0.5") + density * total)


@settings
class TruncatedNormal:
    """Normal distribution of the energy, truncated below zero.

    Examples
    --------
    >>> energy = ae.TruncatedNormal(mean=0.1, standard_deviation=0.1)
    >>> round(energy.true_mean, 3)  # eV, after the truncation
    0.129
    >>> ae.RollUp(energy)
    RollUp(TruncatedNormal(0.1, 0.1))
    """

    mean: float = number("Mean before the truncation.", at_least=0, at_most=HIGHEST_ENERGY, unit="eV")
    standard_deviation: float = number(
        "Standard deviation before the truncation.", above=0, at_most=HIGHEST_ENERGY, unit="eV"
    )

    def quantile(self, u: ArrayLike) -> Floats:
        """Energy [eV] below which the fraction `u` (in (0, 1), any shape) of the distribution lies."""
        u = np.asarray(u, dtype=np.float64)
        ratio = self.mean / self.standard_deviation
        lower = normal_probability(-ratio) + u * normal_probability(ratio)
        # the smaller tail is used: it keeps full precision
        upper = (1 - u) * normal_probability(ratio)
        deviate = normal_quantile(np.minimum(lower, upper))
        deviate = np.where(lower < 0.5, deviate, -deviate)
        return np.maximum(self.mean + self.standard_deviation * deviate, np.finfo(np.float64).tiny)

    @property
    def true_mean(self) -> float:
        """Mean of the truncated distribution [eV]."""
        return self.mean + self.standard_deviation * self._hazard()

    @property
    def true_standard_deviation(self) -> float:
        """Standard deviation of the truncated distribution [eV]."""
        hazard = self._hazard()
        ratio = self.mean / self.standard_deviation
        return self.standard_deviation * math.sqrt(1 - hazard * (ratio + hazard))

    def _hazard(self):
        ratio = self.mean / self.standard_deviation
        return math.exp(-0.5 * ratio * ratio - scipy.special.log_ndtr(ratio)) / math.sqrt(2 * math.pi)


@settings
class Thermal:
    """Energy of the thermal motion along the surface: exponential, with the mean k T.

    Notes
    -----
    Each of the two tangential velocities has a normal distribution of variance k T / m (Maxwell-Boltzmann). The sum of
    their energies therefore has an exponential distribution.
    """

    temperature: float = number("Temperature.", above=0, at_most=1e5, unit="K")

    def quantile(self, u: ArrayLike) -> Floats:
        """Energy [eV] below which the fraction `u` (in (0, 1), any shape) of the distribution lies."""
        return -BOLTZMANN * self.temperature * logarithm(1.0 - np.asarray(u, dtype=np.float64))


DISTRIBUTIONS = (TruncatedNormal, Thermal)
"""The built-in distributions."""


def check_energy(energy: Any, name: str) -> Distribution | float:
    """Return a distribution, or one number for all ions [eV]; ValueError otherwise."""
    if isinstance(energy, Real) and not isinstance(energy, bool):
        return check_number(energy, name, at_least=0, at_most=HIGHEST_ENERGY, unit="eV")
    if not callable(getattr(energy, "quantile", None)):
        raise ValueError(f"{name} must be a number [eV] or have a method quantile(u), got {short_text(energy)}")
    return energy


def draw_energies(energy: Distribution | float, u: Floats) -> Floats:
    """Energies [eV] at the uniform numbers `u`, shape (n,); ValueError if negative or not finite."""
    if isinstance(energy, float):
        return np.full(len(u), energy)
    energies = check_array(energy.quantile(u), f"quantiles of {energy!r}", (len(u),))
    if energies.size and energies.min() < 0:
        raise ValueError(f"quantiles of {energy!r} must be >= 0 [eV], got {energies.min()}")
    return energies
