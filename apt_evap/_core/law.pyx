"""Laws: the key of an atom from its field, index and bonds, and the chooser for these keys."""

import numpy as np

from apt_evap._core.chooser cimport Chooser, Largest
from apt_evap._core.octree cimport Octree


cdef class LawKernel:
    """Interface of an evaporation law in the compiled core.

    After every event the keys of the atoms around the hole are recomputed, because their fields or bonds have changed.
    A compiled law implements `key`, and `begin` if it needs the field in V/nm.
    """

    def begin(self, double field_unit):
        """Set the field of strength 1 [V/nm], after each relaxation."""

    cdef double key(self, double strength, long long atom, int bonds) noexcept nogil:
        # Key of one atom from the field just outside (in the unit set by `begin`), its index in the specimen and its
        # number of nearest neighbours; <= 0 for an atom that cannot evaporate.
        return 0.0

    cdef int keys(self, long n, const double* strength, const long long* atom, const int* bonds,
                  double* key) except -1 nogil:
        # Keys of several atoms.
        cdef long i
        for i in range(n):
            key[i] = self.key(strength[i], atom[i], bonds[i])
        return 0

    cdef Chooser chooser(self, Octree tree, double[::1] key):
        # The chooser for these keys.
        return Largest(tree, key)

    def evaluate(self, const double[::1] strength, const long long[::1] atom, const int[::1] bonds):
        """Keys of atoms as in the sequence of events, shape (n,)."""
        cdef double[::1] key = np.empty(strength.shape[0])
        if strength.shape[0]:
            self.keys(strength.shape[0], &strength[0], &atom[0], &bonds[0], &key[0])
        return np.asarray(key)


cdef class WeightedField(LawKernel):
    """Law with the key field times weight of the atom: the atom with the largest product evaporates next.

    Parameters
    ----------
    weight : ndarray, shape (n_atoms,)
        Weight, such as 1 / evaporation field [nm/V]; 0 for atoms that cannot evaporate.
    """

    def __init__(self, const double[::1] weight):
        self.weight = weight

    cdef double key(self, double strength, long long atom, int bonds) noexcept nogil:
        # all strengths have the same unit, which does not change the order
        return strength * self.weight[atom]


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

    cdef int keys(self, long n, const double* strength, const long long* atom, const int* bonds,
                  double* key) except -1 nogil:
        cdef long i
        cdef double[::1] found
        with gil:
            atoms = np.asarray(<const long long[:n]> atom).copy()
            fields = self.field_unit * np.asarray(<const double[:n]> strength)
            bond_counts = np.asarray(<const int[:n]> bonds).copy()
            found = np.ascontiguousarray(self.law.keys(self.tip, atoms, fields, bond_counts), np.float64)
            if found.shape[0] != n:
                raise ValueError(
                    f"keys of {type(self.law).__name__} must return {n} values, one per atom, got {found.shape[0]}"
                )
            for i in range(n):
                if found[i] != found[i]:
                    raise ValueError(f"keys of {type(self.law).__name__} must be numbers, got NaN for atom {atom[i]}")
                key[i] = found[i]
        return 0
