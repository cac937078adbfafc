"""The octree's memory, for the other compiled modules."""

cdef extern from "pair.h":
    const int GROUP
    const int CELL
    const int LANES
    void group_atoms_single(long, long, const double*, const double*, const double*, const double*, const double*,
                            const float*, float*) noexcept nogil
    void group_cells_single(long, const int*, const double*, const double*, const float*, float*) noexcept nogil
    void group_atoms_double(long, long, const double*, const double*, const double*, const double*, const double*,
                            const double*, double*) noexcept nogil
    void group_cells_double(long, const int*, const double*, const double*, const double*, double*) noexcept nogil
    void point_atoms(long, const double*, const double*, const double*, const double*,
                     double, double, double, double*) noexcept nogil
    void point_cells(long, long, const double*, double, double, double, double*) noexcept nogil
    const int PATCH_LANES
    void patch_row(long, const float*, const float*, const float*, float, float, float, const double*,
                   float*) noexcept nogil
    float patch_dot(long, const float*, const float*) noexcept nogil
    void patch_field(long, const float*, const float*, const float*, const float*, float, float, float,
                     double*) noexcept nogil


cdef struct Sources:
    # What one walk collects for a ball of targets: atoms and cells, ready for the kernels.
    long n_atoms
    long n_cells
    long capacity        # of each column
    double* atoms        # (4, capacity): x y z q
    double* cells        # (CELL, capacity)


cdef int sources_init(Sources* sources) except -1 nogil
cdef void sources_free(Sources* sources) noexcept nogil
cdef void sources_field(const Sources* sources, double px, double py, double pz, double* field) noexcept nogil


cdef class Octree:
    cdef readonly long n_slots          # atoms in the tree's arrays, those taken out included (their charge is 0)
    cdef readonly long n_sorted         # of these, the ones that stand in the order of the leaves
    cdef readonly long n_nodes
    cdef readonly int leaf_size
    cdef double[::1] x, y, z, q         # (capacity,) nm, e
    cdef long long[::1] atom            # (capacity,) the caller's index; -1 for one taken out
    cdef int[::1] leaf                  # (capacity,) node of each slot
    cdef int[::1] next_extra            # (capacity,) chain of the slots put into a leaf after the build
    cdef int[::1] first, last, skip, parent, extra   # (n_nodes,) slots [first, last), next node outside, ...
    cdef double[:, ::1] ball            # (n_nodes, 4) centre and radius [nm], fixed while charges change
    cdef double[:, ::1] cells           # (n_nodes, CELL) moments about the centre of charge
    cdef char[::1] dirty                # (n_nodes,)
    cdef int[::1] queue                 # (n_nodes,) dirty nodes
    cdef long n_dirty

    cdef void set_charge(self, long slot, double charge) noexcept nogil
    cdef void take_out(self, long slot) noexcept nogil
    cdef long put_in(self, long long atom, double px, double py, double pz, int leaf) noexcept nogil
    cdef void refresh(self) noexcept nogil
    cdef void moments(self, long node) noexcept nogil
    cdef int collect(self, double cx, double cy, double cz, double radius, double opening_angle,
                     Sources* sources) except -1 nogil
    cdef long within(self, double px, double py, double pz, double radius, int* slots, long most) noexcept nogil
    cdef long walk_lists(self, long group, double opening_angle, int* cell_list, int* range_list,
                         long* n_cells, long* n_ranges) noexcept nogil
    cdef void mark(self, long node) noexcept nogil
    cdef void add_atom(self, long k, Sources* sources) noexcept nogil
    cdef void group_ball(self, long group, double* ball) noexcept nogil
    cdef void fill_lists(self, long group, double opening_angle, int* cells, int* ranges,
                         long[:, ::1] starts) noexcept nogil
    cdef void group_field_single(self, long group, InteractionLists lists, double[:, ::1] field) noexcept nogil
    cdef void group_field_double(self, long group, InteractionLists lists, double[:, ::1] field) noexcept nogil
    cdef int field_at(self, double px, double py, double pz, double opening_angle, double* field) except -1 nogil
    cdef double potential_at(self, double px, double py, double pz, double opening_angle) except? -1 nogil


cdef class InteractionLists:
    cdef int[::1] cells          # accepted nodes of all groups, one after the other
    cdef int[::1] ranges         # slots [begin, end) of the leaves that stay atoms
    cdef long[:, ::1] starts     # (n_groups + 1, 3) where each group's cells and ranges begin, and its atoms so far
