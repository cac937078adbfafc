"""What a charging rule offers to the event loop."""

from apt_evap._core.octree cimport InteractionLists, Octree


cdef class ChargingRule:
    cdef double[:, ::1] field           # (capacity, 3) e/nm^2, field of all the others on each slot
    cdef readonly double area           # s, surface per atom [nm^2]; field just outside = 4 pi COULOMB q / area
    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, const int* patch, long n,
                         double* charges) noexcept nogil


cdef class Robin(ChargingRule):
    cdef readonly double tolerance
    cdef readonly int window
    cdef double[::1] matrix, residual, change
    cdef double* grow(self, long n) noexcept nogil
