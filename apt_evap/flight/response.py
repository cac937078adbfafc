"""The response of an ion: position and time of its hit, as polynomials of its launch velocity along the surface.

The detector position of an ion is a smooth function of its two tangential launch velocities. A few flights determine
one polynomial for launches from the site, and another for launches from the rolled-up position. Together they give the
hits of any perturbation along the surface, without further flights.

The fitted quantities are the stereographic direction (see `Detector.directions`), and the time of flight times the
cosine of the polar angle. They are smoother than the detector position, which diverges for ions that fly parallel to
the detector.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.small_matrices import pseudo_inverse, squared_lengths
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_count, check_kind, check_number, check_sequence, short_text
from apt_evap._common.warnings import ResponseWarning
from apt_evap._core import polynomials
from apt_evap._core.elementary import sine_and_cosine
from apt_evap.detection.detector import Detector
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.energies import HIGHEST_ENERGY
from apt_evap.emission.surface_frame import along_surface, rolled_positions
from apt_evap.flight.landing import Ends, land
from apt_evap.units import FLIGHT_TIME

_MAX_LAUNCHES = 1000


@dataclass(frozen=True)
class Design:
    """Launches that determine a polynomial.

    Parameters
    ----------
    degree : int
        Total degree of the polynomial in the two velocities.
    rings : tuple of (float, int)
        Radius in units of the largest velocity, and number of launches, of each ring; every second ring is rotated by
        half a step.

    Raises
    ------
    ValueError
        If the launches do not determine the polynomial.
    """

    degree: int
    rings: tuple

    def __post_init__(self):
        check_count(self.degree, "degree", at_most=polynomials.HIGHEST_DEGREE)
        rings = [_ring(ring) for ring in check_sequence(self.rings, "rings", "(radius, launches)")]
        if not rings:
            raise ValueError("rings must contain at least one (radius, launches), got none")
        object.__setattr__(self, "rings", tuple(rings))
        matrix = self.monomials(self.velocities)
        if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
            raise ValueError(
                f"rings must determine the {matrix.shape[1]} coefficients of degree {self.degree}, got {self.rings}"
            )

    @property
    def velocities(self) -> Floats:
        """Launches in units of the largest velocity, shape (m, 2)."""
        rings = []
        for index, (radius, count) in enumerate(self.rings):
            angles = 2 * np.pi * (np.arange(count) + 0.5 * (index % 2)) / count
            sine, cosine = sine_and_cosine(angles)
            rings.append(radius * np.stack([cosine, sine], axis=1))
        return np.concatenate(rings)

    def monomials(self, velocities: ArrayLike) -> Floats:
        """Monomials u^i v^j, i + j <= degree, of velocities (u, v) of shape (n, 2); shape (n, coefficients)."""
        return polynomials.monomials(self.degree, np.ascontiguousarray(velocities, np.float64))

    def fit(self, values: Floats) -> tuple[NDArray[np.float32], Floats]:
        """Least squares fit.

        Parameters
        ----------
        values : ndarray, shape (n, m, 3)
            Three quantities of the m launches of each of n ions.

        Returns
        -------
        coefficients : ndarray of float32, shape (n, 3, coefficients)
            Coefficients of the three quantities.
        residual : ndarray, shape (n,)
            Root mean square residual of the first two quantities over the launches, per degree of freedom. Infinite if
            some launches are NaN (the coefficients are then the minimum norm solution for the others); NaN if all are.
        """
        matrix, inverse = _matrices(self)
        values = np.ascontiguousarray(values, np.float64)
        coefficients = polynomials.fit(inverse, values)
        freedom = max(1, len(matrix) - matrix.shape[1])
        residual = np.sqrt(polynomials.misfits(matrix, coefficients, values) / freedom)
        # the time may be infinite at a finite direction: a launch that never reaches the plane of the detector
        for ion in np.flatnonzero(~(np.isfinite(residual) & np.isfinite(values).all(axis=(1, 2)))):
            good = np.isfinite(values[ion]).all(axis=1)
            if good.any():
                coefficients[ion] = polynomials.fit(pseudo_inverse(matrix[good]), values[ion, good][None])[0]
                residual[ion] = np.inf
        return np.ascontiguousarray(coefficients, np.float32), residual

    def evaluate(self, coefficients: NDArray[np.float32], velocities: Floats) -> Floats:
        """Values of the polynomials of n ions, each at its own velocity; shape (n, 3)."""
        return polynomials.evaluate(
            self.degree, np.ascontiguousarray(coefficients, np.float32), np.ascontiguousarray(velocities, np.float64)
        )


@lru_cache
def _matrices(design):
    """Monomials of the launches of a design, and their pseudo-inverse."""
    matrix = design.monomials(design.velocities)
    return matrix, pseudo_inverse(matrix)


def _ring(ring):
    """Validated radius and number of launches of a ring."""
    pair = check_sequence(ring, "rings", "(radius, launches)")
    if len(pair) != 2:
        raise ValueError(f"rings must be pairs (radius, launches), got {short_text(ring)}")
    radius = check_number(pair[0], "radius of a ring in rings", at_least=0)
    return radius, check_count(pair[1], "launches of a ring in rings", at_least=1, at_most=_MAX_LAUNCHES)


@dataclass(frozen=True)
class ResponseSettings:
    """Flights and polynomials of the responses.

    Parameters
    ----------
    energy_limit : float
        Largest energy of the launches [eV]; above it the polynomials extrapolate.
    site, rolled : Design
        Launches from the site and from the rolled-up position. Measured on Ni[111], R = 80 a, 300 ions: median
        deviation from flights at random energies up to 1.5 eV 0.008 mm and 0.0016 mm on a detector at 100 mm.
    bound : float
        Residual of a fit on the detector above which an ion is flagged [mm].
    """

    energy_limit: float = 1.5
    site: Design = Design(4, ((0.0, 1), (0.55, 7), (1.0, 9)))
    rolled: Design = Design(3, ((0.0, 1), (0.6, 5), (1.0, 7)))
    bound: float = 0.2

    def __post_init__(self):
        check_number(self.energy_limit, "energy_limit", above=0, at_most=HIGHEST_ENERGY, unit="eV")
        check_number(self.bound, "bound", above=0, unit="mm")
        for name in ("site", "rolled"):
            check_kind(getattr(self, name), name, Design, "a Design")

    def reduced(self, velocities: Floats, masses: ArrayLike) -> Floats:
        """Launch velocities [nm/ns], shape (n, 2), in units of the largest velocity of the designs."""
        return velocities * (FLIGHT_TIME * np.sqrt(np.asarray(masses) / (2.0 * self.energy_limit)))[:, None]

    def launched(self, velocities: Floats, charge_states: ArrayLike) -> Floats:
        """Velocities of the designs [sqrt(V)] for ions with these charge states [e]; shape (n, m, 2)."""
        return np.sqrt(2.0 * self.energy_limit / np.asarray(charge_states))[:, None, None] * velocities


class Responses(NamedTuple):
    """Responses of n ions: coefficients of three quantities, and the residuals of the fits [mm].

    The quantities are the two components of the stereographic direction, and the time of flight times the cosine of the
    polar angle [ns].
    """

    site: np.ndarray
    rolled: np.ndarray
    residuals: np.ndarray

    def __repr__(self) -> str:
        n, _, coefficients = self.site.shape
        return f"<Responses: {n:,} ions, {coefficients} coefficients from the site, {self.rolled.shape[2]} rolled up>"


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

    def launches(self, emissions: Emissions) -> list[tuple[Floats, Floats]]:
        """Launches of the two designs, from the site and from the rolled-up position.

        Parameters
        ----------
        emissions : Emissions
            A batch of n.

        Returns
        -------
        list of (ndarray, ndarray)
            Positions [nm] and velocities [sqrt(V)] of each design, shape (n, m, 3); NaN for ions that cannot roll up.
        """
        groups = []
        starts = emissions.positions, rolled_positions(emissions)
        for design, start in zip((self.settings.site, self.settings.rolled), starts, strict=True):
            speeds = self.settings.launched(design.velocities, emissions.charge_states)
            velocities = along_surface(emissions.normals, speeds[..., 0], speeds[..., 1])
            groups.append((np.broadcast_to(start[:, None], velocities.shape), velocities))
        return groups

    def fit(self, ends: Sequence[Ends], slowness: Floats, apex: float) -> Responses:
        """Fit the polynomials to the ends of the launches.

        Parameters
        ----------
        ends : sequence of Ends
            Ends of the launches of the two designs, for n ions.
        slowness : ndarray, shape (n,)
            See `Emissions.slowness`.
        apex : float
            z of the apex [nm].

        Returns
        -------
        Responses
        """
        coefficients, residuals = [], []
        for design, each in zip((self.settings.site, self.settings.rolled), ends, strict=True):
            directions, times = land(each, slowness, self.detector, apex)
            n, m = times.shape
            values = fit_quantities(directions.reshape(-1, 2), times.ravel()).reshape(n, m, 3)
            polynomials, residual = design.fit(values)
            coefficients.append(polynomials)
            # a small change of the stereographic direction is half as large on a plane at unit distance
            residuals.append(2.0 * self.detector.distance * residual)
        site, rolled = coefficients
        return Responses(site, rolled, np.stack(residuals, axis=1).astype(np.float32))

    def evaluate(
        self,
        responses: Responses,
        rolled: Booleans,
        first: Floats,
        second: Floats,
        masses: Floats,
        energy_scale: float = 1.0,
    ) -> tuple[Floats, Floats]:
        """Directions and times of flight of ions launched along the surface.

        Parameters
        ----------
        responses : Responses
            Responses of n ions.
        rolled : ndarray of bool, shape (n,)
            Whether an ion rolled up.
        first, second : ndarray, shape (n,)
            Velocities along t1 and t2 of `tangent_frame` [nm/ns].
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

        Warns
        -----
        ResponseWarning
            If launch energies exceed the energy limit: those hits are extrapolated.
        """
        velocities = self.settings.reduced(np.column_stack([first, second]), masses)
        limit = self.settings.energy_limit / energy_scale
        faster = int(np.count_nonzero(squared_lengths(velocities) > 1.0001))
        if faster:
            warnings.warn(
                f"{faster:,} of {len(velocities):,} ions launch above the energy limit of the responses "
                f"({limit:.3g} eV): their hits are extrapolated; run with a larger energy_limit (ResponseSettings, or "
                "[responses] in a settings file)",
                ResponseWarning,
                stacklevel=3,
            )
        values = np.empty((len(velocities), 3))
        for design, coefficients, mask in (
            (self.settings.site, responses.site, ~rolled),
            (self.settings.rolled, responses.rolled, rolled),
        ):
            ions = slice(None) if mask.all() else mask
            values[ions] = design.evaluate(coefficients[ions], velocities[ions])
        return directions_and_times(values)

    def flagged(self, responses: Responses, can_roll: Booleans) -> Booleans:
        """Whether the response of an ion has a residual above the bound, or could not be fitted, bool (n,)."""
        inexact = ~(responses.residuals <= self.settings.bound)
        return inexact[:, 0] | (inexact[:, 1] & can_roll)


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
