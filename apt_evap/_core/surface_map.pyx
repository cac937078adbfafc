"""Origins of ions on a surface that deflects them: the inner loop of `apt_evap.reconstruction.evolving_surface`.

Each ion is independent, and they are added in their sequence by one thread: the bits do not depend on the threads.
"""

from libc.math cimport M_PI, acos, atan2, sqrt

import numpy as np


cdef enum:
    LANES = 8


cdef struct Cell:
    Py_ssize_t corner    # node above and before the place, and its neighbours
    Py_ssize_t beside
    Py_ssize_t below
    Py_ssize_t opposite
    double down          # place within the cell, 0 to 1
    double right


cdef inline Cell cell_at(
    double x, double y, double z, Py_ssize_t rows, Py_ssize_t columns, double spacing
) noexcept nogil:
    # Nodes of Gauss and Legendre are equidistant within 1e-3 of their spacing, symmetric about the equator.
    cdef Cell cell
    cdef double polar = acos(min(max(y, -1.0), 1.0)), azimuth = atan2(x, z)
    cdef double row = (polar - (0.5 * M_PI - 0.5 * spacing * (rows - 1))) / spacing
    cdef double column = (azimuth + M_PI) * (columns / (2.0 * M_PI))
    row = min(max(row, 0.0), rows - 1.000001)
    cdef Py_ssize_t upper = <Py_ssize_t>row
    cdef Py_ssize_t left = <Py_ssize_t>column
    cell.down = row - upper
    cell.right = column - left
    left = left % columns
    cdef Py_ssize_t after = (left + 1) % columns
    cell.corner = upper * columns + left
    cell.beside = upper * columns + after
    cell.below = cell.corner + columns
    cell.opposite = cell.beside + columns
    return cell


cdef inline double at(const double *table, Cell *cell) noexcept nogil:
    cdef double above = table[cell.corner] + cell.right * (table[cell.beside] - table[cell.corner])
    cdef double under = table[cell.below] + cell.right * (table[cell.opposite] - table[cell.below])
    return above + cell.down * (under - above)


def place_ions(
    const double[:, ::1] apparent,
    const double[:, :, ::1] deflection,
    const double[:, :, ::1] tables,
    double spacing,
    int sweeps,
    double damping,
):
    """Directions from which ions appear elsewhere, by fixed-point sweeps, and values of the surface at them.

    Parameters
    ----------
    apparent : ndarray, shape (n, 3)
        Unit vectors s where the ions appear.
    deflection : ndarray, shape (2, rows, columns)
        Deflection along the polar angle from y, and along the azimuth from -z about y, at the nodes [rad].
    tables : ndarray, shape (k, rows, columns)
        Values at the nodes.
    spacing : float
        Distance of the rows [rad].
    sweeps : int
        Number of sweeps; 0 for the values at the apparent directions.
    damping : float
        Part of each sweep after the first that is taken.

    Returns
    -------
    directions : ndarray, shape (n, 3)
        Unit vectors n with n + delta(n) along s.
    values : ndarray, shape (n, k)
        Bilinear between the nodes.
    counts : ndarray, shape (rows, columns)
        Ions at each node; each ion is shared among four.
    """
    cdef Py_ssize_t n = apparent.shape[0], rows = deflection.shape[1], columns = deflection.shape[2]
    cdef Py_ssize_t k = tables.shape[0], i, j
    cdef int sweep
    directions = np.empty((n, 3))
    values = np.empty((n, k))
    counts = np.zeros((rows, columns))
    cdef double[:, ::1] found = directions
    cdef double[:, ::1] given = values
    cdef double[:, ::1] shared = counts
    if n == 0:
        return directions, values, counts
    cdef const double *along = &deflection[0, 0, 0]
    cdef const double *across = &deflection[1, 0, 0]
    cdef double *node = &shared[0, 0]
    cdef double x[LANES]
    cdef double y[LANES]
    cdef double z[LANES]
    cdef double a, b, sine, turned, upright, p, q, r, length
    cdef Py_ssize_t group, first, lane, lanes
    cdef Cell cell
    with nogil:
        # Some ions together: each step of a search waits for the one before, those of other ions do not.
        for group in range((n + LANES - 1) // LANES):
            first = group * LANES
            lanes = min(<Py_ssize_t>LANES, n - first)
            for lane in range(lanes):
                i = first + lane
                x[lane], y[lane], z[lane] = apparent[i, 0], apparent[i, 1], apparent[i, 2]
            for sweep in range(sweeps):
                for lane in range(lanes):
                    i = first + lane
                    cell = cell_at(x[lane], y[lane], z[lane], rows, columns, spacing)
                    a = at(along, &cell)
                    b = at(across, &cell)
                    sine = sqrt(max(1.0 - y[lane] * y[lane], 1e-12))
                    turned, upright = x[lane] / sine, z[lane] / sine
                    p = apparent[i, 0] - a * y[lane] * turned - b * upright
                    q = apparent[i, 1] + a * sine
                    r = apparent[i, 2] - a * y[lane] * upright + b * turned
                    if sweep > 0:
                        p = damping * p + (1.0 - damping) * x[lane]
                        q = damping * q + (1.0 - damping) * y[lane]
                        r = damping * r + (1.0 - damping) * z[lane]
                    length = 1.0 / sqrt(p * p + q * q + r * r)
                    x[lane], y[lane], z[lane] = p * length, q * length, r * length
            for lane in range(lanes):
                i = first + lane
                cell = cell_at(x[lane], y[lane], z[lane], rows, columns, spacing)
                found[i, 0], found[i, 1], found[i, 2] = x[lane], y[lane], z[lane]
                for j in range(k):
                    given[i, j] = at(&tables[j, 0, 0], &cell)
                node[cell.corner] += (1.0 - cell.down) * (1.0 - cell.right)
                node[cell.beside] += (1.0 - cell.down) * cell.right
                node[cell.below] += cell.down * (1.0 - cell.right)
                node[cell.opposite] += cell.down * cell.right
    return directions, values, counts
