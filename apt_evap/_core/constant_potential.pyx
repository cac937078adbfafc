"""Charges of the surface atoms of a conductor: every atom has the same potential.

sum_{j != i} q_j u(r_ij) + S q_i = V / k_e for every surface atom i. Point charges have u(r) = 1/r; Gaussian charges, as
in the molecular dynamics of electrodes (Siepmann and Sprik, J. Chem. Phys. 102, 511, 1995), have
u(r) = erf(eta r/sqrt 2)/r with eta = S sqrt(pi/2). S is the self term: the potential of an atom by its own charge. The
matrix is symmetric and, for S large enough, positive definite: the charges are solved by conjugate gradients.

The potential of n neighbouring charges increases with sqrt(n), so the eigenvalues of smooth charges are large. The
preconditioner of the whole surface takes the means over blocks of 4, 16, 64 ... successive slots of the tree, which are
neighbours in space, and divides the difference between the means of a block and of the larger block around it by the
self term times sqrt(n)/2: a diagonal matrix in Haar's wavelets. Measured (5,900 atoms, residuals after 200 events): 3
iterations instead of 5 to an error of 4e-4.

Only the residuals need accurate potentials. The change of the charges that removes them is small after some events,
and is computed with rough potentials: a large opening angle.
"""

from libc.math cimport M_PI, fabsf, sqrt

import numpy as np

from apt_evap._core import elementary

from apt_evap._core.index cimport Index
from apt_evap._core.interactions cimport InteractionLists
from apt_evap._core.octree cimport Octree
from apt_evap._core.potentials cimport Potentials
from apt_evap._core.robin cimport Robin, dot
from apt_evap._core.rule cimport FieldRule, Hole, Patch, merge, ring
from apt_evap._core.sources cimport sources_field, sources_potential


cdef extern from "kernels.h":
    const int GROUP
    const double SAME_PLACE
    void patch_row_potential(Index, const float*, const float*, const float*, float, float, float, float,
                             float*) noexcept nogil
    void patch_potential(Index, const float*, const float*, const float*, Index, const float*, const float*,
                         const float*, const float*, float*) noexcept nogil
    void patch_potential_and_field(Index, const float*, const float*, const float*, Index, const float*, const float*,
                                   const float*, const float*, float*, float*, float*, float*) noexcept nogil
    void patch_product(Index, Index, const float*, const float*, float*) noexcept nogil
    void patch_field_of_inverse(Index, Index, const float*, const float*, const float*, const float*, const float*,
                                float*, float*, float*) noexcept nogil
    float patch_dot(Index, const float*, const float*) noexcept nogil


LATTICE_SUM = 3.92
"""Self term times the square root of the area per atom, for a flat lattice with its electrical surface at the nuclei.

The potential of a plane lattice of charges q, area s per charge, outside of it is that of a sheet. At a lattice site,
that of all other charges is lower by 3.92 q/sqrt(s) for a triangular lattice, 3.90 for a square lattice:
lim [2 sqrt(pi N) - sum_{j<N} sqrt(s)/r_j] (Bonsall and Maradudin, Phys. Rev. B 15, 1959, 1977, give 3.921034 and
3.900265).
"""

ROUGH_ANGLE = 1.5
"""Opening angle of the potentials of a change of the charges [rad], unless that of the surface is larger.

Measured (88,800 atoms) with 1.2: potentials of random changes have an error of 3.7e-3, of smooth ones 3.7e-4, and
take 0.37 of the time of those with 0.6. With 1.5 charges have the errors of 1.2 to three digits (Ni[111], R = 24 a);
with 2.5 solutions to 1e-5 do not converge.
"""

ROUGH_ERROR = 0.01
"""Error of a change by rough potentials over the change, at most: above the tolerance, it is corrected in turn."""

_FAR = 3.5   # erfc(3.5) = 7e-7: beyond, Gaussian and point charges agree to 1/10 of the tolerance of a patch
_ENTRIES = 4096   # of the table of differences; linear interpolation is exact to 1e-6 of the self term


def gaussian_table(double eta):
    """Potential erf(eta r/sqrt 2)/r of a Gaussian charge less that of a point charge, by the squared distance.

    Parameters
    ----------
    eta : float
        Inverse width [1/nm]: the density is proportional to exp(-eta^2 r^2).

    Returns
    -------
    table : ndarray, shape (4097,)
        -erfc(eta r/sqrt 2)/r [1/nm] for r^2 of 0, 1, ... over `per_square`; the first value is that of the second.
    per_square : float
        Entries per nm^2.
    """
    cdef Index k
    ends = _FAR * np.sqrt(np.arange(_ENTRIES + 1) / _ENTRIES)
    gauss = elementary.exponential(-ends * ends)
    between = elementary.exponential(-0.25 * (ends[1:] + ends[:_ENTRIES]) ** 2)
    parts = np.diff(ends) / 6.0 * (gauss[1:] + gauss[:_ENTRIES] + 4.0 * between)   # Simpson
    erfc = np.zeros(_ENTRIES + 1)
    for k in range(_ENTRIES - 1, -1, -1):
        erfc[k] = erfc[k + 1] + 2.0 / sqrt(M_PI) * parts[k]
    distance = ends * sqrt(2.0) / eta
    distance[0] = distance[1]
    table = -erfc / distance
    table[0] = table[1]
    return table, _ENTRIES / (distance[_ENTRIES] * distance[_ENTRIES])


cdef class ConstantPotential(FieldRule):
    """Charges at a constant potential; the parameters are those of `apt_evap.ConstantPotential`.

    Parameters
    ----------
    self_term : float
        Potential of an atom by its own charge 1 [1/nm]; 0: `LATTICE_SUM` over the square root of the area per atom.
    gaussian : bool
        Gaussian charges; otherwise points.
    sees_others : bool
        Whether a law sees the field of all other charges; otherwise that of the charge.
    tolerance : float
        Largest residual of a patch over self term and mean charge of the patch.
    """

    def __init__(self, double self_term, bint gaussian, bint sees_others, double tolerance):
        self.requested_self_term, self.tolerance = self_term, tolerance
        self.gaussian, self.sees_others = gaussian, sees_others
        self.area, self.self_term, self.n_iterations = 1.0, 0.0, 0
        self.near = 1.6   # potentials of merged changes: with 1.2 their largest error is 1.4 times as large
        self.robin = Robin(tolerance, 8)
        self.field = np.zeros((1, 3))
        self.grow(512)

    @property
    def state(self):
        """Self term [1/nm] (0 before the first solution) and area per atom [nm^2], as "self_term" and "area"."""
        return {"self_term": np.array([self.self_term]), "area": np.array([self.area])}

    @state.setter
    def state(self, values):
        self.self_term, self.area = float(np.ravel(values["self_term"])[0]), float(np.ravel(values["area"])[0])

    def field_unit(self, double coulomb):
        """Field of strength 1 [V/nm]: that outside a charged surface, or of the strength itself."""
        return coulomb if self.sees_others else FieldRule.field_unit(self, coulomb)

    def solve(self, Octree tree, double[:, ::1] normals, InteractionLists lists, *, double potential, double tolerance,
              int max_sweeps=200, bint double_precision=False, int n_threads=1):
        """Solve the charges by conjugate gradients: see `ChargingRule.solve`."""
        cdef Index n = tree.n_slots
        cdef int sweeps = 0
        cdef double residual
        cdef bint first = self.self_term == 0.0
        self.potential, self.normals = potential, normals
        if first:
            self.robin.iterate(tree, normals, lists, tolerance=1e-2, max_sweeps=max_sweeps, n_threads=n_threads)
            self.self_term = self.requested_self_term
            if not self.self_term > 0.0:
                self.self_term = LATTICE_SUM / sqrt(self.robin.area)

        # potentials A q: accurate ones for the residuals, rough ones for the change that removes these
        shape = gaussian_table(self.self_term * sqrt(M_PI / 2.0)) if self.gaussian else ()
        self.sums = Potentials(lists, *shape)
        angle = max(ROUGH_ANGLE, lists.opening_angle)
        rough = Potentials(lists.with_angle(angle, n_threads), *shape)
        charges, chosen = tree.charges.copy(), lists.slots
        image = self.multiply(self.sums, charges, double_precision, n_threads)
        if lists.disturbed is None:
            # the one with the smallest error
            multiple = potential * elementary.total(charges) / dot(charges[chosen], image)
            charges *= multiple
            image *= multiple

        # refinement: solve A change = V - A q by rough potentials, until the change is below the tolerance
        residuals = potential - image
        while True:
            change = np.zeros(len(chosen))
            sweeps, residual = self.correct(rough, change, residuals, elementary.total(charges) / n, tolerance, sweeps,
                                            max_sweeps, double_precision, n_threads)
            charges[chosen] += change
            if residual < tolerance or sweeps >= max_sweeps:
                break
            residuals = potential - self.multiply(self.sums, charges, double_precision, n_threads)

        # potential of each atom at the end, and for a law that sees them the fields of all other charges
        tree.charges = charges
        if lists.disturbed is None:
            self.value = np.zeros(tree.x.shape[0])
        np.asarray(self.value)[chosen] = potential - residuals
        if first or self.sees_others:
            self.fields_of(tree, lists, n_threads)
        if first:
            self.area = self.effective_area(tree)
        return sweeps, residual

    def correct(self, Potentials rough, change, residuals, double mean, double tolerance, int sweeps, int max_sweeps,
                bint double_precision, int n_threads):
        """Conjugate gradients for the change of the charges of the targets that removes residuals, by rough potentials.

        Returns the number of sweeps, counted on, and the larger of the last change of a charge and its error by the
        rough potentials, over the mean charge.
        """
        cdef double square, before, curvature, step, bound, last = np.inf
        spread = np.zeros(rough.lists.tree.n_slots)
        preconditioned = self.preconditioned(residuals)
        direction = preconditioned.copy()
        square = dot(residuals, preconditioned)
        while sweeps < max_sweeps:
            sweeps += 1
            spread[rough.lists.slots] = direction
            image = self.multiply(rough, spread, double_precision, n_threads)
            curvature = dot(direction, image)
            if not curvature > 0.0:
                if square == 0.0:   # solved exactly
                    return sweeps, 0.0
                raise ValueError(self.indefinite())
            step = square / curvature
            change += step * direction
            residuals -= step * image
            last = abs(step) * np.abs(direction).max() / mean
            bound = ROUGH_ERROR * np.abs(change).max() / mean
            if last < max(tolerance, bound):
                return sweeps, max(last, bound)
            preconditioned = self.preconditioned(residuals)
            before, square = square, dot(residuals, preconditioned)
            direction *= square / before
            direction += preconditioned
        return sweeps, last

    def preconditioned(self, residuals):
        """Residuals with the differences of their means over blocks of slots divided by the potentials of these."""
        cdef const double[::1] fine = residuals
        cdef double[::1] coarse, result, lead
        cdef Index n = fine.shape[0], i, k, block, first, last
        cdef double total

        # means over blocks of 1, 4, 16, ... slots
        means, sizes = [residuals], [1]
        while means[len(means) - 1].shape[0] > 1:
            fine = means[len(means) - 1]
            coarse = np.empty((fine.shape[0] + 3) // 4)
            block = sizes[len(sizes) - 1]
            for k in range(coarse.shape[0]):
                total = 0.0
                first, last = 4 * k, min(4 * k + 4, fine.shape[0])
                for i in range(first, last):   # the last block may be incomplete
                    total += fine[i] * min(block, n - i * block)
                coarse[k] = total / min(4 * block, n - k * 4 * block)
            means.append(np.asarray(coarse))
            sizes.append(4 * block)

        # from the largest blocks down: add the difference from the mean of the block around, over S max(1, sqrt(n)/2)
        lead = np.zeros(1)
        coarse = np.zeros(1)
        for mean, size in zip(means[::-1], sizes[::-1]):
            fine = mean
            result = np.empty(fine.shape[0])
            total = self.self_term * max(1.0, 0.5 * sqrt(<double>size))
            for k in range(fine.shape[0]):
                result[k] = lead[k // 4] + (fine[k] - coarse[k // 4]) / total
            lead, coarse = result, mean
        return np.asarray(result)

    @property
    def potentials(self):
        """Potential of each slot with that of its own charge, as kept up to date [e/nm], shape (capacity,)."""
        return np.asarray(self.value)

    def multiply(self, Potentials sums, charges, bint double_precision, int n_threads):
        """Potentials of the targets of the lists with their self terms, for charges of all slots of either sign."""
        image = np.empty(len(charges))
        sums.of(charges, image, double_precision, n_threads)
        return image[sums.lists.slots] + self.self_term * charges[sums.lists.slots]

    def indefinite(self):
        """Message of the error for a self term that is too small."""
        return (
            f"the potentials of equal charges of alternating sign have the wrong sign: self_term must be larger, got "
            f"{self.self_term:.4g} 1/nm"
        )

    def fields_of(self, Octree tree, InteractionLists lists, int n_threads):
        """Compute the field of all other charges at each target."""
        if tree.n_cancelling:   # these cells must not act as a whole
            lists = InteractionLists(tree, lists.opening_angle, n_threads, lists.disturbed)
        if lists.disturbed is None:
            self.field = np.zeros((tree.x.shape[0], 3))
        lists.sweep(self.field, False, n_threads)

    def effective_area(self, Octree tree):
        """Area s per atom [nm^2]: with it, 4 pi q / s and twice the normal field of the others have the same mean.

        The charges are the weights of the mean: with them, the mean field does not depend on the rule (see `Cap`).
        """
        cdef double flux = 0.0, squares = 0.0
        cdef Index i
        for i in range(tree.n_slots):
            squares += tree.q[i] * tree.q[i]
            flux += tree.q[i] * (self.field[i, 0] * self.normals[i, 0] + self.field[i, 1] * self.normals[i, 1]
                                 + self.field[i, 2] * self.normals[i, 2])
        return 2.0 * M_PI * squares / flux

    def residuals(self, positions, normals, charges, chosen):
        """Residuals of the potentials: see `ChargingRule.residuals`.

        Notes
        -----
        With the deviation d = V - phi of an atom and its mean over the four nearest atoms: the difference of the two
        over S times the mean charge, plus the mean over V. A deviation of one atom changes its charge by d / S; one
        that is common to many atoms changes all charges by the fraction d / V.
        """
        cdef const double[:, ::1] atoms = np.ascontiguousarray(positions)
        cdef const double[::1] q = np.ascontiguousarray(charges)
        cdef double[:, ::1] missing = np.empty((len(chosen), 5))
        cdef double[::1] squares = np.empty(len(positions))
        cdef double total
        cdef Index i, j, k, atom
        for i in range(missing.shape[0]):
            self.squared_distances(atoms, chosen[i], squares)
            for j, atom in enumerate(np.argsort(squares, kind="stable")[:5]):
                self.squared_distances(atoms, atom, squares)
                total = self.self_term * q[atom]
                for k in range(q.shape[0]):
                    if squares[k] > SAME_PLACE:
                        total += q[k] / sqrt(squares[k])
                        if squares[k] < self.sums.reach_squared:
                            total += q[k] * self.sums.difference(squares[k])
                missing[i, j] = self.potential - total
        at_atom, near = np.asarray(missing)[:, 0], np.asarray(missing)[:, 1:].mean(axis=1)
        mean = elementary.total(charges) / len(charges)
        return (at_atom - near) / (self.self_term * mean) + near / self.potential

    cdef void squared_distances(self, const double[:, ::1] atoms, Index atom, double[::1] squares) noexcept nogil:
        cdef Index k
        for k in range(atoms.shape[0]):
            squares[k] = ((atoms[k, 0] - atoms[atom, 0]) ** 2 + (atoms[k, 1] - atoms[atom, 1]) ** 2
                          + (atoms[k, 2] - atoms[atom, 2]) ** 2)

    # ---- events ----------------------------------------------------------------------------------------------------

    cdef double strength(self, Octree tree, Index slot) noexcept nogil:
        if self.sees_others:   # twice, as just outside a charged surface
            return 2.0 * (self.field[slot, 0] * self.normals[slot, 0] + self.field[slot, 1] * self.normals[slot, 1]
                          + self.field[slot, 2] * self.normals[slot, 2])
        return tree.q[slot]

    cdef void removed(self, Octree tree, const Hole* hole, Index n_patch) noexcept nogil:
        cdef double dx, dy, dz, s, over
        cdef Index i
        cdef int slot
        for i in range(n_patch):
            slot = hole.slot[i]
            dx, dy, dz = tree.x[slot] - hole.x, tree.y[slot] - hole.y, tree.z[slot] - hole.z
            s = dx * dx + dy * dy + dz * dz
            over = hole.charge / sqrt(s)
            self.value[slot] -= over
            if self.gaussian:
                self.value[slot] -= hole.charge * self.sums.difference(s)
            if self.sees_others:
                over /= s
                self.field[slot, 0] -= over * dx
                self.field[slot, 1] -= over * dy
                self.field[slot, 2] -= over * dz

    cdef int exposed(self, Octree tree, Index slot, double opening_angle) except -1 nogil:
        # The potential of a neighbour plus the difference between the two places, in which the errors of distant cells
        # cancel.
        cdef Index other = self.nearest(tree, slot)
        cdef double dx = 0.0, dy = 0.0, dz = 0.0
        if other >= 0:
            dx, dy, dz = tree.x[other] - tree.x[slot], tree.y[other] - tree.y[slot], tree.z[other] - tree.z[slot]
        tree.collect(tree.x[slot] + 0.5 * dx, tree.y[slot] + 0.5 * dy, tree.z[slot] + 0.5 * dz,
                     0.5 * sqrt(dx * dx + dy * dy + dz * dz), opening_angle, &self.sources)
        self.value[slot] = self.at(tree, slot)
        if other >= 0:
            self.value[slot] += self.value[other] - self.self_term * tree.q[other] - self.at(tree, other)
        if self.sees_others:
            sources_field(&self.sources, tree.x[slot], tree.y[slot], tree.z[slot], &self.field[slot, 0])
        return 0

    cdef Index nearest(self, Octree tree, Index slot) noexcept nogil:
        # The nearest atom in the same leaf; -1 if there is none.
        cdef Index leaf = tree.leaf[slot], k = tree.first[leaf], best = -1
        cdef double s, least = 1e30
        while k >= 0:
            s = (tree.x[k] - tree.x[slot]) ** 2 + (tree.y[k] - tree.y[slot]) ** 2 + (tree.z[k] - tree.z[slot]) ** 2
            if k != slot and tree.atom[k] >= 0 and s < least:
                best, least = k, s
            k = tree.following(leaf, k)
        return best

    cdef double at(self, Octree tree, Index slot) noexcept nogil:
        # Potential of the collected sources at a slot, without its own charge.
        cdef double total = sources_potential(&self.sources, tree.x[slot], tree.y[slot], tree.z[slot])
        if self.gaussian:   # also cells: one so close contains one atom
            total += self.corrections(tree, slot, self.sources.atoms, self.sources.n_atoms)
            total += self.corrections(tree, slot, self.sources.cells, self.sources.n_cells)
        return total

    cdef double corrections(self, Octree tree, Index slot, const double* sources, Index n) noexcept nogil:
        # Differences between Gaussian and point charges at a slot, for sources in columns x y z q.
        cdef Index k, stride = self.sources.capacity
        cdef double total = 0.0, s
        for k in range(n):
            s = ((tree.x[slot] - sources[k]) ** 2 + (tree.y[slot] - sources[stride + k]) ** 2
                 + (tree.z[slot] - sources[2 * stride + k]) ** 2)
            if SAME_PLACE < s < self.sums.reach_squared:
                total += sources[3 * stride + k] * self.sums.difference(s)
        return total

    cdef int solve_patch(self, Octree tree, double[:, ::1] normals, const Hole* hole, Patch* patch) except -1 nogil:
        cdef Index i, near, padded = ring(hole, patch, &near), first = patch.n, stride = patch.stride + padded
        cdef int slot
        if 4 * stride > self.spreads.shape[0]:
            with gil:
                self.spreads = np.empty(8 * stride, np.float32)
        self.patch_charges(tree, normals, patch)

        # in the patch the potentials are known from the residuals, and the fields from the matrix
        for i in range(patch.n):
            self.value[patch.slot[i]] = self.potential - self.residual[i]
        cdef float* field_x = &self.spreads[stride]
        cdef float* field_y = &self.spreads[2 * stride]
        cdef float* field_z = &self.spreads[3 * stride]
        if self.sees_others:
            self.field_in_patch(hole, patch, field_x, field_y, field_z)

        # around the patch
        merge(tree, hole, patch)
        for i in range(first, first + padded):
            self.spreads[i] = field_x[i] = field_y[i] = field_z[i] = 0.0
        self.act_on(hole, first, near, stride, patch.n + 1, patch.x, patch.y, patch.z, patch.change)
        self.act_on(hole, first + near, padded - near, stride, patch.n_merged, patch.merged_x, patch.merged_y,
                    patch.merged_z, patch.merged_change)
        if self.gaussian:
            self.correct_spread(hole, patch)
        for i in range(first, hole.n):
            self.value[hole.slot[i]] += self.spreads[i]
        if self.sees_others:
            for i in range(hole.n):
                slot = hole.slot[i]
                self.field[slot, 0] += field_x[i]
                self.field[slot, 1] += field_y[i]
                self.field[slot, 2] += field_z[i]
        return 0

    cdef void field_in_patch(self, const Hole* hole, const Patch* patch, float* x, float* y, float* z) noexcept nogil:
        if self.gaussian:   # the matrix has the potentials of Gaussian charges, but fields are those of points
            FieldRule.field_in_patch(self, hole, patch, x, y, z)
        else:
            patch_field_of_inverse(patch.n, patch.stride, &self.matrix[0], patch.x, patch.y, patch.z, patch.change, x,
                                   y, z)

    cdef void act_on(self, const Hole* hole, Index first, Index m, Index stride, Index n, const float* x,
                     const float* y, const float* z, const float* change) noexcept nogil:
        # Potentials, and fields if a law sees them, of n changes at m slots around the hole.
        cdef float* at = &self.spreads[first]
        if self.sees_others:
            patch_potential_and_field(m, hole.near_x + first, hole.near_y + first, hole.near_z + first, n, x, y, z,
                                      change, at, at + stride, at + 2 * stride, at + 3 * stride)
        else:
            patch_potential(m, hole.near_x + first, hole.near_y + first, hole.near_z + first, n, x, y, z, change, at)

    cdef void correct_spread(self, const Hole* hole, const Patch* patch) noexcept nogil:
        # Differences between Gaussian and point charges in these potentials.
        cdef Index i, k
        cdef float dx, dy, dz, s, most = <float>self.sums.reach_squared
        for i in range(patch.n, hole.n):
            for k in range(patch.n + 1):
                dx, dy, dz = hole.near_x[i] - patch.x[k], hole.near_y[i] - patch.y[k], hole.near_z[i] - patch.z[k]
                s = dx * dx + dy * dy + dz * dz
                if SAME_PLACE < s < most:
                    self.spreads[i] += patch.change[k] * <float>self.sums.difference(s)

    cdef int grow(self, Index stride) except -1 nogil:
        if stride > self.residual.shape[0]:
            with gil:
                self.matrix = np.zeros(stride * stride, np.float32)
                self.residual, self.direction, self.image = np.zeros((3, stride), np.float32)
                if self.spreads is None:
                    self.spreads = np.zeros(4, np.float32)
        return 0

    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil:
        # Conjugate gradients for the changes: A x = V - potentials of the old charges.
        cdef double mean = 0.0
        cdef float largest = 0.0, square, before, curvature, step, bound, s, most = <float>self.sums.reach_squared
        cdef Index i, k, n = patch.n, stride = patch.stride
        cdef int _iteration
        self.grow(stride)
        cdef float* residual = &self.residual[0]
        cdef float* direction = &self.direction[0]
        cdef float* image = &self.image[0]
        cdef float* row

        # matrix A_ik = u(r_ik), A_ii = S, and residuals V - phi of the old charges; padding has no residual
        for i in range(n):
            mean += tree.q[patch.slot[i]] / n
            row = &self.matrix[i * stride]
            patch_row_potential(stride, patch.x, patch.y, patch.z, patch.x[i], patch.y[i], patch.z[i],
                                <float>self.self_term, row)
            if self.gaussian:
                for k in range(n):
                    s = (patch.x[i] - patch.x[k]) ** 2 + (patch.y[i] - patch.y[k]) ** 2 + (patch.z[i] - patch.z[k]) ** 2
                    if SAME_PLACE < s < most:
                        row[k] += <float>self.sums.difference(s)
            residual[i] = <float>(self.potential - self.value[patch.slot[i]])
            patch.change[i] = 0.0
        for i in range(n, stride):
            residual[i] = 0.0
        for i in range(stride):
            direction[i] = residual[i]

        # conjugate gradients: step along a direction d by r.r / d.A d, next direction r + d (r.r) / (previous r.r)
        bound = <float>(self.tolerance * self.self_term * mean)
        square = patch_dot(stride, residual, residual)
        for _iteration in range(100):
            largest = 0.0
            for i in range(n):
                largest = max(largest, fabsf(residual[i]))
            if largest <= bound:
                break
            patch_product(n, stride, &self.matrix[0], direction, image)   # the matrix is symmetric
            curvature = patch_dot(stride, direction, image)
            if not curvature > 0.0:
                with gil:
                    raise ValueError(self.indefinite())
            step = square / curvature
            for i in range(n):
                patch.change[i] += step * direction[i]
                residual[i] -= step * image[i]
            before = square
            square = patch_dot(stride, residual, residual)
            for i in range(n):
                direction[i] = residual[i] + square / before * direction[i]
            self.n_iterations += 1
        for i in range(n):
            patch.charge[i] = tree.q[patch.slot[i]] + patch.change[i]
        patch.unsettled = largest > bound
        return 0
