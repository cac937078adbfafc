"""The expansion of a far field about a ball, against the field itself."""

import numpy as np
import pytest

from apt_evap._core.far_field import POTENTIAL_ORDER, FarField, exponents

CENTRE = np.array([3.0, -2.0, 40.0])


def field_of(charge, points):
    """Field of a unit charge."""
    steps = points - charge
    return steps / np.linalg.norm(steps, axis=1, keepdims=True) ** 3


def points_in_ball(n, radius, seed=0):
    """Random points in a ball about CENTRE."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return CENTRE + radius * random.uniform(size=(n, 1)) ** (1 / 3) * directions


def errors(distance, radius=0.4):
    """Errors of the expanded fields of 30 charges at a distance in radii, relative to the field at the centre."""
    random = np.random.default_rng(7)
    points, far_field, found = points_in_ball(200, radius), FarField(CENTRE, radius), []
    for _ in range(30):
        direction = random.normal(size=3)
        charge = CENTRE + distance * radius * direction / np.linalg.norm(direction)
        far_field.fit(field_of(charge, far_field.samples))
        difference = far_field.fields(points) - field_of(charge, points)
        found.append(np.linalg.norm(difference, axis=1) * (distance * radius) ** 2)
    return np.array(found)


def test_the_error_falls_with_the_order_of_the_distance():
    rms = [float(np.sqrt((errors(distance) ** 2).mean())) for distance in (3.0, 4.5, 9.0)]
    assert rms[0] < 3e-3  # measured 2.1e-3
    assert rms[1] < 2.5e-4  # measured 1.8e-4
    # halving the size of the ball divides the error by 2**ORDER, as long as rounding to single precision is smaller
    assert rms[1] / rms[2] == pytest.approx(2.0**POTENTIAL_ORDER, rel=0.25)


def test_a_field_of_the_expansion_is_reproduced():
    # a uniform field with a gradient: E = (1 + 2 x, -3 x, ...) without divergence and curl
    gradient = np.array([[0.5, 0.2, -0.1], [0.2, 0.7, 0.3], [-0.1, 0.3, -1.2]])
    far_field, points = FarField(CENTRE, 2.0), points_in_ball(50, 2.0)
    far_field.fit(np.array([1.0, -2.0, 0.5]) + (far_field.samples - CENTRE) @ gradient)
    expected = np.array([1.0, -2.0, 0.5]) + (points - CENTRE) @ gradient
    # single precision: about ten roundings of values of order one
    assert np.abs(far_field.fields(points) - expected).max() < 1e-5


def test_the_polynomials_against_a_twin():
    """The field of any samples is a polynomial of the stated monomials, and the least squares fit to the samples."""
    random = np.random.default_rng(3)
    far_field, points = FarField(CENTRE, 1.0), points_in_ball(300, 1.0, seed=4)
    samples = random.normal(size=far_field.samples.shape)
    far_field.fit(samples)

    def monomials(places):
        return np.prod((places - CENTRE)[:, None] ** exponents()[None], axis=2)

    fields, at_samples = far_field.fields(points), far_field.fields(far_field.samples)
    for axis in range(3):
        coefficients, _, rank, _ = np.linalg.lstsq(monomials(points), fields[:, axis], rcond=None)
        assert rank == len(exponents())
        # values of order one in single precision
        assert np.abs(monomials(points) @ coefficients - fields[:, axis]).max() < 1e-5
    # the residual of a least squares fit is orthogonal to what is fitted
    assert abs(((samples - at_samples) * at_samples).sum()) < 1e-4 * (samples**2).sum()


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="field"):
        FarField(CENTRE, 1.0).fit(np.zeros((2, 3)))
