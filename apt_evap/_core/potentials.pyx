"""Potentials of charges of either sign at all atoms of a tree, by its interaction lists.

The cells have a charge, a dipole, a quadrupole and an octupole about the centre of their ball. These are linear in the
charges, which may have either sign: an iteration can apply them to any vector. For the distances of an opening angle of
0.4, a potential needs one order more than a field: what acts on the charges are its differences between neighbours.
"""

from cython.parallel cimport prange

import numpy as np

from apt_evap._core.index cimport Index
from apt_evap._core.interactions cimport InteractionLists
from apt_evap._core.octree cimport Octree


cdef extern from "kernels.h":
    const int GROUP, MULTIPOLE
    const double SAME_PLACE
    void group_atoms_potential_single(Index, const int*, const double*, const double*, const double*, const double*,
                                      const double*, const float*, const float*, double*) noexcept nogil
    void group_cells_potential_single(Index, const int*, const double*, const double*, const float*, const float*,
                                      double*) noexcept nogil
    void group_atoms_potential_double(Index, const int*, const double*, const double*, const double*, const double*,
                                      const double*, const double*, const double*, double*) noexcept nogil
    void group_cells_potential_double(Index, const int*, const double*, const double*, const double*, const double*,
                                      double*) noexcept nogil


ctypedef fused real:
    float
    double


cdef void group_potential(Potentials self, InteractionLists lists, Octree tree, Index group, const double* charges,
                          double* potential, real* work) noexcept nogil:
    # Potential at one group; `work` has space for the 32 targets, relative to the centre of the group, and for zeros.
    cdef Index first = lists.starts[group, 0], n_cells = lists.starts[group + 1, 0] - first
    cdef Index range_first = lists.starts[group, 1], n_ranges = lists.starts[group + 1, 1] - range_first, k, lane
    cdef const double* ball = &lists.ball[group, 0]
    cdef double[32] sums
    for lane in range(GROUP):
        k = lists.members[group, lane]
        work[lane] = <real>(tree.x[k] - ball[0])
        work[GROUP + lane] = <real>(tree.y[k] - ball[1])
        work[2 * GROUP + lane] = <real>(tree.z[k] - ball[2])
        work[3 * GROUP + lane] = 0.0
        sums[lane] = 0.0
    if real is float:
        group_cells_potential_single(n_cells, &lists.cells[0] + first, &self.cells[0, 0], ball, work,
                                     work + 3 * GROUP, sums)
        group_atoms_potential_single(n_ranges, &lists.ranges[0] + 2 * range_first, &tree.x[0], &tree.y[0], &tree.z[0],
                                     charges, ball, work, work + 3 * GROUP, sums)
    else:
        group_cells_potential_double(n_cells, &lists.cells[0] + first, &self.cells[0, 0], ball, work,
                                     work + 3 * GROUP, sums)
        group_atoms_potential_double(n_ranges, &lists.ranges[0] + 2 * range_first, &tree.x[0], &tree.y[0], &tree.z[0],
                                     charges, ball, work, work + 3 * GROUP, sums)
    if self.gaussian.shape[0] > 0:
        self.correct(lists, tree, group, charges, sums)
    for lane in range(GROUP):   # atoms that pad a group are members of it and get the same values again
        potential[lists.members[group, lane]] = sums[lane]


cdef class Potentials:
    """Potentials of charges of either sign at all atoms of a tree.

    Parameters
    ----------
    lists : InteractionLists
        Interaction lists of the tree.
    gaussian : ndarray, shape (k,), optional
        Table of `difference` [1/nm] by the squared distance, for Gaussian charges.
    per_square : float
        Entries of this table per nm^2.
    """

    def __init__(self, InteractionLists lists, gaussian=None, double per_square=1.0):
        self.lists = lists
        self.gaussian = np.empty(0) if gaussian is None else gaussian
        self.per_square = per_square
        self.reach_squared = max(0, self.gaussian.shape[0] - 1) / per_square
        self.cells = np.zeros((lists.tree.n_nodes, MULTIPOLE))
        self.raw = np.zeros((lists.tree.n_nodes, 20))
        self.empty = np.zeros(lists.tree.n_nodes, np.int8)
        np.asarray(self.cells)[:, :3] = np.asarray(lists.tree.ball)[:, :3]

    def of(self, const double[::1] charges, double[::1] potential, bint double_precision=False, int n_threads=1):
        """Potential of all other atoms at each target of the lists.

        Parameters
        ----------
        charges : ndarray, shape (n,) or longer
            Charges in the order of the slots [e], of either sign.
        potential : ndarray, shape (n,) or longer
            Filled with the potential [e/nm]; that of slots that are not targets is kept.
        double_precision : bool
            Sums in float64; otherwise partial sums in float32 (relative error about 1e-7).
        n_threads : int
            Number of threads.
        """
        cdef Octree tree = self.lists.tree
        cdef Index node, group
        for node in prange(tree.n_nodes, nogil=True, schedule="dynamic", chunksize=256, num_threads=n_threads):
            if tree.skip[node] == node + 1:
                self.leaf_moments(tree, node, &charges[0])
        with nogil:
            for node in range(tree.n_nodes - 1, -1, -1):
                if tree.skip[node] > node + 1:
                    self.node_moments(tree, node)
        for node in prange(tree.n_nodes, nogil=True, schedule="static", num_threads=n_threads):
            self.traceless(node)
        for group in prange(self.lists.n_groups, nogil=True, schedule="dynamic", chunksize=8, num_threads=n_threads):
            if double_precision:
                self.group_double(self.lists, tree, group, &charges[0], &potential[0])
            else:
                self.group_single(self.lists, tree, group, &charges[0], &potential[0])

    cdef void leaf_moments(self, Octree tree, Index node, const double* charges) noexcept nogil:
        cdef double* m = &self.raw[node, 0]
        cdef double q, x, y, z
        cdef Index k
        for k in range(20):
            m[k] = 0.0
        self.empty[node] = True
        k = tree.first[node]
        while k >= 0 and self.empty[node]:
            self.empty[node] = charges[k] == 0.0
            k = tree.following(node, k)
        if self.empty[node]:
            return
        k = tree.first[node]
        while k >= 0:
            q = charges[k]
            x, y, z = tree.x[k] - tree.ball[node, 0], tree.y[k] - tree.ball[node, 1], tree.z[k] - tree.ball[node, 2]
            m[0] += q
            m[1] += q * x
            m[2] += q * y
            m[3] += q * z
            m[4] += q * x * x
            m[5] += q * x * y
            m[6] += q * x * z
            m[7] += q * y * y
            m[8] += q * y * z
            m[9] += q * z * z
            m[10] += q * x * x * x
            m[11] += q * x * x * y
            m[12] += q * x * x * z
            m[13] += q * x * y * y
            m[14] += q * x * y * z
            m[15] += q * x * z * z
            m[16] += q * y * y * y
            m[17] += q * y * y * z
            m[18] += q * y * z * z
            m[19] += q * z * z * z
            k = tree.following(node, k)

    cdef void node_moments(self, Octree tree, Index node) noexcept nogil:
        # Moments of the children, shifted to the centre of this node.
        cdef double* m = &self.raw[node, 0]
        cdef const double* c
        cdef double x, y, z
        cdef Index k = node + 1, i
        for i in range(20):
            m[i] = 0.0
        self.empty[node] = True
        while k < tree.skip[node]:
            if self.empty[k]:
                k = tree.skip[k]
                continue
            self.empty[node] = False
            c = &self.raw[k, 0]
            x, y = tree.ball[k, 0] - tree.ball[node, 0], tree.ball[k, 1] - tree.ball[node, 1]
            z = tree.ball[k, 2] - tree.ball[node, 2]
            m[0] += c[0]
            m[1] += c[1] + c[0] * x
            m[2] += c[2] + c[0] * y
            m[3] += c[3] + c[0] * z
            m[4] += c[4] + 2.0 * c[1] * x + c[0] * x * x
            m[5] += c[5] + c[1] * y + c[2] * x + c[0] * x * y
            m[6] += c[6] + c[1] * z + c[3] * x + c[0] * x * z
            m[7] += c[7] + 2.0 * c[2] * y + c[0] * y * y
            m[8] += c[8] + c[2] * z + c[3] * y + c[0] * y * z
            m[9] += c[9] + 2.0 * c[3] * z + c[0] * z * z
            m[10] += c[10] + 3.0 * c[4] * x + 3.0 * c[1] * x * x + c[0] * x * x * x
            m[11] += c[11] + c[4] * y + 2.0 * c[5] * x + 2.0 * c[1] * x * y + c[2] * x * x + c[0] * x * x * y
            m[12] += c[12] + c[4] * z + 2.0 * c[6] * x + 2.0 * c[1] * x * z + c[3] * x * x + c[0] * x * x * z
            m[13] += c[13] + c[7] * x + 2.0 * c[5] * y + 2.0 * c[2] * x * y + c[1] * y * y + c[0] * x * y * y
            m[14] += (c[14] + c[5] * z + c[6] * y + c[8] * x + c[1] * y * z + c[2] * x * z + c[3] * x * y
                      + c[0] * x * y * z)
            m[15] += c[15] + c[9] * x + 2.0 * c[6] * z + 2.0 * c[3] * x * z + c[1] * z * z + c[0] * x * z * z
            m[16] += c[16] + 3.0 * c[7] * y + 3.0 * c[2] * y * y + c[0] * y * y * y
            m[17] += c[17] + c[7] * z + 2.0 * c[8] * y + 2.0 * c[2] * y * z + c[3] * y * y + c[0] * y * y * z
            m[18] += c[18] + c[9] * y + 2.0 * c[8] * z + 2.0 * c[3] * y * z + c[2] * z * z + c[0] * y * z * z
            m[19] += c[19] + 3.0 * c[9] * z + 3.0 * c[3] * z * z + c[0] * z * z * z
            k = tree.skip[k]

    cdef void traceless(self, Index node) noexcept nogil:
        # Coefficients of the potential q/r + p.d/r^3 + (3 d d - d^2)/2 r^5 + (5 d d d - 3 d^2 d)/2 r^7 as polynomials
        # of the vector from the centre to the target.
        cdef const double* m = &self.raw[node, 0]
        cdef double* c = &self.cells[node, 0]
        cdef double trace = m[4] + m[7] + m[9]
        cdef double x = m[10] + m[13] + m[15], y = m[11] + m[16] + m[18], z = m[12] + m[17] + m[19]
        c[3], c[4], c[5], c[6] = m[0], m[1], m[2], m[3]
        c[7], c[10], c[12] = 1.5 * m[4] - 0.5 * trace, 1.5 * m[7] - 0.5 * trace, 1.5 * m[9] - 0.5 * trace
        c[8], c[9], c[11] = 3.0 * m[5], 3.0 * m[6], 3.0 * m[8]
        c[13], c[19], c[22] = 2.5 * m[10] - 1.5 * x, 2.5 * m[16] - 1.5 * y, 2.5 * m[19] - 1.5 * z
        c[14], c[15] = 7.5 * m[11] - 1.5 * y, 7.5 * m[12] - 1.5 * z
        c[16], c[18] = 7.5 * m[13] - 1.5 * x, 7.5 * m[15] - 1.5 * x
        c[20], c[21] = 7.5 * m[17] - 1.5 * z, 7.5 * m[18] - 1.5 * y
        c[17] = 15.0 * m[14]

    cdef double difference(self, double s) noexcept nogil:
        # Potential of a Gaussian charge less that of a point charge, at the squared distance s.
        cdef double at = s * self.per_square
        cdef Index k = <Index>at
        if k + 1 >= self.gaussian.shape[0]:
            return 0.0
        return self.gaussian[k] + (at - k) * (self.gaussian[k + 1] - self.gaussian[k])

    cdef void correct(self, InteractionLists lists, Octree tree, Index group, const double* charges,
                      double* potential) noexcept nogil:
        # Add the difference between Gaussian and point charges at small distances. Cells of one atom can be close, too.
        cdef Index index, node, slot
        for index in range(lists.starts[group, 1], lists.starts[group + 1, 1]):
            self.correct_range(lists, tree, group, lists.ranges[2 * index], lists.ranges[2 * index + 1], charges,
                               potential)
        for index in range(lists.starts[group, 0], lists.starts[group + 1, 0]):
            node = lists.cells[index]
            if tree.last[node] - tree.first[node] <= tree.leaf_size:
                self.correct_range(lists, tree, group, tree.first[node], tree.last[node], charges, potential)
                slot = tree.extra[node]
                while slot >= 0:
                    self.correct_range(lists, tree, group, slot, slot + 1, charges, potential)
                    slot = tree.next_extra[slot]

    cdef void correct_range(self, InteractionLists lists, Octree tree, Index group, Index first, Index last,
                            const double* charges, double* potential) noexcept nogil:
        cdef const double* ball = &lists.ball[group, 0]
        cdef double most = self.reach_squared, reach = ball[3], dx, dy, dz, s
        cdef Index k, lane, at
        for k in range(first, last):
            dx, dy, dz = tree.x[k] - ball[0], tree.y[k] - ball[1], tree.z[k] - ball[2]
            s = dx * dx + dy * dy + dz * dz
            if s > 2.0 * (reach * reach + most):   # >= (reach + radius of the correction)^2
                continue
            for lane in range(GROUP):
                at = lists.members[group, lane]
                dx, dy, dz = tree.x[k] - tree.x[at], tree.y[k] - tree.y[at], tree.z[k] - tree.z[at]
                s = dx * dx + dy * dy + dz * dz
                if SAME_PLACE < s < most:
                    potential[lane] += charges[k] * self.difference(s)

    cdef void group_single(self, InteractionLists lists, Octree tree, Index group, const double* charges,
                           double* potential) noexcept nogil:
        cdef float[4 * 32] work
        group_potential[float](self, lists, tree, group, charges, potential, work)

    cdef void group_double(self, InteractionLists lists, Octree tree, Index group, const double* charges,
                           double* potential) noexcept nogil:
        cdef double[4 * 32] work
        group_potential[double](self, lists, tree, group, charges, potential, work)
