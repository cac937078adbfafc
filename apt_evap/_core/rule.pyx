"""Charging rules: the interface, the base of rules that store a field per slot, and rules written in Python."""

from libc.math cimport M_PI, sqrt

import numpy as np

from apt_evap._core import elementary

from apt_evap._core.index cimport Index
from apt_evap._core.interactions cimport InteractionLists
from apt_evap._core.octree cimport Octree
from apt_evap._core.sources cimport sources_field, sources_free, sources_init


cdef extern from "kernels.h":
    const int GROUP
    void patch_field(Index, const float*, const float*, const float*, Index, const float*, const float*, const float*,
                     const float*, float*, float*, float*) noexcept nogil


cdef void merge(Octree tree, const Hole* hole, Patch* patch) noexcept nogil:
    # Merge up to four successive changes of one sign in one leaf into one at their centre of charge. The evaporated
    # charge becomes a source of the surroundings of the patch.
    cdef double x, y, z, total, change
    cdef Index i = 0, n = 0, end
    cdef int leaf
    cdef bint rises
    while i < patch.n:
        leaf, end, rises = tree.leaf[patch.slot[i]], min(i + 4, patch.n), patch.change[i] > 0.0
        x = y = z = total = 0.0
        while i < end and tree.leaf[patch.slot[i]] == leaf and (patch.change[i] > 0.0) == rises:
            change = patch.change[i]
            x += change * patch.x[i]
            y += change * patch.y[i]
            z += change * patch.z[i]
            total += change
            i += 1
        if total != 0.0:
            patch.merged_x[n], patch.merged_y[n] = <float>(x / total), <float>(y / total)
            patch.merged_z[n], patch.merged_change[n] = <float>(z / total), <float>total
            n += 1
    patch.merged_x[n] = patch.merged_y[n] = patch.merged_z[n] = 0.0
    patch.merged_change[n] = <float>-hole.charge
    patch.n_merged = n + 1
    patch.x[patch.n] = patch.y[patch.n] = patch.z[patch.n] = 0.0
    patch.change[patch.n] = <float>-hole.charge


cdef Index ring(const Hole* hole, const Patch* patch, Index* n_near) noexcept nogil:
    # Number of slots around the patch, and of the near ones among them, both padded to multiples of GROUP.
    cdef Index padded = (hole.n - patch.n + GROUP - 1) // GROUP * GROUP
    n_near[0] = min((hole.n_near - patch.n + GROUP - 1) // GROUP * GROUP, padded)
    return padded


cdef class ChargingRule:
    """Interface of a charging rule: the distribution of the charge over the surface atoms.

    Compiled rules implement the five methods below `solve` in Cython (``rule.pxd``); a rule in Python is wrapped by
    `PythonRule`. The strength of a slot is the field just outside it in the unit `field_unit`: by default the charge.
    """

    def solve(self, Octree tree, double[:, ::1] normals, InteractionLists lists, *, double potential, double tolerance,
              int max_sweeps=200, bint double_precision=False, int n_threads=1):
        """Solve the charges of the targets of the lists at the potential of the specimen; all others are fixed.

        Parameters
        ----------
        tree : Octree
            Its charges are the start values, and are replaced.
        normals : ndarray, shape (n, 3)
            Outward unit normals in the order of the slots.
        lists : InteractionLists
            Interaction lists of this tree. Without `disturbed`, the whole surface is solved.
        potential : float
            Potential of the specimen divided by the Coulomb constant [e/nm].
        tolerance : float
            Largest change of a charge in a sweep, relative to the mean charge, at which to stop.
        max_sweeps : int
            Maximum number of sweeps.
        double_precision : bool
            Sums in float64; needed for tolerances below 1e-6.
        n_threads : int
            Number of threads.

        Returns
        -------
        sweeps : int
            Number of sweeps.
        residual : float
            Largest change of a charge in the last sweep, relative to the mean charge.
        """
        raise NotImplementedError(f"{type(self).__name__} has no solve")

    def begin(self, point):
        """Set a point well inside the specimen [nm], shape (3,), before the first relaxation."""

    @property
    def samples(self):
        """Whether `solve` needs samples of the other atoms to solve a part of the surface (bool).

        None for a rule that solves only the whole surface.
        """
        return False

    @property
    def far_change(self):
        """Relative change of what is far from the holes since the whole surface was solved (float)."""
        return 0.0

    @property
    def state(self):
        """Further input of a relaxation besides the charges, dict of arrays by name; stored in files."""
        return {}

    @state.setter
    def state(self, values):
        pass

    def field_unit(self, double coulomb):
        """Field just outside a slot of strength 1 [V/nm]: 4 pi k_e / area for a charge on its surface area."""
        return 4.0 * M_PI * coulomb / self.area

    def strengths(self, Octree tree):
        """Strength of every slot of the tree, shape (n_slots,)."""
        cdef double[::1] values = np.empty(tree.n_slots)
        cdef Index slot
        with nogil:
            for slot in range(tree.n_slots):
                values[slot] = self.strength(tree, slot)
        return np.asarray(values)

    def residuals(self, positions, normals, charges, chosen):
        """Residuals of the equation of the rule, by direct sums over all other atoms.

        Parameters
        ----------
        positions, normals : ndarray, shape (n, 3)
            Surface atoms [nm] and outward unit normals.
        charges : ndarray, shape (n,)
            Charges [e].
        chosen : ndarray of int, shape (m,)
            Indices of the atoms.

        Returns
        -------
        ndarray, shape (m,)
            Residuals relative to the mean charge; NaN for a rule that does not define them.
        """
        return np.full(len(chosen), np.nan)

    cdef void removed(self, Octree tree, const Hole* hole, Index n_patch) noexcept nogil:
        # An atom has evaporated, with its charge: the tree no longer contains it. The first slots around the hole are
        # those of the patch; the others see the removal in `solve_patch`.
        pass

    cdef int exposed(self, Octree tree, Index slot, double opening_angle) except -1 nogil:
        # An atom without charge was exposed, in this slot of the tree.
        return 0

    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, const Hole* hole, Patch* patch) except -1 nogil:
        # Solve the charges of the patch with all others fixed, and update the fields of the slots around the hole.
        with gil:
            raise NotImplementedError(f"{type(self).__name__} has no solve_patch")

    cdef void scaled(self, Octree tree, double factor) noexcept nogil:
        # All charges were multiplied by a factor that removes `drift`; only for rules that compute it.
        pass

    cdef double strength(self, Octree tree, Index slot) noexcept nogil:
        # Field just outside a slot, in units of `field_unit`.
        return tree.q[slot]


cdef class FieldRule(ChargingRule):
    """Base of rules that store the field of all other atoms at every slot, with charges >= 0."""

    def __cinit__(self, *args, **kwargs):
        sources_init(&self.sources)
        self.near = 1.0

    def __dealloc__(self):
        sources_free(&self.sources)

    cdef void removed(self, Octree tree, const Hole* hole, Index n_patch) noexcept nogil:
        cdef double dx, dy, dz, s, over
        cdef Index i
        cdef int slot
        for i in range(n_patch):
            slot = hole.slot[i]
            dx, dy, dz = tree.x[slot] - hole.x, tree.y[slot] - hole.y, tree.z[slot] - hole.z
            s = dx * dx + dy * dy + dz * dz
            over = hole.charge / (s * sqrt(s)) if s > 1e-12 else 0.0
            self.field[slot, 0] -= over * dx
            self.field[slot, 1] -= over * dy
            self.field[slot, 2] -= over * dz

    cdef int exposed(self, Octree tree, Index slot, double opening_angle) except -1 nogil:
        tree.collect(tree.x[slot], tree.y[slot], tree.z[slot], 0.0, opening_angle, &self.sources)
        sources_field(&self.sources, tree.x[slot], tree.y[slot], tree.z[slot], &self.field[slot, 0])
        return 0

    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, const Hole* hole, Patch* patch) except -1 nogil:
        cdef Index i, near, padded = ring(hole, patch, &near), first = patch.n
        cdef int slot
        cdef float *field_x
        cdef float *field_y
        cdef float *field_z
        self.patch_charges(tree, normals, patch)
        for i in range(patch.n):
            if patch.charge[i] < 0.0:   # moments of cells are about the centre of charge: no negative charges
                patch.change[i] = <float>-tree.q[patch.slot[i]]
                patch.charge[i] = 0.0
                patch.n_clipped += 1
        if patch.stride + padded > self.spread.shape[1]:
            with gil:
                self.spread = np.empty((3, 2 * (patch.stride + padded)), np.float32)
        field_x, field_y, field_z = &self.spread[0, 0], &self.spread[1, 0], &self.spread[2, 0]
        self.field_in_patch(hole, patch, field_x, field_y, field_z)
        for i in range(first, first + padded):
            field_x[i] = field_y[i] = field_z[i] = 0.0
        merge(tree, hole, patch)
        patch_field(near, hole.near_x + first, hole.near_y + first, hole.near_z + first, patch.n + 1, patch.x, patch.y,
                    patch.z, patch.change, field_x + first, field_y + first, field_z + first)
        first += near
        patch_field(padded - near, hole.near_x + first, hole.near_y + first, hole.near_z + first, patch.n_merged,
                    patch.merged_x, patch.merged_y, patch.merged_z, patch.merged_change, field_x + first,
                    field_y + first, field_z + first)
        for i in range(hole.n):
            slot = hole.slot[i]
            self.field[slot, 0] += field_x[i]
            self.field[slot, 1] += field_y[i]
            self.field[slot, 2] += field_z[i]
        return 0

    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil:
        # New charges of a patch and their changes, from the fields at its slots and the charges in the tree.
        with gil:
            raise NotImplementedError(f"{type(self).__name__} has no patch_charges")

    cdef void field_in_patch(self, const Hole* hole, const Patch* patch, float* x, float* y, float* z) noexcept nogil:
        # Fields of the changes of a patch at its own slots; there is space for `stride` of them.
        cdef Index i
        for i in range(patch.stride):
            x[i] = y[i] = z[i] = 0.0
        patch_field(patch.stride, patch.x, patch.y, patch.z, patch.n, patch.x, patch.y, patch.z, patch.change, x, y, z)


cdef class PythonRule(FieldRule):
    """Wrapper of a charging rule written in Python.

    Parameters
    ----------
    rule : object
        Object with the methods of `apt_evap.evaporation.rule.Rule`.
    """

    def __init__(self, rule):
        self.rule = rule
        self.area = 1.0

    def solve(self, Octree tree, double[:, ::1] normals, InteractionLists lists, *, double potential, double tolerance,
              int max_sweeps=200, bint double_precision=False, int n_threads=1):
        """Solve the charges of the whole surface: see `ChargingRule.solve`."""
        cdef Index n = tree.n_slots
        self.field = np.zeros((tree.x.shape[0], 3))

        def field_of(charges):
            tree.charges = np.ascontiguousarray(charges, np.float64)
            lists.sweep(self.field, double_precision, n_threads)
            return np.asarray(self.field)[:n].copy()

        charges, area = self.rule.solve(
            tree.positions, np.asarray(normals)[:n].copy(), tree.charges.copy(), field_of, potential, tolerance
        )
        charges = np.ascontiguousarray(charges, np.float64)
        if charges.shape != (n,) or not (charges >= 0.0).all() or not area > 0.0:
            raise ValueError(
                f"solve of {type(self.rule).__name__} must return {n} charges, none negative, and the area per atom, "
                f"got charges of shape {charges.shape} and the area {area!r:.80}"
            )
        self.area = area
        before = tree.charges.copy()
        field_of(charges)
        change = float(np.abs(charges - before).max() / (elementary.total(charges) / n))
        return 1, min(change, 0.5 * tolerance)   # the rule itself decides when to stop

    @property
    def samples(self):
        """None, as for every rule that solves only the whole surface."""
        return None

    def residuals(self, positions, normals, charges, chosen):
        """Residuals of the wrapped rule, if it has a method of this name: see `ChargingRule.residuals`."""
        residuals = getattr(self.rule, "residuals", None)
        return np.full(len(chosen), np.nan) if residuals is None else residuals(positions, normals, charges, chosen)

    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil:
        cdef Index i
        cdef double[::1] solved
        with gil:
            slots = np.asarray(<int[:patch.n]> patch.slot)
            solved = np.ascontiguousarray(
                self.rule.solve_patch(
                    np.stack([np.asarray(tree.x)[slots], np.asarray(tree.y)[slots], np.asarray(tree.z)[slots]], axis=1),
                    np.asarray(normals)[slots],
                    np.asarray(tree.q)[slots],
                    np.asarray(self.field)[slots],
                ),
                np.float64,
            )
            if solved.shape[0] != patch.n:
                raise ValueError(
                    f"solve_patch of {type(self.rule).__name__} must return {patch.n} charges, got {solved.shape[0]}"
                )
            for i in range(patch.n):
                patch.charge[i] = solved[i]
                patch.change[i] = <float>(solved[i] - tree.q[patch.slot[i]])
        return 0
