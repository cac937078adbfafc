"""Laws: the key of an atom from its field, index and bonds, and the chooser for these keys."""

from libc.math cimport INFINITY, fabs, sqrt

import numpy as np

from apt_evap._core.chooser cimport Chooser, Largest, RateSum
from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree


BARRIERS = ("linear", "image_hump", "parabolic", "quadratic")


cdef class LawKernel:
    """Interface of an evaporation law in the compiled core.

    After every event the keys of the atoms around the hole are recomputed, because their fields or bonds have changed.
    A compiled law implements `key`, `begin` if it needs the field in V/nm, and `hopping` if it sees the neighbours.
    """

    def __cinit__(self, *args, **kwargs):
        self.hop_bonds = -1

    def begin(self, double field_unit):
        """Set the field of strength 1 [V/nm], after each relaxation."""

    cdef double key(self, double strength, Index atom, int bonds) noexcept nogil:
        # Key of one atom from the field just outside (in the unit set by `begin`), its index in the specimen and its
        # number of nearest neighbours (with `surroundings`, their code); <= 0 for an atom that cannot evaporate, for
        # rates -inf.
        return 0.0

    cdef int keys(self, Index n, const double* strength, const Index* atom, const int* bonds,
                  double* key) except -1 nogil:
        # Keys of several atoms.
        cdef Index i
        for i in range(n):
            key[i] = self.key(strength[i], atom[i], bonds[i])
        return 0

    cdef double hopping(self, double key, double strength, double ratio) noexcept nogil:
        # Key of an atom with at most `hop_bonds` nearest neighbours, from its key without hops, the field just outside
        # and the charge of its strongest neighbour over its own; 0 without one.
        return key

    cdef Chooser chooser(self, Octree tree, double[::1] key):
        # The chooser for these keys.
        return Largest(tree, key)

    def evaluate(self, const double[::1] strength, const Index[::1] atom, const int[::1] bonds):
        """Keys of atoms as in the sequence of events, shape (n,)."""
        cdef double[::1] key = np.empty(strength.shape[0])
        if strength.shape[0]:
            self.keys(strength.shape[0], &strength[0], &atom[0], &bonds[0], &key[0])
        return np.asarray(key)

    def evaluate_hopping(self, const double[::1] key, const double[::1] strength, const double[::1] ratio):
        """Keys of atoms that may hop as in the sequence of events, shape (n,)."""
        return np.array([self.hopping(key[i], strength[i], ratio[i]) for i in range(key.shape[0])])


cdef class WeightedField(LawKernel):
    """Law with the key field times weight of the atom: the atom with the largest product evaporates next.

    Parameters
    ----------
    weight : ndarray, shape (n_atoms,)
        Weight, such as 1 / evaporation field [nm/V]; 0 for atoms that cannot evaporate.
    surroundings : BondCodes, optional
        How the bonds of an atom are encoded, if the evaporation field depends on them.
    table : ndarray, shape (n_species, n_codes), optional
        Factor of the weight for each species and code.
    species : ndarray of int32, shape (n_atoms,), optional
        Species of each atom, needed with a table.
    hop : tuple of float, optional
        (n, a, b, g, F_hop): an atom with up to n nearest neighbours hops at the field F_hop sqrt(g / (phi^2 - 1)) with
        phi = a + b x and the charge x of its strongest neighbour over its own. Its key is the larger ratio of the field
        to that of evaporation or of the hop.
    """

    def __init__(self, const double[::1] weight, surroundings=None, table=None, species=None, hop=None):
        if hop is not None:
            self.hop_bonds, self.at_rest, self.by_charge, self.gain_needed, field = hop
            self.hop_weight = 1.0 / field
        self.weight, self.surroundings, self.by_bonds = weight, surroundings, table is not None
        self.table = np.empty((0, 1)) if table is None else np.ascontiguousarray(table, np.float64)
        self.species = np.empty(0, np.int32) if species is None else np.ascontiguousarray(species, np.int32)

    cdef double ratio(self, double strength, Index atom, int bonds) noexcept nogil:
        # all strengths have the same unit, which does not change the order
        if self.by_bonds:
            return strength * self.weight[atom] * self.table[self.species[atom], bonds]
        return strength * self.weight[atom]

    cdef double key(self, double strength, Index atom, int bonds) noexcept nogil:
        return self.ratio(strength, atom, bonds)

    cdef double hopping(self, double key, double strength, double ratio) noexcept nogil:
        # the gain increases with the square of the field: the field needed is lower by the root
        cdef double charge = self.at_rest + self.by_charge * ratio, gain = charge * charge - 1.0
        if key <= 0.0 or ratio <= 0.0 or gain <= 0.0:
            return key
        return max(key, strength * self.hop_weight * sqrt(gain / self.gain_needed))


cdef class ThermalRate(WeightedField):
    """Law with the key ln k = ln nu_0 - Q(x)/kT of the ratio x of field to evaporation field.

    With C = -dQ/dx at the working point and s = C/kT, Q/kT is

    - linear: s (1 - x)
    - image_hump: 2 s (1 - sqrt(x)), with the slope C at x = 1
    - parabolic: s^2 / (4 w) (1/x - 1)^2, with w = Q/kT at the working point
    - quadratic: s^2 / (4 w) (1 - x)^2

    The last two are continued antisymmetrically beyond x = 1, so that rates increase with the field throughout.

    Parameters
    ----------
    weight, surroundings, table, species
        As for `WeightedField`.
    stiffness : ndarray, shape (n_atoms,)
        s of each atom.
    log_frequency : float
        ln nu_0, nu_0 in 1/s.
    barrier : str
        One of `BARRIERS`.
    reach : float
        w.
    """

    def __init__(self, const double[::1] weight, const double[::1] stiffness, double log_frequency, barrier,
                 double reach, surroundings=None, table=None, species=None):
        WeightedField.__init__(self, weight, surroundings, table, species)
        self.stiffness, self.log_frequency, self.reach = stiffness, log_frequency, reach
        self.barrier = BARRIERS.index(barrier)
        self.unit = 1.0

    def begin(self, double field_unit):
        """Set the field of strength 1 [V/nm]."""
        self.unit = field_unit

    cdef double key(self, double strength, Index atom, int bonds) noexcept nogil:
        cdef double x = self.ratio(self.unit * strength, atom, bonds), s = self.stiffness[atom], missing
        if not x > 0.0:
            return -INFINITY
        if self.barrier == 0:
            return self.log_frequency - s * (1.0 - x)
        if self.barrier == 1:
            return self.log_frequency - 2.0 * s * (1.0 - sqrt(x))
        missing = 1.0 / x - 1.0 if self.barrier == 2 else 1.0 - x
        return self.log_frequency - s * s / (4.0 * self.reach) * missing * fabs(missing)

    cdef Chooser chooser(self, Octree tree, double[::1] key):
        return RateSum(tree, key)


cdef class PythonLaw(LawKernel):
    """Wrapper of a law written in Python; the atom with the largest key evaporates next.

    Parameters
    ----------
    law : object
        Object with a method ``keys(tip, atoms, fields, bonds)``, see `apt_evap.evaporation.law.Law`.
    tip : Tip
        The specimen.
    """

    def __init__(self, law, tip):
        self.law, self.tip = law, tip
        self.field_unit = 1.0

    def begin(self, double field_unit):
        """Set the field of strength 1 [V/nm]."""
        self.field_unit = field_unit

    cdef int keys(self, Index n, const double* strength, const Index* atom, const int* bonds,
                  double* key) except -1 nogil:
        cdef Index i
        cdef double[::1] keys
        with gil:
            atoms = np.asarray(<const Index[:n]> atom).copy()
            fields = self.field_unit * np.asarray(<const double[:n]> strength)
            bond_counts = np.asarray(<const int[:n]> bonds).copy()
            keys = np.ascontiguousarray(self.law.keys(self.tip, atoms, fields, bond_counts), np.float64)
            if keys.shape[0] != n:
                raise ValueError(
                    f"keys of {type(self.law).__name__} must return {n} values, one per atom, got {keys.shape[0]}"
                )
            for i in range(n):
                if keys[i] != keys[i]:
                    raise ValueError(f"keys of {type(self.law).__name__} must be numbers, got NaN for atom {atom[i]}")
                key[i] = keys[i]
        return 0
