"""Which atoms are at the surface, and their normals: from the centre of mass of each atom's neighbourhood.

For atom i at p_i with the mean c_i of all other atoms within a radius, d_i = |p_i - c_i|: a surface atom has d_i above
a threshold, its outward normal is (p_i - c_i)/d_i (Boll, Philippe, Vurpillot, 2013; Rolland et al., 2015). An atom
once exposed stays exposed until it leaves.
"""

from cython.parallel cimport prange
from libc.math cimport floor, sqrt

import numpy as np


cdef class Neighbourhood:
    """Atoms, their neighbours within a radius, and the surface that follows.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        All atoms held [nm].
    radius : float
        Radius of the neighbourhood [nm].
    threshold : float
        Offset of the centre of mass above which an atom is at the surface [nm].
    support : ndarray of int8, shape (n,)
        1 for atoms that complete the neighbourhoods of others but are never surface atoms themselves.
    n_threads : int
        Threads.
    """

    def __init__(self, const double[:, ::1] positions, double radius, double threshold, const char[::1] support,
                 int n_threads=1):
        cdef long n = positions.shape[0], i
        if n == 0:
            raise ValueError("a specimen needs at least one atom, got none")
        self.n_atoms = n
        self.radius, self.threshold, self.edge = radius, threshold, radius
        self.positions = np.array(positions)
        self.support = np.array(support)
        self.alive = np.ones(n, np.int8)
        self.exposed = np.zeros(n, np.int8)
        self.count = np.zeros(n, np.int32)
        self.offset = np.zeros((n, 3))
        self.normal = np.zeros((n, 3))
        where = np.asarray(positions)
        low = where.min(axis=0)
        self.low = low
        cells = np.floor((where - low) / radius).astype(np.int64)
        shape = cells.max(axis=0) + 1
        self.shape = shape
        flat = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
        self.order = np.argsort(flat, kind="stable").astype(np.int32)
        self.start = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=shape.prod()))])
        for i in prange(n, nogil=True, schedule="dynamic", chunksize=1024, num_threads=n_threads):
            self.gather(i)
            self.exposed[i] = self.judge(i)
        if np.asarray(self.count).min() < 0:
            raise ValueError(f"radius must hold at most {MOST_NEAR} atoms around each atom, got {radius!r} nm")

    cdef int near(self, long atom, int* others) noexcept nogil:
        # The atoms still there within the radius of one atom, in the order of the cells; -1: more than MOST_NEAR.
        cdef double px = self.positions[atom, 0], py = self.positions[atom, 1], pz = self.positions[atom, 2]
        cdef double dx, dy, dz, reach = self.radius * self.radius
        cdef long ci = <long>floor((px - self.low[0]) / self.edge), cj = <long>floor((py - self.low[1]) / self.edge)
        cdef long ck = <long>floor((pz - self.low[2]) / self.edge), i, j, m, row
        cdef int other, n = 0
        for i in range(max(ci - 1, 0), min(ci + 2, self.shape[0])):
            for j in range(max(cj - 1, 0), min(cj + 2, self.shape[1])):
                row = (i * self.shape[1] + j) * self.shape[2]
                for m in range(self.start[row + max(ck - 1, 0)], self.start[row + min(ck + 2, self.shape[2])]):
                    other = self.order[m]
                    dx = self.positions[other, 0] - px
                    dy = self.positions[other, 1] - py
                    dz = self.positions[other, 2] - pz
                    if self.alive[other] and other != atom and dx * dx + dy * dy + dz * dz <= reach:
                        if n == MOST_NEAR:
                            return -1
                        others[n] = other
                        n += 1
        return n

    cdef void gather(self, long atom) noexcept nogil:
        # Count and sum of offsets of the neighbours; a count of -1 says there were too many.
        cdef int[MOST_NEAR] others
        cdef int n = self.near(atom, others), i
        cdef int axis
        self.count[atom] = n
        for i in range(n):
            for axis in range(3):
                self.offset[atom, axis] += self.positions[others[i], axis] - self.positions[atom, axis]

    cdef bint judge(self, long atom) noexcept nogil:
        # Whether the atom is at the surface by its neighbours; sets its normal.
        cdef double sx = self.offset[atom, 0], sy = self.offset[atom, 1], sz = self.offset[atom, 2]
        cdef double length = sqrt(sx * sx + sy * sy + sz * sz)
        if self.support[atom]:
            return False
        if self.count[atom] == 0:
            return True   # alone in space: keeps the normal it had
        if length > 1e-9:
            self.normal[atom, 0] = -sx / length
            self.normal[atom, 1] = -sy / length
            self.normal[atom, 2] = -sz / length
        return length > self.threshold * self.count[atom]

    cdef int remove(self, long atom, int* fresh) noexcept nogil:
        # Takes an atom away, renews the normals around it; lists the atoms that came to the surface, returns how many.
        cdef int[MOST_NEAR] others
        cdef int n = self.near(atom, others), i, other, n_fresh = 0
        cdef int axis
        self.alive[atom] = 0
        self.exposed[atom] = 0
        for i in range(n):
            other = others[i]
            self.count[other] -= 1
            for axis in range(3):
                self.offset[other, axis] -= self.positions[atom, axis] - self.positions[other, axis]
            if self.judge(other) and not self.exposed[other]:
                self.exposed[other] = 1
                fresh[n_fresh] = other
                n_fresh += 1
        return n_fresh

    cdef bint reaches_support(self, long atom) noexcept nogil:
        # Whether taking this atom away could expose atoms that are only held as support.
        cdef int[MOST_NEAR] others
        cdef int n = self.near(atom, others), i
        for i in range(n):
            if self.support[others[i]]:
                return True
        return False

    def remove_atom(self, long atom):
        """Take one atom away; return the atoms that came to the surface by it, shape (m,)."""
        cdef int[::1] fresh = np.empty(MOST_NEAR, np.int32)
        return np.asarray(fresh)[:self.remove(atom, &fresh[0])].copy()

    @property
    def surface(self):
        """Atoms at the surface, shape (m,), in the caller's numbering."""
        return np.flatnonzero(np.asarray(self.exposed))

    @property
    def normals(self):
        """Outward unit normals, shape (n, 3); meaningful for surface atoms."""
        return np.asarray(self.normal)

    @property
    def counts(self):
        """Number of neighbours within the radius, shape (n,)."""
        return np.asarray(self.count)

    @property
    def offsets(self):
        """Distance of each atom from the centre of mass of its neighbours [nm], shape (n,)."""
        return np.linalg.norm(np.asarray(self.offset), axis=1) / np.maximum(np.asarray(self.count), 1)
