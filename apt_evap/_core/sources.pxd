"""Sources that a walk through the octree collects."""

from apt_evap._core.index cimport Index

cdef extern from "kernels.h":
    const int CELL
    const int LANES, SINGLE_LANES
    const double SAME_PLACE
    void point_atoms_double(Index, const double*, const double*, const double*, const double*,
                            double, double, double, double*) noexcept nogil
    void point_cells_double(Index, Index, const double*, double, double, double, double*) noexcept nogil
    void point_atoms_single(Index, const float*, const float*, const float*, const float*,
                            float, float, float, double*) noexcept nogil
    void point_cells_single(Index, Index, const float*, float, float, float, double*) noexcept nogil


cdef struct Sources:
    # Sources for a ball of targets: atoms and cells in the layout of the kernels.
    Index n_atoms
    Index n_cells
    Index capacity       # of each column
    int* atom            # (capacity,) slots
    int* cell            # (capacity,) nodes
    double* atoms        # (4, capacity): x y z q
    double* cells        # (CELL, capacity)


cdef struct SingleSources:
    # The same sources in single precision, relative to a point near the targets.
    double[3] origin
    Index n_atoms        # multiples of SINGLE_LANES, padded with sources without charge
    Index n_cells
    Index capacity
    float* atoms
    float* cells


cdef struct Nodes:
    # Nodes of an octree.
    Index n, capacity
    int* node            # (capacity,)


cdef int nodes_reserve(Nodes* nodes, Index capacity) except -1 nogil
cdef int sources_init(Sources* sources) except -1 nogil
cdef int sources_grow(Sources* sources) except -1 nogil
cdef void sources_free(Sources* sources) noexcept nogil
cdef void sources_field(const Sources* sources, double px, double py, double pz, double* field) noexcept nogil
cdef int single_reserve(SingleSources* single, Index capacity, const double* origin) except -1 nogil
cdef int single_part(const SingleSources* single, const double* ball, SingleSources* inside, SingleSources* outside
                     ) except -1 nogil
cdef void single_pad(SingleSources* single) noexcept nogil
cdef void single_free(SingleSources* single) noexcept nogil
cdef void single_field(const SingleSources* single, double px, double py, double pz, double* field) noexcept nogil
cdef double sources_potential(const Sources* sources, double px, double py, double pz) noexcept nogil
