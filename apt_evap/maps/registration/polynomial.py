"""Polynomial terms of a registration: what a reflectron adds to rotation, scale and shift.

With z = x + iy, a registered point z' moves to z' + sum c_jk w^j conj(w)^k for w = (z' - centre) / radius: the term
conj(w) of first order (anisotropy), and those of second and third order. Measured grids of reflectrons are described to
0.1 mm by the cubic terms, where similarity transforms leave 0.7 to 0.9 mm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import checked, count, number, settings, vector
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array

SIGNIFICANCE = 0.01
"""Probability of a smaller residual by chance below which terms of a higher degree are kept."""
LARGEST_DEGREE = 3
_TERMS = {1: ((0, 1),), 2: ((2, 0), (1, 1), (0, 2)), 3: ((3, 0), (2, 1), (1, 2), (0, 3))}
_ROUNDING = 1e-12  # residual of an exact fit, relative to the unit of length: some thousand units in the last place
_ITERATIONS = 50  # of the inverse; a distortion of 10 % converges by a factor of 10 each


def terms_of(degree: int) -> tuple[tuple[int, int], ...]:
    """Powers of w and of its conjugate in a polynomial of a degree, beyond a similarity; none for degree 0."""
    return tuple(term for order in range(1, degree + 1) for term in _TERMS[order])


def _complex(numbers, name):
    """Complex numbers; in files they are pairs."""
    pairs = [complex(*number) if isinstance(number, list) else number for number in numbers]
    return tuple(np.asarray(pairs, complex).tolist())


def _errors(errors, name):
    """Errors; unknown ones are NaN, in files None."""
    return tuple(np.asarray([np.nan if error is None else error for error in errors], float).tolist())


@settings
class Distortion:
    """Polynomial terms of a registration."""

    degree: int = count(
        "1 for anisotropy alone, 2 and 3 with quadratic and cubic terms.", at_least=1, at_most=LARGEST_DEGREE
    )
    centre: tuple = vector("Origin of the polynomial in the measured frame.", 2, unit="mm")
    radius: float = number("Unit of length of the polynomial.", above=0, unit="mm")
    coefficients: tuple = checked("Of the terms of `terms_of`.", "tuple of complex", _complex, unit="mm")
    errors: tuple = checked(
        "Their standard errors, of the real and the imaginary part alike; NaN if not known.",
        "tuple of float",
        _errors,
        default=(),
        unit="mm",
    )

    def _check(self):
        terms = len(terms_of(self.degree))
        if len(self.coefficients) != terms or not np.isfinite(self.coefficients).all():
            raise ValueError(f"coefficients must be {terms} finite numbers for degree {self.degree}")
        errors = self.errors or (np.nan,) * terms
        if len(errors) != terms:
            raise ValueError(f"errors must be {terms} numbers for degree {self.degree}, got {len(errors)}")
        return {"errors": errors}

    def shift(self, points: Any) -> Any:
        """Displacement of points of the measured frame, complex of any shape [mm]."""
        w = (points - complex(*self.centre)) / self.radius
        return sum(
            c * w**j * np.conj(w) ** k for c, (j, k) in zip(self.coefficients, terms_of(self.degree), strict=True)
        )

    def apply(self, points: Any) -> Any:
        """Distort points, complex of any shape [mm]."""
        return points + self.shift(points)

    def apply_inverse(self, points: Any) -> Any:
        """Points that `apply` moves to these, by fixed point iteration; NaN where it does not converge."""
        origins = np.asarray(points, complex)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(_ITERATIONS):
                origins = points - self.shift(origins)
            wrong = ~(np.abs(self.apply(origins) - points) <= 1e-6 * self.radius)
        return np.where(wrong, np.nan, origins)


class PolynomialFit(NamedTuple):
    """Least squares fit of displacements by a polynomial."""

    degree: int
    """Degree that was selected; 0 for none beyond a similarity."""
    similarity: tuple[complex, complex]
    """Factor and shift of the linear part: z' = factor z + shift."""
    distortion: Distortion | None
    """The other terms, applied after the linear part; None for degree 0."""
    residual: float
    """Root mean square distance of the points [mm]."""
    validated: float
    """The same for points that were left out of the fit, one at a time [mm]."""
    probabilities: dict[int, float]
    """Probability that the terms of each degree reduce the residual as much by chance (F test)."""


def fit_polynomial(source: Any, target: Any, degree: int | None, weights: ArrayLike | None = None) -> PolynomialFit:
    """Fit a similarity transform and polynomial terms to pairs of points, complex (n,) [mm].

    The degree is 0 to 3. By default it is the largest one whose terms, compared with the next lower degree with enough
    points, are significant by an F test at 1 %, and reduce the residual of points that are left out.
    """
    source, target = np.asarray(source, complex), np.asarray(target, complex)
    n = len(source)
    weights = np.ones(n) if weights is None else check_array(weights, "weights", (n,))
    # similarity transform, then coordinates about the centre of the moved points in units of their radius
    linear = np.column_stack([source, np.ones(n)])
    root = np.sqrt(weights)
    similarity = np.linalg.lstsq(linear * root[:, None], target * root, rcond=None)[0]
    moved = linear @ similarity
    centre = complex(np.mean(moved))
    radius = max(float(np.abs(moved - centre).max()), 1e-9)
    w = (moved - centre) / radius
    # fits of rising degree, as long as errors have a freedom
    fits = {}
    for trial in range(LARGEST_DEGREE + 1) if degree is None else sorted({0, degree}):
        matrix = np.column_stack([w, np.ones(n), *(w**j * np.conj(w) ** k for j, k in terms_of(trial))])
        if trial and n <= matrix.shape[1]:  # no freedom for errors
            if degree is not None and trial == degree:
                raise ValueError(f"degree {degree} needs more than {matrix.shape[1]} points, got {n}")
            break
        fits[trial] = _least_squares(matrix, target, root)
    # degree: the largest one that an F test and the left-out points prefer to the one before
    chosen, probabilities = 0, {}
    for trial in sorted(fits)[1:]:
        lower, higher = fits[chosen], fits[trial]
        if degree is None and lower.squares <= (_ROUNDING * radius) ** 2 * weights.sum():
            break  # an exact fit: its residual is rounding
        more, freedom = 2 * (higher.number - lower.number), 2 * (n - higher.number)
        ratio = (lower.squares - higher.squares) / more / max(higher.squares / freedom, np.finfo(float).tiny)
        probabilities[trial] = float(scipy.stats.f.sf(ratio, more, freedom))
        if degree is not None or (probabilities[trial] < SIGNIFICANCE and higher.validated < lower.validated):
            chosen = trial
    # linear part and the rest of the best fit
    best = fits[chosen]
    turn, shift, *others = best.values
    distortion = None
    if others:
        factor = (similarity[0] * turn / radius, shift + turn * (similarity[1] - centre) / radius)
        # the polynomial acts on the points after this linear part: their w is that of the fit, turned by `unit`
        unit = turn / abs(turn)
        coefficients = [c * unit**-j * np.conj(unit) ** -k for c, (j, k) in zip(others, terms_of(chosen), strict=True)]
        errors = tuple(best.errors[2:].tolist())
        distortion = Distortion(chosen, (shift.real, shift.imag), abs(turn), tuple(coefficients), errors)
    else:
        factor = (complex(similarity[0]), complex(similarity[1]))
    return PolynomialFit(
        degree=chosen,
        similarity=(complex(factor[0]), complex(factor[1])),
        distortion=distortion,
        residual=float(np.sqrt(best.squares / weights.sum())),
        validated=best.validated,
        probabilities=probabilities,
    )


class _Solution(NamedTuple):
    values: Floats
    errors: Floats
    squares: float
    validated: float
    number: int


def _least_squares(matrix, target, root):
    """Complex least squares with errors, and the root mean square residual of points left out."""
    weighted = matrix * root[:, None]
    values = np.linalg.lstsq(weighted, target * root, rcond=None)[0]
    residual = (target - matrix @ values) * root
    squares = float(np.sum(np.abs(residual) ** 2))
    inverse = np.linalg.pinv(weighted.conj().T @ weighted)
    n, number = matrix.shape
    # of the real and of the imaginary part; two points determine a similarity, without any error
    variance = squares / (2 * (n - number)) if n > number else np.nan
    errors = np.sqrt(np.real(np.diag(inverse)) * variance)
    leverage = np.real(np.einsum("ij,jk,ik->i", weighted, inverse, weighted.conj()))
    left_out = residual / np.maximum(1 - leverage, 1e-9)
    return _Solution(values, errors, squares, float(np.sqrt(np.sum(np.abs(left_out) ** 2) / np.sum(root**2))), number)
