"""Launches that determine the response polynomials of an ion, and their fit and evaluation.

The variables of a launch, each from 0 to 1 or from -1 to 1, are

* two for the place of a roll-up, in the triangle of all descending shares of three targets: the first is the part of
  the mean of both strongest targets, the second that of the mean of all three, and the rest that of the strongest one;
* the velocity along t1 and t2 of `tangent_frame` in units of the largest velocity;
* the height: 2 h / (1 + h) for a height h above the start in units of the largest one. The field near the surface
  decreases with the distance, and so do the effects of the height.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

import apt_evap._core.polynomials as polynomials
from apt_evap._common.codec import checked, count, settings, switch, to_python
from apt_evap._common.small_matrices import left_inverse, pseudo_inverse
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_count, check_number, check_sequence, short_text
from apt_evap._core.elementary import sine_and_cosine

SECOND, THIRD, FIRST_VELOCITY, SECOND_VELOCITY, HEIGHT = VARIABLES = range(5)
_MOST_LAUNCHES = 1000
_MOST_POWERS = 7
_WEIGHT = 3.0
"""Weight, in the fit, of launches without a height, and without a mean of targets: the launches of most rules.

Measured on Ni[111], R = 80 a, for places after a roll-up: with 1, 2 and 3, the errors (median, 95 %) of such launches
are 0.003 and 0.009, 0.0015 and 0.005, 0.001 and 0.004 mm; over the whole domain they are the same.
"""


def places_of(shares: Floats) -> Floats:
    """Variables of the place, shape (n, 2), from descending shares of the targets (n, 3)."""
    return np.column_stack([2.0 * (shares[:, 1] - shares[:, 2]), 3.0 * shares[:, 2]])


def shares_of(places: Floats) -> Floats:
    """Shares of the targets, shape (n, 3), from the variables of the place (n, 2): the inverse of `places_of`."""
    third = places[:, 1] / 3.0
    second = 0.5 * places[:, 0] + third
    return np.column_stack([1.0 - second - third, second, third])


def height_variable(heights: Floats) -> Floats:
    """Variable of the height from heights in units of the largest one."""
    return 2.0 * heights / (1.0 + heights)


def heights_of(variable: Floats) -> Floats:
    """Heights in units of the largest one: the inverse of `height_variable`."""
    return variable / (2.0 - variable)


def _degrees(degrees, name):
    numbers = tuple(
        check_count(degree, name, at_most=polynomials.HIGHEST_DEGREE) for degree in check_sequence(degrees, name, "int")
    )
    if not 2 <= len(numbers) <= _MOST_POWERS or any(b > a for a, b in itertools.pairwise(numbers)):
        raise ValueError(f"{name} must be 2 to {_MOST_POWERS} integers that do not increase, got {degrees}")
    return numbers


def _rings(rings, name):
    rings = tuple(_ring(ring) for ring in check_sequence(rings, name, "(radius, launches)"))
    if not rings:
        raise ValueError(f"{name} must contain at least one (radius, launches), got none")
    return rings


def _ring(ring):
    """Validated radius and number of launches of a ring."""
    pair = check_sequence(ring, "rings", "(radius, launches)")
    if len(pair) != 2:
        raise ValueError(f"rings must be pairs (radius, launches), got {short_text(ring)}")
    radius = check_number(pair[0], "radius of a ring in rings", at_least=0)
    return radius, check_count(pair[1], "launches of a ring in rings", at_least=1, at_most=_MOST_LAUNCHES)


@settings
class Design:
    """A polynomial of the launch of an ion, and the launches that determine it.

    The first launches are without a height, from the site or from above the strongest target, with the velocities of
    the rings. The others are chosen from a grid of places, velocities and heights, one after the other, as those that
    the previous ones predict worst (a D-optimal design).
    """

    degrees: tuple = checked(
        "Highest total degree, in the velocities and the place, of the monomials with each power of the height, "
        "from 0 on.",
        "tuple of int",
        _degrees,
    )
    rings: tuple = checked(
        "Radius in units of the largest velocity, and number of velocities, of each ring; every second ring is rotated "
        "by half a step.",
        "tuple of (float, int)",
        _rings,
    )
    number: int = count("Number of launches. They must determine the polynomial.", at_least=1, at_most=_MOST_LAUNCHES)
    place: bool = switch("Whether the place of a roll-up is a variable.", default=False)

    def _check(self):
        if self.number > (candidates := len(_grid_of(self))):
            raise ValueError(
                f"number must be at most {candidates}, the launches of the grid of these degrees and rings, got "
                f"{self.number}"
            )
        rank = np.linalg.matrix_rank(self.monomials(self.launches))
        if rank < len(self.exponents):
            raise ValueError(
                f"number and rings must determine the {len(self.exponents)} coefficients of degrees {self.degrees}, "
                f"got {self.number} launches with rings {self.rings}"
            )

    def __repr__(self) -> str:
        return to_python(self, "")

    @property
    def columns(self) -> tuple[int, ...]:
        """Variables of the polynomial."""
        return tuple(VARIABLES) if self.place else (FIRST_VELOCITY, SECOND_VELOCITY, HEIGHT)

    @property
    def exponents(self) -> NDArray[np.int8]:
        """Exponents of the monomials, shape (coefficients, v)."""
        return _exponents_of(self)

    @property
    def launches(self) -> Floats:
        """Variables of the launches, shape (m, v)."""
        return _launches_of(self)

    def monomials(self, variables: ArrayLike) -> Floats:
        """Monomials of variables of shape (n, v), in the order of `columns`; shape (n, coefficients)."""
        return polynomials.monomials(self.exponents, np.ascontiguousarray(variables, np.float64))

    def fit(self, values: Floats) -> tuple[NDArray[np.float32], Floats]:
        """Weighted least squares fit.

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
        matrix, weights, inverse = _matrices(self)
        values = np.ascontiguousarray(values, np.float64)
        coefficients = polynomials.fit(inverse, values)
        freedom = max(1, len(matrix) - matrix.shape[1])
        residual = np.sqrt(polynomials.misfits(matrix, coefficients, values) / freedom)
        # the time may be infinite at a finite direction: a launch that never reaches the plane of the detector
        for ion in np.flatnonzero(~(np.isfinite(residual) & np.isfinite(values).all(axis=(1, 2)))):
            good = np.isfinite(values[ion]).all(axis=1)
            if good.any():
                some = pseudo_inverse(matrix[good] * weights[good, None]) * weights[good]
                coefficients[ion] = polynomials.fit(np.ascontiguousarray(some), values[ion, good][None])[0]
                residual[ion] = np.inf
        return np.ascontiguousarray(coefficients, np.float32), residual

    def evaluate(self, coefficients: NDArray[np.float32], variables: Floats, ions: Integers) -> Floats:
        """Values of the polynomials of n `ions` at variables (n, v) in the order of `columns`; shape (n, 3)."""
        return polynomials.evaluate(
            self.exponents,
            np.ascontiguousarray(coefficients, np.float32),
            np.ascontiguousarray(variables, np.float64),
            np.ascontiguousarray(ions, np.int64),
        )


@functools.lru_cache
def _exponents_of(design):
    rows = []
    for power, degree in enumerate(design.degrees):
        # from low to high total degree, so that the first coefficients are the largest ones
        powers = itertools.product(range(degree + 1), repeat=len(design.columns) - 1)
        rows += [(*row, power) for row in powers if sum(row) <= degree]
    rows.sort(key=lambda row: (sum(row), row[-1]))
    return np.array(rows, np.int8)


def _grid_of(design):
    """Candidates for the launches of a design; the first ones are without a height and without a mean of targets."""
    velocities = []
    for index, (radius, number) in enumerate(design.rings):
        sine, cosine = sine_and_cosine(2 * np.pi * (np.arange(number) + 0.5 * (index % 2)) / number)
        velocities += zip(radius * cosine, radius * sine, strict=True)
    steps, degree = len(design.degrees) - 1, max(1, design.degrees[0])
    heights = [(k / steps,) for k in range(steps + 1)]
    places = [()]
    if design.place:
        places = [(i / degree, j / degree) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.array([[*a, *c, *b] for a, b, c in itertools.product(places, heights, velocities)])


def _first_launches(design):
    """Number of the launches without a height and without a mean of targets."""
    return sum(number for _, number in design.rings)


@functools.lru_cache
def _launches_of(design):
    """Launches of a design, from a grid of candidates."""
    grid = _grid_of(design)
    matrix = design.monomials(grid)
    # rows of the matrix times the covariance of the coefficients, which every chosen launch reduces
    product, chosen = matrix * 1e6, []
    while len(chosen) < design.number:
        if len(chosen) < _first_launches(design):
            launch, weight = len(chosen), _WEIGHT * _WEIGHT
        else:
            leverage = np.round((product * matrix).sum(axis=1), 9)
            leverage[chosen] = -1.0
            launch, weight = int(leverage.argmax()), 1.0
        chosen.append(launch)
        row, along = product[launch], (product * matrix[launch]).sum(axis=1)
        product = product - along[:, None] * (weight * row / (1.0 + weight * along[launch]))
    return grid[sorted(chosen)]


@functools.lru_cache
def _matrices(design):
    """Monomials of the launches of a design, their weights, and the matrix of the weighted fit."""
    matrix = design.monomials(design.launches)
    weights = np.ones(len(matrix))
    weights[: _first_launches(design)] = _WEIGHT
    return matrix, weights, left_inverse(matrix * weights[:, None]) * weights
