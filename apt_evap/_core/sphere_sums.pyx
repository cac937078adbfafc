"""Sums over the atoms of a cap: which atoms are in a cone, and the equations of the sphere through points.

Loops in a fixed order: the bits do not depend on the processor.
"""

from libc.math cimport sqrt

import numpy as np

from apt_evap._core.index cimport Index


def in_cone(const double[:, ::1] points, double x, double y, double z, double cosine):
    """Points within an angle from the direction +z, seen from (x, y, z).

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points [nm], or unit vectors seen from the origin.
    x, y, z : float
        Apex of the cone [nm].
    cosine : float
        Cosine of the angle, above 0.

    Returns
    -------
    ndarray of int64, shape (m,)
        Indices of the points.
    """
    cdef Index[::1] inside = np.empty(points.shape[0], np.int64)
    cdef Index k, n = 0
    cdef double dx, dy, dz
    for k in range(points.shape[0]):
        dz = points[k, 2] - z
        if dz >= 0.0:
            dx, dy = points[k, 0] - x, points[k, 1] - y
            if dz >= cosine * sqrt(dx * dx + dy * dy + dz * dz):
                inside[n] = k
                n += 1
    return np.asarray(inside)[:n].copy()


def sphere_equations(const double[:, ::1] points, const Index[::1] chosen):
    """Normal equations of the algebraic least-squares sphere through points: 2 c.d + (R^2 - |c|^2) = |d|^2.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points [nm].
    chosen : ndarray of int64, shape (m,)
        Indices of those that count, at least one.

    Returns
    -------
    middle : ndarray, shape (3,)
        Mean of these points [nm], the origin of d and c.
    matrix : ndarray, shape (4, 4)
        Matrix of the equations for c and R^2 - |c|^2.
    right : ndarray, shape (4,)
        Their right side.
    """
    cdef double[::1] middle = np.zeros(3), right = np.zeros(4)
    cdef double[:, ::1] matrix = np.zeros((4, 4))
    cdef double[4] row
    cdef double square
    cdef Index i, k, m = chosen.shape[0]
    cdef int j, other
    for i in range(m):
        for j in range(3):
            middle[j] += points[chosen[i], j]
    for j in range(3):
        middle[j] /= m
    row[3] = 1.0
    for i in range(m):
        k = chosen[i]
        square = 0.0
        for j in range(3):
            row[j] = 2.0 * (points[k, j] - middle[j])
            square += 0.25 * row[j] * row[j]
        for j in range(4):
            right[j] += row[j] * square
            for other in range(j + 1):
                matrix[j, other] += row[j] * row[other]
    for j in range(4):
        for other in range(j):
            matrix[other, j] = matrix[j, other]
    return np.asarray(middle), np.asarray(matrix), np.asarray(right)
