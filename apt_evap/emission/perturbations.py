"""Perturbations of the emission: start position of an ion, and its velocity along the surface.

A perturbation is any object with one method, ``launch(emissions, random) -> Launches``, over a batch of
emissions. The built-in ones use up to three random numbers per ion: the first is the quantile of the energy, the second
gives the azimuth, the third decides whether the ion rolls up. The model is that of Shaikh et al., arXiv 2509.13744; the
probability of a roll-up, the sharpness of the target and the launch height are additions to it.
"""

from __future__ import annotations  # `RollUp.of_metal` returns one

import json
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, Protocol

import numpy as np

from apt_evap._common.codec import (
    checked,
    few_digits,
    from_plain,
    is_settings,
    number,
    part,
    settings,
    to_plain,
    to_python,
)
from apt_evap._common.ion_random import IonRandom
from apt_evap._common.validation import check_array, check_number, short_text
from apt_evap._core.elementary import sine_and_cosine
from apt_evap.emission.emissions import Emissions, Launches, TangentialLaunches, choose_launches
from apt_evap.emission.energies import (
    DISTRIBUTIONS,
    Distribution,
    Thermal,
    TruncatedNormal,
    check_energy,
    draw_energies,
)
from apt_evap.emission.roll_probability import ChargeRatio, Migration, RollProbability
from apt_evap.emission.surface_frame import (
    launch_tangentially,
    roll_ups,
    rollup_direction,
    tangent_frame,
    target_shares,
)
from apt_evap.specimen.materials import Material
from apt_evap.units import speed_from_energy
from apt_evap.warnings import EmissionWarning, warn

__all__ = [
    "Combined",
    "Emissions",
    "IonRandom",
    "LateralVelocity",
    "Launches",
    "Mixture",
    "Perturbation",
    "RollUp",
    "TangentialLaunches",
    "TangentialPerturbation",
    "Thermal",
    "TruncatedNormal",
    "Unperturbed",
    "described",
    "launch_tangentially",
    "perturbation_of",
    "rollup_direction",
    "tangent_frame",
    "target_shares",
]


_PART_ALONG = 0.25
"""Mean energy along a roll-up, before truncation, over the polarisation energy of the atom at its site.

Selected, as the sharpness and the height, with maps of tungsten and nickel: parts of 0.22 to 0.30 with a sharpness of
1 to 1.5 give amplitudes of all lines within 0.72 and 1.33 of the measured ones, this one 0.8 to 1.25
(articles/three_metals).
"""
_SHARPNESS = 1.0
_HEIGHT_OF_ROLLED = 0.2
"""Height above the neighbour [nm]. Ions that do not roll up start from their sites, as maps of aluminium require."""
_ENERGY_OF_OTHERS = 0.4
"""Mean energy of ions that do not roll up, before truncation [eV]. Selected with a map of aluminium, 0.35 to 0.5."""


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
        """Compute which ions roll up, and the velocities along t1 and t2 of `tangent_frame` [nm/ns], each (n,).

        These three as a tuple, or with shares of targets and heights as `TangentialLaunches`.
        """
        ...


_HEIGHT = "Height of the start above the site, of a rolled ion above p_r."


def _probability(probability, name):
    """Probability of a roll-up: a number, or an object with a method `probabilities`."""
    is_function = callable(getattr(probability, "probabilities", None))
    return probability if is_function else check_number(probability, name, at_least=0, at_most=1)


class _Tangential:
    """Base of the built-in perturbations: `launch` from `tangential`."""

    def __repr__(self) -> str:
        return to_python(self, "", few_digits)

    def launch(self: TangentialPerturbation, emissions: Emissions, random: IonRandom) -> Launches:
        """Launch a batch of ions."""
        return launch_tangentially(emissions, *self.tangential(emissions, random))

    def _heights(self, n):
        return np.full(n, self.height) if self.height > 0 else None


@settings
class _Energetic:
    """Base of the perturbations with an energy, their first parameter."""

    energy: Distribution | float = part(
        "Energy E: any object with `quantile(u)`, or one number for all ions.",
        *DISTRIBUTIONS,
        check=check_energy,
        kind="distribution or float [eV]",
    )


@settings
class _Rolling(_Tangential):
    """Base of the perturbations with a roll-up, and their options."""

    probability: RollProbability | float = part(
        "Probability that an ion rolls up: one number, or an object such as `ChargeRatio` and `Migration`.",
        ChargeRatio,
        Migration,
        default=1.0,
        check=_probability,
        kind="float or RollProbability",
    )
    sharpness: float = number(
        "0: s is the neighbour of highest charge. Above 0: s is a mean of the three strongest ones with the weights of "
        "`target_shares`.",
        default=0.0,
        at_least=0,
        at_most=100,
    )
    height: float = number(_HEIGHT, default=0.0, at_least=0, at_most=1.0, unit="nm")
    others: Distribution | float | None = part(
        "Energy, in a random direction along the surface, of ions that do not roll up. By default they start at rest "
        "(`RollUp`), or with the random part of E (`Combined`).",
        *DISTRIBUTIONS,
        check=check_energy,
        kind="distribution or float [eV]",
        default=None,
    )
    others_height: float | None = number(
        "Height of the start above the site of ions that do not roll up. By default that of the ions that do.",
        default=None,
        at_least=0,
        at_most=1.0,
        unit="nm",
    )

    def _roll(self, emissions, random):
        """Launches with a roll-up of some ions."""
        n = len(emissions)
        certain = self.probability == 1.0
        u = random.uniform(2 if certain else 3)
        possible, first, second, shares = roll_ups(emissions, self.sharpness)
        rolled = possible.copy()
        if not certain:
            probability = self.probability
            drawn = u[:, 2] < (probability if isinstance(probability, float) else probability.probabilities(emissions))
            rolled = rolled & drawn
        energies = draw_energies(self.energy, u[:, 0])
        fraction = getattr(self, "rollup_fraction", 1.0)
        rolling = np.where(rolled, fraction * energies, 0.0)
        others = (1.0 - fraction) * energies if self.others is None else draw_energies(self.others, u[:, 0])
        lateral = np.where(rolled, (1.0 - fraction) * energies, others)
        speed = speed_from_energy(rolling, emissions.masses)
        random_speed = speed_from_energy(lateral, emissions.masses)
        sine, cosine = sine_and_cosine(2 * np.pi * u[:, 1])
        first, second = speed * first + random_speed * cosine, speed * second + random_speed * sine
        heights = self._heights(n)
        if self.others_height not in (None, self.height):
            heights = np.where(rolled, self.height, self.others_height)
        return TangentialLaunches(rolled, first, second, shares, heights)


@settings
class Unperturbed(_Tangential):
    """Every ion starts at rest from its site.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> hits = run.hits(ae.Unperturbed())
    >>> print(f"first ion at ({hits.x[0]:.0f}, {hits.y[0]:.0f}) mm")
    first ion at (57, 33) mm
    """

    height: float = number(_HEIGHT, default=0.0, at_least=0, at_most=1.0, unit="nm")

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """No ion rolls up; both velocities along the surface are zero: see `Combined.tangential`."""
        n = len(emissions)
        return TangentialLaunches(np.zeros(n, dtype=bool), np.zeros(n), np.zeros(n), None, self._heights(n))


@settings
class LateralVelocity(_Tangential, _Energetic):
    """Every ion starts from its site, with |v| = sqrt(2 E/m) in a random direction along the surface.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> rest, hits = run.hits(ae.Unperturbed()), run.hits(ae.LateralVelocity(0.2))
    >>> print(f"displaced by {np.nanmedian(np.hypot(hits.x - rest.x, hits.y - rest.y)):.1f} mm")
    displaced by 3.7 mm
    """

    height: float = number(_HEIGHT, default=0.0, at_least=0, at_most=1.0, unit="nm")

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """No ion rolls up; velocities along t1 and t2 [nm/ns]: see `Combined.tangential`."""
        u, n = random.uniform(2), len(emissions)
        speed = speed_from_energy(draw_energies(self.energy, u[:, 0]), emissions.masses)
        sine, cosine = sine_and_cosine(2 * np.pi * u[:, 1])
        return TangentialLaunches(np.zeros(n, dtype=bool), speed * cosine, speed * sine, None, self._heights(n))


@settings
class RollUp(_Rolling, _Energetic):
    """Ions roll up onto a neighbour and start there, in the direction of the roll-up.

    They start at p_r = s + d n, with |v| = sqrt(2 E/m) along the component of p_r - p perpendicular to n. By default
    every ion rolls up, and s is its surface nearest neighbour of highest charge, as in Shaikh et al. (2025). An ion
    that does not roll up, as it has no neighbour or by the probability, starts from its site.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> rest = run.hits(ae.Unperturbed())
    >>> for energy in (0.0, 0.2, 0.4):
    ...     hits = run.hits(ae.RollUp(energy))
    ...     print(f"{energy} eV: displaced by {np.nanmedian(np.hypot(hits.x - rest.x, hits.y - rest.y)):.0f} mm")
    0.0 eV: displaced by 15 mm
    0.2 eV: displaced by 18 mm
    0.4 eV: displaced by 19 mm
    """

    @classmethod
    def of_metal(cls, material: Material | str, temperature: float = 80.0, energy_scale: float = 1.0) -> RollUp:
        """Make the rule of a pure metal from its cohesive energy and evaporation field.

        Which ions roll up follows from `Migration`. Their mean energy is a quarter of the polarisation energy at the
        site, alpha F^2/2. The others start from their sites in random directions. The constants are the same for all
        metals: see :doc:`/results/three_metals`.

        Parameters
        ----------
        material : Material or str
            With a cohesive energy; a str is looked up by `apt_evap.material`.
        temperature : float
            Of the specimen [K].
        energy_scale : float
            Factor of all energies: 1 for runs in real units, the mean of `Run.energy_scales` for others.

        Returns
        -------
        RollUp
            For runs with ``rule=ConstantPotential()``.

        Examples
        --------
        >>> for metal in ("Al", "Ni", "W"):
        ...     print(f"{metal}: {ae.RollUp.of_metal(metal).energy.mean:.3f} eV along a roll-up")
        Al: 0.028 eV along a roll-up
        Ni: 0.096 eV along a roll-up
        W: 0.253 eV along a roll-up
        """
        law = Migration.of(material, temperature)
        energy_scale = check_number(energy_scale, "energy_scale", above=0)
        rolled, others = (
            TruncatedNormal(mean * energy_scale, mean * energy_scale)
            for mean in (_PART_ALONG * law.polarization, _ENERGY_OF_OTHERS)
        )
        return cls(rolled, law, _SHARPNESS, _HEIGHT_OF_ROLLED, others=others, others_height=0.0)

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """Compute which ions roll up, and the velocities along t1 and t2 [nm/ns]: see `Combined.tangential`."""
        return self._roll(emissions, random)


@settings
class _Divided(_Energetic):
    """Base of `Combined`: how the energy is divided comes before the options."""

    rollup_fraction: float = number(
        "Fraction of the energy for the roll-up; at 0 the ion still rolls up.", at_least=0, at_most=1
    )


@settings
class Combined(_Rolling, _Divided):
    """Roll-up with a fraction of the energy, plus a random direction with the rest; the velocities add.

    An ion that does not roll up, as it has no neighbour or by the probability, starts from its site with the random
    part only.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> rolled = run.hits(ae.RollUp(0.2))
    >>> for fraction in (1.0, 0.5):
    ...     hits = run.hits(ae.Combined(0.2, rollup_fraction=fraction))
    ...     print(f"{fraction}: {np.nanmedian(np.hypot(hits.x - rolled.x, hits.y - rolled.y)):.0f} mm from the roll-up")
    1.0: 0 mm from the roll-up
    0.5: 3 mm from the roll-up
    """

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """Compute which ions roll up, and their velocities along the surface.

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
            and if they are not the default, the shares of the targets, and the heights.
        """
        return self._roll(emissions, random)


def _members(perturbations, name):
    """Perturbations of a mixture as a tuple."""
    members = tuple(perturbations) if isinstance(perturbations, list | tuple) else ()
    if len(members) < 2 or not all(callable(getattr(member, "tangential", None)) for member in members):
        raise ValueError(
            f"{name} must be two or more perturbations with a method `tangential`, such as (RollUp(0.2), "
            f"LateralVelocity(0.2)), got {short_text(perturbations)}"
        )
    return members


def _weights(weights, name):
    return tuple(check_number(weight, name, above=0) for weight in check_array(weights, name, ("n",)).tolist())


def _read_members(plain, name):
    return [perturbation_of(member) if isinstance(member, Mapping) else member for member in plain]


@settings
class Mixture(_Tangential):
    """Each ion follows one of several perturbations, drawn by a separate random number.

    Examples
    --------
    Seven of ten ions roll up, the others leave in random directions with less energy:

    >>> mixture = ae.emission.Mixture((ae.RollUp(0.4), ae.LateralVelocity(0.1)), (7, 3))
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> hits, rolled = run.hits(mixture), run.hits(ae.RollUp(0.4))
    >>> print(f"{np.mean(hits.x == rolled.x):.2f} of all ions rolled up and hit")
    0.78 of all ions rolled up and hit
    """

    perturbations: Sequence[TangentialPerturbation] = checked(
        "Two or more, with a method `tangential`. One that is followed has the same random numbers as alone.",
        "sequence of perturbations",
        _members,
        read=_read_members,
    )
    weights: Sequence[float] | None = checked(
        "Positive numbers in proportion to the parts of the ions, shape (n,); by default the parts are equal.",
        "sequence of float",
        _weights,
        default=None,
    )

    def _check(self):
        if self.weights is not None and len(self.weights) != len(self.perturbations):
            raise ValueError(f"weights must be {len(self.perturbations)} numbers, got {len(self.weights)}")

    def tangential(self, emissions: Emissions, random: IonRandom) -> TangentialLaunches:
        """Launches of the perturbation that each ion follows: see `Combined.tangential`."""
        copies = [copy(random) for _ in self.perturbations]
        launches = [
            TangentialLaunches(*perturbation.tangential(emissions, stream))
            for perturbation, stream in zip(self.perturbations, copies, strict=True)
        ]
        u = random.uniform(max(stream.n_used for stream in copies) - random.n_used + 1)[:, -1]  # none of theirs
        parts = np.cumsum(self.weights or np.ones(len(launches)))
        return choose_launches(launches, np.searchsorted(parts[:-1] / parts[-1], u, side="right"))


PERTURBATIONS = (Unperturbed, LateralVelocity, RollUp, Combined, Mixture)
"""The built-in perturbations."""


def described(perturbation: Any) -> dict[str, Any]:
    """Description of a perturbation in a file: its plain form, or of a user-defined one the name and `repr`."""
    if isinstance(perturbation, dict):  # of a loaded run
        return perturbation
    if is_settings(perturbation):
        return to_plain(perturbation)
    return {"name": type(perturbation).__name__, "repr": repr(perturbation)}


def perturbation_text(perturbation: Any) -> str:
    """Text of a perturbation, or of the description of one in a file."""
    return perturbation.get("repr", json.dumps(perturbation)) if isinstance(perturbation, dict) else repr(perturbation)


def perturbation_of(perturbation: Any) -> Any:
    """Rebuild a built-in perturbation from its plain form; ValueError otherwise."""
    return from_plain(perturbation, *PERTURBATIONS, what="perturbation")


def warn_if_not_for(rule: str | None, perturbation: Any, elements: Sequence[str] = ()) -> None:
    """Warn if a perturbation, or one of a mixture, has a `Migration`: not for Robin's charges, nor for alloys.

    `rule` is the name of the charging rule, None if it is not known; `elements` are those that evaporate.
    """
    if rule != "Robin" and len(elements) < 2:
        return
    members = [perturbation]
    for member in members:  # grows while it is read
        members += getattr(member, "perturbations", ())
    laws = [getattr(member, name, None) for member in members for name in ("probability", "hop")]
    if not any(isinstance(law, Migration) for law in laws):
        return
    if len(elements) > 1:
        warn(
            f"Migration has the numbers of one metal, but atoms of {', '.join(elements)} evaporate: all of them roll "
            "up like atoms of this metal, which is at best right for those of a dilute alloy's host",
            EmissionWarning,
        )
    if rule == "Robin":
        warn(
            "Migration holds for charges at a constant potential, but those of this run follow from Robin's rule, with "
            "which other atoms roll up: run with rule=ConstantPotential(), or [rule] in a settings file",
            EmissionWarning,
        )
