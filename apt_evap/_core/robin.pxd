"""What a charging rule offers to the event loop."""

from apt_evap._core.octree cimport Octree


cdef struct Patch:
    # The slots around a hole whose charges are solved anew. x, y, z and change have `stride` elements, those from n on
    # without charge and away from all others.
    long n
    long stride
    int* slot
    double* charge          # solved [e]
    float* change           # solved, to the charges in the tree [e]
    float* x                # relative to the hole [nm]
    float* y
    float* z


cdef class ChargingRule:
    cdef double[:, ::1] field           # (capacity, 3) e/nm^2, field of all the others on each slot
    cdef readonly double area           # s, surface per atom [nm^2]; field just outside = 4 pi COULOMB q / area
    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil


cdef class Robin(ChargingRule):
    cdef readonly double tolerance
    cdef readonly int window
    cdef float[::1] matrix, residual
    cdef int grow(self, long stride) except -1 nogil
