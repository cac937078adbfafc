"""Interface of a law for the sequence of events: the key of an atom."""

from apt_evap._core.chooser cimport Chooser
from apt_evap._core.octree cimport Octree


cdef class LawKernel:
    cdef double key(self, double strength, long long atom, int bonds) noexcept nogil
    cdef int keys(self, long n, const double* strength, const long long* atom, const int* bonds,
                  double* key) except -1 nogil
    cdef Chooser chooser(self, Octree tree, double[::1] key)


cdef class WeightedField(LawKernel):
    cdef const double[::1] weight       # (n_atoms,)


cdef class PythonLaw(LawKernel):
    cdef readonly object law, tip
    cdef double field_unit
