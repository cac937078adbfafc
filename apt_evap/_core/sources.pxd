"""Sources that a walk through the octree collects."""

cdef extern from "kernels.h":
    const int CELL
    const int LANES
    void point_atoms(long, const double*, const double*, const double*, const double*,
                     double, double, double, double*) noexcept nogil
    void point_cells(long, long, const double*, double, double, double, double*) noexcept nogil


cdef struct Sources:
    # Sources for a ball of targets: atoms and cells in the layout of the kernels.
    long n_atoms
    long n_cells
    long capacity        # of each column
    double* atoms        # (4, capacity): x y z q
    double* cells        # (CELL, capacity)


cdef int sources_init(Sources* sources) except -1 nogil
cdef int sources_grow(Sources* sources) except -1 nogil
cdef void sources_free(Sources* sources) noexcept nogil
cdef void sources_field(const Sources* sources, double px, double py, double pz, double* field) noexcept nogil
cdef double sources_potential(const Sources* sources, double px, double py, double pz) noexcept nogil
