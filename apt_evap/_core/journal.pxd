"""The journal, for the events that write it and the flights that read it."""

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree


cdef class Journal:
    cdef readonly Index n_events
    cdef Index[::1] start               # (max_events + 1,) begin of the changes of each event
    cdef int[::1] slot                  # changed slots; the first of each event is the removed one
    cdef double[::1] charge             # new charges [e]
    cdef Index[::1] fresh_start         # (max_events + 1,)
    cdef int[::1] fresh_atom            # added atoms
    cdef int[::1] fresh_leaf            # and their leaves
    cdef const double[:, ::1] positions  # (n_atoms, 3) nm

    cdef int reserve(self, Index changes, Index fresh) except -1 nogil
    cdef void replay(self, Index event, Octree tree) noexcept nogil
