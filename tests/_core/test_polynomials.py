"""Polynomials of responses against sums spelled out in NumPy."""

import numpy as np
import pytest

from apt_evap._core import polynomials


def exponents_of(degree):
    """Exponents of two variables up to a total degree."""
    return np.array([(total - j, j) for total in range(degree + 1) for j in range(total + 1)], np.int8)


@pytest.mark.parametrize("degree", [0, 1, 4, polynomials.HIGHEST_DEGREE])
def test_monomials_and_values(degree, rng):
    velocities = rng.normal(size=(7, 2))
    u, v = velocities.T
    columns = [u ** (total - j) * v**j for total in range(degree + 1) for j in range(total + 1)]
    expected = np.stack(columns, axis=1)
    assert polynomials.monomials(exponents_of(degree), velocities) == pytest.approx(expected, rel=1e-14)
    coefficients = rng.normal(size=(7, 3, expected.shape[1])).astype(np.float32)
    ions = np.array([6, 0, 0, 3, 5, 1, 2])
    values = polynomials.evaluate(exponents_of(degree), coefficients, velocities, ions)
    scale = np.abs(coefficients[ions, :, None] * expected[:, None, None]).sum(axis=(2, 3))
    assert np.abs(values - np.einsum("nkc,nc->nk", coefficients[ions], expected)).max() <= 1e-14 * scale.max()


def test_fits_and_misfits(rng):
    matrix = polynomials.monomials(exponents_of(2), rng.normal(size=(11, 2)))
    values = rng.normal(size=(5, 11, 3))
    inverse = np.ascontiguousarray(np.linalg.pinv(matrix))
    coefficients = polynomials.fit(inverse, values)
    exact = np.stack([np.linalg.lstsq(matrix, each, rcond=None)[0].T for each in values])
    assert coefficients == pytest.approx(exact, abs=1e-13)
    squares = ((np.einsum("mc,nkc->nmk", matrix, exact) - values)[..., :2] ** 2).sum(axis=(1, 2))
    assert polynomials.misfits(matrix, coefficients, values) == pytest.approx(squares, rel=1e-12)


def test_five_variables(rng):
    exponents = rng.integers(0, 4, size=(30, 5)).astype(np.int8)
    points = rng.normal(size=(6, 5))
    expected = np.prod(points[:, None] ** exponents, axis=2)
    assert polynomials.monomials(exponents, points) == pytest.approx(expected, rel=1e-13)
    coefficients = rng.normal(size=(6, 3, 30)).astype(np.float32)
    scale = np.abs(coefficients).max() * np.abs(expected).sum(axis=1).max()
    values = polynomials.evaluate(exponents, coefficients, points, np.arange(6))
    assert np.abs(values - np.einsum("nkc,nc->nk", coefficients, expected)).max() <= 1e-13 * scale


@pytest.mark.parametrize(
    ("degree", "shape", "points"),
    [
        (1, (2, 3, 4), 2),
        (1, (3, 3, 3), 3),
        (1, (2, 2, 3), 2),
        (12, (2, 3, 90), 2),
        (0, (2, 3, 0), 2),
    ],
)
def test_shapes_that_do_not_fit_are_refused(degree, shape, points):
    with pytest.raises(ValueError, match="must have shape"):
        polynomials.evaluate(exponents_of(degree), np.zeros(shape, np.float32), np.zeros((points, 2)), np.zeros(2, int))


@pytest.mark.parametrize("ion", [-1, 2])
def test_ions_without_coefficients_are_refused(ion):
    with pytest.raises(ValueError, match="rows of the coefficients, 0 to 1"):
        polynomials.evaluate(exponents_of(1), np.zeros((2, 3, 3), np.float32), np.zeros((1, 2)), np.array([ion]))


@pytest.mark.parametrize("exponent", [-1, 13])
def test_exponents_out_of_range_are_refused(exponent):
    with pytest.raises(ValueError, match="exponents"):
        polynomials.monomials(np.array([[exponent, 0]], np.int8), np.zeros((2, 2)))
