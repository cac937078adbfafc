"""Elementary functions of our own against those of NumPy and SciPy, whose bits depend on the processor."""

import math

import numpy as np
import pytest
import scipy

from apt_evap._core.elementary import (
    arctangent,
    exponential,
    logarithm,
    normal_quantile,
    seventh_root_of_reciprocal,
    sine_and_cosine,
    total,
)


def test_sine_and_cosine(rng):
    angles = np.concatenate(
        [rng.uniform(-7, 7, 20_000), rng.uniform(-1e5, 1e5, 20_000), np.arange(-8, 9) * math.pi / 4]
    )
    sine, cosine = sine_and_cosine(angles)
    assert np.abs(sine - np.sin(angles)).max() < 3e-16
    assert np.abs(cosine - np.cos(angles)).max() < 3e-16
    assert sine_and_cosine(0.0) == (0.0, 1.0)
    assert sine_and_cosine(angles.reshape(-1, 1))[0].shape == (len(angles), 1)


def test_arctangent(rng):
    numbers = np.concatenate([10 ** rng.uniform(-12, 12, 20_000), -(10 ** rng.uniform(-12, 12, 20_000))])
    np.testing.assert_allclose(arctangent(numbers), np.arctan(numbers), rtol=1e-15, atol=0, equal_nan=False)
    assert arctangent(0.0) == 0.0 and arctangent(np.inf) == math.pi / 2 and np.isnan(arctangent(np.nan))


def test_logarithm(rng):
    numbers = np.concatenate([rng.uniform(0, 2, 20_000), 10 ** rng.uniform(-300, 300, 20_000), [5e-324]])
    np.testing.assert_allclose(logarithm(numbers), np.log(numbers), rtol=6e-16, atol=0, equal_nan=False)
    assert logarithm(1.0) == 0.0


def test_exponential(rng):
    numbers = np.concatenate([rng.uniform(-700, 700, 20_000), rng.uniform(-1, 1, 20_000), np.arange(-20.0, 21)])
    np.testing.assert_allclose(exponential(numbers), np.exp(numbers), rtol=4e-16, atol=0, equal_nan=False)
    assert exponential([0.0, -np.inf, np.inf, -1e9, 1e9]).tolist() == [1.0, 0.0, np.inf, 0.0, np.inf]
    assert np.isnan(exponential(np.nan))
    assert exponential([-745.0, 709.7]) == pytest.approx([5e-324, np.exp(709.7)], rel=1e-12)


def test_seventh_root_of_the_reciprocal(rng):
    numbers = np.concatenate([10 ** rng.uniform(-12, 30, 20_000), 2.0 ** np.arange(-40, 90)])
    assert seventh_root_of_reciprocal(numbers) == pytest.approx(numbers ** (-1 / 7), rel=2e-15)


def test_quantile_of_the_normal_distribution(rng):
    p = np.concatenate([rng.uniform(0, 1, 20_000), 10 ** rng.uniform(-300, -1, 20_000), [1 - 2**-53]])
    np.testing.assert_allclose(normal_quantile(p), scipy.special.ndtri(p), rtol=3e-15, atol=0, equal_nan=False)
    assert normal_quantile([0.0, 0.5, 1.0]).tolist() == [-np.inf, 0.0, np.inf]
    assert np.isnan(normal_quantile([np.nan, -0.1, 1.1])).all()


def pairwise(numbers):
    """Sum in the order of the definition: halves, and up to 128 numbers in eight sums."""
    n = len(numbers)
    if n > 128:
        half = n // 2 - n // 2 % 8
        return pairwise(numbers[:half]) + pairwise(numbers[half:])
    sums, whole = np.zeros(8), n - n % 8
    for row in numbers[:whole].reshape(-1, 8):
        sums += row
    result = ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]))
    for number in numbers[whole:]:
        result += number
    return result


@pytest.mark.parametrize("n", [0, 1, 7, 8, 127, 129, 1000, 8191, 8193, 20_001, 300_007])
def test_total_has_one_order(rng, n):
    numbers = 10 ** rng.uniform(-3, 3, n) * rng.choice((-1, 1), n)
    assert total(numbers) == pairwise(numbers)
    assert total(numbers) == pytest.approx(math.fsum(numbers), rel=1e-13, abs=1e-9)
    assert total(np.repeat(numbers, 2)[::2]) == total(numbers)
