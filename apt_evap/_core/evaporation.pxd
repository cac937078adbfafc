"""The sequence of events."""

from apt_evap._core.journal cimport Journal
from apt_evap._core.octree cimport Octree
from apt_evap._core.robin cimport ChargingRule, Patch
from apt_evap._core.neighbourhood cimport Neighbourhood
from apt_evap._core.chooser cimport Tournament


cdef class Evaporation:
    cdef readonly Neighbourhood atoms
    cdef readonly Octree tree
    cdef readonly ChargingRule rule
    cdef readonly double potential, patch_radius, update_radius, bond_length, opening_angle
    cdef readonly object potential_point
    cdef readonly object start          # what the last relaxation started from
    cdef readonly long n_removed, since_sweep
    cdef public long n_clipped          # charges that came out negative and were set to 0
    cdef public long n_unsettled        # patches whose charges were still moving after the last iteration
    cdef double clearance               # of the point of the potential from the surface at first [nm]
    cdef bint has_support
    cdef double[::1] weight             # (n_atoms,) 1/evaporation field, 0 where an atom may not leave
    cdef int[::1] slot_of               # (n_atoms,) -1 away from the surface
    cdef double[:, ::1] normals         # (capacity, 3) by slot
    cdef Tournament tournament          # of charge times weight
    cdef int[::1] near                  # (most,) slots around the hole
    cdef float[:, ::1] near_float       # (6, most) where they are, from the hole [nm], and what changes their field
    cdef Patch patch                    # those whose charges are solved; its memory follows
    cdef int[::1] patch_slot
    cdef double[::1] patch_charge
    cdef float[:, ::1] patch_float

    cdef void make_room(self, long most)
    cdef long strongest_neighbour(self, long atom) noexcept nogil
    cdef void join(self, int slot, double dx, double dy, double dz) noexcept nogil
    cdef int event(self, long atom, Journal journal) except -1 nogil
