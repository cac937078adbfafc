"""Expansion of a field about a ball, for the other compiled modules."""

from apt_evap._core.index cimport Index

cdef enum:
    ORDER = 6                                        # of the potential; add_polynomials has the degree 5
    SAMPLES = 20                                     # points at which the field is summed
    MONOMIALS = ORDER * (ORDER + 1) * (ORDER + 2) // 6   # of each component of the field, up to degree ORDER - 1


cdef struct Expansion:
    double[3] centre                          # of the ball
    double radius
    float[3 * MONOMIALS] coefficients


cdef class FarField:
    cdef const double[:, ::1] matrix          # (3 SAMPLES, 3 MONOMIALS)
    cdef const double[:, ::1] directions      # (SAMPLES, 3)
    cdef Expansion expansion                  # of the methods for Python

    cdef void point(self, const Expansion* expansion, int sample, double* position) noexcept nogil
    cdef void expand(self, Expansion* expansion, const double* field) noexcept nogil


cdef void add_expanded(const Expansion* expansion, const double* origin, Index m, const float* targets,
                       float* field) noexcept nogil
