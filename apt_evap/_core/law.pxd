"""Interface of a law for the sequence of events: the key of an atom."""

from apt_evap._core.chooser cimport Chooser
from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree


cdef class LawKernel:
    cdef readonly object surroundings   # BondCodes if `key` needs the bonds by species; None: their number
    cdef readonly int hop_bonds         # most nearest neighbours of an atom that can hop; -1: none can

    cdef double key(self, double strength, Index atom, int bonds) noexcept nogil
    cdef int keys(self, Index n, const double* strength, const Index* atom, const int* bonds,
                  double* key) except -1 nogil
    cdef double hopping(self, double key, double strength, double ratio) noexcept nogil
    cdef Chooser chooser(self, Octree tree, double[::1] key)


cdef class WeightedField(LawKernel):
    cdef const double[::1] weight       # (n_atoms,)
    cdef const double[:, ::1] table     # (n_species, n_codes) weight by bonds; empty: does not depend on them
    cdef const int[::1] species         # (n_atoms,) rows of the table
    cdef bint by_bonds
    cdef double at_rest, by_charge, gain_needed, hop_weight   # of a hop

    cdef double ratio(self, double strength, Index atom, int bonds) noexcept nogil


cdef class ThermalRate(WeightedField):
    cdef const double[::1] stiffness    # (n_atoms,) sensitivity / kT
    cdef double log_frequency, reach, unit
    cdef int barrier


cdef class PythonLaw(LawKernel):
    cdef readonly object law, tip
    cdef double field_unit
