"""The response of an ion: position and time of its hit, as polynomials of its launch.

The detector position of an ion is a smooth function of its two tangential launch velocities, of the height of its start
and, after a roll-up, of the place between the targets. Some flights determine one polynomial for launches from the
site, and another for launches after a roll-up. Together they give the hits of any perturbation along the surface,
without further flights.

The fitted quantities are the stereographic direction (see `Detector.directions`), and the time of flight times the
cosine of the polar angle. They are smoother than the detector position, which diverges for ions that fly parallel to
the detector.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import count, number, part, settings
from apt_evap._common.small_matrices import squared_lengths
from apt_evap._common.types import Booleans, Floats
from apt_evap.detection.detector import Detector
from apt_evap.emission.emissions import Emissions, TangentialLaunches
from apt_evap.emission.energies import HIGHEST_ENERGY
from apt_evap.emission.surface_frame import along_surface, shared_positions
from apt_evap.simulation.flight.landing import Ends, land
from apt_evap.simulation.flight.launch_designs import (
    FIRST_VELOCITY,
    HEIGHT,
    SECOND,
    SECOND_VELOCITY,
    THIRD,
    VARIABLES,
    Design,
    height_variable,
    heights_of,
    places_of,
    shares_of,
)
from apt_evap.units import FLIGHT_TIME
from apt_evap.warnings import ResponseWarning, warn

_ROUNDING = 1e-9  # of shares and heights
_STEP = 2.0**-20
"""Coefficients are multiples of this, so that files become small: it moves hits at 100 mm by 0.2 to 0.3 um (RMS).

Those of times are multiples of the largest power of two below the first one of the ion, times this.
"""


@settings
class ResponseSettings:
    """Flights and polynomials of the responses.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> settings = ae.ResponseSettings(energy_limit=3.0)
    >>> run = ae.Simulation(tip, seed=1, response_settings=settings).run(50)
    >>> run.hits(ae.RollUp(2.5, sharpness=0.15, height=0.1))
    <Hits: 50 ions, 50 detected from 'simulation, RollUp(2.5, sharpness=0.15, height=0.1)'; x, y, time_of_flight, ...>
    """

    energy_limit: float = number(
        "Largest energy of the launches; above it the polynomials extrapolate.",
        default=1.5,
        above=0,
        at_most=HIGHEST_ENERGY,
        unit="eV",
    )
    site: Design = part(
        "Launches from the site.",
        Design,
        default=Design((5, 4, 2, 1, 0), ((0.0, 1), (0.5, 5), (0.75, 7), (1.0, 11)), 62),
    )
    rolled: Design = part(
        "Launches after a roll-up, from any place between the targets.",
        Design,
        default=Design((3, 2, 1, 0), ((0.0, 1), (0.6, 5), (1.0, 7)), 78, place=True),
    )
    bound: float = number(
        "Residual of a fit on the detector above which an ion is flagged.", default=0.2, above=0, unit="mm"
    )
    height: float = number("Largest height of the launches.", default=0.2, above=0, at_most=1.0, unit="nm")
    shells: int = count(
        "Shells of neighbours that can be targets of a roll-up: 1 for nearest neighbours, 2 also for second ones, "
        "which in bcc are only 15 % more distant.",
        default=1,
        at_least=1,
        at_most=2,
    )

    def _check(self):
        if self.site.place or not self.rolled.place:
            raise ValueError(
                f"site must be a Design without and rolled one with a place, got {self.site.place} and "
                f"{self.rolled.place}"
            )

    @property
    def designs(self) -> tuple[Design, Design]:
        """Designs of the launches from the site, and after a roll-up."""
        return self.site, self.rolled

    def variables(self, launches: TangentialLaunches, masses: ArrayLike) -> Floats:
        """Variables of the designs for n launches, shape (n, 5); ValueError if the responses do not serve them."""
        n = len(launches.rolled)
        variables = np.zeros((n, len(VARIABLES)))
        velocities = self.reduced(np.column_stack([launches.first, launches.second]), masses)
        variables[:, [FIRST_VELOCITY, SECOND_VELOCITY]] = velocities
        if launches.shares is not None:
            places = np.where(np.asarray(launches.rolled)[:, None], places_of(launches.shares), 0.0)
            rest = 1.0 - places[:, 0] - places[:, 1]
            wrong = np.flatnonzero(~((places > -_ROUNDING).all(axis=1) & (rest > -_ROUNDING)))
            if len(wrong):
                raise ValueError(
                    "the responses serve shares that do not increase from the strongest neighbour on, got "
                    f"{launches.shares[wrong[0]].tolist()}: fly this perturbation in the run (`emissions`)"
                )
            variables[:, [SECOND, THIRD]] = places
        if launches.heights is not None:
            if n and launches.heights.max() > self.height * (1.0 + _ROUNDING):
                raise ValueError(
                    f"the responses of this run serve heights up to {self.height:g} nm, got "
                    f"{launches.heights.max():g} nm: run with ResponseSettings(height=...)"
                )
            variables[:, HEIGHT] = height_variable(launches.heights / self.height)
        return variables

    def reduced(self, velocities: Floats, masses: ArrayLike) -> Floats:
        """Launch velocities [nm/ns], shape (n, 2), in units of the largest velocity of the designs."""
        return velocities * (FLIGHT_TIME * np.sqrt(np.asarray(masses) / (2.0 * self.energy_limit)))[:, None]


@dataclass(frozen=True, eq=False, repr=False)
class Responses:
    """Responses of n ions to their launch.

    Parameters
    ----------
    site : ndarray of float32, shape (n, 3, coefficients)
        Coefficients of three quantities, for launches from the site: the two components of the stereographic direction,
        and the time of flight times the cosine of the polar angle [ns].
    rolled : ndarray of float32, shape (n, 3, coefficients)
        The same for launches after a roll-up.
    residuals : ndarray of float32, shape (n, 2)
        Residuals of the two fits [mm].
    not_flown : ndarray of bool, shape (n,), optional
        Ions that cannot arrive in the field of view of the flights: all their numbers are NaN. None if all ions were
        flown.
    """

    site: np.ndarray
    rolled: np.ndarray
    residuals: np.ndarray
    not_flown: np.ndarray | None = None

    def __repr__(self) -> str:
        n, _, coefficients = self.site.shape
        rolled = self.rolled.shape[2]
        return f"<Responses: {n:,} ions, {coefficients} coefficients from the site, {rolled} rolled up>"


class ResponseModel:
    """The responses of a run: launches, fit and evaluation.

    Parameters
    ----------
    settings : ResponseSettings
        Designs of the launches, energy limit and bound of the residuals.
    detector : Detector
        The detector.
    """

    def __init__(self, settings: ResponseSettings, detector: Detector) -> None:
        self.settings, self.detector = settings, detector

    def launches(self, emissions: Emissions) -> tuple[Floats, Floats]:
        """Launches of the designs, from the site and then after a roll-up: one group of flights.

        These places are 0.3 nm apart, so the launches of an ion soon fly in one narrow tube.

        Parameters
        ----------
        emissions : Emissions
            A batch of n, with its targets.

        Returns
        -------
        positions, velocities : ndarray, shape (n, m, 3)
            Positions [nm] and velocities [sqrt(V)]; NaN for ions that cannot roll up.
        """
        settings, n = self.settings, len(emissions)
        fastest = np.sqrt(2.0 * settings.energy_limit / emissions.charge_states)[:, None]
        positions, velocities = [], []
        for design in settings.designs:
            launches = np.zeros((len(design.launches), len(VARIABLES)))
            launches[:, list(design.columns)] = design.launches
            if design.place:
                starts = shared_positions(emissions, shares_of(launches[:, [SECOND, THIRD]])[None])
            else:
                starts = np.broadcast_to(emissions.positions[:, None], (n, len(launches), 3))
            heights = settings.height * heights_of(launches[:, HEIGHT])
            positions.append(starts + heights[:, None] * emissions.normals[:, None])
            velocities.append(
                along_surface(
                    emissions.normals, fastest * launches[:, FIRST_VELOCITY], fastest * launches[:, SECOND_VELOCITY]
                )
            )
        return np.concatenate(positions, axis=1), np.concatenate(velocities, axis=1)

    def fit(self, ends: Ends, slowness: Floats, apex: float, flown: Booleans | None = None) -> Responses:
        """Fit the polynomials to the ends of the launches.

        Parameters
        ----------
        ends : Ends
            Ends of the launches, for n ions.
        slowness : ndarray, shape (n,)
            See `Emissions.slowness`.
        apex : float
            z of the apex [nm].
        flown : ndarray of bool, shape (n,), optional
            Ions that were flown, for a field of view.

        Returns
        -------
        Responses
        """
        rows = slice(None) if flown is None else flown
        all_directions, all_times = land(ends.rows(rows), slowness[rows], self.detector, apex)
        first_of_rolled = [len(self.settings.site.launches)]
        coefficients, residuals = [], []
        for design, directions, times in zip(
            self.settings.designs,
            np.split(all_directions, first_of_rolled, axis=1),
            np.split(all_times, first_of_rolled, axis=1),
            strict=True,
        ):
            n, m = times.shape
            values = fit_quantities(directions.reshape(-1, 2), times.ravel()).reshape(n, m, 3)
            polynomials, residual = design.fit(values)
            coefficients.append(_in_rows(_rounded(polynomials), flown))
            # a small change of the stereographic direction is half as large on a plane at unit distance
            residuals.append(_in_rows(2.0 * self.detector.distance * residual, flown))
        both_residuals = np.stack(residuals, axis=1).astype(np.float32)
        site, rolled = coefficients
        return Responses(site, rolled, both_residuals, None if flown is None else ~flown)

    def evaluate(
        self,
        responses: Responses,
        launches: TangentialLaunches,
        masses: Floats,
        energy_scale: float = 1.0,
    ) -> tuple[Floats, Floats]:
        """Directions and times of flight of ions launched along the surface.

        Parameters
        ----------
        responses : Responses
            Responses of n ions.
        launches : TangentialLaunches
            Launches of these ions.
        masses : ndarray, shape (n,)
            Masses [Da].
        energy_scale : float
            Simulated energy per energy of the user, for the warning.

        Returns
        -------
        directions : ndarray, shape (n, 2)
            Stereographic directions.
        times : ndarray, shape (n,)
            Times of flight [ns].

        Raises
        ------
        ValueError
            If the responses do not serve the launches.

        Warns
        -----
        ResponseWarning
            If launch energies exceed the energy limit: those hits are extrapolated.
        """
        variables = self.settings.variables(launches, masses)
        velocities = variables[:, [FIRST_VELOCITY, SECOND_VELOCITY]]
        limit = self.settings.energy_limit / energy_scale
        faster = int(np.count_nonzero(squared_lengths(velocities) > 1.0001))
        if faster:
            warn(
                f"{faster:,} of {len(velocities):,} ions launch above the energy limit of the responses "
                f"({limit:.3g} eV), and their hits are extrapolated",
                ResponseWarning,
                "run with a larger energy_limit (ResponseSettings, or [responses] in a settings file)",
            )
        values = np.full((len(velocities), 3), np.nan)
        starts = (~launches.rolled, launches.rolled)
        polynomials = (responses.site, responses.rolled)
        flown = True if responses.not_flown is None else ~responses.not_flown
        for design, coefficients, started in zip(self.settings.designs, polynomials, starts, strict=True):
            ions = np.flatnonzero(started & flown)
            values[ions] = design.evaluate(coefficients, variables[ions][:, list(design.columns)], ions)
        return directions_and_times(values)

    def flagged(self, responses: Responses, emissions: Emissions) -> Booleans:
        """Whether the response of an ion has a residual above the bound, or could not be fitted, bool (n,)."""
        inexact = ~(responses.residuals <= self.settings.bound)
        if responses.not_flown is not None:
            inexact &= ~responses.not_flown[:, None]
        return inexact[:, 0] | (inexact[:, 1] & emissions.can_roll)


def _rounded(coefficients):
    """Coefficients of n ions that are multiples of `_STEP`, shape (n, 3, coefficients)."""
    steps = np.full((len(coefficients), 3), _STEP)
    _, exponents = np.frexp(coefficients[:, 2, 0])
    steps[:, 2] = np.ldexp(0.5 * _STEP, exponents)
    return (np.rint(coefficients / steps[..., None]) * steps[..., None]).astype(np.float32)


def _in_rows(values, rows):
    """Values in these rows, NaN in the others; without rows, the values."""
    if rows is None:
        return values
    result = np.full((len(rows), *values.shape[1:]), np.nan, values.dtype)
    result[rows] = values
    return result


def fit_quantities(directions: Floats, times: Floats) -> Floats:
    """The three fitted quantities, shape (n, 3), from directions (n, 2) and times of flight (n,)."""
    s2 = squared_lengths(directions)
    return np.column_stack([directions, times * (1.0 - s2) / (1.0 + s2)])


def directions_and_times(values: Floats) -> tuple[Floats, Floats]:
    """Directions (n, 2) and times of flight (n,) from the three quantities, the inverse of `fit_quantities`."""
    directions = values[:, :2]
    s2 = squared_lengths(directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        return directions, np.where(s2 < 1.0, values[:, 2] * (1.0 + s2) / (1.0 - s2), np.inf)
