"""Elementary functions, bit-identical on every processor, with every C library and every version of NumPy."""

import numpy as np

from apt_evap._core.index cimport Index


cdef extern from "elementary.h":
    void sine_cosine(double, double*, double*) noexcept nogil
    double arc_tangent(double) noexcept nogil
    double natural_logarithm(double) noexcept nogil
    double exponential_of(double) noexcept nogil
    double inverse_seventh_root(double) noexcept nogil
    double quantile_of_normal(double) noexcept nogil


def sine_and_cosine(angles):
    """Sine and cosine of angles [rad] up to 1e5, of any shape; errors below 3e-16."""
    cdef Index i
    shape = np.shape(angles)
    cdef const double[::1] values = np.ascontiguousarray(angles, np.float64).reshape(-1)
    cdef double[::1] sine = np.empty(values.shape[0]), cosine = np.empty(values.shape[0])
    with nogil:
        for i in range(values.shape[0]):
            sine_cosine(values[i], &sine[i], &cosine[i])
    return np.asarray(sine).reshape(shape)[()], np.asarray(cosine).reshape(shape)[()]


cdef apply(double (*function)(double) noexcept nogil, numbers):
    # A function of each of the numbers, in their shape.
    cdef Index i
    cdef const double[::1] values = np.ascontiguousarray(numbers, np.float64).reshape(-1)
    cdef double[::1] results = np.empty(values.shape[0])
    with nogil:
        for i in range(values.shape[0]):
            results[i] = function(values[i])
    return np.asarray(results).reshape(np.shape(numbers))[()]


def arctangent(numbers):
    """Arctangent [rad] of numbers of any shape; relative errors below 1e-15."""
    return apply(arc_tangent, numbers)


def logarithm(numbers):
    """Natural logarithm of positive numbers of any shape; relative errors below 5e-16."""
    return apply(natural_logarithm, numbers)


def exponential(numbers):
    """e^x of numbers of any shape; relative errors below 4e-16, 0 or inf outside the range of float64."""
    return apply(exponential_of, numbers)


def seventh_root_of_reciprocal(numbers):
    """x^(-1/7) of positive numbers of any shape, for the steps of flights; relative errors below 2e-15."""
    return apply(inverse_seventh_root, numbers)


def normal_quantile(probabilities):
    """Quantile of the standard normal distribution for numbers of any shape; -inf at 0, inf at 1.

    Relative errors are below 2e-15 (Wichura, Applied Statistics 37, 477, 1988, algorithm AS 241).
    """
    return apply(quantile_of_normal, probabilities)


def total(numbers):
    """Sum of an array; versions of NumPy add more than 8192 numbers in different orders."""
    cdef const double[::1] values = np.ascontiguousarray(numbers, np.float64).reshape(-1)
    return pairwise(&values[0], values.shape[0]) if values.shape[0] else 0.0


cdef double pairwise(const double* values, Index n) noexcept nogil:
    # Halves are added, and up to 128 numbers in eight sums: the order of NumPy 2.4.
    cdef double sums[8]
    cdef double result = 0.0
    cdef Index i, half = n // 2 - n // 2 % 8
    cdef int lane
    if n > 128:
        return pairwise(values, half) + pairwise(values + half, n - half)
    if n >= 8:
        for lane in range(8):
            sums[lane] = values[lane]
        for i in range(8, n - 7, 8):
            for lane in range(8):
                sums[lane] += values[i + lane]
        result = ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]))
    for i in range(n - n % 8, n):
        result += values[i]
    return result
