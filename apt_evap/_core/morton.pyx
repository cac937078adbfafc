"""Structure of an octree: atoms in Morton order, and the nodes as ranges of them.

All steps are parallel, and the results do not depend on the threads: keys and ranges are integers.
"""

from cython.parallel cimport prange
from libc.math cimport INFINITY
from libc.stdlib cimport free, malloc

import numpy as np

from apt_evap._core.index cimport Index


cdef enum:
    BITS = 21            # bits of a coordinate in the key
    BLOCK = 16384        # keys that one thread counts or moves in one step
    DIGIT = 11           # bits of the key per pass of the sort
    BUCKETS = 1 << DIGIT
    SUBTREE = 4096       # atoms of a subtree that one thread builds; small enough for many threads
    STACK = 8 * (BITS + 2)


ctypedef unsigned long long Key


cdef struct Node:
    int first       # slots [first, last)
    int last
    int parent
    int skip        # the next node outside the subtree
    int level       # lowest bit of the octants of its (possible) children


cdef inline Key spread(Key n) noexcept nogil:
    # The bits of a coordinate, separated by two zeros each.
    n = (n | n << 32) & 0x1F00000000FFFFULL
    n = (n | n << 16) & 0x1F0000FF0000FFULL
    n = (n | n << 8) & 0x100F00F00F00F00FULL
    n = (n | n << 4) & 0x10C30C30C30C30C3ULL
    return (n | n << 2) & 0x1249249249249249ULL


def morton_order(const double[:, ::1] positions, int n_threads=1):
    """Order of the positions along the Morton curve of their bounding cube.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        Positions [nm].
    n_threads : int
        Number of threads.

    Returns
    -------
    order : ndarray of int64, shape (n,)
        Indices of the positions along the curve; equal keys stay in the order of the indices.
    keys : ndarray of uint64, shape (n,)
        Keys in this order: interleaved bits of x, y and z, from the highest.
    """
    cdef Index n = positions.shape[0], n_blocks = (n + BLOCK - 1) // BLOCK, block, i
    cdef double scale
    cdef double[3] low
    cdef double[:, :, ::1] box = np.empty((n_blocks, 2, 3))
    cdef Key[::1] keys = np.empty(n, np.uint64)
    for block in prange(n_blocks, nogil=True, schedule="dynamic", num_threads=n_threads):
        enclose(positions, block * BLOCK, min(n, (block + 1) * BLOCK), &box[block, 0, 0], &box[block, 1, 0])
    lows, highs = np.asarray(box)[:, 0].min(axis=0), np.asarray(box)[:, 1].max(axis=0)
    low[0], low[1], low[2] = lows
    scale = (2**BITS - 1) / max(float((highs - lows).max()), 1e-9)
    for i in prange(n, nogil=True, schedule="static", num_threads=n_threads):
        keys[i] = (spread(<Key>((positions[i, 0] - low[0]) * scale)) << 2
                   | spread(<Key>((positions[i, 1] - low[1]) * scale)) << 1
                   | spread(<Key>((positions[i, 2] - low[2]) * scale)))
    return sort(keys, n_threads)


cdef void enclose(const double[:, ::1] positions, Index begin, Index end, double* low, double* high) noexcept nogil:
    # Bounding box of positions.
    cdef Index i
    cdef int axis
    for axis in range(3):
        low[axis], high[axis] = INFINITY, -INFINITY
        for i in range(begin, end):
            low[axis], high[axis] = min(low[axis], positions[i, axis]), max(high[axis], positions[i, axis])


cdef sort(Key[::1] keys, int n_threads):
    # Order and sorted keys, by stable passes from the lowest digit to the highest.
    cdef Index n = keys.shape[0], n_blocks = (n + BLOCK - 1) // BLOCK, block, bucket, total, count
    cdef int shift
    cdef Key[::1] other_keys = np.empty(n, np.uint64)
    cdef Index[::1] order = np.arange(n, dtype=np.int64), other_order = np.empty(n, np.int64)
    cdef int[:, ::1] place = np.empty((n_blocks, BUCKETS), np.int32)   # counts, then next positions
    for shift in range(0, 3 * BITS, DIGIT):
        for block in prange(n_blocks, nogil=True, schedule="dynamic", num_threads=n_threads):
            count_digits(keys, block * BLOCK, min(n, (block + 1) * BLOCK), shift, &place[block, 0])
        total = 0
        with nogil:
            for bucket in range(BUCKETS):
                for block in range(n_blocks):
                    count = place[block, bucket]
                    place[block, bucket] = <int>total
                    total += count
        for block in prange(n_blocks, nogil=True, schedule="dynamic", num_threads=n_threads):
            move(keys, order, other_keys, other_order, block * BLOCK, min(n, (block + 1) * BLOCK), shift,
                 &place[block, 0])
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return np.asarray(order), np.asarray(keys)


cdef void count_digits(const Key[::1] keys, Index begin, Index end, int shift, int* count) noexcept nogil:
    cdef Index i
    for i in range(BUCKETS):
        count[i] = 0
    for i in range(begin, end):
        count[keys[i] >> shift & (BUCKETS - 1)] += 1


cdef void move(const Key[::1] keys, const Index[::1] order, Key[::1] to_keys, Index[::1] to_order,
               Index begin, Index end, int shift, int* place) noexcept nogil:
    cdef Index i, digit
    for i in range(begin, end):
        digit = keys[i] >> shift & (BUCKETS - 1)
        to_keys[place[digit]] = keys[i]
        to_order[place[digit]] = order[i]
        place[digit] += 1


def split(const Key[::1] keys, int leaf_size, int n_threads=1):
    """Nodes of the octree over sorted keys, in preorder.

    Parameters
    ----------
    keys : ndarray of uint64, shape (n,)
        Sorted keys.
    leaf_size : int
        Largest number of atoms of a node that is not split into octants; more only for equal keys.
    n_threads : int
        Number of threads.

    Returns
    -------
    first, last, parent, skip : ndarray of int32, shape (n_nodes,)
        Slots [first, last), the node above (-1 for the root), and the next node outside the subtree.
    """
    cdef Index n = keys.shape[0], n_top, t, begin
    # a split node has at least two children, so m atoms have less than 2 m nodes: subtrees do not overlap
    cdef Node* top = <Node*>malloc(2 * n * sizeof(Node))
    cdef Node* below = <Node*>malloc(2 * n * sizeof(Node))
    cdef Index[::1] start
    cdef int[::1] first, last, parent, skip
    if top == NULL or below == NULL:
        free(top)
        free(below)
        raise MemoryError
    try:
        with nogil:
            n_top = grow(keys, 0, n, 3 * (BITS - 1), max(leaf_size, SUBTREE), top)
        start = np.ones(n_top + 1, np.int64)
        for t in prange(n_top, nogil=True, schedule="dynamic", num_threads=n_threads):
            if top[t].skip == t + 1:
                start[t + 1] = grow(keys, top[t].first, top[t].last, top[t].level, leaf_size, below + 2 * top[t].first)
        start[0] = 0
        start = np.cumsum(start)
        first, last, parent, skip = np.empty((4, start[n_top]), np.int32)
        for t in prange(n_top, nogil=True, schedule="dynamic", num_threads=n_threads):
            begin = start[t]
            if top[t].skip == t + 1:
                copy(below + 2 * top[t].first, start[t + 1] - begin, begin, &first[begin], &last[begin], &parent[begin],
                     &skip[begin])
            else:
                first[begin], last[begin], skip[begin] = top[t].first, top[t].last, <int>start[top[t].skip]
            parent[begin] = <int>start[top[t].parent] if t else -1
    finally:
        free(top)
        free(below)
    return np.asarray(first), np.asarray(last), np.asarray(parent), np.asarray(skip)


cdef void copy(const Node* nodes, Index n, Index begin, int* first, int* last, int* parent, int* skip) noexcept nogil:
    # The nodes of a subtree, numbered from `begin` on.
    cdef Index i
    for i in range(n):
        first[i], last[i] = nodes[i].first, nodes[i].last
        parent[i], skip[i] = <int>begin + nodes[i].parent, <int>begin + nodes[i].skip


cdef Index grow(const Key[::1] keys, Index begin, Index end, int level, int leaf_size, Node* nodes) noexcept nogil:
    # Nodes over the slots [begin, end), numbered from 0; returns their number. Preorder with an explicit stack; a range
    # with all atoms in one octant goes one level down without a node.
    cdef Node[STACK] stack
    cdef Node* node
    cdef Index[9] cut
    cdef Index count = 0, low, high, middle, octant
    cdef int depth = 1, i
    cdef bint whole
    stack[0].first, stack[0].last, stack[0].parent, stack[0].level = <int>begin, <int>end, -1, level
    while depth:
        depth -= 1
        node = nodes + count
        node[0] = stack[depth]
        node.skip = 0
        begin, end, level = node.first, node.last, node.level
        whole = end - begin > leaf_size
        while whole and level >= 0:
            cut[0], cut[8] = begin, end
            for octant in range(1, 8):
                low, high = cut[octant - 1], end
                while low < high:
                    middle = (low + high) // 2
                    if <Index>(keys[middle] >> level & 7) < octant:
                        low = middle + 1
                    else:
                        high = middle
                cut[octant] = low
            level -= 3
            for octant in range(7, -1, -1):
                if 0 < cut[octant + 1] - cut[octant] < end - begin:
                    whole = False
                    stack[depth].first, stack[depth].last = <int>cut[octant], <int>cut[octant + 1]
                    stack[depth].parent, stack[depth].level = <int>count, level
                    depth += 1
        count += 1
    for i in range(<int>count - 1, -1, -1):
        if nodes[i].skip == 0:
            nodes[i].skip = i + 1
        if i and nodes[nodes[i].parent].skip < nodes[i].skip:
            nodes[nodes[i].parent].skip = nodes[i].skip
    return count
