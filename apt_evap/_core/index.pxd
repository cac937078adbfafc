"""The integer type of the core; arrays of it have the dtype `np.int64`."""

cdef extern from "index.h":
    ctypedef long long Index
