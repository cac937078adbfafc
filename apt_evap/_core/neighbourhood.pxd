"""The atoms and their neighbourhoods, for the other compiled modules."""

from apt_evap._core.index cimport Index

cdef enum:
    MAX_NEAR = 1024    # largest number of atoms within the radius of an atom; a dense metal has 54
    MAX_BONDS = 64     # nearest neighbours of a removed atom that may be detached; fcc has 12
    MAX_CODED = 15     # neighbours of one kind that four bits of a code can count
    MAX_PIECE = 2048   # atoms visited to decide which part is no longer attached; larger parts count as the body


cdef class Neighbourhood:
    cdef readonly Index n_atoms
    cdef readonly double radius         # largest radius of a neighbourhood; also the edge of a cell of the grid [nm]
    cdef bint has_kinds                 # whether atoms of several kinds differ in the distances below
    cdef const signed char[::1] kind    # (n,) kind of each atom; one element if there is only one kind
    cdef double[::1] reach              # (kinds,) squared radius of the neighbourhood [nm^2]
    cdef double[::1] threshold          # (kinds,) [nm]
    cdef double[:, ::1] bond            # (kinds, kinds) squared length below which atoms are nearest neighbours [nm^2]
    cdef const double[:, ::1] positions  # (n, 3) nm, array of the caller
    cdef signed char[::1] alive         # (n,)
    cdef const signed char[::1] support  # (n,) atoms that never become surface atoms
    cdef const signed char[::1] anchored  # (n,) atoms that never evaporate; bonds to them attach others
    cdef signed char[::1] exposed       # (n,) surface atoms
    cdef signed char[::1] detached      # (n,) atoms without a chain of bonds to the body
    cdef signed char[::1] hidden        # (n,) walls of closed voids: surface atoms when the void opens; or empty
    cdef Index n_hidden
    cdef bint opened                    # whether walls were exposed that have no slot yet
    cdef int[::1] stack                 # of a search among the hidden atoms, or among all atoms
    cdef readonly Index n_detached      # detached atoms removed so far
    cdef int[::1] waiting               # detached atoms in the order in which they leave
    cdef Index n_waiting
    cdef int[::1] visited, piece_of, following, table  # search for detached parts: atoms, their part, its next atom
    cdef int[::1] count                 # (n,) neighbours within the radius
    cdef signed char[::1] bonds         # (n,) number of nearest neighbours, closer than the bond length
    cdef const int[::1] code            # (n,) what an atom adds to the code of its nearest neighbours
    cdef const int[::1] far_code        # (n,) and to that of its second neighbours
    cdef int[::1] bond_code             # (n,) sum of the codes of the remaining neighbours
    cdef readonly double second_length  # [nm]: atoms closer than this, but no nearest neighbours, are second neighbours
    cdef bint has_codes, too_many
    cdef double[:, ::1] offset          # (n, 3) sum of (neighbour - atom) over the neighbours [nm]
    cdef double[::1] low                # (3,) corner of the grid of cells [nm]
    cdef Index[::1] shape               # (3,) cells along each axis
    cdef int[::1] start                 # (cells + 1,) begin of the atoms of each cell in `order`
    cdef int[::1] order                 # (n,) atoms cell by cell

    cdef int kind_of(self, Index atom) noexcept nogil
    cdef int near(self, Index atom, int* others) noexcept nogil
    cdef int within(self, Index atom, double reach, int* others) noexcept nogil
    cdef void gather(self, Index atom) noexcept nogil
    cdef int code_of(self, Index atom, double s, double bond) noexcept nogil
    cdef bint is_surface_atom(self, Index atom) noexcept nogil
    cdef void normal(self, Index atom, double* normal) noexcept nogil
    cdef int remove(self, Index atom, int* fresh) noexcept nogil
    cdef Index open_from(self, Index atom) noexcept nogil
    cdef void mark_attached(self, signed char[::1] attached) noexcept nogil
    cdef bint bonded(self, Index first, Index second, double stretch=*) noexcept nogil
    cdef void detach_parts(self, const int* nearest, int n) noexcept nogil
    cdef Index visit(self, int atom, int piece, Index n, Index* known) noexcept nogil
    cdef void append(self, Index at, int piece, int* front, int* last) noexcept nogil
    cdef void detach(self, int atom) noexcept nogil
    cdef Index next_detached(self, const int* slot_of) noexcept nogil
    cdef bint reaches_support(self, Index atom) noexcept nogil
