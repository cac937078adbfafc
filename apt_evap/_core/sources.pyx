"""Sources for a ball of targets: atoms and cells in columns, and their field and potential at a point."""

from libc.math cimport sqrt
from libc.stdlib cimport free, malloc, realloc


cdef int sources_init(Sources* sources) except -1 nogil:
    sources.n_atoms = sources.n_cells = 0
    sources.capacity = 4096
    sources.atoms = <double*>malloc(4 * sources.capacity * sizeof(double))
    sources.cells = <double*>malloc(CELL * sources.capacity * sizeof(double))
    if sources.atoms == NULL or sources.cells == NULL:
        with gil:
            raise MemoryError
    return 0


cdef void sources_free(Sources* sources) noexcept nogil:
    free(sources.atoms)
    free(sources.cells)
    sources.atoms = sources.cells = NULL


cdef int sources_grow(Sources* sources) except -1 nogil:
    # The stride of the columns changes: they are moved to the new memory layout, the last column first.
    cdef long old = sources.capacity, column, k
    sources.capacity = 2 * old
    sources.atoms = <double*>realloc(sources.atoms, 8 * old * sizeof(double))
    sources.cells = <double*>realloc(sources.cells, 2 * CELL * old * sizeof(double))
    if sources.atoms == NULL or sources.cells == NULL:
        with gil:
            raise MemoryError
    for column in range(3, 0, -1):
        for k in range(old - 1, -1, -1):
            sources.atoms[column * 2 * old + k] = sources.atoms[column * old + k]
    for column in range(CELL - 1, 0, -1):
        for k in range(old - 1, -1, -1):
            sources.cells[column * 2 * old + k] = sources.cells[column * old + k]
    return 0


cdef void sources_field(const Sources* sources, double px, double py, double pz, double* field) noexcept nogil:
    # Field [e/nm^2] of all collected sources at one point.
    cdef const double* a = sources.atoms
    cdef long stride = sources.capacity
    field[0] = field[1] = field[2] = 0.0
    point_atoms(sources.n_atoms, a, a + stride, a + 2 * stride, a + 3 * stride, px, py, pz, field)
    point_cells(sources.n_cells, stride, sources.cells, px, py, pz, field)


cdef double sources_potential(const Sources* sources, double px, double py, double pz) noexcept nogil:
    # Potential [e/nm] of all collected sources at one point.
    cdef const double* a = sources.atoms
    cdef const double* c
    cdef double total = 0.0, dx, dy, dz, s, w2
    cdef long k, stride = sources.capacity
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
