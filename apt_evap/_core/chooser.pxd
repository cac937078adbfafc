"""Interface of a chooser for the sequence of events: the slot of the tree that evaporates next."""

from apt_evap._core.index cimport Index


cdef class Chooser:
    cdef double[::1] key                # (capacity,) of each slot; -inf: empty; call `update` after a change
    cdef bint draws                     # whether the choice depends on the random number

    cdef void update(self, const int* slots, Index n) noexcept nogil
    cdef int choose(self, double u) noexcept nogil
    cdef double total(self) noexcept nogil
    cdef double log_total(self) noexcept nogil


cdef class Largest(Chooser):
    cdef const Index[::1] atom          # (capacity,) atom in each slot, memory of the tree
    cdef int[::1] winner                # (2 leaves,) node i has the better of nodes 2 i and 2 i + 1; 1 is the final
    cdef int[::1] rising                # (capacity,) nodes whose match is repeated
    cdef Index leaves

    cdef bint better(self, int a, int b) noexcept nogil
    cdef void play(self, Index node) noexcept nogil


cdef class RateSum(Chooser):
    cdef double[::1] value              # (2 leaves,) rate of a slot, or of both children: value 2^exponent
    cdef Index[::1] exponent            # (2 leaves,)
    cdef int[::1] rising                # (capacity,) nodes whose sum is recomputed
    cdef Index leaves

    cdef void set_rate(self, int slot) noexcept nogil
    cdef void add(self, Index node) noexcept nogil
