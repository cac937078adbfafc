"""The journal, for the events that write it and the flights that read it."""

from apt_evap._core.octree cimport Octree


cdef class Journal:
    cdef readonly long n_events
    cdef long[::1] start                # (max_events + 1,) begin of the changes of each event
    cdef int[::1] slot                  # changed slots; the first of each event is the removed one
    cdef double[::1] charge             # new charges [e]
    cdef long[::1] fresh_start          # (max_events + 1,)
    cdef int[::1] fresh_atom            # added atoms
    cdef int[::1] fresh_leaf            # and their leaves
    cdef const double[:, ::1] positions  # (n_atoms, 3) nm

    cdef int reserve(self, long changes, long fresh) except -1 nogil
    cdef void replay(self, long event, Octree tree) noexcept nogil
