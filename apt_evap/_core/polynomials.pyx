"""Fit and evaluation of polynomials, for the responses of ions; sums in a fixed order.

A monomial is a product of powers of the variables, and is given by its exponents.
"""

import numpy as np

from apt_evap._core.index cimport Index

cdef enum:
    MAX_DEGREE = 12
    MAX_VARIABLES = 8
    MAX_MONOMIALS = 512

HIGHEST_DEGREE = MAX_DEGREE


cdef void fill(const signed char[:, ::1] exponents, const double* variables, double* monomial) noexcept nogil:
    # All monomials at one point.
    cdef double power[MAX_VARIABLES * (MAX_DEGREE + 1)]
    cdef Index c, v, d, n_variables = exponents.shape[1]
    for v in range(n_variables):
        power[v * (MAX_DEGREE + 1)] = 1.0
        for d in range(MAX_DEGREE):
            power[v * (MAX_DEGREE + 1) + d + 1] = power[v * (MAX_DEGREE + 1) + d] * variables[v]
    for c in range(exponents.shape[0]):
        monomial[c] = power[exponents[c, 0]]
        for v in range(1, n_variables):
            monomial[c] *= power[v * (MAX_DEGREE + 1) + exponents[c, v]]


cdef void add_scaled(Index n, double factor, const double* values, double* totals) noexcept nogil:
    cdef Index c
    for c in range(n):
        totals[c] += values[c] * factor


def _check(exponents):
    if exponents.shape[0] > MAX_MONOMIALS or not 1 <= exponents.shape[1] <= MAX_VARIABLES \
            or np.min(exponents) < 0 or np.max(exponents) > MAX_DEGREE:
        raise ValueError(
            f"exponents must be 0 to {MAX_DEGREE}, at most {MAX_MONOMIALS} of {MAX_VARIABLES} variables, got shape "
            f"{exponents.shape}"
        )


def monomials(const signed char[:, ::1] exponents, const double[:, ::1] variables):
    """Monomials at points, shapes (c, v) and (n, v) -> (n, c)."""
    cdef Index i
    cdef double[:, ::1] values = np.empty((variables.shape[0], exponents.shape[0]))
    _check(np.asarray(exponents))
    with nogil:
        for i in range(variables.shape[0]):
            fill(exponents, &variables[i, 0], &values[i, 0])
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
    cdef Index i, j, k, n = values.shape[0], m = values.shape[1], n_monomials = inverse.shape[0]
    # the innermost loop is over the coefficients: each has its sum in the order of the launches
    cdef double[:, ::1] columns = np.ascontiguousarray(np.asarray(inverse).T)
    cdef double[:, :, ::1] coefficients = np.zeros((n, 3, n_monomials))
    if n and m and n_monomials:
        with nogil:
            for i in range(n):
                for j in range(m):
                    for k in range(3):
                        add_scaled(n_monomials, values[i, j, k], &columns[j, 0], &coefficients[i, k, 0])
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
    cdef Index i, j, k, c, n = values.shape[0], m = matrix.shape[0]
    cdef double total
    cdef double[:, ::1] columns = np.ascontiguousarray(np.asarray(matrix).T)
    cdef double[:, ::1] fitted = np.empty((2, m))
    cdef double[::1] sums = np.zeros(n)
    if n and m:
        with nogil:
            for i in range(n):
                fitted[:, :] = 0.0
                for k in range(2):
                    for c in range(matrix.shape[1]):
                        add_scaled(m, coefficients[i, k, c], &columns[c, 0], &fitted[k, 0])
                for j in range(m):
                    for k in range(2):
                        total = fitted[k, j] - values[i, j, k]
                        sums[i] += total * total
    return np.asarray(sums)


def evaluate(
    const signed char[:, ::1] exponents,
    const float[:, :, ::1] coefficients,
    const double[:, ::1] variables,
    const Index[::1] ions,
):
    """Values of the polynomials of n ions, each at its own point.

    Parameters
    ----------
    exponents : ndarray of int8, shape (c, v)
        Exponents of the monomials.
    coefficients : ndarray of float32, shape (m, 3, c)
        Coefficients of the three quantities of all ions.
    variables : ndarray, shape (n, v)
        Points.
    ions : ndarray of int, shape (n,)
        Rows of the ions in `coefficients`.

    Returns
    -------
    ndarray, shape (n, 3)
    """
    cdef double monomial[MAX_MONOMIALS]
    cdef double first, second, third
    cdef Index i, ion, n = ions.shape[0]
    cdef int c, m = <int>exponents.shape[0]
    cdef double[:, ::1] values = np.empty((n, 3))
    _check(np.asarray(exponents))
    if coefficients.shape[1] != 3 or coefficients.shape[2] != m or variables.shape[0] != n \
            or variables.shape[1] != exponents.shape[1]:
        raise ValueError(
            f"coefficients of {m} monomials must have shape (ions, 3, {m}), and variables ({n}, {exponents.shape[1]}), "
            f"got {(coefficients.shape[0], coefficients.shape[1], coefficients.shape[2])} and "
            f"{(variables.shape[0], variables.shape[1])}"
        )
    if n and not 0 <= np.min(np.asarray(ions)) <= np.max(np.asarray(ions)) < coefficients.shape[0]:
        raise ValueError(f"ions must be rows of the coefficients, 0 to {coefficients.shape[0] - 1}")
    with nogil:
        for i in range(n):
            ion = ions[i]
            fill(exponents, &variables[i, 0], monomial)
            # three sums side by side: none waits for the addition before
            first = second = third = 0.0
            for c in range(m):
                first += coefficients[ion, 0, c] * monomial[c]
                second += coefficients[ion, 1, c] * monomial[c]
                third += coefficients[ion, 2, c] * monomial[c]
            values[i, 0], values[i, 1], values[i, 2] = first, second, third
    return np.asarray(values)
