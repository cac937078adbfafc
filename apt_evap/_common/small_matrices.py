"""Products, inverses and lengths of small matrices, with the same bits on every processor and with every BLAS.

Only additions, multiplications, divisions and square roots in a fixed order are used: these are rounded correctly on
every processor (IEEE 754). The order of summation of BLAS and LAPACK depends on the processor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats


def matrix_product(first: ArrayLike, second: ArrayLike) -> Floats:
    """Product of small matrices; shapes (m,) or (n, m), and (m,) or (m, k)."""
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if second.ndim == 1:
        return (first * second).sum(axis=-1)
    return (first[..., None, :] * second.T).sum(axis=-1)


def squared_lengths(vectors: ArrayLike) -> Any:
    """Squared lengths of vectors along the last axis, shape (..., m) -> (...)."""
    vectors = np.asarray(vectors, dtype=np.float64)
    total = vectors[..., 0] * vectors[..., 0]
    for k in range(1, vectors.shape[-1]):
        total = total + vectors[..., k] * vectors[..., k]
    return total


def lengths(vectors: ArrayLike) -> Any:
    """Lengths of vectors along the last axis, shape (..., m) -> (...)."""
    return np.sqrt(squared_lengths(vectors))


def products(first: ArrayLike, second: ArrayLike) -> Any:
    """Scalar products along the last axis, shapes (..., m) -> (...)."""
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    total = first[..., 0] * second[..., 0]
    for k in range(1, first.shape[-1]):
        total = total + first[..., k] * second[..., k]
    return total


def left_inverse(matrix: Floats) -> Floats:
    """Moore-Penrose inverse of a matrix whose columns are independent, shape (m, n) -> (n, m).

    Gram-Schmidt orthogonalisation of the columns, and back substitution: much faster than `pseudo_inverse`.
    """
    columns = np.array(matrix.T, dtype=np.float64, order="C")  # each column is a row here
    n = len(columns)
    triangle = np.zeros((n, n))
    for k in range(n):
        triangle[k, k] = math.sqrt(float((columns[k] * columns[k]).sum()))
        columns[k] /= triangle[k, k]
        triangle[k, k + 1 :] = (columns[k + 1 :] * columns[k]).sum(axis=1)
        columns[k + 1 :] -= triangle[k, k + 1 :, None] * columns[k]
    for k in range(n - 1, -1, -1):
        known = (triangle[k, k + 1 :, None] * columns[k + 1 :]).sum(axis=0)
        columns[k] = (columns[k] - known) / triangle[k, k]
    return columns


def pseudo_inverse(matrix: Floats) -> Floats:
    """Moore-Penrose inverse of a small matrix, shape (m, n) -> (n, m).

    One-sided Jacobi rotations (Hestenes, J. SIAM 6, 51, 1958): pairs of columns are rotated until all columns are
    orthogonal. Their lengths are then the singular values. Values below 1e-13 of the largest one are treated as 0.
    """
    if matrix.shape[0] < matrix.shape[1]:
        return np.ascontiguousarray(pseudo_inverse(matrix.T).T)
    columns = np.array(matrix.T, dtype=np.float64)  # each column is a row here
    rotations = np.eye(len(columns))
    for _ in range(60):
        rotated = False
        for p in range(len(columns) - 1):
            for q in range(p + 1, len(columns)):
                first, second = columns[p], columns[q]
                a, b, c = float((first * first).sum()), float((second * second).sum()), float((first * second).sum())
                if abs(c) <= 1e-16 * math.sqrt(a * b):
                    continue
                rotated = True
                zeta = (b - a) / (2.0 * c)
                tangent = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
                for rows in (columns, rotations):
                    rows[p], rows[q] = (
                        cosine * rows[p] - cosine * tangent * rows[q],
                        cosine * tangent * rows[p] + cosine * rows[q],
                    )
        if not rotated:
            break
    squares = (columns * columns).sum(axis=1)
    large = squares > 1e-26 * squares.max()
    weights = np.divide(1.0, squares, out=np.zeros_like(squares), where=large)
    return np.ascontiguousarray(matrix_product(rotations.T * weights, columns))
