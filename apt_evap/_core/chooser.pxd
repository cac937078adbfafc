"""The tournament, for the sequence of events."""

cdef class Tournament:
    cdef double[::1] rank               # (capacity,) of each slot; call `settle` after a change
    cdef const long long[::1] atom      # (capacity,) atom in each slot, the tree's own
    cdef int[::1] winner                # (2 leaves,) node i has the better of 2 i and 2 i + 1; 1 is the final
    cdef int[::1] rising                # (capacity,) nodes whose match is played anew
    cdef long leaves

    cdef bint better(self, int a, int b) noexcept nogil
    cdef void play(self, long node) noexcept nogil
    cdef void settle(self, const int* slots, long n) noexcept nogil
