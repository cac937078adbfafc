"""Sequence of events: selection of the evaporating atom, and change of the charges around the hole.

An event removes the atom that the chooser selects by the keys of the law, and exposes the atoms below it. The charging
rule then solves a patch around the hole with all other charges fixed: the change decreases with the cube of the
distance. The remaining error is smooth; `relax`, a solution for the whole surface after many events, removes it. The
cost of an event does not depend on the size of the specimen.
"""

from functools import partial

from cython.parallel cimport prange
from libc.math cimport INFINITY, fabs

import numpy as np

from apt_evap._core.control cimport Control
from apt_evap._core.events cimport TARGETS, Event, Events
from apt_evap._core.index cimport Index
from apt_evap._core.interactions cimport InteractionLists
from apt_evap._core.journal cimport Journal
from apt_evap._core.neighbourhood cimport MAX_NEAR
from apt_evap._core.octree cimport Octree


cdef extern from "kernels.h":
    const int GROUP, PATCH_LANES


cdef extern from "random_numbers.h":
    double uniform_number(unsigned long long, unsigned long long, unsigned long long) noexcept nogil


cdef enum:
    NOT_RELAXED = 1 << 30   # number of events since the last relaxation before the first one
    FEW = 16384             # number of surface atoms up to which one thread is faster than several
    INITIAL_CAPACITY = 4096   # slots within the update radius at first; 18 d_nn of fcc contain about 1,000
    STATUS_DONE = 0
    STATUS_SWEEP_DUE = 1
    STATUS_EXHAUSTED = 2
    STATUS_TOO_SHALLOW = 3

FAR_CHANGE = 1.5e-3
"""Largest relative change of the charges far from the holes by relaxations of parts.

Measured (Ni[111], R = 20 a, first events on a perfect surface): 5e-3 leave an error of 1e-3 there, 1.5e-3 one of 3e-4.
"""

DONE, SWEEP_DUE, EXHAUSTED, TOO_SHALLOW = STATUS_DONE, STATUS_SWEEP_DUE, STATUS_EXHAUSTED, STATUS_TOO_SHALLOW


cdef class RelaxationStart:
    """Start values of a relaxation, from which the same charges are recomputed bit by bit.

    Number of events so far, charges of the surface atoms in the order of their indices (n,) [e], atoms without
    neighbours that keep their last normal (m,), these normals (m, 3), and the state of the charging rule (dict of
    arrays).
    """

    cdef readonly Index n_removed
    cdef readonly object charges, isolated, isolated_normals, rule_state

    def __init__(self, Index n_removed, charges, isolated, isolated_normals, rule_state):
        self.n_removed, self.charges, self.rule_state = n_removed, charges, rule_state
        self.isolated, self.isolated_normals = isolated, isolated_normals


cdef class Evaporation:
    """A charged surface whose atoms evaporate one by one.

    Parameters
    ----------
    atoms : Neighbourhood
        The atoms and their surface.
    rule : ChargingRule
        Distribution of the charge over the surface.
    law : LawKernel
        Selects the next atom to evaporate.
    potential : float
        Potential of the specimen divided by the Coulomb constant [e/nm].
    coulomb : float
        Coulomb constant [V nm/e].
    patch_radius, update_radius : float
        Distances from the hole within which charges are solved, and within which fields are updated, after an event
        [nm].
    opening_angle : float
        Opening angle of relaxations, and of fields at newly exposed atoms [rad].
    potential_bound : float
        Relative change of the potential inside the specimen by events, above which it is restored by a common factor of
        all charges, and a relaxation is due. Only for rules that compute it: `Robin`.
    seed : int
        Seed of the random numbers of a stochastic law: the choice of event k depends on (seed, k) only.
    control : Control, optional
        Control of the voltage, for a law with rates; by default the voltage is constant.
    target_stretch : float
        Squared reach of a roll-up over that of a nearest neighbour.
    """

    def __init__(self, Neighbourhood atoms, ChargingRule rule, LawKernel law, double potential, double coulomb,
                 double patch_radius, double update_radius, double opening_angle, double potential_bound,
                 unsigned long long seed=0, Control control=None, double target_stretch=1.0):
        self.atoms, self.rule, self.law = atoms, rule, law
        self.potential, self.coulomb = potential, coulomb
        self.patch_radius, self.update_radius, self.opening_angle = patch_radius, update_radius, opening_angle
        self.n_removed = self.n_clipped = self.n_unsettled = 0
        self.since_relaxation, self.n_partial = NOT_RELAXED, 0
        self.seed, self.target_stretch = seed, target_stretch
        self.control = Control() if control is None else control
        self.potential_bound = potential_bound
        self.has_support = bool(np.asarray(atoms.support).any())
        self.slot_of = np.full(atoms.n_atoms, -1, np.int32)
        self.allocate(INITIAL_CAPACITY)

    cdef void allocate(self, Index capacity):
        # Buffers for this number of slots around a hole, and for the newly exposed atoms.
        self.hole_slot = np.empty(capacity + MAX_NEAR, np.int32)
        self.hole_float = np.empty((3, capacity + MAX_NEAR + GROUP), np.float32)
        self.hole.slot = &self.hole_slot[0]
        self.hole.near_x, self.hole.near_y = &self.hole_float[0, 0], &self.hole_float[1, 0]
        self.hole.near_z = &self.hole_float[2, 0]
        self.patch_slot = np.empty(capacity + MAX_NEAR, np.int32)
        self.patch_charge = np.empty(capacity + MAX_NEAR)
        self.patch_float = np.empty((8, capacity + MAX_NEAR), np.float32)
        self.patch.slot, self.patch.charge = &self.patch_slot[0], &self.patch_charge[0]
        self.patch.x, self.patch.y = &self.patch_float[0, 0], &self.patch_float[1, 0]
        self.patch.z, self.patch.change = &self.patch_float[2, 0], &self.patch_float[3, 0]
        self.patch.merged_x, self.patch.merged_y = &self.patch_float[4, 0], &self.patch_float[5, 0]
        self.patch.merged_z, self.patch.merged_change = &self.patch_float[6, 0], &self.patch_float[7, 0]
        self.ring_slot, self.far_slot = np.empty((2, capacity + MAX_NEAR), np.int32)
        self.strength, self.key = np.empty(capacity + MAX_NEAR), np.empty(capacity + MAX_NEAR)
        self.key_atom, self.key_bonds = np.empty(capacity + MAX_NEAR, np.int64), np.empty(capacity + MAX_NEAR, np.int32)

    def replace_atoms(self, Neighbourhood atoms, LawKernel law):
        """Continue with additional atoms; the first ones are the previous atoms. Call `relax` next."""
        cdef int[::1] slot_of = np.full(atoms.n_atoms, -1, np.int32)
        np.asarray(slot_of)[:self.atoms.n_atoms] = self.slot_of
        self.since_relaxation = NOT_RELAXED
        self.has_support = bool(np.asarray(atoms.support).any())
        self.atoms, self.law, self.slot_of = atoms, law, slot_of

    def relax(self, *, double tolerance=1e-4, int max_sweeps=200, bint double_precision=False, Index extra=0,
              opening_angle=None, int n_threads=1, start=None):
        """Rebuild the tree and solve the charges of the whole surface at its potential.

        Parameters
        ----------
        tolerance : float
            Largest change of a charge in a sweep, relative to the mean charge, at which to stop.
        max_sweeps : int
            Maximum number of sweeps.
        double_precision : bool
            Sums in float64; needed for tolerances below 1e-6.
        extra : int
            Space for atoms exposed before the next relaxation; by default 1/8 of the number of surface atoms.
        opening_angle : float
            Opening angle of the sweeps [rad]; by default that of the events.
        n_threads : int
            Number of threads.
        start : RelaxationStart, optional
            Start values; by default the current surface, or equal charges.

        Returns
        -------
        sweeps : int
            Number of sweeps.
        residual : float
            Largest change of a charge in the last sweep, relative to the mean charge.
        """
        cdef Index n, slot
        cdef int builders
        cdef int[::1] slot_of = np.full(self.atoms.n_atoms, -1, np.int32)
        surface = self.atoms.surface
        if len(surface) == 0:
            raise ValueError("the specimen has no surface atoms")
        builders = n_threads if len(surface) > FEW else 1
        self.since_relaxation = NOT_RELAXED   # after an interruption below no atom can evaporate

        # initial charges: those of the last events, or of another run, or equal ones
        log_rate_at, factor = partial(self.log_rate_at, n_threads=n_threads), self.control.voltage_factor
        if start is None:
            if self.tree is not None:
                factor = self.control.before_relaxation(self.chooser.log_total(), log_rate_at)
            start = self.current_start(surface, builders)
        elif len(start.charges) != len(surface):
            raise ValueError(f"start must have the charges of {len(surface)} surface atoms, got {len(start.charges)}")
        self.start, self.n_removed, self.rule.state = start, start.n_removed, start.rule_state

        # the tree orders the atoms along the Morton curve; from here on, arrays are in the order of its slots
        tree = Octree(self.atoms.positions_of(surface, builders), start.charges, surface,
                      extra=extra or len(surface) // 8 + MAX_NEAR, n_threads=builders)
        surface = tree.atoms
        n, capacity = tree.n_slots, tree.capacity
        normals = np.zeros((capacity, 3))
        normals[:n] = self.atoms.normals_of(surface, builders)
        for slot in prange(n, nogil=True, schedule="static", num_threads=builders):
            slot_of[tree.atom[slot]] = <int>slot
        normals[np.asarray(slot_of)[start.isolated]] = start.isolated_normals

        # charges at the given potential, then the keys of all atoms in the resulting fields
        lists = InteractionLists(tree, self.opening_angle if opening_angle is None else opening_angle, n_threads)
        outcome = self.rule.solve(tree, normals, lists, potential=self.potential, tolerance=tolerance,
                                  max_sweeps=max_sweeps, double_precision=double_precision, n_threads=n_threads)
        self.field_unit = self.rule.field_unit(self.coulomb)
        self.tree, self.normals, self.slot_of = tree, normals, slot_of
        self.disturbed = np.zeros(capacity, np.int8)
        self.update_chooser(factor, log_rate_at, builders)
        self.n_partial, self.n_slots_before, self.atoms.opened = 0, tree.n_slots, False
        return outcome

    def relax_disturbed(self, *, double tolerance=1e-4, int max_sweeps=200, int n_threads=1):
        """Solve the charges of the atoms near the holes since the last relaxation, in the same tree.

        These are the atoms within `update_radius` of a hole. The charges further away are fixed, or follow samples: see
        `samples` of the rule. Parameters and results are those of `relax`.

        Raises
        ------
        ValueError
            If the whole surface must be relaxed: see `whole_is_due`.
        """
        cdef int builders
        if self.whole_is_due:
            raise ValueError("relax_disturbed needs a rule that solves parts, and a tree with space: call relax")
        builders = n_threads if self.tree.n_slots > FEW else 1
        self.since_relaxation = NOT_RELAXED   # after an interruption below no atom can evaporate
        log_rate_at = partial(self.log_rate_at, n_threads=n_threads)
        factor = self.control.before_relaxation(self.chooser.log_total(), log_rate_at)
        lists = InteractionLists(self.tree, self.opening_angle, n_threads, self.disturbed, self.rule.samples)
        outcome = self.rule.solve(self.tree, self.normals, lists, potential=self.potential, tolerance=tolerance,
                                  max_sweeps=max_sweeps, n_threads=n_threads)
        self.disturbed[:] = 0
        self.update_chooser(factor, log_rate_at, builders)
        self.n_partial += 1
        self.n_slots_before = self.tree.n_slots
        return outcome

    @property
    def whole_is_due(self):
        """Whether `relax` must be called: for a new surface, an opened void, a full tree, or a rule in Python.

        Or for a change far from the holes above `FAR_CHANGE`, which samples do not follow well enough. A tree is full
        if its space is below twice the number of atoms that were exposed since the last relaxation.
        """
        if self.since_relaxation >= NOT_RELAXED or self.atoms.opened or self.rule.samples is None:
            return True
        if self.rule.far_change > FAR_CHANGE:
            return True
        exposed = self.tree.n_slots - self.n_slots_before
        return self.tree.n_slots + 2 * exposed + MAX_NEAR > self.tree.capacity

    def remove(self, const Index[::1] atoms):
        """Remove atoms as if they had evaporated, without charges; call `relax` next."""
        self.atoms.remove_atoms(atoms)
        self.n_removed += atoms.shape[0]
        self.since_relaxation = NOT_RELAXED

    cdef update_chooser(self, double factor, log_rate_at, int n_threads):
        # New chooser after a relaxation, for a voltage over that of the charges, which the control may change.
        self.control.voltage_factor, self.control.rise = factor, 0.0
        self.chooser = self.new_chooser(factor, n_threads)
        self.control.voltage_factor = self.control.after_relaxation(log_rate_at)
        if self.control.voltage_factor != factor:
            self.chooser = self.new_chooser(self.control.voltage_factor, n_threads)
        self.since_relaxation, self.was_scaled = 0, False

    def log_rate_at(self, double voltage_factor, int n_threads=1):
        """Natural logarithm of the sum of all rates [1/s] for a voltage over that of the charges; the keys are kept.

        -inf for a law without rates.
        """
        cdef double total = self.new_chooser(voltage_factor, n_threads).log_total()
        self.law.begin(self.field_unit * self.control.voltage_factor)
        return total

    cdef Chooser new_chooser(self, double voltage_factor, int n_threads):
        # The chooser for recomputed keys of all slots, for a voltage over that of the charges.
        cdef Index n = self.tree.n_slots, slot
        cdef int[::1] bonds = np.zeros(n, np.int32)
        cdef Index[::1] atom = np.maximum(self.tree.atoms[:n], 0)   # empty slots get a key, which is removed below
        cdef double[::1] key = np.full(self.tree.capacity, -INFINITY), strength = self.rule.strengths(self.tree)
        for slot in prange(n, nogil=True, schedule="static", num_threads=n_threads):
            bonds[slot] = self.surroundings(atom[slot])
        self.law.begin(self.field_unit * voltage_factor)
        self.law.keys(n, &strength[0], &atom[0], &bonds[0], &key[0])
        if self.law.hop_bonds >= 0:
            for slot in prange(n, nogil=True, schedule="static", num_threads=n_threads):
                key[slot] = self.hopping(key[slot], strength[slot], atom[slot])
        for slot in range(n):
            if self.tree.atom[slot] < 0:
                key[slot] = -INFINITY
        return self.law.chooser(self.tree, key)

    def current_start(self, const Index[::1] surface, int n_threads=1):
        """Start values of a relaxation of the current surface; equal charges if it has none yet."""
        cdef double[::1] charges = np.ones(len(surface))
        cdef char[::1] alone = np.zeros(len(surface), np.int8)
        cdef Index i, slot
        isolated, normals = np.empty(0, np.int64), np.empty((0, 3))
        if self.tree is not None:
            for i in prange(surface.shape[0], nogil=True, schedule="static", num_threads=n_threads):
                slot = self.slot_of[surface[i]]
                charges[i] = self.tree.q[slot] if slot >= 0 else 0.0
                alone[i] = slot >= 0 and self.atoms.count[surface[i]] == 0
            isolated = np.asarray(surface)[np.asarray(alone).view(bool)]
            normals = np.asarray(self.normals)[np.asarray(self.slot_of)[isolated]]
        return RelaxationStart(self.n_removed, np.asarray(charges), isolated, normals, self.rule.state)

    # ---- one event -------------------------------------------------------------------------------------------------

    cdef void strongest_neighbours(self, Index atom, double stretch, Index* neighbour,
                                   double* charge) noexcept nogil:
        # The TARGETS surface neighbours of an atom with the highest charges, in descending order; -1 if there are
        # fewer. Nearest neighbours, and with a stretch above 1 also those of the second shell.
        cdef int[MAX_NEAR] others
        cdef int n, i, k, m
        cdef Index other
        cdef double q
        for k in range(TARGETS):
            neighbour[k] = -1
            charge[k] = 0.0
        n = self.atoms.near(atom, others)
        for i in range(n):
            other = others[i]
            if self.slot_of[other] < 0 or not self.atoms.bonded(atom, other, stretch):
                continue
            q = self.tree.q[self.slot_of[other]]
            for k in range(TARGETS):
                if neighbour[k] < 0 or q > charge[k] or (q == charge[k] and other < neighbour[k]):
                    for m in range(TARGETS - 1, k, -1):
                        neighbour[m], charge[m] = neighbour[m - 1], charge[m - 1]
                    neighbour[k], charge[k] = other, q
                    break

    cdef void add_to_patch(self, int slot, double dx, double dy, double dz) noexcept nogil:
        # Add a slot at (dx, dy, dz) from the hole to the patch. Its normal may have changed if the hole was a
        # neighbour.
        cdef Index n = self.patch.n
        cdef double reach = 1.001 * self.atoms.radius
        self.patch.slot[n] = slot
        self.patch.x[n], self.patch.y[n], self.patch.z[n] = <float>dx, <float>dy, <float>dz
        if dx * dx + dy * dy + dz * dz <= reach * reach or slot >= self.n_slots_before:
            self.atoms.normal(self.tree.atom[slot], &self.normals[slot, 0])
        self.patch.n = n + 1

    cdef void sort_near_first(self, Hole* hole) noexcept nogil:
        # Order the slots around a hole: first those of the patch, then the other near ones.
        cdef double near = self.rule.near * self.patch_radius, dx, dy, dz, s
        cdef Index i, n_ring = 0, n_far = 0
        cdef int slot
        for i in range(hole.n):
            slot = hole.slot[i]
            dx, dy, dz = self.tree.x[slot] - hole.x, self.tree.y[slot] - hole.y, self.tree.z[slot] - hole.z
            s = dx * dx + dy * dy + dz * dz
            if s <= self.patch_radius * self.patch_radius:
                self.add_to_patch(slot, dx, dy, dz)
            elif s <= near * near:
                self.ring_slot[n_ring] = slot
                n_ring += 1
            else:
                self.far_slot[n_far] = slot
                n_far += 1
        hole.n_near = self.patch.n + n_ring
        for i in range(self.patch.n):
            hole.slot[i] = self.patch.slot[i]
            hole.near_x[i], hole.near_y[i], hole.near_z[i] = self.patch.x[i], self.patch.y[i], self.patch.z[i]
        for i in range(n_ring):
            self.put_around(hole, self.patch.n + i, self.ring_slot[i])
        for i in range(n_far):
            self.put_around(hole, hole.n_near + i, self.far_slot[i])

    cdef void put_around(self, Hole* hole, Index i, int slot) noexcept nogil:
        hole.slot[i] = slot
        hole.near_x[i] = <float>(self.tree.x[slot] - hole.x)
        hole.near_y[i] = <float>(self.tree.y[slot] - hole.y)
        hole.near_z[i] = <float>(self.tree.z[slot] - hole.z)

    cdef int surroundings(self, Index atom) noexcept nogil:
        # Bonds of an atom for the law: their number, or their code.
        return self.atoms.bond_code[atom] if self.atoms.has_codes else self.atoms.bonds[atom]

    cdef double hopping(self, double key, double strength, Index atom) noexcept nogil:
        # Key of an atom that may hop onto its strongest nearest neighbour, from its key without hops.
        cdef Index[TARGETS] neighbour
        cdef double[TARGETS] charge
        cdef int slot = self.slot_of[atom]
        if slot < 0 or self.atoms.bonds[atom] > self.law.hop_bonds or not self.tree.q[slot] > 0.0:
            return key
        self.strongest_neighbours(atom, 1.0, neighbour, charge)   # for which phi was solved, whatever rolls
        return self.law.hopping(key, strength, charge[0] / self.tree.q[slot])

    cdef int update_keys(self, const int* slots, Index n) except -1 nogil:
        # New keys of slots whose fields or bonds have changed.
        cdef Index i
        if n == 0:
            return 0
        for i in range(n):
            self.strength[i] = self.rule.strength(self.tree, slots[i])
            self.key_atom[i] = self.tree.atom[slots[i]]
            self.key_bonds[i] = self.surroundings(self.key_atom[i])
        self.law.keys(n, &self.strength[0], &self.key_atom[0], &self.key_bonds[0], &self.key[0])
        if self.law.hop_bonds >= 0:
            for i in range(n):
                self.key[i] = self.hopping(self.key[i], self.strength[i], self.key_atom[i])
        for i in range(n):
            self.chooser.key[slots[i]] = self.key[i]
        self.chooser.update(slots, n)
        return 0

    cdef int event(self, Index atom, Journal journal) except -1 nogil:
        cdef int[MAX_NEAR] fresh
        cdef int removed_slot = self.slot_of[atom], n_fresh
        cdef Hole* hole = &self.hole
        cdef Patch* patch = &self.patch
        cdef Index capacity, i, at

        # remove the atom from the tree, the chooser and the neighbourhoods; the removal exposes the atoms `fresh`
        hole.x, hole.y = self.atoms.positions[atom, 0], self.atoms.positions[atom, 1]
        hole.z = self.atoms.positions[atom, 2]
        hole.charge = self.tree.q[removed_slot]
        self.n_removed += 1
        self.since_relaxation += 1
        self.tree.remove_atom(removed_slot)
        self.slot_of[atom] = -1
        self.chooser.key[removed_slot] = -INFINITY
        self.chooser.update(&removed_slot, 1)
        n_fresh = self.atoms.remove(atom, fresh)
        if n_fresh > 0:   # for the fields at these
            self.tree.refresh()

        # the slots around the hole; subtract the evaporated charge from the fields of the patch, add the exposed atoms
        capacity = self.hole_slot.shape[0] - MAX_NEAR - PATCH_LANES
        hole.n = self.tree.within(hole.x, hole.y, hole.z, self.update_radius, hole.slot, capacity)
        if hole.n > capacity:
            with gil:
                self.allocate(2 * hole.n + PATCH_LANES)
            hole.n = self.tree.within(hole.x, hole.y, hole.z, self.update_radius, hole.slot, hole.n)
        patch.n = patch.n_clipped = 0
        patch.unsettled = False
        self.sort_near_first(hole)
        self.rule.removed(self.tree, hole, patch.n)
        self.expose(fresh, n_fresh, removed_slot, journal)

        # solve the charges of the patch with all others fixed, and add the changes, also that by the evaporated charge,
        # to the fields around it; padding is far away and has no charge
        patch.stride = (patch.n + PATCH_LANES - 1) // PATCH_LANES * PATCH_LANES
        for i in range(patch.n, patch.stride):
            patch.x[i] = patch.y[i] = patch.z[i] = 1e6
            patch.change[i] = 0.0
        for i in range(hole.n):
            self.disturbed[hole.slot[i]] = 1
        for i in range(hole.n, hole.n + GROUP):
            hole.near_x[i] = hole.near_y[i] = hole.near_z[i] = 1e6
        if patch.n:
            self.rule.solve_patch(self.tree, self.normals, hole, patch)
        else:
            self.rule.removed(self.tree, hole, hole.n)
        self.n_clipped += patch.n_clipped
        self.n_unsettled += patch.unsettled

        # record the changes for the flights, and set the new charges
        at = journal.start[journal.n_events]
        journal.slot[at] = removed_slot
        journal.charge[at] = 0.0
        journal.start[journal.n_events + 1] = at + 1 + patch.n
        for i in range(patch.n):
            journal.slot[at + 1 + i] = patch.slot[i]
            journal.charge[at + 1 + i] = patch.charge[i]
            self.tree.set_charge(patch.slot[i], patch.charge[i])

        # if the potential inside has changed too much, restore it; otherwise only the keys near the hole have changed
        if fabs(self.rule.drift) > self.potential_bound:
            self.scale(journal)
        else:
            self.tree.refresh()
            self.update_keys(patch.slot, patch.n)
        journal.n_events += 1
        return 0

    cdef int scale(self, Journal journal) except -1 nogil:
        # Multiply all charges by the factor 1 / (1 + drift), which restores the potential inside. These are then the
        # changes by the event.
        cdef double factor = 1.0 / (1.0 + self.rule.drift)
        cdef Index slot, at = journal.start[journal.n_events] + 1
        journal.reserve(self.tree.n_slots + 1, 0)
        for slot in range(self.tree.n_slots):
            if self.tree.atom[slot] >= 0:
                self.tree.set_charge(slot, factor * self.tree.q[slot])
                journal.slot[at] = <int>slot
                journal.charge[at] = self.tree.q[slot]
                at += 1
        journal.start[journal.n_events + 1] = at
        self.tree.refresh()
        self.rule.scaled(self.tree, factor)
        self.was_scaled = True
        with gil:
            self.chooser = self.new_chooser(self.control.voltage_factor, 1)
        return 0

    cdef int expose(self, const int* fresh, int n_fresh, int removed_slot, Journal journal) except -1 nogil:
        # Add the exposed atoms to the leaf of their nearest slot, without charge.
        cdef double px, py, pz, s, nearest
        cdef Hole* hole = &self.hole
        cdef int slot, best
        cdef Index i, k, at
        journal.reserve(self.patch.n + n_fresh + 1, n_fresh)
        journal.fresh_start[journal.n_events + 1] = journal.fresh_start[journal.n_events] + n_fresh
        for k in range(n_fresh):
            px, py = self.atoms.positions[fresh[k], 0], self.atoms.positions[fresh[k], 1]
            pz = self.atoms.positions[fresh[k], 2]
            nearest = 1e30
            best = removed_slot
            for i in range(self.patch.n):
                slot = self.patch.slot[i]
                s = (self.tree.x[slot] - px) ** 2 + (self.tree.y[slot] - py) ** 2 + (self.tree.z[slot] - pz) ** 2
                if s < nearest:
                    nearest = s
                    best = slot
            at = journal.fresh_start[journal.n_events] + k
            journal.fresh_atom[at] = fresh[k]
            journal.fresh_leaf[at] = self.tree.leaf[best]
            slot = <int>self.tree.insert_atom(fresh[k], px, py, pz, self.tree.leaf[best])
            self.slot_of[fresh[k]] = slot
            self.rule.exposed(self.tree, slot, self.opening_angle)
            # the first of the distant slots becomes the last one, and the first one around the patch the last near one
            if hole.n_near < hole.n:
                self.put_around(hole, hole.n, hole.slot[hole.n_near])
            if self.patch.n < hole.n_near:
                self.put_around(hole, hole.n_near, hole.slot[self.patch.n])
            self.put_around(hole, self.patch.n, slot)
            hole.n, hole.n_near = hole.n + 1, hole.n_near + 1
            self.add_to_patch(slot, px - hole.x, py - hole.y, pz - hole.z)
        return 0

    def evaporate(self, Events events, Index sweep_interval):
        """Evaporate atoms until the table of events is full.

        Stops early if a relaxation or an extension of the shell is needed, or no atom is left. Atoms that have lost all
        chains of bonds to the body leave at once, before the law selects the next atom.

        Parameters
        ----------
        events : Events
            Table to fill.
        sweep_interval : int
            Events after which a relaxation is due.

        Returns
        -------
        int
            DONE; SWEEP_DUE (call `relax`); EXHAUSTED (no atom can evaporate); TOO_SHALLOW (the next event would reach
            support atoms).
        """
        cdef Journal journal = events.journal
        cdef Event* event
        cdef Index leaving
        cdef int status = STATUS_DONE, best, axis
        cdef double u = 0.5
        cdef bint drawn
        with nogil:
            while journal.n_events < events.rows.shape[0]:
                event = &events.rows[journal.n_events]
                leaving = self.atoms.next_detached(&self.slot_of[0]) if self.atoms.n_waiting else -1
                if self.chooser.draws:
                    u = uniform_number(self.seed, self.n_removed, 0)
                best = self.slot_of[leaving] if leaving >= 0 else self.chooser.choose(u)
                if self.since_relaxation < NOT_RELAXED and best < 0:
                    status = STATUS_EXHAUSTED
                    break
                if (self.since_relaxation >= sweep_interval or self.was_scaled or self.atoms.opened
                        or self.tree.n_slots + MAX_NEAR > self.tree.x.shape[0]):
                    status = STATUS_SWEEP_DUE
                    break
                drawn = self.chooser.draws and leaving < 0
                leaving = self.tree.atom[best]
                event.detached = self.atoms.detached[leaving]
                if self.has_support and self.atoms.reaches_support(leaving):
                    status = STATUS_TOO_SHALLOW
                    break
                event.waits = 0.0
                if drawn:
                    event.waits = self.control.wait(uniform_number(self.seed, self.n_removed, 1),
                                                    self.chooser.log_total())
                event.rises = self.control.rise
                if drawn:
                    self.control.evaporated()
                event.site = leaving
                event.charges = self.tree.q[best]
                event.fields = self.field_unit * self.rule.strength(self.tree, best)
                for axis in range(3):
                    event.normals[axis] = self.normals[best, axis]
                self.strongest_neighbours(leaving, self.target_stretch, event.targets, event.target_charges)
                self.event(leaving, journal)
        return status

    @property
    def next_slot(self):
        """Slot of the next atom to evaporate (int); -1 if none can evaporate."""
        return self.chooser.choose(uniform_number(self.seed, self.n_removed, 0) if self.chooser.draws else 0.5)

    @property
    def slots(self):
        """Slots that contain an atom, shape (n,)."""
        return np.flatnonzero(self.tree.atoms >= 0)

    @property
    def slot_normals(self):
        """Outward unit normals by slot, shape (capacity, 3)."""
        return np.asarray(self.normals)

    @property
    def slot_fields(self):
        """Field just outside each slot [V/nm], shape (n_slots,)."""
        return self.field_unit * self.rule.strengths(self.tree)
