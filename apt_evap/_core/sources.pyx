"""Sources for a ball of targets: atoms and cells in columns, and their field and potential at a point."""

from libc.math cimport sqrt
from libc.stdlib cimport free, malloc, realloc

import numpy as np

from apt_evap._core.index cimport Index


cdef int nodes_reserve(Nodes* nodes, Index capacity) except -1 nogil:
    # Space for this many nodes, with the present ones kept. The memory must be NULL, and capacity 0, at the first call.
    cdef int* node
    if capacity > nodes.capacity:
        node = <int*>realloc(nodes.node, 2 * capacity * sizeof(int))
        if node == NULL:
            with gil:
                raise MemoryError
        nodes.node, nodes.capacity = node, 2 * capacity
    return 0


cdef int sources_init(Sources* sources) except -1 nogil:
    sources.n_atoms = sources.n_cells = 0
    sources.capacity = 4160   # not a power of two: the columns of a source would share one set of the cache
    sources.atoms = <double*>malloc(4 * sources.capacity * sizeof(double))
    sources.cells = <double*>malloc(CELL * sources.capacity * sizeof(double))
    sources.atom = <int*>malloc(sources.capacity * sizeof(int))
    sources.cell = <int*>malloc(sources.capacity * sizeof(int))
    if sources.atoms == NULL or sources.cells == NULL or sources.atom == NULL or sources.cell == NULL:
        with gil:
            raise MemoryError
    return 0


cdef void sources_free(Sources* sources) noexcept nogil:
    free(sources.atoms)
    free(sources.cells)
    free(sources.atom)
    free(sources.cell)
    sources.atoms = sources.cells = NULL
    sources.atom = sources.cell = NULL


cdef int sources_grow(Sources* sources) except -1 nogil:
    # Double the capacity; the lists are kept, the columns are not.
    sources.capacity *= 2
    sources.atom = <int*>realloc(sources.atom, sources.capacity * sizeof(int))
    sources.cell = <int*>realloc(sources.cell, sources.capacity * sizeof(int))
    free(sources.atoms)
    free(sources.cells)
    sources.atoms = <double*>malloc(4 * sources.capacity * sizeof(double))
    sources.cells = <double*>malloc(CELL * sources.capacity * sizeof(double))
    if sources.atoms == NULL or sources.cells == NULL or sources.atom == NULL or sources.cell == NULL:
        with gil:
            raise MemoryError
    return 0


cdef void sources_field(const Sources* sources, double px, double py, double pz, double* field) noexcept nogil:
    # Field [e/nm^2] of all collected sources at one point.
    cdef const double* a = sources.atoms
    cdef Index stride = sources.capacity
    field[0] = field[1] = field[2] = 0.0
    point_atoms_double(sources.n_atoms, a, a + stride, a + 2 * stride, a + 3 * stride, px, py, pz, field)
    point_cells_double(sources.n_cells, stride, sources.cells, px, py, pz, field)


cdef double sources_potential(const Sources* sources, double px, double py, double pz) noexcept nogil:
    # Potential [e/nm] of all collected sources at one point.
    cdef const double* a = sources.atoms
    cdef const double* c
    cdef double total = 0.0, dx, dy, dz, s, w2
    cdef Index k, stride = sources.capacity
    for k in range(sources.n_atoms):
        dx, dy, dz = px - a[k], py - a[stride + k], pz - a[2 * stride + k]
        s = dx * dx + dy * dy + dz * dz
        if s > 1e-12:
            total += a[3 * stride + k] / sqrt(s)
    for k in range(sources.n_cells):
        c = sources.cells + k
        dx, dy, dz = px - c[0], py - c[stride], pz - c[2 * stride]
        w2 = 1.0 / (dx * dx + dy * dy + dz * dz)
        s = c[4 * stride] * dx * dx + c[7 * stride] * dy * dy + c[9 * stride] * dz * dz + 2.0 * (
            c[5 * stride] * dx * dy + c[6 * stride] * dx * dz + c[8 * stride] * dy * dz)
        total += sqrt(w2) * (c[3 * stride] + 0.5 * s * w2 * w2)
    return total


cdef int single_reserve(SingleSources* single, Index capacity, const double* origin) except -1 nogil:
    # Removes all sources, with space for this many and for padding. The memory must be NULL at the first call.
    cdef int axis
    if single.atoms == NULL or single.capacity < capacity + SINGLE_LANES:
        single_free(single)
        single.capacity = capacity + SINGLE_LANES
        single.atoms = <float*>malloc(4 * single.capacity * sizeof(float))
        single.cells = <float*>malloc(CELL * single.capacity * sizeof(float))
        if single.atoms == NULL or single.cells == NULL:
            with gil:
                raise MemoryError
    for axis in range(3):
        single.origin[axis] = origin[axis]
    single.n_atoms = single.n_cells = 0
    return 0


cdef inline SingleSources* side(float x, float y, float z, const float* ball, SingleSources* inside,
                                SingleSources* outside) noexcept nogil:
    x, y, z = x - ball[0], y - ball[1], z - ball[2]
    return inside if x * x + y * y + z * z <= ball[3] else outside


cdef int single_part(const SingleSources* single, const double* ball, SingleSources* inside, SingleSources* outside
                     ) except -1 nogil:
    # Copies the sources in a ball relative to the origin, and the others.
    cdef float[4] rounded
    cdef SingleSources* part
    cdef Index k, at, stride = single.capacity
    cdef int m
    single_reserve(inside, stride, single.origin)
    single_reserve(outside, stride, single.origin)
    for m in range(3):
        rounded[m] = <float>ball[m]
    rounded[3] = <float>(ball[3] * ball[3])
    for k in range(single.n_atoms):
        part = side(single.atoms[k], single.atoms[stride + k], single.atoms[2 * stride + k], rounded, inside, outside)
        at = part.n_atoms
        for m in range(4):
            part.atoms[m * part.capacity + at] = single.atoms[m * stride + k]
        part.n_atoms = at + 1
    for k in range(single.n_cells):
        part = side(single.cells[k], single.cells[stride + k], single.cells[2 * stride + k], rounded, inside, outside)
        at = part.n_cells
        for m in range(CELL):
            part.cells[m * part.capacity + at] = single.cells[m * stride + k]
        part.n_cells = at + 1
    return 0


cdef void single_pad(SingleSources* single) noexcept nogil:
    # Sources without charge, up to a multiple of SINGLE_LANES.
    cdef int axis
    while single.n_atoms % SINGLE_LANES:
        for axis in range(4):
            single.atoms[axis * single.capacity + single.n_atoms] = 1e4 if axis == 0 else 0.0
        single.n_atoms += 1
    while single.n_cells % SINGLE_LANES:
        for axis in range(CELL):
            single.cells[axis * single.capacity + single.n_cells] = 1e4 if axis == 0 else 0.0
        single.n_cells += 1


cdef void single_free(SingleSources* single) noexcept nogil:
    free(single.atoms)
    free(single.cells)
    single.atoms = single.cells = NULL


cdef void single_field(const SingleSources* single, double px, double py, double pz, double* field) noexcept nogil:
    # Field [e/nm^2] at one point, as `sources_field`.
    cdef const float* a = single.atoms
    cdef Index stride = single.capacity
    cdef float x = <float>(px - single.origin[0]), y = <float>(py - single.origin[1])
    cdef float z = <float>(pz - single.origin[2])
    field[0] = field[1] = field[2] = 0.0
    point_atoms_single(single.n_atoms, a, a + stride, a + 2 * stride, a + 3 * stride, x, y, z, field)
    point_cells_single(single.n_cells, stride, single.cells, x, y, z, field)


cdef columns_of(const SingleSources* single):
    # Copies of the columns of atoms and of cells, and the origin.
    cdef Index k, m
    cdef float[:, ::1] atoms = np.empty((4, single.n_atoms), np.float32)
    cdef float[:, ::1] cells = np.empty((CELL, single.n_cells), np.float32)
    for k in range(single.n_atoms):
        for m in range(4):
            atoms[m, k] = single.atoms[m * single.capacity + k]
    for k in range(single.n_cells):
        for m in range(CELL):
            cells[m, k] = single.cells[m * single.capacity + k]
    return np.asarray(atoms), np.asarray(cells), [single.origin[0], single.origin[1], single.origin[2]]


def parted(float[:, ::1] atoms, float[:, ::1] cells, const double[::1] ball, const double[::1] origin):
    """Sources in a ball relative to their origin, and the others; for tests.

    Returns
    -------
    inside, outside : tuple
        Columns of atoms (4, .) and of cells (CELL, .), and the origin.
    """
    cdef SingleSources single, inside, outside
    cdef Index k, m
    single.atoms = single.cells = inside.atoms = inside.cells = outside.atoms = outside.cells = NULL
    single_reserve(&single, max(atoms.shape[1], cells.shape[1]), &origin[0])
    for m in range(4):
        for k in range(atoms.shape[1]):
            single.atoms[m * single.capacity + k] = atoms[m, k]
    for m in range(CELL):
        for k in range(cells.shape[1]):
            single.cells[m * single.capacity + k] = cells[m, k]
    single.n_atoms, single.n_cells = atoms.shape[1], cells.shape[1]
    single_part(&single, &ball[0], &inside, &outside)
    result = columns_of(&inside), columns_of(&outside)
    single_free(&single)
    single_free(&inside)
    single_free(&outside)
    return result
