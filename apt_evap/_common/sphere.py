"""Sphere through points, with the same bits on every processor."""

import math

import numpy as np

from apt_evap._common.small_matrices import matrix_product, products, pseudo_inverse
from apt_evap._common.types import Floats


def fit_sphere(points: Floats) -> tuple[Floats, float]:
    """Algebraic least-squares sphere through points.

    Parameters
    ----------
    points : ndarray
        At least four points [nm], shape (n, 3).

    Returns
    -------
    centre : ndarray, shape (3,)
        Centre [nm].
    radius : float
        Radius [nm].

    Notes
    -----
    The sphere minimises the sum of (|r - c|^2 - R^2)^2, a linear problem for c and R^2 - |c|^2. On a rough cap it is a
    little too small, and single points far inside make it smaller: `analysis.fit_caps` is robust against them.
    """
    middle = points.mean(axis=0)
    shifted = points - middle
    matrix = np.column_stack([2.0 * shifted, np.ones(len(shifted))])
    right = products(shifted, shifted)
    inverse = pseudo_inverse(matrix_product(matrix.T, matrix))
    *centre, rest = matrix_product(inverse, matrix_product(matrix.T, right)).tolist()
    return middle + centre, math.sqrt(max(rest + float(products(centre, centre)), 0.0))
