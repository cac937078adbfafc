"""Choosers: the slot of the tree that evaporates next, from the keys of a law."""

import numpy as np

from apt_evap._core.octree cimport Octree


cdef class Chooser:
    """Interface of a chooser over the keys of the slots of a tree."""

    cdef void update(self, const int* slots, long n) noexcept nogil:
        # To be called when the keys of these slots have changed.
        pass

    cdef int choose(self, double u) noexcept nogil:
        # The slot that evaporates next; a stochastic chooser uses the random number u in (0, 1). -1: none can
        # evaporate.
        return -1

    cdef double total(self) noexcept nogil:
        # Sum of the keys if they are rates [1/s]; otherwise 0.
        return 0.0

    def chosen(self, double u=0.5):
        """The slot that evaporates next (int); -1 if none can evaporate."""
        return self.choose(u)


cdef class Largest(Chooser):
    """Chooser of the slot with the largest key, by a tournament; equal keys are ordered by the index of the atom.

    Parameters
    ----------
    tree : Octree
        Tree of the slots.
    key : ndarray, shape (capacity,)
        Key of each slot; <= 0 if it cannot evaporate.
    """

    def __init__(self, Octree tree, double[::1] key):
        cdef long node
        self.key, self.atom = key, tree.atom
        self.leaves = 1
        while self.leaves < key.shape[0]:
            self.leaves *= 2
        self.winner = np.full(2 * self.leaves, -1, np.int32)
        self.rising = np.empty(key.shape[0], np.int32)
        np.asarray(self.winner)[self.leaves:self.leaves + tree.n_slots] = np.arange(tree.n_slots)
        with nogil:
            for node in range(self.leaves - 1, 0, -1):
                self.play(node)

    cdef int choose(self, double u) noexcept nogil:
        cdef int best = self.winner[1]
        return best if best >= 0 and self.key[best] > 0.0 else -1

    cdef bint better(self, int a, int b) noexcept nogil:
        if a < 0 or b < 0:
            return b < 0 <= a
        if self.key[a] != self.key[b]:
            return self.key[a] > self.key[b]
        return self.atom[a] < self.atom[b]

    cdef void play(self, long node) noexcept nogil:
        cdef int a = self.winner[2 * node], b = self.winner[2 * node + 1]
        self.winner[node] = b if self.better(b, a) else a

    cdef void update(self, const int* slots, long n) noexcept nogil:
        # Update the matches of changed keys level by level: neighbouring slots soon have common matches.
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
