"""Perturbations of the emission: start position of an ion, and its velocity along the surface.

A perturbation is any object with one method, ``launch(emissions, random) -> Launches``, over a batch of
emissions. The built-in ones use two random numbers per ion: the first is the quantile of the energy, the second gives
the azimuth. The model is that of Shaikh et al., arXiv 2509.13744.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_kind, check_number, did_you_mean, short_text
from apt_evap._core.elementary import sine_and_cosine
from apt_evap.emission.emissions import Emissions, Launches
from apt_evap.emission.energies import (
    DISTRIBUTIONS,
    Distribution,
    Fixed,
    Thermal,
    TruncatedNormal,
    as_distribution,
    draw_energies,
)
from apt_evap.emission.ion_random import IonRandom
from apt_evap.emission.surface_frame import launch_tangentially, rollup_direction, tangent_frame
from apt_evap.units import speed_from_energy

__all__ = [
    "Combined",
    "Emissions",
    "Fixed",
    "IonRandom",
    "LateralVelocity",
    "Launches",
    "Perturbation",
    "RollUp",
    "TangentialPerturbation",
    "Thermal",
    "TruncatedNormal",
    "Unperturbed",
    "from_dict",
    "launch_tangentially",
    "rollup_direction",
    "tangent_frame",
    "to_dict",
]


class Perturbation(Protocol):
    """Interface of a perturbation."""

    def launch(self, emissions: Emissions, random: IonRandom) -> Launches:
        """Launch a batch of ions: positions [nm], velocities [nm/ns], and which ions rolled up."""
        ...


class TangentialPerturbation(Perturbation, Protocol):
    """Interface of a perturbation that only adds velocities along the surface.

    A run with stored responses evaluates its hits without further flights.
    """

    def tangential(self, emissions: Emissions, random: IonRandom) -> tuple[Booleans, Floats, Floats]:
        """Which ions roll up, and the velocities along t1 and t2 of `tangent_frame` [nm/ns], each of shape (n,)."""
        ...


class _Tangential:
    """Base of the built-in perturbations: `launch` from `tangential`."""

    def launch(self: TangentialPerturbation, emissions: Emissions, random: IonRandom) -> Launches:
        """Launch a batch of ions.

        Parameters
        ----------
        emissions : Emissions
            A batch of n.
        random : IonRandom
            Random numbers of these ions.

        Returns
        -------
        Launches
        """
        return launch_tangentially(emissions, *self.tangential(emissions, random))

    def _draw(self, emissions, random):
        u = random.uniform(2)
        return draw_energies(self.energy, u[:, 0]), 2 * np.pi * u[:, 1]


@dataclass(frozen=True)
class Unperturbed(_Tangential):
    """Every ion starts at rest from its site."""

    def tangential(self, emissions: Emissions, random: IonRandom) -> tuple[Booleans, Floats, Floats]:
        """No ion rolls up; both velocities along the surface are zero: see `Combined.tangential`."""
        n = len(emissions)
        return np.zeros(n, dtype=bool), np.zeros(n), np.zeros(n)


@dataclass(frozen=True)
class LateralVelocity(_Tangential):
    """Every ion starts from its site, with |v| = sqrt(2 E/m) in a random direction along the surface.

    Parameters
    ----------
    energy : distribution or float
        Energy E: any object with `quantile(u)` [eV], or one number for all ions [eV].
    """

    energy: Distribution | float

    def __post_init__(self):
        object.__setattr__(self, "energy", as_distribution(self.energy))

    def tangential(self, emissions: Emissions, random: IonRandom) -> tuple[Booleans, Floats, Floats]:
        """No ion rolls up; velocities along t1 and t2 [nm/ns]: see `Combined.tangential`."""
        energy, azimuth = self._draw(emissions, random)
        speed = speed_from_energy(energy, emissions.masses)
        sine, cosine = sine_and_cosine(azimuth)
        return np.zeros(len(emissions), dtype=bool), speed * cosine, speed * sine


@dataclass(frozen=True)
class RollUp(_Tangential):
    """Every ion rolls up onto its neighbour of highest charge and starts there, in the direction of the roll-up.

    It starts at p_r = s + d n, with |v| = sqrt(2 E/m) along the component of p_r - p perpendicular to n. An ion without
    a neighbour does not roll up: it starts at rest from its site.

    Parameters
    ----------
    energy : distribution or float
        Energy E: any object with `quantile(u)` [eV], or one number for all ions [eV].
    """

    energy: Distribution | float

    def __post_init__(self):
        object.__setattr__(self, "energy", as_distribution(self.energy))

    def tangential(self, emissions: Emissions, random: IonRandom) -> tuple[Booleans, Floats, Floats]:
        """Which ions roll up, and the velocities along t1 and t2 [nm/ns]: see `Combined.tangential`."""
        energy, _ = self._draw(emissions, random)
        speed = speed_from_energy(energy, emissions.masses)
        rolled, first, second = rollup_direction(emissions)
        return rolled, speed * first, speed * second


@dataclass(frozen=True)
class Combined(_Tangential):
    """Roll-up with a fraction of the energy, plus a random direction with the rest; the velocities add.

    An ion without a neighbour does not roll up: it starts from its site with the random part only.

    Parameters
    ----------
    energy : distribution or float
        Energy E: any object with `quantile(u)` [eV], or one number for all ions [eV].
    rollup_fraction : float
        Fraction of the energy for the roll-up, from 0 to 1; at 0 the ion still rolls up.
    """

    energy: Distribution | float
    rollup_fraction: float

    def __post_init__(self):
        fraction = check_number(self.rollup_fraction, "rollup_fraction", at_least=0, at_most=1)
        object.__setattr__(self, "energy", as_distribution(self.energy))
        object.__setattr__(self, "rollup_fraction", fraction)

    def tangential(self, emissions: Emissions, random: IonRandom) -> tuple[Booleans, Floats, Floats]:
        """Which ions roll up, and their velocities along the surface.

        Parameters
        ----------
        emissions : Emissions
            A batch of n.
        random : IonRandom
            Random numbers of these ions.

        Returns
        -------
        tuple of ndarray
            Whether each ion rolls up, and its velocity along t1 and t2 of `tangent_frame` [nm/ns], each of
            shape (n,).
        """
        energy, azimuth = self._draw(emissions, random)
        rolled, first, second = rollup_direction(emissions)
        rolling = speed_from_energy(self.rollup_fraction * energy, emissions.masses)
        lateral = speed_from_energy((1 - self.rollup_fraction) * energy, emissions.masses)
        sine, cosine = sine_and_cosine(azimuth)
        return rolled, rolling * first + lateral * cosine, rolling * second + lateral * sine


PERTURBATIONS = {kind.__name__: kind for kind in (Unperturbed, LateralVelocity, RollUp, Combined)}
"""The built-in perturbations by name."""


def to_dict(perturbation: Any) -> dict[str, Any]:
    """Name and parameters of a perturbation or a distribution, in plain types, for files.

    A user-defined one is described by its name and `repr`: enough to recognise it, not to rebuild it.

    Parameters
    ----------
    perturbation : object
        A perturbation or a distribution.

    Returns
    -------
    dict
    """
    name = type(perturbation).__name__
    if type(perturbation) not in (*PERTURBATIONS.values(), *DISTRIBUTIONS.values()):
        return {"name": name, "repr": repr(perturbation)}
    values = {item.name: getattr(perturbation, item.name) for item in fields(perturbation)}
    return {"name": name} | {
        key: value if isinstance(value, float) else to_dict(value) for key, value in values.items()
    }


def from_dict(settings: Mapping[str, Any]) -> Any:
    """Rebuild a perturbation or distribution from the result of `to_dict`.

    Parameters
    ----------
    settings : mapping
        Its "name" and parameters.

    Returns
    -------
    object

    Raises
    ------
    ValueError
        If the name or a parameter is unknown, or if a parameter is missing.
    """
    known = PERTURBATIONS | DISTRIBUTIONS
    name = check_kind(settings, "settings", Mapping, "a mapping with a name and parameters").get("name")
    if not isinstance(name, str) or name not in known:
        hint = did_you_mean(name, known)
        raise ValueError(
            f"no perturbation or distribution is named {short_text(name)}{hint}; known are {', '.join(known)}"
        )
    parameters = {key: value for key, value in settings.items() if key != "name"}
    expected = {item.name for item in fields(known[name])}
    if set(parameters) != expected:
        lists = [", ".join(sorted(names)) or "no parameters" for names in (expected, parameters)]
        raise ValueError(f"{name} needs {lists[0]}, got {lists[1]}")
    parameters = {key: from_dict(value) if isinstance(value, dict) else value for key, value in parameters.items()}
    return known[name](**parameters)
