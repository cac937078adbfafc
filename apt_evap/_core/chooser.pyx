"""Choosers: which slot of the tree evaporates next, from the keys that a law gives to the slots."""

import numpy as np

from apt_evap._core.octree cimport Octree


cdef class Chooser:
    """Interface of a chooser over the keys of the slots of a tree."""

    cdef void update(self, const int* slots, long n) noexcept nogil:
        # The keys of these slots have changed.
        pass

    cdef int choose(self, double u) noexcept nogil:
        # The slot that evaporates next, by a random number u in (0, 1) where chance decides; -1: none may leave.
        return -1

    cdef double total(self) noexcept nogil:
        # Sum of the keys where they are rates [1/s]; else 0.
        return 0.0

    def chosen(self, double u=0.5):
        """The slot that evaporates next (int); -1 if none may leave."""
        return self.choose(u)


cdef class Largest(Chooser):
    """Chooses the slot of the largest key, by a tournament; equal keys go by the number of the atom.

    Parameters
    ----------
    tree : Octree
        Whose slots take part.
    key : ndarray, shape (capacity,)
        Key of each slot; not above 0 where no atom may leave.
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
        # Carry changed keys up, level by level: slots that are neighbours soon share their matches.
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
