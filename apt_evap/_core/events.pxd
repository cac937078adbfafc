"""The table of events, for the sequence that fills it."""

from apt_evap._core.index cimport Index
from apt_evap._core.journal cimport Journal


cdef enum:
    TARGETS = 3   # neighbours onto which an atom may roll before its flight


cdef struct Event:
    # One row, for the compiled code. `COLUMNS` of events.pyx has the units and meanings; the import checks that both
    # have the same fields.
    Index site
    double charges
    double fields
    double[3] normals
    Index[TARGETS] targets
    double[TARGETS] target_charges
    double waits
    double rises
    unsigned char detached


cdef class Events:
    cdef readonly Journal journal
    cdef Event[::1] rows                # (max_events,)
    cdef object table                   # the same memory as an array of NumPy
