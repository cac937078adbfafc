"""Interaction lists, for the charging rules."""

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree


cdef class InteractionLists:
    cdef readonly Octree tree
    cdef readonly double opening_angle
    cdef readonly object slots   # (m,) slots of the targets, in the order of the leaves
    cdef const signed char[::1] disturbed   # (n_slots,) 1 where atoms must be targets; None: everywhere
    cdef Index[:, ::1] blocks    # (k, 3) of each block with samples: their leaf, and their begin and end in `slots`
    cdef Index n_groups
    cdef int[:, ::1] members     # (n_groups, 32) slots of each group
    cdef double[:, ::1] ball     # (n_groups, 4) centre and radius of each group
    cdef int[::1] cells          # accepted nodes of all groups in sequence
    cdef int[::1] ranges         # slots [begin, end) of the leaves whose atoms are summed one by one
    cdef Index[:, ::1] starts    # (n_groups + 1, 3) begin of cells and ranges of each group, atoms so far

    cdef bint has_disturbed(self, Octree tree, Index node) noexcept nogil
    cdef Index middle_of(self, Octree tree, Index node) noexcept nogil
    cdef Index targets_of(self, Octree tree, Index node, int* slots, Index n) noexcept nogil
    cdef void split(self, Octree tree, int* slots, Index n, Index group) noexcept nogil
    cdef list_sources(self, Octree tree, int n_threads)
    cdef int* kept_list(self, Octree tree, Index group, int* work) noexcept nogil
    cdef void put_list(self, Octree tree, Index group, int* kept) noexcept nogil
    cdef void walk(self, Octree tree, Index group, int* cells, int* ranges, Index* counts) noexcept nogil
    cdef void add_to_group(self, Octree tree, Index group, double[:, ::1] field, const double* changes,
                           const double* charge) noexcept nogil
    cdef void sweep_single(self, Octree tree, Index group, double[:, ::1] field) noexcept nogil
    cdef void sweep_double(self, Octree tree, Index group, double[:, ::1] field) noexcept nogil
