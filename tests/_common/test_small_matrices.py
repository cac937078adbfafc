"""Small matrices against LAPACK."""

import numpy as np
import pytest

from apt_evap._common.small_matrices import (
    left_inverse,
    lengths,
    matrix_product,
    products,
    pseudo_inverse,
    squared_lengths,
)


@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (5, 5), (78, 56)])
def test_left_inverse(shape, rng):
    matrix = rng.normal(size=shape) * np.logspace(0, 3, shape[1])
    np.testing.assert_allclose(left_inverse(matrix), np.linalg.pinv(matrix), rtol=0, atol=1e-12)
    np.testing.assert_allclose(left_inverse(matrix) @ matrix, np.eye(shape[1]), atol=1e-10)


@pytest.mark.parametrize("shape", [(25, 15), (3, 6), (4, 4), (9, 1)])
def test_pseudo_inverse(shape, rng):
    matrix = rng.normal(size=shape)
    assert pseudo_inverse(matrix) == pytest.approx(np.linalg.pinv(matrix), abs=1e-13)


@pytest.mark.parametrize("shape", [(9, 5), (5, 9)])
def test_pseudo_inverse_of_less_than_full_rank(shape, rng):
    matrix = rng.normal(size=(shape[0], 3)) @ rng.normal(size=(3, shape[1]))
    assert pseudo_inverse(matrix) == pytest.approx(np.linalg.pinv(matrix, rcond=1e-12), abs=1e-12)


def test_products_and_lengths(rng):
    a, b = rng.normal(size=(6, 3)), rng.normal(size=(3, 3))
    assert matrix_product(a, b) == pytest.approx(a @ b, rel=1e-13)
    assert matrix_product(b, a[0]) == pytest.approx(b @ a[0], rel=1e-13)
    assert matrix_product(a[0], b) == pytest.approx(a[0] @ b, rel=1e-13)
    assert lengths(a) == pytest.approx(np.linalg.norm(a, axis=1), rel=1e-15)
    assert squared_lengths(a) == pytest.approx((a**2).sum(axis=1), rel=1e-15)
    assert products(a, a[::-1]) == pytest.approx(np.einsum("ij,ij->i", a, a[::-1]), rel=1e-12, abs=1e-15)
