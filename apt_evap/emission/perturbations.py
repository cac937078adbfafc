"""Perturbations of the emission: start position of an ion, and its velocity along the surface.

A perturbation is any object with one method, ``launch(emissions, random) -> Launches``, over a batch of
emissions. The built-in ones use up to four random numbers per ion: the first is the quantile of the energy, the second
gives the azimuth, the third decides whether the ion rolls up, the fourth whether it does so twice. The model is that of
Shaikh et al., arXiv 2509.13744; the probability of a roll-up and of a second one, the sharpness of the target and the
launch height are additions to it.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, Protocol

import numpy as np

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_number, did_you_mean, short_text
from apt_evap._core.elementary import exponential, sine_and_cosine
from apt_evap.emission.emissions import Emissions, Launches, TangentialLaunches
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
from apt_evap.emission.surface_frame import (
    launch_tangentially,
    rollup_direction,
    second_direction,
    tangent_frame,
    target_shares,
)
from apt_evap.units import speed_from_energy

__all__ = [
    "ChargeRatio",
    "Combined",
    "Emissions",
    "Fixed",
    "IonRandom",
    "LateralVelocity",
    "Launches",
    "Perturbation",
    "RollProbability",
    "RollUp",
    "TangentialLaunches",
    "TangentialPerturbation",
    "Thermal",
    "TruncatedNormal",
    "Unperturbed",
    "from_dict",
    "launch_tangentially",
    "rollup_direction",
    "tangent_frame",
    "target_shares",
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

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches | tuple:
        """Which ions roll up, and the velocities along t1 and t2 of `tangent_frame` [nm/ns], each of shape (n,).

        These three as a tuple, or with shares of targets and heights as `TangentialLaunches`.
        """
        ...


class RollProbability(Protocol):
    """Interface of a probability that an ion rolls up."""

    def probabilities(self, emissions: Emissions) -> Floats:
        """Probability of each ion of a batch, from 0 to 1, shape (n,)."""
        ...


@dataclass(frozen=True)
class ChargeRatio:
    """Probability of a roll-up by the charge of the strongest neighbour over that of the atom.

    Parameters
    ----------
    threshold : float
        Ratio at which half of the atoms roll up. In runs of fcc and bcc tips the median ratio is about 0.9.
    width : float
        Width of the transition; 0 for a step.

    Notes
    -----
    p = 1 / (1 + exp(-(ratio - threshold) / width)).
    """

    threshold: float
    width: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "threshold", check_number(self.threshold, "threshold", at_least=0, at_most=10))
        object.__setattr__(self, "width", check_number(self.width, "width", at_least=0, at_most=10))

    def probabilities(self, emissions: Emissions) -> Floats:
        """Probability of each ion, shape (n,); 0 without a neighbour. ValueError if the emissions have no targets."""
        if emissions.charge_ratios is None:
            raise ValueError(
                "ChargeRatio needs the charges of the neighbours, which this run does not have: run with "
                "response_settings=ResponseSettings.wide()"
            )
        ratios = emissions.charge_ratios[:, 0]
        excess = np.where(np.isfinite(ratios), ratios, 0.0) - self.threshold
        if self.width == 0.0:
            return (excess > 0).astype(float)
        return 1.0 / (1.0 + exponential(np.clip(-excess / self.width, -700.0, 700.0)))


class _Tangential:
    """Base of the built-in perturbations: `launch` from `tangential`."""

    def __repr__(self) -> str:
        values = ((item, getattr(self, item.name)) for item in fields(self))  # type: ignore[arg-type]
        options = ", ".join(f"{item.name}={value!r}" for item, value in values if value != item.default)
        return f"{type(self).__name__}({options})"

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

    def _check(self, *distributions):
        """Validate the fields that several perturbations have."""
        for name in distributions:
            object.__setattr__(self, name, as_distribution(getattr(self, name)))
        height = check_number(self.height, "height", at_least=0, at_most=1.0, unit="nm")
        object.__setattr__(self, "height", height)

    def _heights(self, n):
        return np.full(n, self.height) if self.height > 0 else None


class _Rolling(_Tangential):
    """Base of the perturbations with a roll-up."""

    def _check_roll(self):
        if not callable(getattr(self.probability, "probabilities", None)):
            probability = check_number(self.probability, "probability", at_least=0, at_most=1)
            object.__setattr__(self, "probability", probability)
        sharpness = check_number(self.sharpness, "sharpness", at_least=0, at_most=100)
        object.__setattr__(self, "sharpness", sharpness)
        second_roll = check_number(self.second_roll, "second_roll", at_least=0, at_most=1)
        object.__setattr__(self, "second_roll", second_roll)

    def _roll(self, emissions, random):
        """Launches with a roll-up of some ions."""
        n = len(emissions)
        certain = self.probability == 1.0
        u = random.uniform(4 if self.second_roll else 2 if certain else 3)
        shares = None if self.sharpness == 0.0 else target_shares(emissions, self.sharpness)
        rolled, first, second = rollup_direction(emissions, shares)
        if not certain:
            given = self.probability
            wanted = u[:, 2] < (given if isinstance(given, float) else given.probabilities(emissions))
            rolled = rolled & wanted
        twice = second_shares = None
        if self.second_roll:
            if shares is not None:
                second_shares = target_shares(emissions, self.sharpness, second=True)
            can_roll_twice, onward, aside = second_direction(emissions, shares, second_shares)
            twice = rolled & can_roll_twice & (u[:, 3] < self.second_roll)
            first, second = np.where(twice, onward, first), np.where(twice, aside, second)
        energies = draw_energies(self.energy, u[:, 0])
        fraction = getattr(self, "rollup_fraction", 1.0)
        rolling = np.where(rolled, fraction * energies, 0.0)
        others = (1.0 - fraction) * energies if self.others is None else draw_energies(self.others, u[:, 0])
        lateral = np.where(rolled, (1.0 - fraction) * energies, others)
        speed = speed_from_energy(rolling, emissions.masses)
        random_speed = speed_from_energy(lateral, emissions.masses)
        sine, cosine = sine_and_cosine(2 * np.pi * u[:, 1])
        first, second = speed * first + random_speed * cosine, speed * second + random_speed * sine
        return TangentialLaunches(rolled, first, second, shares, self._heights(n), twice, second_shares)


@dataclass(frozen=True, repr=False)
class Unperturbed(_Tangential):
    """Every ion starts at rest from its site.

    Parameters
    ----------
    height : float
        Height of the start above the site [nm]; above 0 it needs wide responses (`ResponseSettings.wide`).
    """

    height: float = 0.0

    def __post_init__(self):
        self._check()

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """No ion rolls up; both velocities along the surface are zero: see `Combined.tangential`."""
        n = len(emissions)
        return TangentialLaunches(np.zeros(n, dtype=bool), np.zeros(n), np.zeros(n), None, self._heights(n))


@dataclass(frozen=True, repr=False)
class LateralVelocity(_Tangential):
    """Every ion starts from its site, with |v| = sqrt(2 E/m) in a random direction along the surface.

    Parameters
    ----------
    energy : distribution or float
        Energy E: any object with `quantile(u)` [eV], or one number for all ions [eV].
    height : float
        Height of the start above the site [nm]; above 0 it needs wide responses (`ResponseSettings.wide`).
    """

    energy: Distribution | float
    height: float = 0.0

    def __post_init__(self):
        self._check("energy")

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """No ion rolls up; velocities along t1 and t2 [nm/ns]: see `Combined.tangential`."""
        u, n = random.uniform(2), len(emissions)
        speed = speed_from_energy(draw_energies(self.energy, u[:, 0]), emissions.masses)  # type: ignore[arg-type]
        sine, cosine = sine_and_cosine(2 * np.pi * u[:, 1])
        return TangentialLaunches(np.zeros(n, dtype=bool), speed * cosine, speed * sine, None, self._heights(n))


@dataclass(frozen=True, repr=False)
class RollUp(_Rolling):
    """Ions roll up onto a neighbour and start there, in the direction of the roll-up.

    They start at p_r = s + d n, with |v| = sqrt(2 E/m) along the component of p_r - p perpendicular to n. By default
    every ion rolls up, and s is its surface nearest neighbour of highest charge, as in the paper. An ion that does not
    roll up, as it has no neighbour or by the probability, starts from its site.

    Parameters
    ----------
    energy : distribution or float
        Energy E: any object with `quantile(u)` [eV], or one number for all ions [eV].
    probability : float or RollProbability
        Probability that an ion rolls up: one number, or an object such as `ChargeRatio`.
    sharpness : float
        0: s is the neighbour of highest charge. Above 0: s is a mean of the three strongest ones with the weights of
        `target_shares`; this needs wide responses (`ResponseSettings.wide`).
    height : float
        Height of the start above p_r, or above the site [nm]; above 0 it needs wide responses.
    others : distribution or float, optional
        Energy, in a random direction along the surface, of ions that do not roll up [eV]; by default they start at
        rest.
    second_roll : float
        Probability that an ion that rolls up rolls once more, from above its strongest neighbour onto the strongest
        one of those beyond, and starts there, in the direction of this last step. Beyond are the surface neighbours of
        the neighbour that are no neighbours of the site; an ion without any rolls once. Above 0 it needs responses with
        ``rolls=2`` (`ResponseSettings`).
    """

    energy: Distribution | float
    probability: "RollProbability | float" = 1.0
    sharpness: float = 0.0
    height: float = 0.0
    others: Distribution | float | None = None
    second_roll: float = 0.0

    def __post_init__(self):
        self._check("energy", *(("others",) if self.others is not None else ()))
        self._check_roll()

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """Which ions roll up, and the velocities along t1 and t2 [nm/ns]: see `Combined.tangential`."""
        return self._roll(emissions, random)


@dataclass(frozen=True, repr=False)
class Combined(_Rolling):
    """Roll-up with a fraction of the energy, plus a random direction with the rest; the velocities add.

    An ion that does not roll up, as it has no neighbour or by the probability, starts from its site with the random
    part only.

    Parameters
    ----------
    energy : distribution or float
        Energy E: any object with `quantile(u)` [eV], or one number for all ions [eV].
    rollup_fraction : float
        Fraction of the energy for the roll-up, from 0 to 1; at 0 the ion still rolls up.
    probability, sharpness, height : float
        As in `RollUp`.
    others : distribution or float, optional
        Energy of ions that do not roll up [eV]; by default the random part of E.
    second_roll : float
        As in `RollUp`.
    """

    energy: Distribution | float
    rollup_fraction: float
    probability: "RollProbability | float" = 1.0
    sharpness: float = 0.0
    height: float = 0.0
    others: Distribution | float | None = None
    second_roll: float = 0.0

    def __post_init__(self):
        fraction = check_number(self.rollup_fraction, "rollup_fraction", at_least=0, at_most=1)
        object.__setattr__(self, "rollup_fraction", fraction)
        self._check("energy", *(("others",) if self.others is not None else ()))
        self._check_roll()

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """Which ions roll up, and their velocities along the surface.

        Parameters
        ----------
        emissions : Emissions
            A batch of n.
        random : IonRandom
            Random numbers of these ions.

        Returns
        -------
        TangentialLaunches
            Whether each ion rolls up, its velocity along t1 and t2 of `tangent_frame` [nm/ns], each of shape (n,),
            and if they are not the default, the shares of the targets, the heights, and which ions roll up twice.
        """
        return self._roll(emissions, random)


PERTURBATIONS = {kind.__name__: kind for kind in (Unperturbed, LateralVelocity, RollUp, Combined)}
"""The built-in perturbations by name."""
PROBABILITIES = {kind.__name__: kind for kind in (ChargeRatio,)}
"""The built-in probabilities of a roll-up by name."""


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
    if type(perturbation) not in (*PERTURBATIONS.values(), *DISTRIBUTIONS.values(), *PROBABILITIES.values()):
        return {"name": name, "repr": repr(perturbation)}
    values = {item.name: (getattr(perturbation, item.name), item.default) for item in fields(perturbation)}
    return {"name": name} | {
        key: value if isinstance(value, float) else to_dict(value)
        for key, (value, default) in values.items()
        if value != default  # as in files of earlier versions, which did not have these options
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
    known = PERTURBATIONS | DISTRIBUTIONS | PROBABILITIES
    name = check_kind(settings, "settings", Mapping, "a mapping with a name and parameters").get("name")
    if not isinstance(name, str) or name not in known:
        hint = did_you_mean(name, known)
        raise ValueError(
            f"no perturbation or distribution is named {short_text(name)}{hint}; known are {', '.join(known)}"
        )
    parameters = {key: value for key, value in settings.items() if key != "name"}
    expected = {item.name: item.default is MISSING for item in fields(known[name])}
    if not {key for key, needed in expected.items() if needed} <= set(parameters) <= set(expected):
        optional = [f"{key} (optional)" for key, needed in expected.items() if not needed]
        lists = sorted(key for key, needed in expected.items() if needed) + optional, sorted(parameters)
        raise ValueError(f"{name} needs {', got '.join(', '.join(each) or 'no parameters' for each in lists)}")
    parameters = {key: from_dict(value) if isinstance(value, dict) else value for key, value in parameters.items()}
    return known[name](**parameters)
