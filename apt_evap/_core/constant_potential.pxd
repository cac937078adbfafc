"""Rule of the constant potential."""

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree
from apt_evap._core.potentials cimport Potentials
from apt_evap._core.robin cimport Robin
from apt_evap._core.rule cimport FieldRule, Hole, Patch


cdef class ConstantPotential(FieldRule):
    cdef readonly double tolerance
    cdef readonly double self_term      # potential of an atom by its own charge 1 [1/nm]; 0 before the first solution
    cdef readonly bint gaussian, sees_others
    cdef readonly Index n_iterations    # of all patches
    cdef double requested_self_term, potential        # self term of the user, or 0; potential of the specimen [e/nm]
    cdef double[::1] value              # (capacity,) potential of each slot with that of its own charge [e/nm]
    cdef double[:, ::1] normals         # (capacity, 3) by slot
    cdef Potentials sums
    cdef Robin robin
    cdef float[::1] matrix, residual, direction, image, spreads

    cdef void squared_distances(self, const double[:, ::1] atoms, Index atom, double[::1] squares) noexcept nogil
    cdef int grow(self, Index stride) except -1 nogil
    cdef Index nearest(self, Octree tree, Index slot) noexcept nogil
    cdef double at(self, Octree tree, Index slot) noexcept nogil
    cdef double corrections(self, Octree tree, Index slot, const double* sources, Index n) noexcept nogil
    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil
    cdef void act_on(self, const Hole* hole, Index first, Index m, Index stride, Index n, const float* x,
                     const float* y, const float* z, const float* change) noexcept nogil
    cdef void correct_spread(self, const Hole* hole, const Patch* patch) noexcept nogil
