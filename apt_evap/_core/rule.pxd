"""Interface of a charging rule: all that the events, the monitor and the chooser need of the electrostatics.

A rule stores, for every slot of the tree, the effect of all other charges: a field or a potential. The order of the
calls is: `solve` for a new tree; then for every event `removed`, `exposed` for each newly exposed atom, and
`solve_patch`, which solves the charges around the hole and updates the fields of its surroundings.
"""

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree
from apt_evap._core.sources cimport Sources


cdef struct Hole:
    # The surroundings of an evaporated atom: slots whose fields are updated, first those of the patch in its order,
    # then the near ones. Positions are relative to the hole; behind the patch, the arrays are padded to a multiple of
    # GROUP with distant positions.
    double x                # position of the evaporated atom [nm]
    double y
    double z
    double charge           # its charge [e]
    Index n
    Index n_near            # of these, the slots for which the atoms of the patch act one by one
    int* slot
    float* near_x           # [nm]
    float* near_y
    float* near_z


cdef struct Patch:
    # The slots around a hole whose charges are solved. x, y, z and change have `stride` elements, a multiple of
    # PATCH_LANES; elements from n on have no charge and are distant, until the changes act on the surroundings: then
    # element n is the evaporated charge.
    Index n
    Index stride
    int* slot
    double* charge          # new charges [e]
    float* change           # new charges minus the charges in the tree [e]
    float* x                # relative to the hole [nm]
    float* y
    float* z
    Index n_merged          # the changes of the patch merged by four, for distant slots, and the evaporated charge
    float* merged_change
    float* merged_x
    float* merged_y
    float* merged_z
    Index n_clipped         # negative charges that were set to 0
    bint unsettled          # whether the iteration did not converge


cdef void merge(Octree tree, const Hole* hole, Patch* patch) noexcept nogil
cdef Index ring(const Hole* hole, const Patch* patch, Index* n_near) noexcept nogil


cdef class ChargingRule:
    cdef readonly double area           # area per surface atom at the last relaxation [nm^2]
    cdef readonly double near           # distance over the radius of the patch, beyond which its changes are merged
    cdef readonly double drift          # relative change of the potential inside the specimen by events

    cdef void removed(self, Octree tree, const Hole* hole, Index n_patch) noexcept nogil
    cdef int exposed(self, Octree tree, Index slot, double opening_angle) except -1 nogil
    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, const Hole* hole, Patch* patch) except -1 nogil
    cdef void scaled(self, Octree tree, double factor) noexcept nogil
    cdef double strength(self, Octree tree, Index slot) noexcept nogil


cdef class FieldRule(ChargingRule):
    cdef double[:, ::1] field           # (capacity, 3) field of all other atoms at each slot [e/nm^2]
    cdef float[:, ::1] spread           # (3, capacity) change of this field by a patch
    cdef Sources sources

    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil
    cdef void field_in_patch(self, const Hole* hole, const Patch* patch, float* x, float* y, float* z) noexcept nogil


cdef class PythonRule(FieldRule):
    cdef readonly object rule
