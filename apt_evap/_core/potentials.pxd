"""Potentials of charges of either sign at all atoms of a tree, for the charging rules."""

from apt_evap._core.index cimport Index
from apt_evap._core.interactions cimport InteractionLists
from apt_evap._core.octree cimport Octree


cdef class Potentials:
    cdef readonly InteractionLists lists
    cdef double[:, ::1] cells            # (n_nodes, MULTIPOLE) centre of the ball and moments about it
    cdef double[:, ::1] raw              # (n_nodes, 20) moments sum q, q d_i, q d_i d_j, q d_i d_j d_k
    cdef signed char[::1] empty          # (n_nodes,) 1 for nodes without charges
    cdef const double[::1] gaussian      # potential of Gaussian less point charges by the squared distance, or empty
    cdef double per_square               # entries of this table per nm^2
    cdef double reach_squared            # squared distance of its last entry [nm^2]

    cdef void leaf_moments(self, Octree tree, Index node, const double* charges) noexcept nogil
    cdef void node_moments(self, Octree tree, Index node) noexcept nogil
    cdef void traceless(self, Index node) noexcept nogil
    cdef double difference(self, double s) noexcept nogil
    cdef void correct(self, InteractionLists lists, Octree tree, Index group, const double* charges,
                      double* potential) noexcept nogil
    cdef void correct_range(self, InteractionLists lists, Octree tree, Index group, Index first, Index last,
                            const double* charges, double* potential) noexcept nogil
    cdef void group_single(self, InteractionLists lists, Octree tree, Index group, const double* charges,
                           double* potential) noexcept nogil
    cdef void group_double(self, InteractionLists lists, Octree tree, Index group, const double* charges,
                           double* potential) noexcept nogil
