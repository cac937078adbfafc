"""Fit and evaluation of polynomials of two velocities, for the responses of ions; sums in a fixed order.

The (d + 1)(d + 2)/2 monomials up to degree d are u^(t - j) v^j for t = 0 ... d and j = 0 ... t.
"""

import numpy as np

cdef enum:
    MAX_DEGREE = 12
    MAX_MONOMIALS = (MAX_DEGREE + 1) * (MAX_DEGREE + 2) // 2

HIGHEST_DEGREE = MAX_DEGREE


cdef int fill(int degree, double u, double v, double* monomial) noexcept nogil:
    # All monomials of one velocity; returns their number.
    cdef double power_u[MAX_DEGREE + 1]
    cdef double power_v[MAX_DEGREE + 1]
    cdef int total, j, n = 0
    power_u[0] = power_v[0] = 1.0
    for j in range(degree):
        power_u[j + 1], power_v[j + 1] = power_u[j] * u, power_v[j] * v
    for total in range(degree + 1):
        for j in range(total + 1):
            monomial[n] = power_u[total - j] * power_v[j]
            n += 1
    return n


def monomials(int degree, const double[:, ::1] velocities):
    """Monomials of velocities, shape (n, 2) -> (n, monomials)."""
    cdef long i
    cdef double[:, ::1] values = np.empty((velocities.shape[0], (degree + 1) * (degree + 2) // 2))
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be 0 to {MAX_DEGREE}, got {degree}")
    with nogil:
        for i in range(velocities.shape[0]):
            fill(degree, velocities[i, 0], velocities[i, 1], &values[i, 0])
    return np.asarray(values)


def fit(const double[:, ::1] inverse, const double[:, :, ::1] values):
    """Coefficients of the least-squares fit.

    Parameters
    ----------
    inverse : ndarray, shape (c, m)
        Pseudo-inverse of the monomials (m, c) of the m launches.
    values : ndarray, shape (n, m, 3)
        Three quantities at the m launches of n ions.

    Returns
    -------
    ndarray, shape (n, 3, c)
    """
    cdef long i, j, k, c, n = values.shape[0], m = values.shape[1]
    cdef double total
    cdef double[:, :, ::1] coefficients = np.empty((n, 3, inverse.shape[0]))
    with nogil:
        for i in range(n):
            for k in range(3):
                for c in range(inverse.shape[0]):
                    total = 0.0
                    for j in range(m):
                        total += inverse[c, j] * values[i, j, k]
                    coefficients[i, k, c] = total
    return np.asarray(coefficients)


def misfits(const double[:, ::1] matrix, const double[:, :, ::1] coefficients, const double[:, :, ::1] values):
    """Sums of the squared misfits of the first two quantities over the launches, shape (n,).

    Parameters
    ----------
    matrix : ndarray, shape (m, c)
        Monomials of the launches.
    coefficients : ndarray, shape (n, 3, c)
        Coefficients of the polynomials.
    values : ndarray, shape (n, m, 3)
        Results of the launches.
    """
    cdef long i, j, k, c
    cdef double total, squares
    cdef double[::1] sums = np.empty(values.shape[0])
    with nogil:
        for i in range(values.shape[0]):
            squares = 0.0
            for j in range(matrix.shape[0]):
                for k in range(2):
                    total = 0.0
                    for c in range(matrix.shape[1]):
                        total += matrix[j, c] * coefficients[i, k, c]
                    total -= values[i, j, k]
                    squares += total * total
            sums[i] = squares
    return np.asarray(sums)


def evaluate(int degree, const float[:, :, ::1] coefficients, const double[:, ::1] velocities):
    """Values of the polynomials of n ions, each at its own velocity.

    Parameters
    ----------
    degree : int
        Degree, at most 12.
    coefficients : ndarray of float32, shape (n, 3, c)
        Coefficients of the three quantities of each ion.
    velocities : ndarray, shape (n, 2)
        Velocities.

    Returns
    -------
    ndarray, shape (n, 3)
    """
    cdef double monomial[MAX_MONOMIALS]
    cdef double total
    cdef long i, n = velocities.shape[0]
    cdef int k, c, m = (degree + 1) * (degree + 2) // 2
    cdef double[:, ::1] values = np.empty((n, 3))
    if not 0 <= degree <= MAX_DEGREE or coefficients.shape[0] != n or coefficients.shape[1] != 3 \
            or coefficients.shape[2] != m:
        raise ValueError(
            f"coefficients of degree {degree} must have shape ({n}, 3, {m}), got "
            f"{(coefficients.shape[0], coefficients.shape[1], coefficients.shape[2])}"
        )
    with nogil:
        for i in range(n):
            fill(degree, velocities[i, 0], velocities[i, 1], monomial)
            for k in range(3):
                total = 0.0
                for c in range(m):
                    total += coefficients[i, k, c] * monomial[c]
                values[i, k] = total
    return np.asarray(values)
