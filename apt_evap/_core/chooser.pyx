"""A tournament over the slots of a tree: who leaves next."""

import numpy as np

from apt_evap._core.octree cimport Octree


cdef class Tournament:
    """Knows the slot of the highest rank; equal ranks go by the number of the atom.

    Parameters
    ----------
    tree : Octree
        Whose slots take part.
    rank : ndarray, shape (capacity,)
        Rank of each slot; below 0 where no atom is yet.
    """

    def __init__(self, Octree tree, double[::1] rank):
        cdef long node
        self.rank, self.atom = rank, tree.atom
        self.leaves = 1
        while self.leaves < rank.shape[0]:
            self.leaves *= 2
        self.winner = np.full(2 * self.leaves, -1, np.int32)
        self.rising = np.empty(rank.shape[0], np.int32)
        np.asarray(self.winner)[self.leaves:self.leaves + tree.n_slots] = np.arange(tree.n_slots)
        with nogil:
            for node in range(self.leaves - 1, 0, -1):
                self.play(node)

    cdef bint better(self, int a, int b) noexcept nogil:
        if a < 0 or b < 0:
            return b < 0 <= a
        if self.rank[a] != self.rank[b]:
            return self.rank[a] > self.rank[b]
        return self.atom[a] < self.atom[b]

    cdef void play(self, long node) noexcept nogil:
        cdef int a = self.winner[2 * node], b = self.winner[2 * node + 1]
        self.winner[node] = b if self.better(b, a) else a

    cdef void settle(self, const int* slots, long n) noexcept nogil:
        # Carry changed ranks up, level by level: slots that are neighbours soon share their matches.
        cdef long i, left
        cdef int node
        for i in range(n):
            self.rising[i] = <int>self.leaves + slots[i]
            self.winner[self.rising[i]] = slots[i]
        while n and self.rising[0] > 1:
            left = 0
            for i in range(n):
                node = self.rising[i] // 2
                if left == 0 or self.rising[left - 1] != node:
                    self.rising[left] = node
                    left += 1
                    self.play(node)
            n = left
