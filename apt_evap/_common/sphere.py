"""Sphere through points, with the same bits on every processor."""

import math

import numpy as np

from apt_evap._common.small_matrices import matrix_product, products, pseudo_inverse
from apt_evap._common.types import Floats, Integers
from apt_evap._core.sphere_sums import sphere_equations


def fit_sphere(points: Floats, chosen: Integers | None = None) -> tuple[Floats, float]:
    """Centre and radius of the sphere through points [nm], shape (n, 3), or those with the indices `chosen`.

    It minimises the sum of (|r - c|^2 - R^2)^2, a linear problem for c and R^2 - |c|^2. On a rough cap it is a little
    too small, and single points far inside make it smaller: `simulation.fit_caps` is robust against them.
    """
    chosen = np.arange(len(points)) if chosen is None else chosen
    middle, matrix, right = sphere_equations(np.ascontiguousarray(points, np.float64), chosen)
    *centre, rest = matrix_product(pseudo_inverse(matrix), right).tolist()
    return middle + centre, math.sqrt(max(rest + float(products(centre, centre)), 0.0))
