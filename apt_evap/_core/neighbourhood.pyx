"""Surface atoms and their normals, from the mean position of the neighbourhood of each atom.

For atom i at p_i with the mean c_i of all other atoms within a radius, d_i = |p_i - c_i|: a surface atom has d_i above
a threshold, its outward normal is (p_i - c_i)/d_i (Rolland et al., Microsc. Microanal. 21, 1649, 2015). An exposed atom
stays exposed until it evaporates.
"""

from cython.parallel cimport prange
from libc.math cimport floor, sqrt

import numpy as np


cdef class Neighbourhood:
    """Atoms, their neighbours within a radius, and the resulting surface.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        All atoms [nm].
    radius : float
        Radius of the neighbourhood [nm].
    threshold : float
        Distance from the mean position of the neighbourhood above which an atom is a surface atom [nm].
    support : ndarray of int8, shape (n,)
        1 for atoms that complete the neighbourhoods of others but are never surface atoms.
    bond_length : float
        Atoms closer than this are nearest neighbours [nm]; not larger than the radius.
    n_threads : int
        Number of threads.
    before : Neighbourhood, optional
        Neighbourhood of the first of these atoms: its removed and exposed atoms stay removed and exposed.
    """

    def __init__(self, const double[:, ::1] positions, double radius, double threshold, const signed char[::1] support,
                 double bond_length=0.0, int n_threads=1, Neighbourhood before=None):
        cdef long n = positions.shape[0], i
        if n == 0:
            raise ValueError("a specimen must have at least one atom, got none")
        self.n_atoms = n
        self.radius, self.threshold, self.bond_length = radius, threshold, bond_length
        if n >= 2**31:
            raise ValueError(f"a specimen must have fewer than 2**31 atoms, got {n}")
        self.positions, self.support = positions, support
        self.alive = np.ones(n, np.int8)
        self.exposed = np.zeros(n, np.int8)
        self.count = np.zeros(n, np.int32)
        self.bonds = np.zeros(n, np.int8)
        self.offset = np.zeros((n, 3))
        if before is not None:
            np.asarray(self.alive)[:before.n_atoms] = before.alive
        where = np.asarray(positions)
        low = where.min(axis=0)
        self.low = low
        shape = np.floor((where.max(axis=0) - low) / radius).astype(np.int64) + 1
        self.shape = shape
        flat = np.zeros(n, np.int64)
        for axis in range(3):   # one axis at a time: complete temporary arrays would dominate the peak memory
            flat *= shape[axis]
            flat += np.floor((where[:, axis] - low[axis]) / radius).astype(np.int64)
        self.order = np.argsort(flat, kind="stable").astype(np.int32)
        start = np.zeros(shape.prod() + 1, np.int32)
        np.cumsum(np.bincount(flat, minlength=shape.prod()), out=start[1:])
        self.start = start
        del flat
        for i in prange(n, nogil=True, schedule="dynamic", chunksize=1024, num_threads=n_threads):
            self.gather(i)
            self.exposed[i] = self.alive[i] and self.judge(i)
        if before is not None:
            np.asarray(self.exposed)[:before.n_atoms] |= before.exposed
        if np.asarray(self.count).min() < 0:
            raise ValueError(f"radius must include at most {MAX_NEAR} neighbours of each atom, got {radius!r} nm")

    cdef int near(self, long atom, int* others) noexcept nogil:
        # The remaining atoms within the radius of an atom, in the order of the cells; -1: more than MAX_NEAR.
        cdef double px = self.positions[atom, 0], py = self.positions[atom, 1], pz = self.positions[atom, 2]
        cdef double dx, dy, dz, reach = self.radius * self.radius
        cdef long ci = <long>floor((px - self.low[0]) / self.radius), cj = <long>floor((py - self.low[1]) / self.radius)
        cdef long ck = <long>floor((pz - self.low[2]) / self.radius), i, j, m, row
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
                        if n == MAX_NEAR:
                            return -1
                        others[n] = other
                        n += 1
        return n

    cdef void gather(self, long atom) noexcept nogil:
        # Count, bonds and sum of offsets of the neighbours; a count of -1 means too many.
        cdef int[MAX_NEAR] others
        cdef int n = self.near(atom, others), i
        cdef double step, s, bond = self.bond_length * self.bond_length
        cdef int axis
        self.count[atom] = n
        for i in range(n):
            s = 0.0
            for axis in range(3):
                step = self.positions[others[i], axis] - self.positions[atom, axis]
                self.offset[atom, axis] += step
                s += step * step
            self.bonds[atom] += s <= bond

    cdef bint judge(self, long atom) noexcept nogil:
        # Whether the atom is a surface atom by its neighbours; an isolated atom is.
        cdef double sx = self.offset[atom, 0], sy = self.offset[atom, 1], sz = self.offset[atom, 2]
        if self.support[atom]:
            return False
        return self.count[atom] == 0 or sqrt(sx * sx + sy * sy + sz * sz) > self.threshold * self.count[atom]

    cdef void normal(self, long atom, double* normal) noexcept nogil:
        # Outward unit normal; an atom with zero offset keeps its last normal.
        cdef double sx = self.offset[atom, 0], sy = self.offset[atom, 1], sz = self.offset[atom, 2]
        cdef double length = sqrt(sx * sx + sy * sy + sz * sz)
        if self.count[atom] > 0 and length > 1e-9:
            normal[0], normal[1], normal[2] = -sx / length, -sy / length, -sz / length

    cdef int remove(self, long atom, int* fresh) noexcept nogil:
        # Removes an atom and updates the normals around it; lists the newly exposed atoms and returns their number.
        cdef int[MAX_NEAR] others
        cdef int n = self.near(atom, others), i, other, n_fresh = 0
        cdef double step, s, bond = self.bond_length * self.bond_length
        cdef int axis
        self.alive[atom] = 0
        self.exposed[atom] = 0
        for i in range(n):
            other = others[i]
            self.count[other] -= 1
            s = 0.0
            for axis in range(3):
                step = self.positions[atom, axis] - self.positions[other, axis]
                self.offset[other, axis] -= step
                s += step * step
            self.bonds[other] -= s <= bond
            if self.judge(other) and not self.exposed[other]:
                self.exposed[other] = 1
                fresh[n_fresh] = other
                n_fresh += 1
        return n_fresh

    cdef bint reaches_support(self, long atom) noexcept nogil:
        # Whether the removal of this atom could expose support atoms.
        cdef int[MAX_NEAR] others
        cdef int n = self.near(atom, others), i
        for i in range(n):
            if self.support[others[i]]:
                return True
        return False

    def remove_atom(self, long atom):
        """Remove an atom; return the newly exposed atoms, shape (m,)."""
        cdef int[::1] fresh = np.empty(MAX_NEAR, np.int32)
        return np.asarray(fresh)[:self.remove(atom, &fresh[0])].copy()

    def remove_atoms(self, const long long[::1] atoms):
        """Remove atoms one by one, as events do; ValueError for an atom that was already removed."""
        cdef int[::1] fresh = np.empty(MAX_NEAR, np.int32)
        cdef long i
        for i in range(atoms.shape[0]):
            if not (0 <= atoms[i] < self.n_atoms and self.alive[atoms[i]]):
                raise ValueError(f"atoms to remove must be in the specimen, got {atoms[i]} of {self.n_atoms}")
        with nogil:
            for i in range(atoms.shape[0]):
                self.remove(atoms[i], &fresh[0])

    @property
    def surface(self):
        """Indices of the surface atoms, shape (m,)."""
        return np.flatnonzero(np.asarray(self.exposed).view(bool))   # as bool: seven times faster

    def positions_of(self, const long long[::1] atoms, int n_threads=1):
        """Positions of atoms [nm], shape (m, 3); slow, because they are scattered in memory."""
        cdef double[:, ::1] positions = np.empty((len(atoms), 3))
        cdef long i
        for i in prange(atoms.shape[0], nogil=True, schedule="static", num_threads=n_threads):
            positions[i, 0] = self.positions[atoms[i], 0]
            positions[i, 1] = self.positions[atoms[i], 1]
            positions[i, 2] = self.positions[atoms[i], 2]
        return np.asarray(positions)

    def normals_of(self, atoms, int n_threads=1):
        """Outward unit normals of atoms, shape (m, 3); (0, 0, 1) for zero offset of the neighbours."""
        cdef long long[::1] chosen = np.ascontiguousarray(atoms, np.int64)
        cdef double[:, ::1] normals = np.tile([0.0, 0.0, 1.0], (len(chosen), 1))
        cdef long i
        for i in prange(chosen.shape[0], nogil=True, schedule="static", num_threads=n_threads):
            self.normal(chosen[i], &normals[i, 0])
        return np.asarray(normals)

    @property
    def counts(self):
        """Number of neighbours within the radius, shape (n,)."""
        return np.asarray(self.count)

    @property
    def bond_counts(self):
        """Number of nearest neighbours, closer than `bond_length`, shape (n,)."""
        return np.asarray(self.bonds).astype(np.int32)

    @property
    def offsets(self):
        """Distance of each atom from the mean position of its neighbours [nm], shape (n,)."""
        return np.linalg.norm(np.asarray(self.offset), axis=1) / np.maximum(np.asarray(self.count), 1)
