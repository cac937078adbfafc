"""Launches that determine the response polynomials of an ion, and their fit and evaluation.

The variables of a launch are: the shares of the second and the third target of a roll-up, the velocity along t1 and t2
of `tangent_frame` in units of the largest velocity, and the height above the usual start in units of the largest one.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import apt_evap._core.polynomials as polynomials
from apt_evap._common.codec import checked, count, number, settings
from apt_evap._common.small_matrices import pseudo_inverse
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_count, check_number, check_sequence, short_text
from apt_evap._core.elementary import sine_and_cosine

SECOND, THIRD, FIRST_VELOCITY, SECOND_VELOCITY, HEIGHT = VARIABLES = range(5)
_MAX_LAUNCHES = 1000


class _Polynomial:
    """Fit and evaluation of a design: a frozen dataclass with `exponents`, `columns` and `launches`."""

    exponents: Any
    columns: Any
    launches: Any

    def monomials(self, variables: ArrayLike) -> Floats:
        """Monomials of variables of shape (n, v), in the order of `columns`; shape (n, coefficients)."""
        return polynomials.monomials(self.exponents, np.ascontiguousarray(variables, np.float64))

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

    def evaluate(self, coefficients: NDArray[np.float32], variables: Floats) -> Floats:
        """Values of the polynomials of n ions at variables (n, v) in the order of `columns`; shape (n, 3)."""
        return polynomials.evaluate(
            self.exponents,
            np.ascontiguousarray(coefficients, np.float32),
            np.ascontiguousarray(variables, np.float64),
        )


def _rings(rings, name):
    rings = tuple(_ring(ring) for ring in check_sequence(rings, name, "(radius, launches)"))
    if not rings:
        raise ValueError(f"{name} must contain at least one (radius, launches), got none")
    return rings


@settings
class Design(_Polynomial):
    """Launches that determine a polynomial."""

    degree: int = count(
        "Total degree of the polynomial in the two velocities.", at_least=0, at_most=polynomials.HIGHEST_DEGREE
    )
    rings: tuple = checked(
        "Radius in units of the largest velocity, and number of launches, of each ring; every second ring is rotated "
        "by half a step. They must determine the polynomial.",
        "tuple of (float, int)",
        _rings,
    )

    def _check(self):
        matrix = self.monomials(self.launches)
        if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
            raise ValueError(
                f"rings must determine the {matrix.shape[1]} coefficients of degree {self.degree}, got {self.rings}"
            )

    @property
    def columns(self) -> tuple:  # type: ignore[override]
        """Variables of the polynomial."""
        return FIRST_VELOCITY, SECOND_VELOCITY

    @property
    def exponents(self) -> NDArray[np.int8]:  # type: ignore[override]
        """Exponents of the monomials u^(t - j) v^j, shape (coefficients, 2)."""
        return np.array([(t - j, j) for t in range(self.degree + 1) for j in range(t + 1)], np.int8)

    @property
    def launches(self) -> Floats:  # type: ignore[override]
        """Launches in units of the largest velocity, shape (m, 2)."""
        rings = []
        for index, (radius, launches) in enumerate(self.rings):
            angles = 2 * np.pi * (np.arange(launches) + 0.5 * (index % 2)) / launches
            sine, cosine = sine_and_cosine(angles)
            rings.append(radius * np.stack([cosine, sine], axis=1))
        return np.concatenate(rings)


@settings
class WideDesign(_Polynomial):
    """Launches from any place between the targets of a roll-up, with any velocity and height.

    Monomials of one kind of variable have degrees up to `place`, `velocity` or `height`, others a total degree of up to
    `mixed`. The launches are chosen from a grid, one after the other, as those that the previous ones predict worst
    (a D-optimal design).
    """

    place: int = count("Degree in the shares of the second and third target; 0 for launches from the site.", at_most=6)
    velocity: int = count("Degree in the two velocities.", at_least=1, at_most=6)
    height: int = count("Degree in the height.", at_least=1, at_most=6)
    mixed: int = count("Degree of monomials of several kinds.", at_least=1, at_most=6)
    launches_per_coefficient: float = number(
        "Number of launches per coefficient.", default=1.4, at_least=1.0, at_most=4.0
    )

    @property
    def columns(self) -> tuple:  # type: ignore[override]
        """Variables of the polynomial."""
        return tuple(VARIABLES) if self.place else (FIRST_VELOCITY, SECOND_VELOCITY, HEIGHT)

    @property
    def exponents(self) -> NDArray[np.int8]:  # type: ignore[override]
        """Exponents of the monomials, shape (coefficients, v)."""
        return _exponents_of(self)

    @property
    def launches(self) -> Floats:  # type: ignore[override]
        """Variables of the launches, shape (m, v)."""
        return _launches_of(self)


@functools.lru_cache
def _exponents_of(design):
    rows = []
    for row in itertools.product(range(7), repeat=5):
        place, velocity, height = row[0] + row[1], row[2] + row[3], row[4]
        if place > design.place or velocity > design.velocity or height > design.height:
            continue
        if sum(row) <= design.mixed or sum(row) in (place, velocity, height):
            rows.append([row[column] for column in design.columns])
    return np.array(rows, np.int8)


@functools.lru_cache
def _launches_of(design):
    """Launches of a wide design, from a grid of candidates."""
    velocities = [(0.0, 0.0)]
    for ring, radius in enumerate((0.55, 1.0)):
        launches = 2 * design.velocity + 1 + 2 * ring
        sine, cosine = sine_and_cosine(2 * np.pi * (np.arange(launches) + 0.5 * ring) / launches)
        velocities += zip(radius * cosine, radius * sine, strict=True)
    heights = [(k / design.height,) for k in range(design.height + 1)]
    places = [()]
    if steps := design.place:
        places = [(i / steps, j / steps) for i in range(steps + 1) for j in range(steps + 1 - i)]
    grid = np.array([[*a, *b, *c] for a, b, c in itertools.product(places, velocities, heights)])
    matrix = design.monomials(grid)
    # rows of the matrix times the covariance of the coefficients, which every chosen launch reduces
    product, chosen = matrix * 1e6, []
    while len(chosen) < min(round(design.launches_per_coefficient * matrix.shape[1]), len(grid)):
        leverage = np.round((product * matrix).sum(axis=1), 9)
        leverage[chosen] = -1.0
        chosen.append(int(leverage.argmax()))
        row, along = product[chosen[-1]], (product * matrix[chosen[-1]]).sum(axis=1)
        product = product - along[:, None] * (row / (1.0 + along[chosen[-1]]))
    return grid[sorted(chosen)]


@functools.lru_cache
def _matrices(design):
    """Monomials of the launches of a design, and their pseudo-inverse."""
    matrix = design.monomials(design.launches)
    return matrix, pseudo_inverse(matrix)


def _ring(ring):
    """Validated radius and number of launches of a ring."""
    pair = check_sequence(ring, "rings", "(radius, launches)")
    if len(pair) != 2:
        raise ValueError(f"rings must be pairs (radius, launches), got {short_text(ring)}")
    radius = check_number(pair[0], "radius of a ring in rings", at_least=0)
    return radius, check_count(pair[1], "launches of a ring in rings", at_least=1, at_most=_MAX_LAUNCHES)
