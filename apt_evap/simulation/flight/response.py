"""The response of an ion: position and time of its hit, as polynomials of its launch velocity along the surface.

The detector position of an ion is a smooth function of its two tangential launch velocities. A few flights determine
one polynomial for launches from the site, and another for launches from the rolled-up position. Together they give the
hits of any perturbation along the surface, without further flights. Wide responses (`ResponseSettings.wide`) are also
polynomials of the place between several targets of the roll-up, and of the height of the launch.

The fitted quantities are the stereographic direction (see `Detector.directions`), and the time of flight times the
cosine of the polar angle. They are smoother than the detector position, which diverges for ions that fly parallel to
the detector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import count, from_plain, number, part, settings
from apt_evap._common.small_matrices import squared_lengths
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_switch
from apt_evap.detection.detector import Detector
from apt_evap.emission.emissions import Emissions, TangentialLaunches
from apt_evap.emission.energies import HIGHEST_ENERGY
from apt_evap.emission.surface_frame import along_surface, rolled_positions, shared_positions
from apt_evap.simulation.flight.landing import Ends, land
from apt_evap.simulation.flight.launch_designs import (
    FIRST_VELOCITY,
    HEIGHT,
    SECOND,
    SECOND_VELOCITY,
    THIRD,
    VARIABLES,
    Design,
    WideDesign,
)
from apt_evap.units import FLIGHT_TIME
from apt_evap.warnings import ResponseWarning, warn


@settings
class ResponseSettings:
    """Flights and polynomials of the responses.

    Both designs are `Design`, or both `WideDesign`, see `wide`.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> settings = ae.ResponseSettings(energy_limit=3.0)
    >>> run = ae.Simulation(tip, seed=1, response_settings=settings).run(50)
    >>> run.hits(ae.RollUp(2.5))
    <Hits: 50 ions, 46 detected from 'simulation, RollUp(2.5)'; x, y, time_of_flight, ...>
    """

    energy_limit: float = number(
        "Largest energy of the launches; above it the polynomials extrapolate.",
        default=1.5,
        above=0,
        at_most=HIGHEST_ENERGY,
        unit="eV",
    )
    site: Design | WideDesign = part(
        "Launches from the site. Measured on Ni[111], R = 80 a, 300 ions: median deviation from flights at random "
        "energies up to 1.5 eV 0.008 mm on a detector at 100 mm.",
        Design,
        WideDesign,
        default=Design(4, ((0.0, 1), (0.55, 7), (1.0, 9))),
    )
    rolled: Design | WideDesign = part(
        "Launches from the rolled-up position; the same deviation is 0.0016 mm.",
        Design,
        WideDesign,
        default=Design(3, ((0.0, 1), (0.6, 5), (1.0, 7))),
    )
    bound: float = number(
        "Residual of a fit on the detector above which an ion is flagged.", default=0.2, above=0, unit="mm"
    )
    height: float = number(
        "Largest launch height of wide designs; 0 for others.", default=0.0, at_least=0, at_most=1.0, unit="nm"
    )
    shells: int = count(
        "Shells of neighbours that can be targets of a roll-up: 1 for nearest neighbours, 2 also for second ones, "
        "which in bcc are only 15 % more distant.",
        default=1,
        at_least=1,
        at_most=2,
    )

    def _check(self):
        if isinstance(self.site, WideDesign) != isinstance(self.rolled, WideDesign):
            raise ValueError(f"site and rolled must both be a Design or both a WideDesign, got {self.site!r:.60}")
        if self.is_wide and not (self.height > 0 and self.rolled.place > 0 == self.site.place):  # type: ignore[union-attr]
            raise ValueError(
                "wide designs need a height > 0 nm, and a place of degree 0 for site and > 0 for rolled, got "
                f"{self.height:g} nm, {self.site.place} and {self.rolled.place}"  # type: ignore[union-attr]
            )
        if not self.is_wide and self.height > 0:
            raise ValueError(f"height needs wide designs (ResponseSettings.wide), got {self.height:g} nm")

    @classmethod
    def wide(cls, height: float = 0.2, **others: Any) -> ResponseSettings:
        """Settings whose responses also cover other targets of the roll-up and other launch heights.

        A run then covers any `sharpness`, `probability` and `height` of the perturbations in post-processing.

        Parameters
        ----------
        height : float
            Largest launch height [nm].
        **others
            Further parameters but the designs.

        Returns
        -------
        ResponseSettings

        Notes
        -----
        Second neighbours are farther apart, so that the polynomials need more terms. For Ni[111], R = 12 a, 100 ions,
        up to 0.35 eV, the median deviations from flights are then 0.02 to 0.09 mm on a detector at 100 mm; with the
        terms for nearest neighbours, they would be 0.11 to 0.18 mm.
        """
        rolled = WideDesign(4, 2, 2, 4) if others.get("shells") == 2 else WideDesign(3, 2, 2, 3)
        return cls(site=WideDesign(0, 4, 3, 4), rolled=rolled, height=height, **others)

    @classmethod
    def of_table(cls, table: dict[str, Any]) -> ResponseSettings:
        """Settings from a table ``[responses]`` of a file: ``wide = true`` chooses wide designs."""
        values = dict(table)
        wide = check_switch(values.pop("wide", False), "wide")
        if not wide:
            return from_plain(values, cls, what="responses")
        from_plain({name: value for name, value in values.items() if name != "height"}, cls, what="responses")
        return cls.wide(**values)

    @property
    def is_wide(self) -> bool:
        """Whether the responses serve several targets of the roll-up and launch heights."""
        return isinstance(self.rolled, WideDesign)

    @property
    def designs(self) -> tuple[Design | WideDesign, Design | WideDesign]:
        """Designs of the launches from the site, and after a roll-up."""
        return self.site, self.rolled

    def variables(self, launches: TangentialLaunches, masses: ArrayLike) -> Floats:
        """Variables of the designs for n launches, shape (n, 5); ValueError if the responses do not serve them."""
        n = len(launches.rolled)
        variables = np.zeros((n, len(VARIABLES)))
        velocities = self.reduced(np.column_stack([launches.first, launches.second]), masses)
        variables[:, FIRST_VELOCITY], variables[:, SECOND_VELOCITY] = velocities.T
        if launches.shares is not None:
            variables[:, [SECOND, THIRD]] = launches.shares[:, 1:]
        if launches.heights is not None:
            variables[:, HEIGHT] = launches.heights / (self.height or 1.0)
        if not self.is_wide and variables[:, [SECOND, THIRD, HEIGHT]].any():
            raise ValueError(
                "the responses of this run serve launches from the site and above the strongest neighbour only, got "
                "shares of other neighbours or a height: run with response_settings=ResponseSettings.wide()"
            )
        if n and variables[:, HEIGHT].max() > 1.0 + 1e-9:
            raise ValueError(
                f"the responses of this run serve heights up to {self.height:g} nm, got {launches.heights.max():g} nm: "  # type: ignore[union-attr]
                "run with ResponseSettings.wide(height=...)"
            )
        return variables

    def reduced(self, velocities: Floats, masses: ArrayLike) -> Floats:
        """Launch velocities [nm/ns], shape (n, 2), in units of the largest velocity of the designs."""
        return velocities * (FLIGHT_TIME * np.sqrt(np.asarray(masses) / (2.0 * self.energy_limit)))[:, None]


@dataclass(frozen=True, eq=False, repr=False)
class Responses:
    """Responses of n ions to their launch velocity.

    Parameters
    ----------
    site : ndarray of float32, shape (n, 3, coefficients)
        Coefficients of three quantities, for launches from the site: the two components of the stereographic direction,
        and the time of flight times the cosine of the polar angle [ns].
    rolled : ndarray of float32, shape (n, 3, coefficients)
        The same for launches from the rolled-up position.
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
        """Launches of the designs, from the site and then from the rolled-up positions: one group of flights.

        These places are 0.3 nm apart, so the launches of an ion soon fly in one narrow tube.

        Parameters
        ----------
        emissions : Emissions
            A batch of n.

        Returns
        -------
        positions, velocities : ndarray, shape (n, m, 3)
            Positions [nm] and velocities [sqrt(V)]; NaN for ions that cannot roll up.
        """
        settings, n = self.settings, len(emissions)
        fastest = np.sqrt(2.0 * settings.energy_limit / emissions.charge_states)[:, None]
        positions, velocities = [], []
        for rolled, design in zip((False, True), settings.designs, strict=True):
            launches = np.zeros((len(design.launches), len(VARIABLES)))
            launches[:, list(design.columns)] = design.launches
            if not rolled:
                starts = np.broadcast_to(emissions.positions[:, None], (n, len(launches), 3))
            elif settings.is_wide:
                second, third = launches[:, SECOND], launches[:, THIRD]
                shares = np.stack([1.0 - second - third, second, third], axis=1)[None]
                starts = shared_positions(emissions, shares)
            else:
                starts = np.broadcast_to(rolled_positions(emissions)[:, None], (n, len(launches), 3))
            if settings.is_wide:
                starts = starts + (settings.height * launches[:, HEIGHT])[:, None] * emissions.normals[:, None]
            positions.append(starts)
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
            coefficients.append(_in_rows(polynomials, flown))
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
        values = np.empty((len(velocities), 3))
        starts = (~launches.rolled, launches.rolled)
        polynomials = (responses.site, responses.rolled)
        for design, coefficients, mask in zip(self.settings.designs, polynomials, starts, strict=True):
            ions = slice(None) if mask.all() else mask
            values[ions] = design.evaluate(coefficients[ions], variables[ions][:, list(design.columns)])
        return directions_and_times(values)

    def flagged(self, responses: Responses, emissions: Emissions) -> Booleans:
        """Whether the response of an ion has a residual above the bound, or could not be fitted, bool (n,)."""
        inexact = ~(responses.residuals <= self.settings.bound)
        if responses.not_flown is not None:
            inexact &= ~responses.not_flown[:, None]
        return inexact[:, 0] | (inexact[:, 1] & emissions.can_roll)


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
