"""Sweeps: the field of all atoms at each atom, by common interaction lists of groups of 32 neighbouring atoms.

The walk collects, the kernel sums: the 32 atoms of a group have one list of the cells and atoms that act on them. Lists
depend only on positions, so they are valid for all sweeps until an atom is added or removed (and on nodes whose charges
cancel, which are not used as cells). The groups are made by
median splits within nodes of the octree. Measured: at equal error, a sweep over R = 80 a takes 0.7 of the time for
groups of 32 successive atoms in Morton order, which are wider because of the jumps of this order.
"""

from cython.parallel cimport prange, threadid
from libc.math cimport sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy

import numpy as np

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree


cdef extern from "kernels.h":
    const int GROUP
    void group_atoms_single(Index, const int*, const double*, const double*, const double*, const double*,
                            const double*, const float*, float*) noexcept nogil
    void group_cells_single(Index, const int*, const double*, const double*, const float*, float*) noexcept nogil
    void group_charges_single(Index, const int*, const double*, const double*, const double*, const float*,
                              float*) noexcept nogil
    void group_atoms_double(Index, const int*, const double*, const double*, const double*, const double*,
                            const double*, const double*, double*) noexcept nogil
    void point_atoms_double(Index, const double*, const double*, const double*, const double*,
                            double, double, double, double*) noexcept nogil
    void group_cells_double(Index, const int*, const double*, const double*, const double*, double*) noexcept nogil


cdef enum:
    CHUNK = 1024    # largest number of atoms of a node that is split into groups


ctypedef fused real:
    float
    double


cdef void group_field(InteractionLists lists, Octree tree, Index group, double[:, ::1] field,
                      real* work) noexcept nogil:
    # Field at one group; `work` has space for the 32 targets and their sums, relative to the centre of the group.
    cdef Index first = lists.starts[group, 0], n_cells = lists.starts[group + 1, 0] - first
    cdef Index range_first = lists.starts[group, 1], n_ranges = lists.starts[group + 1, 1] - range_first, k, lane
    cdef const double* ball = &lists.ball[group, 0]
    cdef real* sums = work + 3 * GROUP
    for lane in range(GROUP):
        k = lists.members[group, lane]
        work[lane] = <real>(tree.x[k] - ball[0])
        work[GROUP + lane] = <real>(tree.y[k] - ball[1])
        work[2 * GROUP + lane] = <real>(tree.z[k] - ball[2])
        sums[lane] = sums[GROUP + lane] = sums[2 * GROUP + lane] = 0.0
    if real is float:
        group_cells_single(n_cells, &lists.cells[0] + first, &tree.cells[0, 0], ball, work, sums)
        group_atoms_single(n_ranges, &lists.ranges[0] + 2 * range_first, &tree.x[0], &tree.y[0], &tree.z[0],
                           &tree.q[0], ball, work, sums)
    else:
        group_cells_double(n_cells, &lists.cells[0] + first, &tree.cells[0, 0], ball, work, sums)
        group_atoms_double(n_ranges, &lists.ranges[0] + 2 * range_first, &tree.x[0], &tree.y[0], &tree.z[0],
                           &tree.q[0], ball, work, sums)
    for lane in range(GROUP):   # atoms that pad a group are members of it and get the same values again
        k = lists.members[group, lane]
        field[k, 0] = sums[lane]
        field[k, 1] = sums[GROUP + lane]
        field[k, 2] = sums[2 * GROUP + lane]


cdef class InteractionLists:
    """Cells and atoms that act on each group of 32 atoms of a tree.

    Parameters
    ----------
    tree : Octree
        Its charges may change later, but not its atoms.
    opening_angle : float
        A cell replaces its atoms if the full angle of its ball is smaller than this angle [rad].
    n_threads : int
        Number of threads.
    disturbed : ndarray of int8, shape (n_slots,) or longer, optional
        1 for slots that must be targets. All atoms of their block, a node with at most 1,024 atoms, are targets. By
        default all atoms are.
    samples : bool
        Whether the atoms of the leaf in the middle of each other block are targets, too.
    """

    def __init__(self, Octree tree, double opening_angle, int n_threads=1, const signed char[::1] disturbed=None,
                 bint samples=False):
        cdef Index node = 0, leaf, n = 0, chunk, n_chunks = 0, n_blocks = 0
        cdef Index[::1] chunk_slot = np.zeros(tree.n_nodes + 1, np.int64)
        cdef Index[::1] chunk_group = np.zeros(tree.n_nodes + 1, np.int64)
        cdef int[::1] slots = np.empty(tree.n_slots, np.int32), targets
        cdef Index[:, ::1] blocks = np.empty((tree.n_nodes if samples else 0, 3), np.int64)
        cdef bint whole
        self.tree, self.opening_angle, self.disturbed = tree, opening_angle, disturbed

        # targets: nodes of at most CHUNK atoms, whole if an atom is disturbed, otherwise the leaf in the middle
        while node < tree.n_nodes:
            if tree.last[node] - tree.first[node] <= CHUNK or tree.skip[node] == node + 1:
                whole = disturbed is None or self.has_disturbed(tree, node)
                if whole:
                    n = self.targets_of(tree, node, &slots[0], n)
                elif samples:
                    leaf = self.middle_of(tree, node)
                    n = self.targets_of(tree, leaf, &slots[0], n)
                    blocks[n_blocks, 0], blocks[n_blocks, 1], blocks[n_blocks, 2] = leaf, chunk_slot[n_chunks], n
                    n_blocks += 1
                chunk_slot[n_chunks + 1] = n
                chunk_group[n_chunks + 1] = chunk_group[n_chunks] + (n - chunk_slot[n_chunks] + GROUP - 1) // GROUP
                n_chunks += 1
                node = tree.skip[node]
            else:
                node += 1

        # groups of 32 targets within these nodes
        self.blocks = np.asarray(blocks)[:n_blocks].copy()
        self.n_groups = chunk_group[n_chunks]
        self.members = np.empty((self.n_groups, GROUP), np.int32)
        self.ball = np.empty((self.n_groups, 4))
        targets = slots[:n].copy()
        self.slots = np.asarray(slots)[:n]
        for chunk in prange(n_chunks, nogil=True, schedule="dynamic", chunksize=4, num_threads=n_threads):
            if chunk_slot[chunk] < chunk_slot[chunk + 1]:
                self.split(tree, &targets[chunk_slot[chunk]], chunk_slot[chunk + 1] - chunk_slot[chunk],
                           chunk_group[chunk])
        self.list_sources(tree, n_threads)

    def with_angle(self, double opening_angle, int n_threads=1):
        """Return lists of the same targets with another opening angle [rad]."""
        cdef InteractionLists other = InteractionLists.__new__(InteractionLists)
        other.tree, other.opening_angle, other.disturbed = self.tree, opening_angle, self.disturbed
        other.slots, other.blocks, other.n_groups = self.slots, self.blocks, self.n_groups
        other.members, other.ball = self.members, self.ball
        other.list_sources(self.tree, n_threads)
        return other

    cdef list_sources(self, Octree tree, int n_threads):
        # Lists of all groups: each is kept until the place of all is known.
        cdef Index group, n_ranges = 2 * (tree.n_nodes + tree.n_slots - tree.n_sorted)
        cdef int[:, ::1] work = np.empty((max(1, n_threads), tree.n_nodes + n_ranges), np.int32)
        cdef int** kept = <int**>malloc(max(1, self.n_groups) * sizeof(int*))
        if kept == NULL:
            raise MemoryError
        self.starts = np.zeros((self.n_groups + 1, 3), np.int64)
        for group in prange(self.n_groups, nogil=True, schedule="dynamic", chunksize=16, num_threads=n_threads):
            kept[group] = self.kept_list(tree, group, &work[threadid(), 0])
        starts = np.cumsum(np.asarray(self.starts), axis=0)
        self.starts = starts
        self.cells = np.empty(max(1, starts[self.n_groups, 0]), np.int32)
        self.ranges = np.empty(max(1, 2 * starts[self.n_groups, 1]), np.int32)
        for group in prange(self.n_groups, nogil=True, schedule="dynamic", chunksize=16, num_threads=n_threads):
            self.put_list(tree, group, kept[group])
        free(kept)

    cdef int* kept_list(self, Octree tree, Index group, int* work) noexcept nogil:
        # Cells, then ranges of a group in memory of their own, and their numbers in `starts`; NULL if there is none.
        cdef Index* counts = &self.starts[group + 1, 0]
        cdef int* kept
        self.walk(tree, group, work, work + tree.n_nodes, counts)
        kept = <int*>malloc((counts[0] + 2 * counts[1]) * sizeof(int))
        if kept != NULL:
            memcpy(kept, work, counts[0] * sizeof(int))
            memcpy(kept + counts[0], work + tree.n_nodes, 2 * counts[1] * sizeof(int))
        return kept

    cdef void put_list(self, Octree tree, Index group, int* kept) noexcept nogil:
        cdef int* cells = &self.cells[0] + self.starts[group, 0]
        cdef int* ranges = &self.ranges[0] + 2 * self.starts[group, 1]
        cdef Index n_cells = self.starts[group + 1, 0] - self.starts[group, 0]
        cdef Index n_ranges = self.starts[group + 1, 1] - self.starts[group, 1]
        cdef Index[3] counts
        if kept == NULL:   # there was no memory to keep it
            self.walk(tree, group, cells, ranges, counts)
        else:
            memcpy(cells, kept, n_cells * sizeof(int))
            memcpy(ranges, kept + n_cells, 2 * n_ranges * sizeof(int))
            free(kept)

    cdef bint has_disturbed(self, Octree tree, Index node) noexcept nogil:
        # Whether a slot below a node is disturbed.
        cdef Index leaf, slot
        for leaf in range(node, tree.skip[node]):
            slot = tree.first[leaf] if tree.skip[leaf] == leaf + 1 else -1
            while slot >= 0:
                if self.disturbed[slot]:
                    return True
                slot = tree.following(leaf, slot)
        return False

    cdef Index middle_of(self, Octree tree, Index node) noexcept nogil:
        # The leaf below a node that is nearest to the mean position of its leaves.
        cdef double[3] mean
        cdef double s, least = 1e30
        cdef Index leaf, best = node, n = 0
        cdef int axis
        for axis in range(3):
            mean[axis] = 0.0
        for leaf in range(node, tree.skip[node]):
            if tree.skip[leaf] == leaf + 1:
                n += 1
                for axis in range(3):
                    mean[axis] += tree.ball[leaf, axis]
        for leaf in range(node, tree.skip[node]):
            if tree.skip[leaf] == leaf + 1:
                s = 0.0
                for axis in range(3):
                    s += (tree.ball[leaf, axis] - mean[axis] / n) ** 2
                if s < least:
                    best, least = leaf, s
        return best

    cdef Index targets_of(self, Octree tree, Index node, int* slots, Index n) noexcept nogil:
        # Adds the atoms below a node to the n slots listed so far; returns their number.
        cdef Index leaf, slot
        for leaf in range(node, tree.skip[node]):
            slot = tree.first[leaf] if tree.skip[leaf] == leaf + 1 else -1
            while slot >= 0:
                if tree.atom[slot] >= 0:
                    slots[n] = <int>slot
                    n += 1
                slot = tree.following(leaf, slot)
        return n

    cdef void split(self, Octree tree, int* slots, Index n, Index group) noexcept nogil:
        # Splits n slots across their longest side into halves of complete groups, down to groups numbered from `group`
        # on.
        cdef double[3] low, high
        cdef double middle, far = 0.0, s
        cdef const double* c
        cdef double* ball
        cdef Index k, left, half, i, j, begin = 0, end = n - 1
        cdef int axis = 0, swap
        low[0] = low[1] = low[2] = 1e30
        high[0] = high[1] = high[2] = -1e30
        for k in range(n):
            low[0], high[0] = min(low[0], tree.x[slots[k]]), max(high[0], tree.x[slots[k]])
            low[1], high[1] = min(low[1], tree.y[slots[k]]), max(high[1], tree.y[slots[k]])
            low[2], high[2] = min(low[2], tree.z[slots[k]]), max(high[2], tree.z[slots[k]])
        if n <= GROUP:
            ball = &self.ball[group, 0]
            for axis in range(3):
                ball[axis] = 0.5 * (low[axis] + high[axis])
            for k in range(GROUP):   # an incomplete group is padded with its last atom
                self.members[group, k] = slots[min(k, n - 1)]
            for k in range(n):
                s = ((tree.x[slots[k]] - ball[0]) ** 2 + (tree.y[slots[k]] - ball[1]) ** 2
                     + (tree.z[slots[k]] - ball[2]) ** 2)
                far = max(far, s)
            ball[3] = sqrt(far) * 1.0001   # an atom on the rim must not act on itself as a cell of one atom
            return
        for k in range(1, 3):
            if high[k] - low[k] > high[axis] - low[axis]:
                axis = <int>k
        c = &tree.x[0] if axis == 0 else &tree.y[0] if axis == 1 else &tree.z[0]
        left = ((n + GROUP - 1) // GROUP + 1) // 2
        half = left * GROUP
        while begin < end:   # Hoare's selection of the half smallest
            middle = c[slots[(begin + end) // 2]]
            i, j = begin, end
            while i <= j:
                while c[slots[i]] < middle:
                    i += 1
                while c[slots[j]] > middle:
                    j -= 1
                if i <= j:
                    swap = slots[i]
                    slots[i] = slots[j]
                    slots[j] = swap
                    i += 1
                    j -= 1
            if half <= j:
                end = j
            elif half >= i:
                begin = i
            else:
                break
        self.split(tree, slots, half, group)
        self.split(tree, slots + half, n - half, group + left)

    cdef void walk(self, Octree tree, Index group, int* cells, int* ranges, Index* counts) noexcept nogil:
        # Lists of one group: accepted cells, and slots [begin, end) of the leaves whose atoms are summed one by one,
        # adjacent ranges merged; atoms added to a leaf later are ranges of one slot. Counts cells, ranges and atoms.
        cdef const double* ball = &self.ball[group, 0]
        cdef Index node = 0, n_cells = 0, n_ranges = 0, n_atoms = 0, open_end = -1, slot
        cdef double dx, dy, dz, reach, factor = 2.0 / self.opening_angle if self.opening_angle > 0.0 else 1e30
        while node < tree.n_nodes:
            dx, dy, dz = ball[0] - tree.ball[node, 0], ball[1] - tree.ball[node, 1], ball[2] - tree.ball[node, 2]
            reach = tree.ball[node, 3] * factor + ball[3]
            if reach * reach < dx * dx + dy * dy + dz * dz and not tree.cancels[node]:
                cells[n_cells] = <int>node
                n_cells += 1
                node = tree.skip[node]
            elif tree.skip[node] == node + 1:
                if tree.first[node] != open_end:
                    ranges[2 * n_ranges] = tree.first[node]
                    n_ranges += 1
                open_end = tree.last[node]
                ranges[2 * n_ranges - 1] = <int>open_end
                n_atoms += tree.last[node] - tree.first[node]
                slot = tree.extra[node]
                while slot >= 0:
                    ranges[2 * n_ranges], ranges[2 * n_ranges + 1] = <int>slot, <int>slot + 1
                    n_ranges += 1
                    n_atoms += 1
                    open_end = -1
                    slot = tree.next_extra[slot]
                node += 1
            else:
                node += 1
        counts[0], counts[1], counts[2] = n_cells, n_ranges, n_atoms

    def sweep(self, double[:, ::1] field, bint double_precision=False, int n_threads=1):
        """Field of all other atoms at each target, from the current charges of the tree.

        Parameters
        ----------
        field : ndarray, shape (n, 3) or longer
            Filled with the field [e/nm^2], in the order of the slots; that of slots that are not targets is kept.
        double_precision : bool
            Sums in float64; otherwise in float32 (relative error about 1e-6).
        n_threads : int
            Number of threads.
        """
        cdef Octree tree = self.tree
        cdef Index group
        for group in prange(self.n_groups, nogil=True, schedule="dynamic", chunksize=8, num_threads=n_threads):
            if double_precision:
                self.sweep_double(tree, group, field)
            else:
                self.sweep_single(tree, group, field)

    def add_changes(self, double[:, ::1] field, const double[::1] changes, int n_threads=1):
        """Add the field of changes of the charges at each target, with cells that have only a charge in their middle.

        Parameters
        ----------
        field : ndarray, shape (n, 3) or longer
            Field [e/nm^2], in the order of the slots; that of the targets is changed.
        changes : ndarray, shape (n,)
            Changes of the charges of the slots [e], of either sign.
        n_threads : int
            Number of threads.
        """
        cdef Octree tree = self.tree
        cdef Index group, node, k
        cdef double[::1] charge = np.zeros(tree.n_nodes)
        with nogil:
            for node in range(tree.n_nodes - 1, -1, -1):
                k = tree.first[node] if tree.skip[node] == node + 1 else -1
                while k >= 0:
                    charge[node] += changes[k]
                    k = tree.following(node, k)
                if node > 0:
                    charge[tree.parent[node]] += charge[node]
        for group in prange(self.n_groups, nogil=True, schedule="dynamic", chunksize=8, num_threads=n_threads):
            self.add_to_group(tree, group, field, &changes[0], &charge[0])

    cdef void add_to_group(self, Octree tree, Index group, double[:, ::1] field, const double* changes,
                           const double* charge) noexcept nogil:
        cdef float[6 * 32] work
        cdef Index first = self.starts[group, 0], range_first = self.starts[group, 1], lane, k
        cdef const double* ball = &self.ball[group, 0]
        for lane in range(GROUP):
            k = self.members[group, lane]
            work[lane] = <float>(tree.x[k] - ball[0])
            work[GROUP + lane] = <float>(tree.y[k] - ball[1])
            work[2 * GROUP + lane] = <float>(tree.z[k] - ball[2])
            work[3 * GROUP + lane] = work[4 * GROUP + lane] = work[5 * GROUP + lane] = 0.0
        group_charges_single(self.starts[group + 1, 0] - first, &self.cells[0] + first, &tree.ball[0, 0], charge, ball,
                             work, work + 3 * GROUP)
        group_atoms_single(self.starts[group + 1, 1] - range_first, &self.ranges[0] + 2 * range_first, &tree.x[0],
                           &tree.y[0], &tree.z[0], changes, ball, work, work + 3 * GROUP)
        for lane in range(GROUP):
            k = self.members[group, lane]
            if lane == 0 or k != self.members[group, lane - 1]:   # not an atom that pads the group
                field[k, 0] += work[3 * GROUP + lane]
                field[k, 1] += work[4 * GROUP + lane]
                field[k, 2] += work[5 * GROUP + lane]

    cdef void sweep_single(self, Octree tree, Index group, double[:, ::1] field) noexcept nogil:
        cdef float[6 * 32] work
        group_field[float](self, tree, group, field, work)

    cdef void sweep_double(self, Octree tree, Index group, double[:, ::1] field) noexcept nogil:
        cdef double[6 * 32] work
        group_field[double](self, tree, group, field, work)

    @property
    def pairs(self):
        """Number of (atom, atom) and of (atom, cell) interactions of one sweep."""
        totals = np.asarray(self.starts)[self.n_groups]
        return int(totals[2]) * GROUP, int(totals[0]) * GROUP

    @property
    def nbytes(self):
        """Memory [bytes]."""
        return self.cells.nbytes + self.ranges.nbytes + self.starts.nbytes + self.ball.nbytes


def direct_field(const double[:, ::1] points, const double[:, ::1] positions, const double[::1] charges):
    """Field at points by sums over all charges in float64, one thread: the reference of speed and accuracy.

    Parameters
    ----------
    points : ndarray, shape (m, 3)
        Points [nm]; a charge at the position of a point does not act on it.
    positions : ndarray, shape (n, 3)
        Positions of the charges [nm].
    charges : ndarray, shape (n,)
        Charges [e].

    Returns
    -------
    ndarray, shape (m, 3)
        Field q r/r^3 [e/nm^2].
    """
    cdef const double[:, ::1] columns = np.ascontiguousarray(np.asarray(positions).T)
    cdef double[:, ::1] field = np.zeros((points.shape[0], 3))
    cdef Index i
    with nogil:
        for i in range(points.shape[0]):
            point_atoms_double(charges.shape[0], &columns[0, 0], &columns[1, 0], &columns[2, 0], &charges[0],
                               points[i, 0], points[i, 1], points[i, 2], &field[i, 0])
    return np.asarray(field)
