"""The contract of a charging rule: all that the events, the monitor and the chooser need of an electrostatics.

A rule keeps, for every slot of the tree, what it needs to know of the charges of all others: a field or a potential. The
calls come in this order: `solve` over a new tree; then for every event `removed`, `exposed` for each atom that comes to
the surface, and `solve_patch`, which solves the charges around the hole and spreads their change over its surroundings.
"""

from apt_evap._core.octree cimport Octree
from apt_evap._core.sources cimport Sources


cdef struct Hole:
    # The surroundings of an atom that left: slots whose fields are kept up to date. Places are relative to the hole; their
    # arrays are filled up to a multiple of GROUP with places far away.
    double x                # of the atom that left [nm]
    double y
    double z
    double charge           # it took along [e]
    long n
    int* slot
    float* near_x           # [nm]
    float* near_y
    float* near_z


cdef struct Patch:
    # The slots around a hole whose charges are solved. x, y, z and change have `stride` elements, a multiple of
    # PATCH_LANES; those from n on have no charge and are far away.
    long n
    long stride
    int* slot
    double* charge          # solved [e]
    float* change           # solved, relative to the charges in the tree [e]
    float* x                # relative to the hole [nm]
    float* y
    float* z
    long n_clipped          # charges that came out negative and were set to 0
    bint unsettled          # whether the charges were still changing after the last iteration


cdef class ChargingRule:
    cdef readonly double area           # surface per atom [nm^2], as of the last relaxation

    cdef void removed(self, Octree tree, const Hole* hole) noexcept nogil
    cdef int exposed(self, Octree tree, long slot, double opening_angle) except -1 nogil
    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, const Hole* hole, Patch* patch) except -1 nogil
    cdef double strength(self, Octree tree, long slot) noexcept nogil


cdef class FieldRule(ChargingRule):
    cdef double[:, ::1] field           # (capacity, 3) field of all the others on each slot [e/nm^2]
    cdef float[:, ::1] spread           # (3, room) what a patch changes in it
    cdef Sources sources

    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil


cdef class PythonRule(FieldRule):
    cdef readonly object rule
