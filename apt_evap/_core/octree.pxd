"""The octree's memory, for the other compiled modules."""

from apt_evap._core.index cimport Index
from apt_evap._core.sources cimport Nodes, SingleSources, Sources


cdef class Octree:
    cdef readonly Index n_slots         # atoms in the arrays of the tree, including removed ones (with charge 0)
    cdef readonly Index n_sorted        # number of these in the order of the leaves
    cdef readonly Index n_nodes
    cdef readonly int leaf_size
    cdef int n_threads                  # for operations on the whole tree
    cdef double[::1] x, y, z, q         # (capacity,) nm, e
    cdef Index[::1] atom                # (capacity,) index of the caller; -1 for a removed atom
    cdef int[::1] leaf                  # (capacity,) node of each slot
    cdef int[::1] next_extra            # (capacity,) chain of the slots added to a leaf after the build
    cdef int[::1] first, last, skip, parent, extra   # (n_nodes,) slots [first, last), next node outside, ...
    cdef double[:, ::1] ball            # (n_nodes, 4) centre and radius [nm], fixed while charges change
    cdef double[:, ::1] cells           # (n_nodes, CELL) moments about the centre of charge
    cdef signed char[::1] cancels              # (n_nodes,) charges of both signs without a centre inside the ball
    cdef signed char[::1] dirty                # (n_nodes,)
    cdef int[::1] queue                 # (n_nodes,) dirty nodes
    cdef Index n_dirty

    cdef enclose(self, int n_threads)
    cdef void box_of_leaf(self, Index node, double* low, double* high) noexcept nogil
    cdef void ball_of_box(self, Index node, const double* low, const double* high) noexcept nogil
    cdef Index following(self, Index node, Index slot) noexcept nogil
    cdef void set_charge(self, Index slot, double charge) noexcept nogil
    cdef void remove_atom(self, Index slot) noexcept nogil
    cdef Index insert_atom(self, Index atom, double px, double py, double pz, int leaf) noexcept nogil
    cdef void refresh(self) noexcept nogil
    cdef void moments(self, Index node) noexcept nogil
    cdef int walk(self, double cx, double cy, double cz, double radius, double opening_angle,
                  Sources* sources) except -1 nogil
    cdef int collect(self, double cx, double cy, double cz, double radius, double opening_angle,
                     Sources* sources) except -1 nogil
    cdef int copy_single(self, const double* centre, int n_balls, const double* balls, const Sources* sources,
                         SingleSources* near, SingleSources* far) except -1 nogil
    cdef Index within(self, double px, double py, double pz, double radius, int* slots, Index most) noexcept nogil
    cdef void mark(self, Index node) noexcept nogil
    cdef int field_at(self, double px, double py, double pz, double opening_angle, double* field) except -1 nogil
    cdef double potential_at(self, double px, double py, double pz, double opening_angle) except? -1 nogil
    cdef int walk_from(self, Index n_roots, const int* roots, double cx, double cy, double cz, double radius,
                       double opening_angle, Sources* sources) except -1 nogil
    cdef int part(self, const Nodes* roots, const double* ball, double opening_angle, double beyond, Sources* sources,
                  Nodes* rest) except -1 nogil
