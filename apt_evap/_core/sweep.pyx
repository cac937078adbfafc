"""Sweeps: the field of all atoms on each of them, by lists shared by groups of 32 neighbours.

The walk collects, the kernel sums: 32 atoms that follow each other in the Morton order share one list of cells and
atoms that act on them. Lists depend on places alone, so they serve every sweep until an atom comes or goes.
"""

from cython.parallel cimport prange
from libc.math cimport sqrt

import numpy as np

from apt_evap._core.octree cimport Octree


cdef extern from "pair.h":
    const int GROUP
    void group_atoms_single(long, long, const double*, const double*, const double*, const double*, const double*,
                            const float*, float*) noexcept nogil
    void group_cells_single(long, const int*, const double*, const double*, const float*, float*) noexcept nogil
    void group_atoms_double(long, long, const double*, const double*, const double*, const double*, const double*,
                            const double*, double*) noexcept nogil
    void group_cells_double(long, const int*, const double*, const double*, const double*, double*) noexcept nogil


ctypedef fused real:
    float
    double


cdef void group_field(InteractionLists lists, Octree tree, long group, double[:, ::1] field, real* work) noexcept nogil:
    # Field on one group; `work` has room for the 32 targets and their sums, relative to the middle of the group.
    cdef long begin = GROUP * group, count = min(<long>GROUP, tree.n_sorted - begin), k, l
    cdef long first = lists.starts[group, 0], n_cells = lists.starts[group + 1, 0] - first
    cdef const double* ball = &lists.ball[group, 0]
    cdef const int* ranges = &lists.ranges[0]
    cdef real* sums = work + 3 * GROUP
    for l in range(GROUP):   # a last group that is not full is filled up with its last atom
        k = begin + min(l, count - 1)
        work[l] = <real>(tree.x[k] - ball[0])
        work[GROUP + l] = <real>(tree.y[k] - ball[1])
        work[2 * GROUP + l] = <real>(tree.z[k] - ball[2])
        sums[l] = sums[GROUP + l] = sums[2 * GROUP + l] = 0.0
    if real is float:
        group_cells_single(n_cells, &lists.cells[0] + first, &tree.cells[0, 0], ball, work, sums)
    else:
        group_cells_double(n_cells, &lists.cells[0] + first, &tree.cells[0, 0], ball, work, sums)
    for k in range(lists.starts[group, 1], lists.starts[group + 1, 1]):
        if real is float:
            group_atoms_single(ranges[2 * k], ranges[2 * k + 1], &tree.x[0], &tree.y[0], &tree.z[0], &tree.q[0],
                               ball, work, sums)
        else:
            group_atoms_double(ranges[2 * k], ranges[2 * k + 1], &tree.x[0], &tree.y[0], &tree.z[0], &tree.q[0],
                               ball, work, sums)
    for l in range(count):
        field[begin + l, 0] = sums[l]
        field[begin + l, 1] = sums[GROUP + l]
        field[begin + l, 2] = sums[2 * GROUP + l]


cdef class InteractionLists:
    """Cells and atoms that act on each group of 32 atoms of a tree.

    Parameters
    ----------
    tree : Octree
        With no atoms put in since it was built. Its charges may change later, its atoms may not.
    opening_angle : float
        A cell stands for its atoms where its ball is seen under less than this full angle [rad].
    n_threads : int
        Threads.
    """

    def __init__(self, Octree tree, double opening_angle, int n_threads=1):
        if tree.n_slots != tree.n_sorted:
            raise ValueError("lists need a tree with no atoms put in since it was built")
        self.tree = tree
        self.n_groups = (tree.n_sorted + GROUP - 1) // GROUP
        self.ball = np.empty((self.n_groups, 4))
        self.starts = np.zeros((self.n_groups + 1, 3), np.int64)
        cdef long group
        for group in prange(self.n_groups, nogil=True, schedule="dynamic", chunksize=16, num_threads=n_threads):
            self.enclose(tree, group)
            self.walk(tree, group, opening_angle, NULL, NULL, &self.starts[group + 1, 0])
        starts = np.cumsum(np.asarray(self.starts), axis=0)
        self.starts = starts
        self.cells = np.empty(max(1, starts[self.n_groups, 0]), np.int32)
        self.ranges = np.empty(max(1, 2 * starts[self.n_groups, 1]), np.int32)
        for group in prange(self.n_groups, nogil=True, schedule="dynamic", chunksize=16, num_threads=n_threads):
            self.walk(tree, group, opening_angle, &self.cells[0] + self.starts[group, 0],
                      &self.ranges[0] + 2 * self.starts[group, 1], NULL)

    cdef void enclose(self, Octree tree, long group) noexcept nogil:
        # Middle and radius of the atoms [GROUP * group, GROUP * (group + 1)) of the Morton order.
        cdef long begin = GROUP * group, end = min(begin + GROUP, tree.n_sorted), k
        cdef double lx = 1e30, ly = 1e30, lz = 1e30, hx = -1e30, hy = -1e30, hz = -1e30, far = 0.0, s
        cdef double* ball = &self.ball[group, 0]
        for k in range(begin, end):
            lx, hx = min(lx, tree.x[k]), max(hx, tree.x[k])
            ly, hy = min(ly, tree.y[k]), max(hy, tree.y[k])
            lz, hz = min(lz, tree.z[k]), max(hz, tree.z[k])
        ball[0], ball[1], ball[2] = 0.5 * (lx + hx), 0.5 * (ly + hy), 0.5 * (lz + hz)
        for k in range(begin, end):
            s = (tree.x[k] - ball[0]) ** 2 + (tree.y[k] - ball[1]) ** 2 + (tree.z[k] - ball[2]) ** 2
            far = max(far, s)
        ball[3] = sqrt(far) * 1.0001   # no atom on the rim may take itself for a cell of one atom

    cdef void walk(self, Octree tree, long group, double opening_angle, int* cells, int* ranges, long* counts) noexcept nogil:
        # Lists of one group: accepted cells, and slots [begin, end) of the leaves that stay atoms, neighbours merged.
        # Without lists it only counts: cells, ranges, atoms.
        cdef const double* ball = &self.ball[group, 0]
        cdef long node = 0, n_cells = 0, n_ranges = 0, n_atoms = 0, open_end = -1
        cdef double dx, dy, dz, reach, factor = 2.0 / opening_angle if opening_angle > 0.0 else 1e30
        while node < tree.n_nodes:
            dx, dy, dz = ball[0] - tree.ball[node, 0], ball[1] - tree.ball[node, 1], ball[2] - tree.ball[node, 2]
            reach = tree.ball[node, 3] * factor + ball[3]
            if reach * reach < dx * dx + dy * dy + dz * dz:
                if cells != NULL:
                    cells[n_cells] = <int>node
                n_cells += 1
                node = tree.skip[node]
            elif tree.skip[node] == node + 1:
                if tree.first[node] != open_end:
                    if ranges != NULL:
                        ranges[2 * n_ranges] = tree.first[node]
                    n_ranges += 1
                open_end = tree.last[node]
                if ranges != NULL:
                    ranges[2 * n_ranges - 1] = <int>open_end
                n_atoms += tree.last[node] - tree.first[node]
                node += 1
            else:
                node += 1
        if counts != NULL:
            counts[0], counts[1], counts[2] = n_cells, n_ranges, n_atoms

    def sweep(self, double[:, ::1] field, bint double_precision=False, int n_threads=1):
        """Field of all the others on each atom of the tree, from the charges it has now.

        Parameters
        ----------
        field : ndarray, shape (n, 3) or longer
            Filled with the field [e/nm^2], in the order of the slots.
        double_precision : bool
            Vector lanes of float64; else of float32 (relative error near 1e-6).
        n_threads : int
            Threads.
        """
        cdef Octree tree = self.tree
        cdef long group
        for group in prange(self.n_groups, nogil=True, schedule="dynamic", chunksize=8, num_threads=n_threads):
            if double_precision:
                self.sweep_double(tree, group, field)
            else:
                self.sweep_single(tree, group, field)

    cdef void sweep_single(self, Octree tree, long group, double[:, ::1] field) noexcept nogil:
        cdef float[6 * 32] work
        group_field[float](self, tree, group, field, work)

    cdef void sweep_double(self, Octree tree, long group, double[:, ::1] field) noexcept nogil:
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
