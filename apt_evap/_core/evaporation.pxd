"""The sequence of events."""

from apt_evap._core.chooser cimport Chooser
from apt_evap._core.control cimport Control
from apt_evap._core.index cimport Index
from apt_evap._core.journal cimport Journal
from apt_evap._core.law cimport LawKernel
from apt_evap._core.neighbourhood cimport Neighbourhood
from apt_evap._core.octree cimport Octree
from apt_evap._core.rule cimport ChargingRule, Hole, Patch


cdef class Evaporation:
    cdef readonly Neighbourhood atoms
    cdef readonly Octree tree
    cdef readonly ChargingRule rule
    cdef readonly LawKernel law
    cdef readonly double potential, coulomb, field_unit, patch_radius, update_radius, opening_angle
    cdef readonly double potential_bound
    cdef readonly object start          # start values of the last relaxation of the whole surface
    cdef readonly Index n_removed, since_relaxation
    cdef readonly Index n_partial       # relaxations of a part since that of the whole surface
    cdef Index n_slots_before           # slots of the tree after the last relaxation
    cdef readonly signed char[::1] disturbed  # (capacity,) 1 for slots near holes since the last relaxation
    cdef public Index n_clipped         # negative charges that were set to 0
    cdef public Index n_unsettled       # patches that did not converge
    cdef readonly Control control       # of the voltage
    cdef readonly double target_stretch  # squared reach of a roll-up over that of a nearest neighbour
    cdef readonly unsigned long long seed
    cdef readonly bint was_scaled       # whether the potential inside was restored since the last relaxation
    cdef bint has_support
    cdef int[::1] slot_of               # (n_atoms,) -1 for atoms not at the surface
    cdef double[:, ::1] normals         # (capacity, 3) by slot
    cdef readonly Chooser chooser       # selects the slot that evaporates next
    cdef Hole hole                      # surroundings of an evaporating atom; its memory follows
    cdef int[::1] hole_slot
    cdef float[:, ::1] hole_float       # (3, capacity)
    cdef Patch patch                    # slots whose charges are solved; its memory follows
    cdef int[::1] patch_slot
    cdef double[::1] patch_charge
    cdef float[:, ::1] patch_float      # (8, capacity)
    cdef int[::1] ring_slot, far_slot   # (capacity,) slots around the patch, near and far
    cdef double[::1] strength, key      # (capacity,) of the patch, for the law
    cdef Index[::1] key_atom
    cdef int[::1] key_bonds

    cdef void allocate(self, Index capacity)
    cdef update_chooser(self, double factor, log_rate_at, int n_threads)
    cdef Chooser new_chooser(self, double voltage_factor, int n_threads)
    cdef void strongest_neighbours(self, Index atom, double stretch, Index* neighbour,
                                   double* charge) noexcept nogil
    cdef void add_to_patch(self, int slot, double dx, double dy, double dz) noexcept nogil
    cdef void sort_near_first(self, Hole* hole) noexcept nogil
    cdef void put_around(self, Hole* hole, Index i, int slot) noexcept nogil
    cdef int surroundings(self, Index atom) noexcept nogil
    cdef double hopping(self, double key, double strength, Index atom) noexcept nogil
    cdef int update_keys(self, const int* slots, Index n) except -1 nogil
    cdef int event(self, Index atom, Journal journal) except -1 nogil
    cdef int scale(self, Journal journal) except -1 nogil
    cdef int expose(self, const int* fresh, int n_fresh, int removed_slot, Journal journal) except -1 nogil
