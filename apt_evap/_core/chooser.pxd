"""The contract of a chooser, for the sequence of events: which slot of the tree evaporates next."""

cdef class Chooser:
    cdef double[::1] key                # (capacity,) of each slot, not above 0: may not leave; `update` after a change

    cdef void update(self, const int* slots, long n) noexcept nogil
    cdef int choose(self, double u) noexcept nogil
    cdef double total(self) noexcept nogil


cdef class Largest(Chooser):
    cdef const long long[::1] atom      # (capacity,) atom in each slot, the tree's own
    cdef int[::1] winner                # (2 leaves,) node i has the better of 2 i and 2 i + 1; 1 is the final
    cdef int[::1] rising                # (capacity,) nodes whose match is played again
    cdef long leaves

    cdef bint better(self, int a, int b) noexcept nogil
    cdef void play(self, long node) noexcept nogil
