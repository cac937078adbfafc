"""The response of an ion: where and when it lands, as polynomials of its launch velocity along the surface.

For one ion the place on the detector is a smooth function of the two tangential launch velocities. A few flights fix a
polynomial for launches from the site, and another for launches from the rolled-up position; together they give the hits
of any perturbation that launches along the surface, without another flight.

What is fitted is the stereographic direction (see `Detector.directions`) and the time of flight times the cosine of the
polar angle: smoother than the place itself, which grows without bound for ions that fly along the detector.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_count, check_kind, check_number, check_sequence, shown
from apt_evap.emission.energies import HIGHEST_ENERGY
from apt_evap.units import FLIGHT_TIME

_HIGHEST_DEGREE = 12  # 91 coefficients: no response needs more
_MOST_LAUNCHES = 1000
CHUNK = 1 << 16  # ions evaluated at once: their monomials stay below 10 MB


@dataclass(frozen=True)
class Design:
    """Launches that fix a polynomial.

    Parameters
    ----------
    degree : int
        Total degree of the polynomial in the two velocities.
    rings : tuple of (float, int)
        Radius in units of the largest velocity, and number of launches, of each ring; every other ring is turned by
        half a step.

    Raises
    ------
    ValueError
        If the launches do not fix the polynomial.
    """

    degree: int
    rings: tuple

    def __post_init__(self):
        check_count(self.degree, "degree", at_most=_HIGHEST_DEGREE)
        rings = [_ring(ring) for ring in check_sequence(self.rings, "rings", "(radius, launches)")]
        if not rings:
            raise ValueError("rings must hold at least one (radius, launches), got none")
        object.__setattr__(self, "rings", tuple(rings))
        matrix = self.monomials(self.velocities)
        if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
            raise ValueError(
                f"rings must fix the {matrix.shape[1]} coefficients of degree {self.degree}, got {self.rings}"
            )

    @property
    def velocities(self) -> Floats:
        """Launches in units of the largest velocity, shape (m, 2)."""
        rings = []
        for index, (radius, count) in enumerate(self.rings):
            angles = 2 * np.pi * (np.arange(count) + 0.5 * (index % 2)) / count
            rings.append(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1))
        return np.concatenate(rings)

    def monomials(self, velocities: ArrayLike) -> Floats:
        """Monomials u^i v^j, i + j <= degree, of velocities (u, v) of shape (n, 2); shape (n, coefficients)."""
        u, v = np.asarray(velocities).T
        powers = [(np.ones_like(u), np.ones_like(v))]
        for _ in range(self.degree):
            powers.append((powers[-1][0] * u, powers[-1][1] * v))
        columns = [powers[total - j][0] * powers[j][1] for total in range(self.degree + 1) for j in range(total + 1)]
        return np.stack(columns, axis=1)

    def fit(self, values: Floats) -> tuple[NDArray[np.float32], Floats]:
        """Least squares fit.

        Parameters
        ----------
        values : ndarray, shape (n, m, 3)
            What the m launches of each of n ions gave.

        Returns
        -------
        coefficients : ndarray of float32, shape (n, 3, coefficients)
            Of the three quantities.
        residual : ndarray, shape (n,)
            Root mean square over the launches of the misfit of the first two, per degree of freedom. Infinite where
            some launches are NaN: the polynomial is the smallest through the others; NaN where all are.
        """
        matrix = self.monomials(self.velocities)
        coefficients = np.einsum("cm,nmk->nkc", np.linalg.pinv(matrix), values)
        misfit = np.einsum("mc,nkc->nmk", matrix, coefficients[:, :2]) - values[:, :, :2]
        freedom = max(1, len(matrix) - matrix.shape[1])
        residual = np.sqrt(np.einsum("nmk,nmk->n", misfit, misfit) / freedom)
        for ion in np.flatnonzero(~np.isfinite(residual)):
            good = np.isfinite(values[ion]).all(axis=1)
            if good.any():
                coefficients[ion] = np.linalg.lstsq(matrix[good], values[ion, good], rcond=None)[0].T
                residual[ion] = np.inf
        return np.ascontiguousarray(coefficients, np.float32), residual

    def evaluate(self, coefficients: NDArray[np.float32], velocities: Floats) -> Floats:
        """Values of the polynomials of n ions, each at a velocity of its own; shape (n, 3)."""
        values = np.empty((len(velocities), 3))
        for begin in range(0, len(velocities), CHUNK):
            chunk = slice(begin, begin + CHUNK)
            values[chunk] = np.einsum("nkc,nc->nk", coefficients[chunk], self.monomials(velocities[chunk]))
        return values


def _ring(ring):
    """Radius and launches of a ring, checked."""
    pair = check_sequence(ring, "rings", "(radius, launches)")
    if len(pair) != 2:
        raise ValueError(f"rings must be pairs (radius, launches), got {shown(ring)}")
    radius = check_number(pair[0], "radius of a ring in rings", at_least=0)
    return radius, check_count(pair[1], "launches of a ring in rings", at_least=1, at_most=_MOST_LAUNCHES)


@dataclass(frozen=True)
class ResponseSettings:
    """Flights and polynomials of the responses.

    Parameters
    ----------
    energy_limit : float
        Largest energy of the launches flown [eV]; beyond it the polynomials extrapolate.
    site, rolled : Design
        Launches from the site and from the rolled-up position. Measured on Ni[111], R = 80 a, 300 ions, against flights
        at random energies up to 1.5 eV: median 0.008 mm and 0.0016 mm on a detector at 100 mm.
    bound : float
        Residual of a fit, on the detector, above which an ion is marked [mm].
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
        """Velocities of the designs, in sqrt(V), of ions of some charge states [e]; shape (n, m, 2)."""
        return np.sqrt(2.0 * self.energy_limit / np.asarray(charge_states))[:, None, None] * velocities


class Responses(NamedTuple):
    """Responses of n ions: coefficients of three quantities, and the residuals of the fits [mm].

    The quantities are the two components of the stereographic direction, and time of flight times cosine [ns].
    """

    site: np.ndarray
    rolled: np.ndarray
    residuals: np.ndarray

    def __repr__(self) -> str:
        n, _, coefficients = self.site.shape
        return f"<Responses: {n:,} ions, {coefficients} coefficients from the site, {self.rolled.shape[2]} rolled up>"


def flattened(directions: Floats, times: Floats) -> Floats:
    """The three quantities that are fitted, shape (n, 3), from directions (n, 2) and times of flight (n,)."""
    s2 = np.einsum("ij,ij->i", directions, directions)
    return np.column_stack([directions, times * (1.0 - s2) / (1.0 + s2)])


def unflattened(values: Floats) -> tuple[Floats, Floats]:
    """Directions (n, 2) and times of flight (n,) from the three quantities, the inverse of `flattened`."""
    directions = values[:, :2]
    s2 = np.einsum("ij,ij->i", directions, directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        return directions, np.where(s2 < 1.0, values[:, 2] * (1.0 + s2) / (1.0 - s2), np.inf)
