"""Octree over charged atoms: fields by cells with quadrupoles (Barnes and Hut, Nature 324, 446, 1986).

The tree is flat: nodes in preorder with two integers each (`skip`, the next node outside the subtree, and the slots
[first, last)), so a walk is a loop. A cell has a charge and a traceless quadrupole about its centre of charge. Whether
it replaces its atoms depends on its fixed ball, so the lists do not depend on the charges.

Charges may have either sign. Where they nearly cancel, the centre of charge of a cell can be outside its ball. Such a
cell does not replace its atoms: its smaller cells or its atoms act one by one.
"""

from cython.parallel cimport prange
from libc.math cimport sqrt
from libc.stdlib cimport free

from apt_evap._core.index cimport Index
from apt_evap._core.sources cimport (
    CELL, LANES, Nodes, SingleSources, Sources, nodes_reserve, single_reserve, sources_field, sources_free,
    sources_grow, sources_init, sources_potential,
)

import numpy as np

import apt_evap._core.morton as morton


cdef extern from *:
    """
    #ifdef __GNUC__
    #define APT_PREFETCH(place) do { __builtin_prefetch(place); __builtin_prefetch((place) + 8); } while (0)
    #else
    #define APT_PREFETCH(place) (void)(place)
    #endif
    """
    void prefetch "APT_PREFETCH"(const double*) noexcept nogil


cdef inline bint is_within(double x, double y, double z, int n_balls, const double* balls) noexcept nogil:
    # Whether a point is in one of n balls (n, 4).
    cdef int k
    for k in range(n_balls):
        if ((x - balls[4 * k]) ** 2 + (y - balls[4 * k + 1]) ** 2 + (z - balls[4 * k + 2]) ** 2
                <= balls[4 * k + 3] * balls[4 * k + 3]):
            return True
    return False


cdef class Octree:
    """Octree over n charged atoms.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        Positions of the atoms [nm].
    charges : ndarray, shape (n,)
        Charges [e].
    atoms : ndarray of int64, shape (n,), optional
        Index of each atom for the caller; by default 0 ... n - 1.
    leaf_size : int
        Largest number of atoms of a leaf. Measured: 8, 16 and 24 differ by less than 10 % in time and error of lists
        and sweep (R = 80 a).
    extra : int
        Number of atoms that can be added before the tree is rebuilt.
    n_threads : int
        Number of threads.
    """

    def __init__(self, const double[:, ::1] positions, const double[::1] charges, atoms=None, int leaf_size=16,
                 Index extra=0, int n_threads=1):
        cdef Index n = positions.shape[0], capacity = n + extra, i, k
        cdef Index[::1] order
        cdef bint numbered = atoms is None
        cdef const Index[::1] numbers = np.empty(0, np.int64) if numbered else np.asarray(atoms, np.int64)
        if n == 0:
            raise ValueError("an octree needs at least one atom, got none")
        order, keys = morton.morton_order(positions, n_threads)
        self.first, self.last, self.parent, self.skip = morton.split(keys, leaf_size, n_threads)
        self.leaf_size, self.n_threads = leaf_size, n_threads
        self.n_slots, self.n_sorted, self.n_nodes = n, n, self.first.shape[0]
        self.x, self.y, self.z, self.q = np.zeros((4, capacity))
        self.atom = np.full(capacity, -1, np.int64)
        self.leaf = np.full(capacity, -1, np.int32)
        self.next_extra = np.full(capacity, -1, np.int32)
        self.extra = np.full(self.n_nodes, -1, np.int32)
        for i in prange(n, nogil=True, schedule="static", num_threads=n_threads):
            k = order[i]
            self.x[i], self.y[i], self.z[i], self.q[i] = positions[k, 0], positions[k, 1], positions[k, 2], charges[k]
            self.atom[i] = k if numbered else numbers[k]
        self.enclose(n_threads)
        self.dirty, self.cancels = np.zeros((2, self.n_nodes), np.int8)
        self.queue = np.empty(self.n_nodes, np.int32)
        self.n_dirty = 0
        self.cells = np.zeros((self.n_nodes, CELL))
        self.refresh_all()

    cdef enclose(self, int n_threads):
        # Leaf of every slot, and ball of every node: centre of its bounding box, and distance of its farthest atom.
        cdef Index node
        cdef int up, axis
        cdef double[:, ::1] low = np.full((self.n_nodes, 3), np.inf), high = np.full((self.n_nodes, 3), -np.inf)
        for node in prange(self.n_nodes, nogil=True, schedule="dynamic", chunksize=256, num_threads=n_threads):
            if self.skip[node] == node + 1:
                self.box_of_leaf(node, &low[node, 0], &high[node, 0])
        self.ball = np.empty((self.n_nodes, 4))
        with nogil:
            for node in range(self.n_nodes - 1, 0, -1):
                up = self.parent[node]
                for axis in range(3):
                    low[up, axis] = min(low[up, axis], low[node, axis])
                    high[up, axis] = max(high[up, axis], high[node, axis])
        for node in prange(self.n_nodes, nogil=True, schedule="dynamic", chunksize=256, num_threads=n_threads):
            self.ball_of_box(node, &low[node, 0], &high[node, 0])

    cdef void box_of_leaf(self, Index node, double* low, double* high) noexcept nogil:
        cdef Index k
        for k in range(self.first[node], self.last[node]):
            self.leaf[k] = <int>node
            low[0], high[0] = min(low[0], self.x[k]), max(high[0], self.x[k])
            low[1], high[1] = min(low[1], self.y[k]), max(high[1], self.y[k])
            low[2], high[2] = min(low[2], self.z[k]), max(high[2], self.z[k])

    cdef void ball_of_box(self, Index node, const double* low, const double* high) noexcept nogil:
        cdef double far = 0.0
        cdef double* ball = &self.ball[node, 0]
        cdef Index k
        cdef int axis
        for axis in range(3):
            ball[axis] = 0.5 * (low[axis] + high[axis])
        for k in range(self.first[node], self.last[node]):
            far = max(far, (self.x[k] - ball[0]) ** 2 + (self.y[k] - ball[1]) ** 2 + (self.z[k] - ball[2]) ** 2)
        ball[3] = sqrt(far)

    cdef inline Index following(self, Index node, Index slot) noexcept nogil:
        # The next slot of a leaf: first those in order, then those added later; -1 after the last.
        if slot + 1 < self.last[node]:
            return slot + 1
        return self.extra[node] if slot < self.last[node] else self.next_extra[slot]

    # ---- charges and moments ---------------------------------------------------------------------------------------

    cdef void moments(self, Index node) noexcept nogil:
        # Charge, centre of charge and traceless quadrupole sum q (3 d d - d^2) of one node, from its atoms or children.
        cdef double charge = 0.0, cx = 0.0, cy = 0.0, cz = 0.0, q, dx, dy, dz, s
        cdef double xx = 0.0, xy = 0.0, xz = 0.0, yy = 0.0, yz = 0.0, zz = 0.0
        cdef Index k, leaf, end = self.skip[node]
        cdef bint by_atoms = end == node + 1
        cdef double* ball = &self.ball[node, 0]
        cdef double* cell
        k = node + 1
        while k < end and not by_atoms:
            by_atoms = self.cancels[k]   # such a child has no dipole
            k = self.skip[k]

        # charge Q = sum q, and sum q r
        if by_atoms:
            for leaf in range(node, end):
                k = self.first[leaf] if self.skip[leaf] == leaf + 1 else -1
                while k >= 0:
                    q = self.q[k]
                    charge += q
                    cx += q * self.x[k]
                    cy += q * self.y[k]
                    cz += q * self.z[k]
                    k = self.following(leaf, k)
        else:
            k = node + 1
            while k < end:
                q = self.cells[k, 3]
                charge += q
                cx += q * self.cells[k, 0]
                cy += q * self.cells[k, 1]
                cz += q * self.cells[k, 2]
                k = self.skip[k]

        # centre of charge c = sum q r / Q; if it is outside the ball, the charges cancel: moments about its centre
        if charge != 0.0:
            cx /= charge
            cy /= charge
            cz /= charge
            dx, dy, dz, s = cx - ball[0], cy - ball[1], cz - ball[2], ball[3] + 1e-6   # the centre is rounded
            self.cancels[node] = dx * dx + dy * dy + dz * dz > s * s
        else:
            self.cancels[node] = cx != 0.0 or cy != 0.0 or cz != 0.0
        if charge == 0.0 or self.cancels[node]:
            cx, cy, cz = ball[0], ball[1], ball[2]

        # quadrupole about c, sum q (3 d d - d^2) with d = r - c; that of a child, and that of its charge at its centre
        if by_atoms:
            for leaf in range(node, end):
                k = self.first[leaf] if self.skip[leaf] == leaf + 1 else -1
                while k >= 0:
                    q, dx, dy, dz = self.q[k], self.x[k] - cx, self.y[k] - cy, self.z[k] - cz
                    s = dx * dx + dy * dy + dz * dz
                    xx += q * (3.0 * dx * dx - s)
                    xy += q * 3.0 * dx * dy
                    xz += q * 3.0 * dx * dz
                    yy += q * (3.0 * dy * dy - s)
                    yz += q * 3.0 * dy * dz
                    zz += q * (3.0 * dz * dz - s)
                    k = self.following(leaf, k)
        else:
            k = node + 1
            while k < end:
                q = self.cells[k, 3]
                dx, dy, dz = self.cells[k, 0] - cx, self.cells[k, 1] - cy, self.cells[k, 2] - cz
                s = dx * dx + dy * dy + dz * dz
                xx += self.cells[k, 4] + q * (3.0 * dx * dx - s)
                xy += self.cells[k, 5] + q * 3.0 * dx * dy
                xz += self.cells[k, 6] + q * 3.0 * dx * dz
                yy += self.cells[k, 7] + q * (3.0 * dy * dy - s)
                yz += self.cells[k, 8] + q * 3.0 * dy * dz
                zz += self.cells[k, 9] + q * (3.0 * dz * dz - s)
                k = self.skip[k]
        cell = &self.cells[node, 0]
        cell[0], cell[1], cell[2], cell[3] = cx, cy, cz, charge
        cell[4], cell[5], cell[6], cell[7], cell[8], cell[9] = xx, xy, xz, yy, yz, zz

    def refresh_all(self):
        """Recompute the moments of every node from the charges."""
        cdef Index node
        for node in prange(self.n_nodes, nogil=True, schedule="dynamic", chunksize=256, num_threads=self.n_threads):
            if self.skip[node] == node + 1:
                self.moments(node)
        with nogil:
            for node in range(self.n_nodes - 1, -1, -1):
                if self.skip[node] > node + 1:
                    self.moments(node)

    cdef void mark(self, Index node) noexcept nogil:
        while node >= 0 and not self.dirty[node]:
            self.dirty[node] = 1
            self.queue[self.n_dirty] = <int>node
            self.n_dirty += 1
            node = self.parent[node]

    cdef void set_charge(self, Index slot, double charge) noexcept nogil:
        # The moments are updated at the next refresh().
        self.q[slot] = charge
        self.mark(self.leaf[slot])

    cdef void remove_atom(self, Index slot) noexcept nogil:
        # The slot remains, without charge and without an atom.
        self.atom[slot] = -1
        self.set_charge(slot, 0.0)

    cdef Index insert_atom(self, Index atom, double px, double py, double pz, int leaf) noexcept nogil:
        # Adds an atom to the leaf of a neighbouring atom; the balls above grow to contain it. -1: no space left.
        cdef Index slot = self.n_slots, node = leaf
        cdef double far
        if slot >= self.x.shape[0]:
            return -1
        self.n_slots += 1
        self.atom[slot] = atom
        self.x[slot] = px
        self.y[slot] = py
        self.z[slot] = pz
        self.q[slot] = 0.0
        self.leaf[slot] = leaf
        self.next_extra[slot] = self.extra[leaf]
        self.extra[leaf] = <int>slot
        while node >= 0:
            far = sqrt((px - self.ball[node, 0]) ** 2 + (py - self.ball[node, 1]) ** 2 + (pz - self.ball[node, 2]) ** 2)
            self.ball[node, 3] = max(self.ball[node, 3], far)
            node = self.parent[node]
        return slot

    cdef void refresh(self) noexcept nogil:
        # Recomputes moments of the nodes above changed charges, children before parents: descending preorder numbers.
        cdef Index i, j
        cdef int node
        if 4 * self.n_dirty > self.n_nodes:   # faster than sorting
            for node in range(self.n_nodes - 1, -1, -1):
                if self.dirty[node]:
                    self.moments(node)
                    self.dirty[node] = 0
            self.n_dirty = 0
            return
        for i in range(1, self.n_dirty):   # changes come in the order of the tree: nearly sorted
            node = self.queue[i]
            j = i - 1
            while j >= 0 and self.queue[j] > node:
                self.queue[j + 1] = self.queue[j]
                j -= 1
            self.queue[j + 1] = node
        for i in range(self.n_dirty - 1, -1, -1):
            self.moments(self.queue[i])
            self.dirty[self.queue[i]] = 0
        self.n_dirty = 0

    # ---- walks -----------------------------------------------------------------------------------------------------

    cdef int walk(self, double cx, double cy, double cz, double radius, double opening_angle,
                  Sources* sources) except -1 nogil:
        # Lists the sources for the targets in a ball: a cell if its ball appears under less than the opening angle from
        # every point of the ball of the targets, otherwise its atoms.
        cdef int root = 0
        return self.walk_from(1, &root, cx, cy, cz, radius, opening_angle, sources)

    cdef int walk_from(self, Index n_roots, const int* roots, double cx, double cy, double cz, double radius,
                       double opening_angle, Sources* sources) except -1 nogil:
        # The same of the subtrees of some nodes.
        cdef Index node, k, number, end
        cdef double dx, dy, dz, apart, factor = 2.0 / opening_angle if opening_angle > 0.0 else 1e30
        sources.n_atoms = sources.n_cells = 0
        for number in range(n_roots):
            node, end = roots[number], self.skip[roots[number]]
            while node < end:
                if sources.n_cells + LANES >= sources.capacity:
                    sources_grow(sources)
                dx, dy, dz = cx - self.ball[node, 0], cy - self.ball[node, 1], cz - self.ball[node, 2]
                apart = self.ball[node, 3] * factor + radius
                if apart * apart < dx * dx + dy * dy + dz * dz and not self.cancels[node]:
                    sources.cell[sources.n_cells] = <int>node
                    sources.n_cells += 1
                    node = self.skip[node]
                elif self.skip[node] == node + 1:
                    k = self.first[node]
                    while k >= 0:
                        if sources.n_atoms >= sources.capacity:
                            sources_grow(sources)
                        if self.atom[k] >= 0:
                            sources.atom[sources.n_atoms] = <int>k
                            sources.n_atoms += 1
                        k = self.following(node, k)
                    node += 1
                else:
                    node += 1
        return 0

    cdef int part(self, const Nodes* roots, const double* ball, double opening_angle, double beyond, Sources* sources,
                  Nodes* rest) except -1 nogil:
        # Divides the subtrees of some nodes: sources for the targets in a ball that are farther than `beyond` from its
        # centre, and nodes with all the others. These are as large as possible: a smaller ball needs fewer of them.
        cdef Index node, k, number, end
        cdef double dx, dy, dz, s, radius, apart, factor = 2.0 / opening_angle
        sources.n_atoms = sources.n_cells = rest.n = 0
        for number in range(roots.n):
            node, end = roots.node[number], self.skip[roots.node[number]]
            while node < end:
                if sources.n_cells >= sources.capacity:
                    sources_grow(sources)
                if rest.n >= rest.capacity:
                    nodes_reserve(rest, rest.n + 1)
                dx, dy, dz = ball[0] - self.ball[node, 0], ball[1] - self.ball[node, 1], ball[2] - self.ball[node, 2]
                s = dx * dx + dy * dy + dz * dz
                radius = self.ball[node, 3]
                apart = radius * factor + ball[3]
                if radius <= beyond and s <= (beyond - radius) * (beyond - radius):
                    rest.node[rest.n] = <int>node
                    rest.n += 1
                    node = self.skip[node]
                elif apart * apart < s and not self.cancels[node]:
                    dx, dy = ball[0] - self.cells[node, 0], ball[1] - self.cells[node, 1]
                    dz = ball[2] - self.cells[node, 2]
                    if dx * dx + dy * dy + dz * dz > beyond * beyond:
                        sources.cell[sources.n_cells] = <int>node
                        sources.n_cells += 1
                    else:
                        rest.node[rest.n] = <int>node
                        rest.n += 1
                    node = self.skip[node]
                elif self.skip[node] == node + 1:
                    if s > (beyond + radius) * (beyond + radius):
                        k = self.first[node]
                        while k >= 0:
                            if sources.n_atoms >= sources.capacity:
                                sources_grow(sources)
                            if self.atom[k] >= 0:
                                sources.atom[sources.n_atoms] = <int>k
                                sources.n_atoms += 1
                            k = self.following(node, k)
                    else:
                        rest.node[rest.n] = <int>node
                        rest.n += 1
                    node += 1
                else:
                    node += 1
        return 0

    cdef int collect(self, double cx, double cy, double cz, double radius, double opening_angle,
                     Sources* sources) except -1 nogil:
        # Copies the sources of a walk into columns.
        cdef Index k, m, stride
        cdef int slot
        self.walk(cx, cy, cz, radius, opening_angle, sources)
        stride = sources.capacity
        for k in range(sources.n_atoms):
            slot = sources.atom[k]
            sources.atoms[k] = self.x[slot]
            sources.atoms[stride + k] = self.y[slot]
            sources.atoms[2 * stride + k] = self.z[slot]
            sources.atoms[3 * stride + k] = self.q[slot]
        for k in range(sources.n_cells):
            for m in range(CELL):
                sources.cells[m * stride + k] = self.cells[sources.cell[k], m]
        while sources.n_cells % LANES:
            for m in range(CELL):
                sources.cells[m * stride + sources.n_cells] = 0.0
            sources.cells[sources.n_cells] = cx + 4.0 * radius + 1e4   # an empty cell, distant from every target
            sources.n_cells += 1
        return 0

    cdef int copy_single(self, const double* centre, int n_balls, const double* balls, const Sources* sources,
                         SingleSources* near, SingleSources* far) except -1 nogil:
        # Copies the sources of a walk in single precision, relative to the centre: those within one of n balls (n, 4),
        # relative to the centre, too, and the others. Without balls all are near. The caller pads the lists.
        cdef SingleSources* part
        cdef double dx, dy, dz
        cdef const double* cell
        cdef Index k, at
        cdef int slot, m
        single_reserve(near, sources.capacity, centre)
        single_reserve(far, sources.capacity, centre)
        for k in range(sources.n_atoms):
            slot = sources.atom[k]
            dx, dy, dz = self.x[slot] - centre[0], self.y[slot] - centre[1], self.z[slot] - centre[2]
            part = near if n_balls == 0 or is_within(dx, dy, dz, n_balls, balls) else far
            at = part.n_atoms
            part.atoms[at], part.atoms[part.capacity + at] = <float>dx, <float>dy
            part.atoms[2 * part.capacity + at], part.atoms[3 * part.capacity + at] = <float>dz, <float>self.q[slot]
            part.n_atoms = at + 1
        for k in range(sources.n_cells):
            if k + 8 < sources.n_cells:
                prefetch(&self.cells[sources.cell[k + 8], 0])
            cell = &self.cells[sources.cell[k], 0]
            dx, dy, dz = cell[0] - centre[0], cell[1] - centre[1], cell[2] - centre[2]
            if cell[3] == 0.0:
                continue   # a leaf whose atoms were removed: a flight may start at its place
            part = near if n_balls == 0 or is_within(dx, dy, dz, n_balls, balls) else far
            at = part.n_cells
            part.cells[at], part.cells[part.capacity + at] = <float>dx, <float>dy
            part.cells[2 * part.capacity + at] = <float>dz
            for m in range(3, CELL):
                part.cells[m * part.capacity + at] = <float>cell[m]
            part.n_cells = at + 1
        return 0

    cdef Index within(self, double px, double py, double pz, double radius, int* slots, Index most) noexcept nogil:
        # Slots of the atoms within a radius, in the order of the tree; lists up to `most` of them, returns their
        # number.
        cdef Index node = 0, k, n = 0
        cdef double dx, dy, dz, reach
        while node < self.n_nodes:
            dx, dy, dz = px - self.ball[node, 0], py - self.ball[node, 1], pz - self.ball[node, 2]
            reach = self.ball[node, 3] + radius
            if dx * dx + dy * dy + dz * dz > reach * reach:
                node = self.skip[node]
                continue
            if self.skip[node] == node + 1:
                k = self.first[node]
                while k >= 0:
                    dx, dy, dz = px - self.x[k], py - self.y[k], pz - self.z[k]
                    if self.atom[k] >= 0 and dx * dx + dy * dy + dz * dz <= radius * radius:
                        if n < most:
                            slots[n] = <int>k
                        n += 1
                    k = self.following(node, k)
            node += 1
        return n

    # ---- single points ---------------------------------------------------------------------------------------------

    def fields(self, const double[:, ::1] points, double opening_angle, int n_threads=1):
        """Field at points in space.

        Parameters
        ----------
        points : ndarray, shape (m, 3)
            Points [nm]; an atom of the tree at the position of a point does not act on it.
        opening_angle : float
            Largest full angle of a cell that replaces its atoms [rad]; 0 sums over all atoms.
        n_threads : int
            Number of threads.

        Returns
        -------
        ndarray, shape (m, 3)
            Field q r/r^3 [e/nm^2]; times COULOMB it is in V/nm.
        """
        cdef double[:, ::1] field = np.empty((points.shape[0], 3))
        cdef Index i
        for i in prange(points.shape[0], nogil=True, schedule="dynamic", chunksize=16, num_threads=n_threads):
            self.field_at(points[i, 0], points[i, 1], points[i, 2], opening_angle, &field[i, 0])
        return np.asarray(field)

    cdef int field_at(self, double px, double py, double pz, double opening_angle, double* field) except -1 nogil:
        cdef Sources sources
        sources_init(&sources)
        self.collect(px, py, pz, 0.0, opening_angle, &sources)
        sources_field(&sources, px, py, pz, field)
        sources_free(&sources)
        return 0

    def potentials(self, const double[:, ::1] points, double opening_angle, int n_threads=1):
        """Potential q/r at points in space [e/nm], shape (m,); times COULOMB it is in V. Parameters as in `fields`."""
        cdef double[::1] potential = np.empty(points.shape[0])
        cdef Index i
        for i in prange(points.shape[0], nogil=True, schedule="dynamic", chunksize=16, num_threads=n_threads):
            potential[i] = self.potential_at(points[i, 0], points[i, 1], points[i, 2], opening_angle)
        return np.asarray(potential)

    cdef double potential_at(self, double px, double py, double pz, double opening_angle) except? -1 nogil:
        cdef Sources sources
        cdef double total
        sources_init(&sources)
        self.collect(px, py, pz, 0.0, opening_angle, &sources)
        total = sources_potential(&sources, px, py, pz)
        sources_free(&sources)
        return total

    # ---- read access -----------------------------------------------------------------------------------------------

    @property
    def positions(self):
        """Positions of the slots [nm], shape (n_slots, 3)."""
        return np.stack([np.asarray(self.x), np.asarray(self.y), np.asarray(self.z)], axis=1)[:self.n_slots]

    @property
    def charges(self):
        """Charges of the slots [e], shape (n_slots,); 0 where an atom was removed."""
        return np.asarray(self.q)[:self.n_slots]

    @charges.setter
    def charges(self, const double[::1] charges):
        np.asarray(self.q)[:self.n_slots] = charges
        self.refresh_all()

    @property
    def atoms(self):
        """Index of the atom in each slot, shape (n_slots,); -1 where an atom was removed."""
        return np.asarray(self.atom)[:self.n_slots]

    def parted(self, const double[::1] ball, double opening_angle, double beyond, roots=(0,)):
        """Sources for a ball (4,) that are farther than `beyond` from its centre [nm], and the nodes with all others.

        Returns
        -------
        slots, cells, rest : list of int
            Slots of atoms; nodes that act as cells; nodes whose subtrees contain the other atoms.
        """
        cdef Sources sources
        cdef Nodes all_roots, rest
        cdef int root
        cdef Index k
        sources_init(&sources)
        all_roots.node = rest.node = NULL
        all_roots.n = all_roots.capacity = rest.capacity = 0
        for root in roots:
            nodes_reserve(&all_roots, all_roots.n + 1)
            all_roots.node[all_roots.n] = root
            all_roots.n += 1
        self.part(&all_roots, &ball[0], opening_angle, beyond, &sources, &rest)
        result = ([sources.atom[k] for k in range(sources.n_atoms)], [sources.cell[k] for k in range(sources.n_cells)],
                  [rest.node[k] for k in range(rest.n)])
        sources_free(&sources)
        free(all_roots.node)
        free(rest.node)
        return result

    @property
    def n_cancelling(self):
        """Number of nodes with charges of both signs and no centre of charge inside their balls."""
        return np.count_nonzero(self.cancels)

    @property
    def capacity(self):
        """Largest number of slots."""
        return self.x.shape[0]

    @property
    def nodes(self):
        """Balls (n_nodes, 4), cells (n_nodes, 10) and parents (n_nodes,) of the tree."""
        return np.asarray(self.ball), np.asarray(self.cells), np.asarray(self.parent)

    def copy(self):
        """Return an independent tree with the same bits."""
        cdef Octree other = Octree.__new__(Octree)
        other.n_slots, other.n_sorted, other.n_nodes = self.n_slots, self.n_sorted, self.n_nodes
        other.leaf_size, other.n_dirty, other.n_threads = self.leaf_size, self.n_dirty, self.n_threads
        other.x, other.y, other.z, other.q = self.x.copy(), self.y.copy(), self.z.copy(), self.q.copy()
        other.atom, other.leaf, other.next_extra = self.atom.copy(), self.leaf.copy(), self.next_extra.copy()
        other.first, other.last, other.skip = self.first, self.last, self.skip
        other.parent, other.extra = self.parent, self.extra.copy()
        other.ball, other.cells = self.ball.copy(), self.cells.copy()
        other.dirty, other.cancels, other.queue = self.dirty.copy(), self.cancels.copy(), self.queue.copy()
        return other
