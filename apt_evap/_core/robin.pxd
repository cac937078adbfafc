"""Robin's rule, and the scalar product of the charging rules."""

from apt_evap._core.octree cimport Octree
from apt_evap._core.rule cimport FieldRule, Patch


cdef double dot(const double[::1] first, const double[::1] second) noexcept nogil


cdef class Robin(FieldRule):
    cdef readonly double tolerance
    cdef readonly int window
    cdef readonly object point          # (1, 3) the point inside with the given potential [nm]
    cdef double clearance               # initial distance of this point from the surface [nm]
    cdef float[::1] matrix, residual

    cdef normal_field(self, const double[:, ::1] normals, long n)
    cdef int grow(self, long stride) except -1 nogil
    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil
