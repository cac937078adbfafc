"""Charges of the surface atoms: Robin's iteration for the whole surface or for a patch of it.

q_i <- (s/2 pi) sum_{k != i} q_k n_i . (r_i - r_k)/|r_i - r_k|^3, with s, the area per atom, chosen in every sweep so
that the total charge is conserved (Robin, 1886; Rolland et al., Microsc. Microanal. 21, 1649, 2015).
"""

cimport cython
from libc.math cimport M_PI, sqrt

import numpy as np

from apt_evap._core import elementary, interactions

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree
from apt_evap._core.rule cimport FieldRule, Hole, Patch
from apt_evap._core.interactions cimport InteractionLists


cdef extern from "kernels.h":
    void patch_column(Index, const float*, const float*, const float*, const float*, const float*, const float*,
                      float, float, float, float, float*, float*) noexcept nogil
    float patch_iteration(Index, Index, const float*, float*, float*) noexcept nogil
    void patch_field_of_cubes(Index, Index, const float*, const float*, const float*, const float*, const float*,
                              float*, float*, float*) noexcept nogil


ROUGH_ERROR = 0.05
"""Error of the field of changes of the charges by `add_changes` over that field, at most.

Measured (Ni[111], R = 40 a, four places of a run): the errors of the charges after a relaxation are the same to two
digits with sweeps instead, which take 1.7 times as long.
"""

OUTLIER = 4.0
"""Deviation of a ratio of fields from a smooth function over the median deviation, above which it is not used."""


cdef smooth_functions(places):
    # 1, z, z^2, z^3, x, y, x z and y z of places, shape (m, 3), for a change along a specimen and across it.
    x, y, z = np.ascontiguousarray(places.T)
    return [np.ones(len(z)), z, z * z, z * z * z, x, y, x * z, y * z]


cdef double dot(const double[::1] first, const double[::1] second) noexcept nogil:
    # Scalar product; eight sums allow vectorisation in an order that does not depend on the processor.
    cdef double sums[8]
    cdef Index i, n = first.shape[0]
    cdef int lane
    for lane in range(8):
        sums[lane] = 0.0
    for i in range(0, n - 7, 8):
        for lane in range(8):
            sums[lane] += first[i + lane] * second[i + lane]
    for i in range(n - n % 8, n):
        sums[0] += first[i] * second[i]
    return ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]))


cdef eliminate(double[:, ::1] matrix, double[::1] right):
    # Solution of a small symmetric positive definite system by Gaussian elimination, stored in `right`. Not by LAPACK,
    # whose bits depend on the processor.
    cdef Index i, j, k, n = right.shape[0]
    cdef double factor
    for k in range(n):
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k, n):
                matrix[i, j] -= factor * matrix[k, j]
            right[i] -= factor * right[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]


cdef class Robin(FieldRule):
    """Robin's iteration; the parameters are those of `apt_evap.Robin`."""

    def __init__(self, double tolerance, int window):
        self.tolerance = tolerance
        self.window = window
        self.area = 1.0
        self.clearance, self.far_scale = 0.0, 1.0
        self.point = np.zeros((1, 3))
        self.grow(512)

    def begin(self, point):
        """Set the point inside the specimen with the given potential [nm], shape (3,)."""
        self.point = np.array(point, dtype=np.float64).reshape(1, 3)

    @property
    def samples(self):
        """Whether samples are needed: True, as the area per atom is common to all charges, near and far from holes."""
        return True

    @property
    def far_change(self):
        """Relative change of the sum of the charges that are not targets, since all were solved (float)."""
        return abs(self.far_scale - 1.0)

    @property
    def state(self):
        """The point with the given potential [nm], as "potential_point"."""
        return {"potential_point": self.point.ravel()}

    @state.setter
    def state(self, values):
        self.point = np.array(values["potential_point"], dtype=np.float64).reshape(1, 3)

    def solve(self, Octree tree, double[:, ::1] normals, InteractionLists lists, *, double potential, double tolerance,
              int max_sweeps=200, bint double_precision=False, int n_threads=1):
        """Iterate over the whole surface, then scale all charges to the potential: see `ChargingRule.solve`."""
        others = np.zeros(tree.n_slots, bool)
        if lists.disturbed is None:
            self.far_scale = 1.0
        else:
            others[:] = tree.atoms >= 0
            others[lists.slots] = False
        before = elementary.total(tree.charges[others])
        outcome = self.iterate(tree, normals, lists, tolerance=tolerance, max_sweeps=max_sweeps,
                               double_precision=double_precision, n_threads=n_threads)
        self.scale(tree, potential / elementary.total(tree.charges / self.keep_inside(tree)))
        self.inner, self.potential, self.drift = self.point.ravel(), potential, 0.0
        if before > 0.0:
            self.far_scale *= elementary.total(tree.charges[others]) / before
        return outcome

    def scale(self, Octree tree, double factor):
        """Multiply all charges and their fields by a factor."""
        tree.charges = np.asarray(tree.charges) * factor
        np.asarray(self.field)[:] *= factor

    def keep_inside(self, Octree tree):
        """Distances of the surface atoms from the point of the potential [nm]; moves the point down if it is close."""
        away = self.distances(tree)
        if self.clearance == 0.0:
            self.clearance = away.min()
        for _ in range(100):
            if away.min() >= 0.5 * self.clearance:
                break
            self.point = self.point - (0.0, 0.0, 0.25 * self.clearance)
            away = self.distances(tree)
        return np.maximum(away, 1e-3 * self.clearance)

    def distances(self, Octree tree):
        """Distances of the surface atoms from the point of the potential [nm]."""
        columns = np.asarray(tree.x), np.asarray(tree.y), np.asarray(tree.z)
        return np.sqrt(sum((column[:tree.n_slots] - at) ** 2 for column, at in zip(columns, self.point[0])))

    def residuals(self, positions, normals, charges, chosen):
        """Residuals of Robin's equation: see `ChargingRule.residuals`.

        Notes
        -----
        (s/2 pi) sum_k q_k n_i . r_ik / r_ik^3 - q_i, with r_ik = r_i - r_k and the area per atom s of the last
        relaxation (Rolland et al., Microsc. Microanal. 21, 1649, 2015). Each sweep of Robin's iteration reduces the
        error to about one half, so the error is about as large as the residual.
        """
        field = interactions.direct_field(positions[chosen], positions, charges)
        settled = self.area / (2 * np.pi) * (field * normals[chosen]).sum(axis=1)
        return (settled - charges[chosen]) / (elementary.total(charges) / len(charges))

    @cython.wraparound(True)
    def iterate(self, Octree tree, const double[:, ::1] normals, InteractionLists lists, *, double tolerance=1e-6,
                int max_sweeps=200, bint double_precision=False, int n_threads=1):
        """Iterate over the whole surface from the charges in the tree.

        Parameters
        ----------
        tree : Octree
            Its charges are the initial values and are replaced; their sum is conserved.
        normals : ndarray, shape (n, 3)
            Outward unit normals in the order of the slots.
        lists : InteractionLists
            Interaction lists of this tree. In their blocks with samples, the fields of all atoms change by the ratio
            of the fields of the samples.
        tolerance : float
            Largest change of a charge in a sweep, relative to the mean charge, at which to stop.
        max_sweeps : int
            Maximum number of sweeps.
        double_precision : bool
            Needed for tolerances below 1e-6.
        n_threads : int
            Number of threads.

        Returns
        -------
        sweeps : int
            Number of sweeps.
        residual : float
            Largest change of a charge in the last sweep, relative to the mean charge.
        """
        cdef Index n = tree.n_slots
        cdef int sweeps = 0
        cdef double residual = np.inf
        if lists.disturbed is None:
            self.field = np.zeros((tree.x.shape[0], 3))
        at_slots = charges = tree.charges   # without new moments of the tree
        total = elementary.total(charges)
        maps, steps = [], []   # results of the last sweeps of Robin's iteration, and their changes
        while sweeps < max_sweeps:
            sweeps += 1
            # fields of the targets; those of all other atoms are scaled by the ratios of the samples
            before = self.sample_fields(normals, lists)
            if sweeps == 1 or double_precision or ROUGH_ERROR * residual > tolerance:
                if sweeps > 1:
                    tree.refresh_all()
                lists.sweep(self.field, double_precision, n_threads)
            else:
                lists.add_changes(self.field, tree.charges - charges, n_threads)
            charges = tree.charges.copy()
            if len(before):
                after = self.sample_fields(normals, lists)
                unknown = np.full(len(before), np.nan)
                self.scale_others(tree, lists, np.divide(after, before, unknown, where=before > 0.0))
            # Robin's equation q_i = (s/2 pi) E_i . n_i, with the area s per atom that conserves the total charge
            flux = np.maximum(self.normal_field(tree, normals), 0.0)   # a site deep in a notch has no charge
            emitted = elementary.total(flux)
            if not emitted > 0.0:
                raise ValueError(f"the total charge of {n} surface atoms is not positive: normals must point outwards")
            self.area = 2.0 * M_PI * total / emitted
            flux *= total / emitted
            maps.append(flux)
            steps.append(flux - charges)
            residual = np.abs(steps[-1]).max() * n / total
            if residual < tolerance:
                at_slots[:] = flux
                break
            # next charges from the last sweeps, none of them negative
            mixed = np.maximum(self.mixed(maps, steps), 0.0)
            mixed *= total / elementary.total(mixed)
            at_slots[:] = mixed
        if lists.disturbed is None:   # otherwise `scale` follows, which computes them
            tree.refresh_all()
        return sweeps, residual

    cdef sample_fields(self, const double[:, ::1] normals, InteractionLists lists):
        # Mean field along the normals of the samples of each block [e/nm^2].
        cdef double[::1] means = np.zeros(lists.blocks.shape[0])
        cdef const int[::1] slots = lists.slots
        cdef Index block, k, begin, end
        for block in range(lists.blocks.shape[0]):
            begin, end = lists.blocks[block, 1], lists.blocks[block, 2]
            for k in range(begin, end):
                means[block] += self.along(normals, slots[k]) / (end - begin)
        return np.asarray(means)

    cdef scale_others(self, Octree tree, InteractionLists lists, ratios):
        # Fields of the atoms that are not targets, scaled by a smooth function through the ratios of the samples.
        # Blocks that deviate are left out: at the open end of the shank, a higher charge lowers the fields next to it.
        cdef const double[::1] low, high, c
        cdef signed char[::1] kept = np.zeros(tree.n_slots, np.int8)
        cdef double x, y, z, scale
        cdef Index i

        # coordinates of the blocks from -1 to 1
        places = np.asarray(tree.ball)[np.asarray(lists.blocks)[:, 0], :3]
        lowest, highest = places.min(axis=0), places.max(axis=0)
        basis = smooth_functions((2.0 * places - lowest - highest) / np.maximum(highest - lowest, 1e-9))

        # least squares of the ratios of the samples, twice: the second time without blocks that deviate
        used = np.isfinite(ratios)
        for _ in range(2):
            functions = basis[:min(len(basis), np.count_nonzero(used) // 2)]
            if not functions:
                return
            gram = np.array([[dot(one[used], other[used]) for other in functions] for one in functions])
            right = np.array([dot(one[used], ratios[used]) for one in functions])
            gram += 1e-10 * np.trace(gram) * np.eye(len(gram))
            eliminate(gram, right)
            apart = np.abs(sum(factor * one for factor, one in zip(right, functions)) - ratios)
            used &= apart <= OUTLIER * np.median(apart[used])

        # scale the fields of all other atoms by the value of the function at their positions
        low, high = lowest, np.maximum(highest, lowest + 1e-9)
        c = np.concatenate([right, np.zeros(len(basis) - len(right))])
        np.asarray(kept)[lists.slots] = 1
        for i in range(tree.n_slots):
            if tree.atom[i] >= 0 and not kept[i]:
                x = (2.0 * tree.x[i] - low[0] - high[0]) / (high[0] - low[0])
                y = (2.0 * tree.y[i] - low[1] - high[1]) / (high[1] - low[1])
                z = (2.0 * tree.z[i] - low[2] - high[2]) / (high[2] - low[2])
                scale = c[0] + (c[1] + (c[2] + c[3] * z) * z) * z + (c[4] + c[6] * z) * x + (c[5] + c[7] * z) * y
                self.field[i, 0] *= scale
                self.field[i, 1] *= scale
                self.field[i, 2] *= scale

    cdef double along(self, const double[:, ::1] normals, Index i) noexcept nogil:
        # Field of all other charges along the normal of a slot [e/nm^2].
        return (self.field[i, 0] * normals[i, 0] + self.field[i, 1] * normals[i, 1]
                + self.field[i, 2] * normals[i, 2])

    cdef normal_field(self, Octree tree, const double[:, ::1] normals):
        # Field of all other charges along the normals of all slots [e/nm^2]; 0 where an atom was removed.
        cdef double[::1] along = np.zeros(tree.n_slots)
        cdef Index i
        for i in range(tree.n_slots):
            if tree.atom[i] >= 0:
                along[i] = self.along(normals, i)
        return np.asarray(along)

    @cython.wraparound(True)
    def mixed(self, maps, steps):
        """Next charges by Anderson mixing of the last sweeps (J. ACM 12, 547, 1965).

        The linear combination of the last maps with the smallest combined step; the common total charge of all maps is
        conserved.
        """
        cdef int i, j
        del maps[:-self.window - 1], steps[:-self.window - 1]
        if len(steps) == 1:
            return maps[-1]
        step_changes = [steps[-1] - step for step in steps[:-1]]
        gram = np.empty((len(step_changes), len(step_changes)))
        for i in range(len(step_changes)):
            for j in range(i + 1):
                gram[i, j] = gram[j, i] = dot(step_changes[i], step_changes[j])
        right = np.array([dot(change, steps[-1]) for change in step_changes])
        gram += 1e-12 * np.trace(gram) * np.eye(len(gram))   # regular also for equal steps
        eliminate(gram, right)
        charges = maps[-1].copy()
        for fraction, other in zip(right, maps[:-1]):
            charges -= fraction * (maps[-1] - other)
        return charges

    cdef double inside(self, double x, double y, double z, double charge) noexcept nogil:
        # Potential of a charge at the point inside the specimen, over that of the specimen.
        cdef double dx = x - self.inner[0], dy = y - self.inner[1], dz = z - self.inner[2]
        return charge / (max(sqrt(dx * dx + dy * dy + dz * dz), 1e-3 * self.clearance) * self.potential)

    cdef void removed(self, Octree tree, const Hole* hole, Index n_patch) noexcept nogil:
        FieldRule.removed(self, tree, hole, n_patch)
        self.drift -= self.inside(hole.x, hole.y, hole.z, hole.charge)

    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, const Hole* hole, Patch* patch) except -1 nogil:
        cdef Index i, slot
        FieldRule.solve_patch(self, tree, normals, hole, patch)
        for i in range(patch.n):
            slot = patch.slot[i]
            self.drift += self.inside(tree.x[slot], tree.y[slot], tree.z[slot], patch.change[i])
        return 0

    cdef void scaled(self, Octree tree, double factor) noexcept nogil:
        cdef Index slot
        cdef int axis
        for slot in range(tree.n_slots):
            for axis in range(3):
                self.field[slot, axis] *= factor
        self.drift = 0.0

    cdef int grow(self, Index stride) except -1 nogil:
        if 4 * stride > self.columns.shape[0]:
            with gil:
                self.matrix, self.cubes = np.zeros((2, stride * stride), np.float32)
                self.columns = np.zeros(4 * stride, np.float32)
        return 0

    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil:
        # Gauss-Seidel iteration of the changes: x_i = r_i + (s/2 pi) sum_k K_ik x_k with the residual r_i of the old
        # charges.
        cdef double c = self.area / (2.0 * M_PI), mean = 0.0
        cdef float largest = 0.0
        cdef Index i, slot, n = patch.n, stride = patch.stride
        cdef int _iteration, axis
        self.grow(stride)
        cdef float* right = &self.columns[0]
        cdef float* normal = &self.columns[stride]

        # residuals r_i = (s/2 pi) E_i . n_i - q_i of the old charges, normals, and columns of the matrix
        for i in range(n):
            slot = patch.slot[i]
            mean += tree.q[slot] / n
            right[i] = <float>(c * self.along(normals, slot) - tree.q[slot])
            patch.change[i] = 0.0
            for axis in range(3):
                normal[axis * stride + i] = <float>normals[slot, axis]
        for i in range(n, stride):
            right[i] = normal[i] = normal[stride + i] = normal[2 * stride + i] = 0.0
        for i in range(n):
            patch_column(stride, patch.x, patch.y, patch.z, normal, normal + stride, normal + 2 * stride, patch.x[i],
                         patch.y[i], patch.z[i], <float>c, &self.matrix[i * stride], &self.cubes[i * stride])
        for _iteration in range(60):
            largest = patch_iteration(n, stride, &self.matrix[0], right, patch.change)
            if largest <= self.tolerance * mean:
                break
        for i in range(n):
            patch.charge[i] = tree.q[patch.slot[i]] + patch.change[i]
        patch.unsettled = largest > self.tolerance * mean
        return 0

    cdef void field_in_patch(self, const Hole* hole, const Patch* patch, float* x, float* y, float* z) noexcept nogil:
        patch_field_of_cubes(patch.n, patch.stride, &self.cubes[0], patch.x, patch.y, patch.z, patch.change, x, y, z)
