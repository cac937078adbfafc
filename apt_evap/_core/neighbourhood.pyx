"""Surface atoms and their normals, from the mean position of the neighbourhood of each atom.

For atom i at p_i with the mean c_i of all other atoms within a radius, d_i = |p_i - c_i|: a surface atom has d_i above
a threshold, its outward normal is (p_i - c_i)/d_i (Rolland et al., Microsc. Microanal. 21, 1649, 2015). An exposed atom
stays exposed until it evaporates.

The walls of a closed void are in no field, and are no surface atoms before it opens.

Atoms without a chain of nearest neighbour bonds to the body are detached. Only the removal of an atom can detach
others, and each part that it cuts off contains one of its nearest neighbours: the search starts there.
"""

from cython.parallel cimport prange
from libc.math cimport floor, sqrt

import numpy as np

from apt_evap._core.index cimport Index


cdef int root(int* parent, int i) noexcept nogil:
    # The part that an atom belongs to, of parts that have met.
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


cdef class Neighbourhood:
    """Atoms, their neighbours within a radius, and the resulting surface.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        All atoms [nm].
    radius : float or ndarray, shape (kinds,)
        Radius of the neighbourhood [nm], of each kind of atoms.
    threshold : float or ndarray, shape (kinds,)
        Distance from the mean position of the neighbourhood above which an atom is a surface atom [nm].
    support : ndarray of int8, shape (n,)
        1 for atoms that complete the neighbourhoods of others but are never surface atoms.
    bond_length : float or ndarray, shape (kinds,)
        Atoms closer than this are nearest neighbours [nm]; not larger than the radius. Between two kinds, the mean of
        theirs.
    n_threads : int
        Number of threads.
    before : Neighbourhood, optional
        Neighbourhood of the first of these atoms: its removed, exposed and detached atoms remain so.
    anchored : ndarray of int8, shape (n,), optional
        1 for atoms that never evaporate; atoms with a chain of bonds to them are attached. By default the support
        atoms.
    codes : (ndarray of int32, ndarray of int32, float), optional
        What an atom adds to the bond code of its nearest and of its second neighbours, each of shape (n,), and the
        distance of second neighbours [nm]. A law that depends on the species of the neighbours sees this code.
    kinds : ndarray of int8, shape (n,), optional
        Kind of each atom, if there are several.
    outer : ndarray of int8, shape (n,), optional
        1 for atoms near the outer surface of a specimen with voids or gaps. Other atoms with incomplete neighbourhoods
        are walls of voids, and atoms without a chain of bonds to an anchored atom are detached from the beginning.
        By default there are no voids.
    """

    def __init__(self, const double[:, ::1] positions, radius, threshold, const signed char[::1] support,
                 bond_length=0.0, int n_threads=1, Neighbourhood before=None,
                 const signed char[::1] anchored=None, codes=None, const signed char[::1] kinds=None,
                 const signed char[::1] outer=None):
        cdef Index n = positions.shape[0], i
        if n == 0:
            raise ValueError("a specimen must have at least one atom, got none")
        self.n_atoms = n
        radii, bond_lengths = np.atleast_1d(np.float64(radius)), np.atleast_1d(np.float64(bond_length))
        self.radius, self.reach, self.threshold = radii.max(), radii * radii, np.atleast_1d(np.float64(threshold))
        bond_lengths = 0.5 * (bond_lengths[:, None] + bond_lengths)
        self.bond = bond_lengths * bond_lengths
        self.has_kinds = kinds is not None
        self.kind = np.zeros(1, np.int8) if kinds is None else kinds
        if n >= 2**31:
            raise ValueError(f"a specimen must have fewer than 2**31 atoms, got {n}")
        self.positions, self.support = positions, support
        self.alive = np.ones(n, np.int8)
        self.exposed = np.zeros(n, np.int8)
        self.detached = np.zeros(n, np.int8)
        self.anchored = support if anchored is None else anchored
        self.n_detached = self.n_waiting = 0
        self.waiting = np.empty(MAX_PIECE, np.int32)
        self.visited, self.piece_of = np.empty(MAX_PIECE, np.int32), np.empty(MAX_PIECE, np.int32)
        self.following, self.table = np.empty(MAX_PIECE, np.int32), np.full(4 * MAX_PIECE, -1, np.int32)
        self.count = np.zeros(n, np.int32)
        self.bonds = np.zeros(n, np.int8)
        self.offset = np.zeros((n, 3))
        self.has_codes, self.second_length, self.too_many = codes is not None, 0.0, False
        if codes is not None:
            self.code, self.far_code, self.second_length = codes
            if self.second_length > self.radius:
                raise ValueError(f"second neighbours must be within {self.radius:g} nm, got {self.second_length:g} nm")
            self.bond_code = np.zeros(n, np.int32)
        if before is not None:
            np.asarray(self.alive)[:before.n_atoms] = before.alive
            np.asarray(self.detached)[:before.n_atoms] = before.detached
            self.waiting, self.n_waiting, self.n_detached = before.waiting, before.n_waiting, before.n_detached
        where = np.asarray(positions)
        low = where.min(axis=0)
        self.low = low
        shape = np.floor((where.max(axis=0) - low) / self.radius).astype(np.int64) + 1
        self.shape = shape
        flat = np.zeros(n, np.int64)
        for axis in range(3):   # one axis at a time: complete temporary arrays would dominate the peak memory
            flat *= shape[axis]
            flat += np.floor((where[:, axis] - low[axis]) / self.radius).astype(np.int64)
        self.order = np.argsort(flat, kind="stable").astype(np.int32)
        start = np.zeros(shape.prod() + 1, np.int32)
        np.cumsum(np.bincount(flat, minlength=shape.prod()), out=start[1:])
        self.start = start
        del flat
        for i in prange(n, nogil=True, schedule="dynamic", chunksize=1024, num_threads=n_threads):
            self.gather(i)
            self.exposed[i] = self.alive[i] and self.is_surface_atom(i)
        if before is not None:
            np.asarray(self.exposed)[:before.n_atoms] |= before.exposed
        self.n_hidden, self.opened = 0, False
        if outer is not None:
            self.find_voids(outer, before)
        if self.has_codes and self.too_many:
            raise ValueError(f"bonds by species need at most {MAX_CODED} nearest and second neighbours of each atom")
        if np.asarray(self.count).min() < 0:
            raise ValueError(f"radius must include at most {MAX_NEAR} neighbours of each atom, got {self.radius!r} nm")

    def find_voids(self, const signed char[::1] outer, Neighbourhood before=None):
        """Hide the walls of closed voids, and detach atoms without bonds to an anchored atom."""
        cdef Index i, n_old = 0 if before is None else before.n_atoms
        hidden = np.asarray(self.exposed).view(bool) & ~np.asarray(outer).view(bool)
        if before is not None:
            hidden[:n_old] &= ~np.asarray(before.exposed).view(bool)
        np.asarray(self.exposed)[hidden] = 0
        self.hidden, self.n_hidden = hidden.view(np.int8), np.count_nonzero(hidden)
        self.stack = np.empty(self.n_hidden, np.int32)
        for i in self.surface if self.n_hidden else ():
            self.open_from(i)
        self.opened = False
        if not np.any(self.anchored):
            return
        self.stack = np.empty(self.n_atoms, np.int32)
        attached = np.zeros(self.n_atoms, np.int8)
        self.mark_attached(attached)
        left = ~np.asarray(self.alive).view(bool)
        for i in np.flatnonzero(~(attached | left | np.asarray(self.detached)).view(bool)):
            self.detach(i)
        self.stack = np.empty(self.n_hidden, np.int32)

    cdef Index open_from(self, Index atom) noexcept nogil:
        # Exposes the walls of the void next to an exposed atom; returns the number of their atoms.
        cdef int[MAX_NEAR] others
        cdef Index n = 0, n_opened = 0
        cdef int m, k
        while True:
            m = self.near(atom, others)
            for k in range(m):
                if self.hidden[others[k]]:
                    self.hidden[others[k]] = 0
                    self.exposed[others[k]] = 1
                    self.stack[n] = others[k]
                    n += 1
                    n_opened += 1
            if n == 0:
                break
            n -= 1
            atom = self.stack[n]
        self.n_hidden -= n_opened
        if n_opened:
            self.opened = True
        return n_opened

    cdef void mark_attached(self, signed char[::1] attached) noexcept nogil:
        # Marks all atoms with a chain of bonds to an anchored atom.
        cdef int[MAX_NEAR] others
        cdef Index i, n = 0
        cdef int m, k
        for i in range(self.n_atoms):
            if self.anchored[i] and self.alive[i] and not attached[i]:
                attached[i] = 1
                self.stack[n] = <int>i
                n += 1
        while n:
            n -= 1
            i = self.stack[n]
            m = self.near(i, others)
            for k in range(m):
                if not attached[others[k]] and self.bonded(i, others[k]):
                    attached[others[k]] = 1
                    self.stack[n] = others[k]
                    n += 1

    cdef int kind_of(self, Index atom) noexcept nogil:
        # Kind of an atom.
        return self.kind[atom] if self.has_kinds else 0

    cdef int near(self, Index atom, int* others) noexcept nogil:
        # The remaining atoms within the largest radius of an atom, in the order of the cells; -1: more than MAX_NEAR.
        return self.within(atom, self.radius * self.radius, others)

    cdef int within(self, Index atom, double reach, int* others) noexcept nogil:
        # The remaining atoms within a squared distance, not larger than the largest radius; otherwise as `near`.
        cdef double px = self.positions[atom, 0], py = self.positions[atom, 1], pz = self.positions[atom, 2]
        cdef double dx, dy, dz
        cdef Index ci = <Index>floor((px - self.low[0]) / self.radius)
        cdef Index cj = <Index>floor((py - self.low[1]) / self.radius)
        cdef Index ck = <Index>floor((pz - self.low[2]) / self.radius), i, j, m, row
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

    cdef void gather(self, Index atom) noexcept nogil:
        # Count, bonds and sum of offsets of the neighbours; a count of -1 means too many.
        cdef int[MAX_NEAR] others
        cdef int atom_kind = self.kind_of(atom), n = self.within(atom, self.reach[atom_kind], others), i
        cdef double step, s, bond = self.bond[atom_kind, atom_kind]
        cdef int axis, n_near = 0, n_far = 0
        self.count[atom] = n
        for i in range(n):
            s = 0.0
            for axis in range(3):
                step = self.positions[others[i], axis] - self.positions[atom, axis]
                self.offset[atom, axis] += step
                s += step * step
            if self.has_kinds:
                bond = self.bond[atom_kind, self.kind[others[i]]]
            self.bonds[atom] += s <= bond
            n_near += s <= bond
            if self.has_codes:
                self.bond_code[atom] += self.code_of(others[i], s, bond)
                n_far += bond < s <= self.second_length * self.second_length
        if n_near > MAX_CODED or n_far > MAX_CODED:
            self.too_many = True    # the same value from all threads

    cdef int code_of(self, Index atom, double s, double bond) noexcept nogil:
        # What an atom adds to the code of an atom at this squared distance, with this squared bond length.
        if s <= bond:
            return self.code[atom]
        return self.far_code[atom] if s <= self.second_length * self.second_length else 0

    cdef bint is_surface_atom(self, Index atom) noexcept nogil:
        # Whether the atom is a surface atom by its neighbours; an isolated atom is.
        cdef double sx = self.offset[atom, 0], sy = self.offset[atom, 1], sz = self.offset[atom, 2]
        if self.support[atom]:
            return False
        return self.count[atom] == 0 or sqrt(sx * sx + sy * sy + sz * sz) > (
            self.threshold[self.kind_of(atom)] * self.count[atom])

    cdef void normal(self, Index atom, double* normal) noexcept nogil:
        # Outward unit normal; an atom with zero offset keeps its last normal.
        cdef double sx = self.offset[atom, 0], sy = self.offset[atom, 1], sz = self.offset[atom, 2]
        cdef double length = sqrt(sx * sx + sy * sy + sz * sz)
        if self.count[atom] > 0 and length > 1e-9:
            normal[0], normal[1], normal[2] = -sx / length, -sy / length, -sz / length

    cdef int remove(self, Index atom, int* fresh) noexcept nogil:
        # Removes an atom and updates the normals around it; lists the newly exposed atoms and returns their number.
        cdef int[MAX_NEAR] others
        cdef int[MAX_BONDS] nearest
        cdef int n = self.near(atom, others), i, other, n_fresh = 0, n_nearest = 0
        cdef int removed_kind = self.kind_of(atom), kind
        cdef double step, s, bond = self.bond[removed_kind, removed_kind]
        cdef int axis
        self.alive[atom] = 0
        self.exposed[atom] = 0
        self.n_detached += self.detached[atom]
        for i in range(n):
            other = others[i]
            s = 0.0
            if self.has_kinds:
                kind = self.kind[other]
                bond = self.bond[removed_kind, kind]
                for axis in range(3):
                    step = self.positions[atom, axis] - self.positions[other, axis]
                    s += step * step
                if s > self.reach[kind]:   # outside the neighbourhood of the other one
                    continue
                s = 0.0
            self.count[other] -= 1
            for axis in range(3):
                step = self.positions[atom, axis] - self.positions[other, axis]
                self.offset[other, axis] -= step
                s += step * step
            if self.has_codes:
                self.bond_code[other] -= self.code_of(atom, s, bond)
            if s <= bond:
                self.bonds[other] -= 1
                if not self.detached[other]:
                    if n_nearest < MAX_BONDS:
                        nearest[n_nearest] = other
                    n_nearest += 1
            if self.is_surface_atom(other) and not self.exposed[other]:
                self.exposed[other] = 1
                if self.n_hidden and self.hidden[other]:
                    self.hidden[other] = 0
                    self.n_hidden -= 1
                    self.open_from(other)
                fresh[n_fresh] = other
                n_fresh += 1
        if 1 < n_nearest <= MAX_BONDS:
            self.detach_parts(nearest, n_nearest)
        return n_fresh

    # ---- detached atoms ----------------------------------------------------------------------------------------------

    cdef bint bonded(self, Index first, Index second, double stretch=1.0) noexcept nogil:
        # Whether two atoms are nearest neighbours; `stretch` multiplies the squared length of the bond.
        cdef double s = 0.0, step
        cdef int axis
        for axis in range(3):
            step = self.positions[first, axis] - self.positions[second, axis]
            s += step * step
        return s <= stretch * self.bond[self.kind_of(first), self.kind_of(second)]

    cdef void detach_parts(self, const int* nearest, int n) noexcept nogil:
        # Detaches the parts of the specimen that are no longer attached when a common neighbour of these atoms is
        # removed. All parts grow in turn, one atom at a time, until they meet, touch an anchored atom, or have no
        # further atom. If no part touches an anchored atom, the last one that grows is the body.
        cdef int[MAX_NEAR] others
        cdef int[MAX_BONDS] parent, front, last
        cdef bint[MAX_BONDS] attached
        cdef int i, j, k, m, piece, other_piece, growing, n_attached
        cdef Index at, known, n_visited = 0

        # parts of neighbours that are bonded to each other, by union and find; most often there is only one
        for i in range(n):
            parent[i] = i
        for i in range(n):
            for j in range(i):
                if root(parent, i) != root(parent, j) and self.bonded(nearest[i], nearest[j]):
                    parent[root(parent, i)] = root(parent, j)
        growing = 0
        for i in range(n):
            growing += parent[i] == i
        if growing == 1:
            return

        # the other parts grow from these atoms; an atom of another part joins the two
        for i in range(n):
            attached[i], front[i], last[i] = False, -1, -1
        for i in range(n):
            piece = root(parent, i)
            n_visited = self.visit(nearest[i], piece, n_visited, &known)
            self.append(n_visited - 1, piece, front, last)
            attached[piece] = attached[piece] or self.anchored[nearest[i]]
        while True:
            growing = n_attached = 0
            for i in range(n):
                if parent[i] == i:
                    n_attached += attached[i]
                    growing += not attached[i] and front[i] >= 0
            if growing == 0 or (growing == 1 and n_attached == 0):
                break
            for i in range(n):
                if parent[i] != i or attached[i] or front[i] < 0:
                    continue
                at = front[i]
                front[i] = self.following[at]
                m = self.near(self.visited[at], others)
                for k in range(m):
                    if self.detached[others[k]] or not self.bonded(self.visited[at], others[k]):
                        continue
                    piece = root(parent, i)
                    n_visited = self.visit(others[k], piece, n_visited, &known)
                    if known < 0:
                        self.append(n_visited - 1, piece, front, last)
                        attached[piece] = attached[piece] or self.anchored[others[k]]
                    else:
                        other_piece = root(parent, self.piece_of[known])
                        if other_piece != piece:   # two parts meet
                            parent[piece] = other_piece
                            attached[other_piece] = attached[other_piece] or attached[piece]
                            if front[piece] >= 0:
                                if front[other_piece] < 0:
                                    front[other_piece] = front[piece]
                                else:
                                    self.following[last[other_piece]] = front[piece]
                                last[other_piece] = last[piece]
                    if n_visited == MAX_PIECE:
                        break
                if n_visited == MAX_PIECE:
                    break
            if n_visited == MAX_PIECE:
                break
        if growing == 0 and n_attached == 0:   # all parts ended in the same round: the largest one is the body
            for i in range(n):
                last[i] = 0
            for at in range(n_visited):
                last[root(parent, self.piece_of[at])] += 1
            piece = 0
            for i in range(n):
                if last[i] > last[piece]:
                    piece = i
            attached[piece] = True

        # parts without an anchored atom that cannot grow any more are detached
        for at in range(n_visited):
            piece = root(parent, self.piece_of[at])
            if not attached[piece] and front[piece] < 0:
                self.detach(self.visited[at])
        for i in range(self.table.shape[0]):
            self.table[i] = -1

    cdef Index visit(self, int atom, int piece, Index n, Index* known) noexcept nogil:
        # Adds an atom to those visited, of which there are n; returns their new number. known: place of an atom that
        # was visited before, or -1.
        cdef Index size = self.table.shape[0], key = (<Index>atom * 40503) % size
        while self.table[key] >= 0:
            if self.visited[self.table[key]] == atom:
                known[0] = self.table[key]
                return n
            key = (key + 1) % size
        known[0] = -1
        self.table[key] = <int>n
        self.visited[n], self.piece_of[n], self.following[n] = atom, piece, -1
        return n + 1

    cdef void append(self, Index at, int piece, int* front, int* last) noexcept nogil:
        # Adds a visited atom to those from which its part still has to grow.
        if front[piece] < 0:
            front[piece] = <int>at
        else:
            self.following[last[piece]] = <int>at
        last[piece] = <int>at

    cdef void detach(self, int atom) noexcept nogil:
        # Adds an atom to those that leave next, sorted by index.
        cdef Index i = self.n_waiting
        if i == self.waiting.shape[0]:
            with gil:
                self.waiting = np.concatenate([self.waiting, np.empty(i, np.int32)])
        self.detached[atom] = 1
        while i > 0 and self.waiting[i - 1] > atom:
            self.waiting[i] = self.waiting[i - 1]
            i -= 1
        self.waiting[i] = atom
        self.n_waiting += 1

    cdef Index next_detached(self, const int* slot_of) noexcept nogil:
        # The next detached atom with a slot; -1 if there is none.
        cdef Index i, n = 0, atom, best = -1
        for i in range(self.n_waiting):
            atom = self.waiting[i]
            if self.alive[atom]:
                self.waiting[n] = <int>atom
                n += 1
                if best < 0 and slot_of[atom] >= 0:
                    best = atom
        self.n_waiting = n
        return best

    @property
    def waiting_atoms(self):
        """Detached atoms that have not left yet, shape (m,)."""
        waiting = np.asarray(self.waiting)[:self.n_waiting]
        return waiting[np.asarray(self.alive)[waiting].view(bool)].astype(np.int64)

    cdef bint reaches_support(self, Index atom) noexcept nogil:
        # Whether the removal of this atom could expose support atoms.
        cdef int[MAX_NEAR] others
        cdef int n = self.near(atom, others), i
        for i in range(n):
            if self.support[others[i]]:
                return True
        return False

    def remove_atom(self, Index atom):
        """Remove an atom; return the newly exposed atoms, shape (m,)."""
        cdef int[::1] fresh = np.empty(MAX_NEAR, np.int32)
        return np.asarray(fresh)[:self.remove(atom, &fresh[0])].copy()

    def remove_atoms(self, const Index[::1] atoms):
        """Remove atoms one by one, as events do; ValueError for an atom that was already removed."""
        cdef int[::1] fresh = np.empty(MAX_NEAR, np.int32)
        cdef Index i
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

    def positions_of(self, const Index[::1] atoms, int n_threads=1):
        """Positions of atoms [nm], shape (m, 3); slow, because they are scattered in memory."""
        cdef double[:, ::1] positions = np.empty((len(atoms), 3))
        cdef Index i
        for i in prange(atoms.shape[0], nogil=True, schedule="static", num_threads=n_threads):
            positions[i, 0] = self.positions[atoms[i], 0]
            positions[i, 1] = self.positions[atoms[i], 1]
            positions[i, 2] = self.positions[atoms[i], 2]
        return np.asarray(positions)

    def normals_of(self, atoms, int n_threads=1):
        """Outward unit normals of atoms, shape (m, 3); (0, 0, 1) for zero offset of the neighbours."""
        cdef Index[::1] chosen = np.ascontiguousarray(atoms, np.int64)
        cdef double[:, ::1] normals = np.tile([0.0, 0.0, 1.0], (len(chosen), 1))
        cdef Index i
        for i in prange(chosen.shape[0], nogil=True, schedule="static", num_threads=n_threads):
            self.normal(chosen[i], &normals[i, 0])
        return np.asarray(normals)

    @property
    def counts(self):
        """Number of neighbours within the radius, shape (n,)."""
        return np.asarray(self.count)

    @property
    def bond_counts(self):
        """Number of nearest neighbours, closer than the bond length, shape (n,)."""
        return np.asarray(self.bonds).astype(np.int32)

    @property
    def bond_codes(self):
        """Sum of the codes of the remaining neighbours, shape (n,)."""
        return np.asarray(self.bond_code)

    @property
    def offsets(self):
        """Distance of each atom from the mean position of its neighbours [nm], shape (n,)."""
        return np.linalg.norm(np.asarray(self.offset), axis=1) / np.maximum(np.asarray(self.count), 1)
