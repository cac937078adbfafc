"""Expansion of the field of distant charges about a ball of targets.

The potential of charges outside a ball is harmonic inside. Up to an order, the expansion in harmonic polynomials is
fitted to the field at points on a sphere in the ball (least squares, with a fixed matrix). It then replaces the sums
over the charges at any number of points inside: a local expansion as in fast multipole methods (Greengard and Rokhlin,
J. Comput. Phys. 73, 325, 1987), but from sums of any kind of source. The error of a charge at the distance kappa radii
from the centre decreases as kappa**-ORDER.

Harmonic polynomials of degree l are the real and imaginary parts of (n . r)**l with n = (cos f, sin f, i), for l + 1
and l values of f.
"""

import functools

import numpy as np

import apt_evap._core.elementary as elementary

from apt_evap._core.index cimport Index

cdef extern from "kernels.h":
    const int SINGLE_LANES
    void add_polynomials(const float*, const float*, float, Index, const float*, float*) noexcept nogil
    void weighted_sum(Index, int, const double*, const double*, Index, double*) noexcept nogil

N_SAMPLES, POTENTIAL_ORDER = SAMPLES, ORDER

DEPTH = 0.8
"""Radius of the sphere of the samples over that of the ball.

The harmonics above the order disturb the fit less than at the rim of the ball. Measured (sheets of charges beyond 3.2
radii, places along a tube, RMS errors): 24 samples at 1 / 0.9 / 0.8 have 1.64e-4 / 1.46e-4 / 1.37e-4, 20 samples
2.2e-4 / 1.78e-4 / 1.56e-4, 18 samples 3.1e-4 / 2.4e-4 / 1.95e-4.
"""


def _directions():
    """Points along a spiral on a sphere in the unit ball, shape (SAMPLES, 3)."""
    number = np.arange(SAMPLES) + 0.5
    z = 1.0 - 2.0 * number / SAMPLES
    sine, cosine = elementary.sine_and_cosine(np.pi * (1.0 + np.sqrt(5.0)) * number)
    radius = np.sqrt(1.0 - z * z)
    return DEPTH * np.stack([radius * cosine, radius * sine, z], axis=1)


def exponents():
    """Exponents of x, y and z in the order of the coefficients, shape (MONOMIALS, 3)."""
    return np.array([(i, j, k) for i in range(ORDER) for j in range(ORDER - i) for k in range(ORDER - i - j)])


def _basis():
    """Fields of the harmonic polynomials as coefficients of monomials, shape (harmonics, MONOMIALS, 3)."""
    place = {tuple(powers): number for number, powers in enumerate(exponents().tolist())}
    fields = []
    for degree in range(1, ORDER + 1):
        for count, imaginary in ((degree + 1, 0), (degree, 1)):
            sines, cosines = elementary.sine_and_cosine(np.pi * np.arange(count) / count)
            for sine, cosine in zip(sines, cosines):
                # (n . r)**(degree - 1) n, multiplied out
                power = {(0, 0, 0): (1.0, 0.0)}
                for _ in range(degree - 1):
                    new = {}
                    for (i, j, k), (re, im) in power.items():
                        for key, add in (
                            ((i + 1, j, k), (re * cosine, im * cosine)),
                            ((i, j + 1, k), (re * sine, im * sine)),
                            ((i, j, k + 1), (-im, re)),
                        ):
                            old = new.get(key, (0.0, 0.0))
                            new[key] = old[0] + add[0], old[1] + add[1]
                    power = new
                field = np.zeros((MONOMIALS, 3))
                for key, (re, im) in power.items():
                    parts = (re * cosine, im * cosine), (re * sine, im * sine), (-im, re)
                    field[place[key]] = [part[imaginary] for part in parts]
                fields.append(field)
    return np.array(fields)


def _product(first, second):
    """Matrix product in a fixed order of summation: that of BLAS depends on the processor."""
    return (first[:, None, :] * second.T).sum(axis=-1)


def _inverse(matrix):
    """Pseudo-inverse of a well-conditioned matrix (m, n) with independent columns, by modified Gram-Schmidt; (n, m)."""
    columns = np.array(matrix.T)   # each column is a row here
    n = len(columns)
    upper, inverse = np.zeros((n, n)), np.zeros_like(columns)
    for k in range(n):
        upper[k, k] = np.sqrt((columns[k] * columns[k]).sum())
        columns[k] /= upper[k, k]
        upper[k, k + 1:] = (columns[k + 1:] * columns[k]).sum(axis=1)
        columns[k + 1:] -= upper[k, k + 1:, None] * columns[k]
    for k in range(n - 1, -1, -1):   # upper . inverse = orthogonal columns
        inverse[k] = (columns[k] - (upper[k, k + 1:, None] * inverse[k + 1:]).sum(axis=0)) / upper[k, k]
    return inverse


@functools.lru_cache
def _matrix():
    """Coefficients of the field from its values at the samples, shape (3 SAMPLES, 3 MONOMIALS)."""
    powers, directions = exponents(), _directions()
    values = np.ones((SAMPLES, MONOMIALS))
    for axis in range(3):
        power = np.ones(SAMPLES)
        for exponent in range(ORDER):
            values[:, powers[:, axis] == exponent] *= power[:, None]
            power = power * directions[:, axis]
    basis = _basis()
    by_component = [_product(values, basis[:, :, axis].T) for axis in range(3)]   # (SAMPLES, harmonics)
    inverse = _inverse(np.stack(by_component, axis=1).reshape(3 * SAMPLES, -1))   # (harmonics, 3 SAMPLES)
    by_component = [_product(inverse.T, basis[:, :, axis]) for axis in range(3)]  # (3 SAMPLES, MONOMIALS)
    return np.ascontiguousarray(np.concatenate(by_component, axis=1))


cdef void add_expanded(const Expansion* expansion, const double* origin, Index m, const float* targets,
                       float* field) noexcept nogil:
    # Adds the field at m places relative to the origin, in the layout of the kernels.
    cdef float[3] centre
    cdef int axis
    for axis in range(3):
        centre[axis] = <float>(expansion.centre[axis] - origin[axis])
    add_polynomials(expansion.coefficients, centre, <float>(1.0 / expansion.radius), m, targets, field)


cdef class FarField:
    """Expansion of a field about a ball.

    Parameters
    ----------
    centre : array_like, shape (3,)
        Centre of the ball [nm].
    radius : float
        Radius of the ball [nm].
    """

    def __init__(self, centre, double radius):
        self.matrix, self.directions = _matrix(), _directions()
        self.expansion.centre[0], self.expansion.centre[1], self.expansion.centre[2] = centre
        self.expansion.radius = radius

    cdef void point(self, const Expansion* expansion, int sample, double* position) noexcept nogil:
        # One of the points at which `expand` needs the field.
        cdef int axis
        for axis in range(3):
            position[axis] = expansion.centre[axis] + expansion.radius * self.directions[sample, axis]

    cdef void expand(self, Expansion* expansion, const double* field) noexcept nogil:
        # From the field at the samples, (SAMPLES, 3).
        cdef double[3 * MONOMIALS] total
        cdef int j
        weighted_sum(3 * MONOMIALS, 3 * SAMPLES, field, &self.matrix[0, 0], 3 * MONOMIALS, total)
        for j in range(3 * MONOMIALS):
            expansion.coefficients[j] = <float>total[j]

    @property
    def samples(self):
        """Points at which `fit` needs the field [nm], shape (SAMPLES, 3)."""
        return np.array(self.expansion.centre) + self.expansion.radius * np.asarray(self.directions)

    def fit(self, const double[:, ::1] field):
        """Expand the field that has these values at the samples, shape (SAMPLES, 3)."""
        if field.shape[0] != SAMPLES or field.shape[1] != 3:
            raise ValueError(f"field must have shape ({SAMPLES}, 3), got {(field.shape[0], field.shape[1])}")
        self.expand(&self.expansion, &field[0, 0])

    def fields(self, const double[:, ::1] positions):
        """Field at points in the ball [nm], shape (n, 3)."""
        n = len(positions)
        cdef Index width = (n + SINGLE_LANES - 1) // SINGLE_LANES * SINGLE_LANES
        cdef float[:, ::1] targets = np.zeros((3, width), np.float32), field = np.zeros((3, width), np.float32)
        np.asarray(targets)[:, :n] = (np.asarray(positions) - np.array(self.expansion.centre)).T
        if n:
            add_expanded(&self.expansion, self.expansion.centre, width, &targets[0, 0], &field[0, 0])
        return np.asarray(field, np.float64)[:, :n].T
