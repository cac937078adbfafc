"""Choosers: the slot of the tree that evaporates next, from the keys of a law."""

from libc.math cimport INFINITY, ldexp

import numpy as np

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree


cdef extern from "elementary.h":
    double exponential_parts(double, Index*) noexcept nogil
    double natural_logarithm(double) noexcept nogil


cdef extern from *:
    """
    #define NO_RATE (-(1LL << 62))   /* exponent of a rate of 0; no enum, because it does not fit into an int */
    """
    const Index NO_RATE


cdef class Chooser:
    """Interface of a chooser over the keys of the slots of a tree."""

    cdef void update(self, const int* slots, Index n) noexcept nogil:
        # To be called when the keys of these slots have changed.
        pass

    cdef int choose(self, double u) noexcept nogil:
        # The slot that evaporates next; a stochastic chooser uses the random number u in (0, 1). -1: none can
        # evaporate.
        return -1

    cdef double total(self) noexcept nogil:
        # Sum of the rates [1/s]; 0 for a chooser without rates.
        return 0.0

    cdef double log_total(self) noexcept nogil:
        # Natural logarithm of the sum of the rates; -inf for a chooser without rates.
        return -INFINITY

    def chosen(self, u=0.5):
        """The slots that evaporate next for random numbers; -1 if none can evaporate. In the shape of `u`."""
        return np.array([self.choose(number) for number in np.ravel(u)]).reshape(np.shape(u))[()]

    @property
    def rate(self):
        """Sum of the rates of all slots [1/s]; 0 for a chooser without rates."""
        return self.total()


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
        cdef Index node
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

    cdef void play(self, Index node) noexcept nogil:
        cdef int a = self.winner[2 * node], b = self.winner[2 * node + 1]
        self.winner[node] = b if self.better(b, a) else a

    cdef void update(self, const int* slots, Index n) noexcept nogil:
        # Update the matches of changed keys level by level: neighbouring slots soon have common matches.
        cdef Index i, left
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


cdef class RateSum(Chooser):
    """Chooser of a slot with a probability proportional to its rate (residence-time algorithm), by a tree of sums.

    Every sum is recomputed from its two parts, never corrected by a difference: rounding errors do not accumulate.
    Rates are kept as value 2^exponent: there is no overflow, even if they differ by thousands of orders of magnitude.

    Parameters
    ----------
    tree : Octree
        Tree of the slots.
    key : ndarray, shape (capacity,)
        Natural logarithm of the rate of each slot [1/s], at most 1e15; -inf if it cannot evaporate.
    """

    def __init__(self, Octree tree, double[::1] key):
        cdef Index node
        cdef int slot
        self.key, self.draws = key, True
        self.leaves = 1
        while self.leaves < key.shape[0]:
            self.leaves *= 2
        self.value, self.exponent = np.zeros(2 * self.leaves), np.full(2 * self.leaves, NO_RATE, np.int64)
        self.rising = np.empty(key.shape[0], np.int32)
        with nogil:
            for slot in range(<int>key.shape[0]):
                self.set_rate(slot)
            for node in range(self.leaves - 1, 0, -1):
                self.add(node)

    cdef void set_rate(self, int slot) noexcept nogil:
        # The rate of a slot from its key.
        cdef Index leaf = self.leaves + slot
        if self.key[slot] >= -1e15:
            self.value[leaf] = exponential_parts(self.key[slot], &self.exponent[leaf])
        else:
            self.value[leaf], self.exponent[leaf] = 0.0, NO_RATE

    cdef void add(self, Index node) noexcept nogil:
        # The sum of two nodes; the smaller exponent is at most 2000 below, or its node adds nothing.
        cdef Index left = 2 * node, right = 2 * node + 1
        cdef Index gap
        if self.exponent[left] < self.exponent[right]:
            left, right = right, left
        self.exponent[node] = self.exponent[left]
        self.value[node] = self.value[left]
        gap = self.exponent[left] - self.exponent[right]
        if self.exponent[right] > NO_RATE and gap < 2000:
            self.value[node] += self.value[right] if gap == 0 else ldexp(self.value[right], -<int>gap)

    cdef int choose(self, double u) noexcept nogil:
        cdef Index node = 1, left
        cdef Index gap
        cdef double below, part
        if self.value[1] <= 0.0:
            return -1
        below = u * self.value[1]           # in units of 2^exponent of the node
        while node < self.leaves:
            left = 2 * node
            gap = self.exponent[node] - self.exponent[left]
            part = ldexp(self.value[left], -<int>gap) if gap < 2000 else 0.0
            if below < part or self.value[left + 1] <= 0.0:
                node = left
            else:
                below -= part
                node = left + 1
            gap = self.exponent[left // 2] - self.exponent[node]
            if gap:
                below = ldexp(below, <int>gap) if gap < 2000 else 0.0
        return <int>(node - self.leaves)

    cdef double total(self) noexcept nogil:
        return ldexp(self.value[1], <int>max(min(self.exponent[1], 5000), -5000))

    cdef double log_total(self) noexcept nogil:
        if self.value[1] <= 0.0:
            return -INFINITY
        return natural_logarithm(self.value[1]) + 0.69314718055994531 * <double>self.exponent[1]

    cdef void update(self, const int* slots, Index n) noexcept nogil:
        # Recompute the sums above changed keys level by level: neighbouring slots soon have common sums.
        cdef Index i, left
        cdef int node
        for i in range(n):
            self.rising[i] = <int>self.leaves + slots[i]
            self.set_rate(slots[i])
        while n and self.rising[0] > 1:
            left = 0
            for i in range(n):
                node = self.rising[i] // 2
                if left == 0 or self.rising[left - 1] != node:
                    self.rising[left] = node
                    left += 1
                    self.add(node)
            n = left

    @property
    def root_error(self):
        """Relative difference of the sum at the root from a direct sum of all rates."""
        values, exponents = np.asarray(self.value)[self.leaves:], np.asarray(self.exponent)[self.leaves:]
        shift = np.maximum(exponents - self.exponent[1], -2000).astype(np.int32)
        return abs(np.ldexp(values, shift).sum() / self.value[1] - 1.0)
