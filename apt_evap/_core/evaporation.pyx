"""Events: which atom leaves, and what its leaving does to the charges around the hole.

An event takes the atom with the largest field over evaporation field, exposes what lay under it, and solves the charges
of a patch around the hole while all others are held: the change falls off as the cube of the distance. What is left
over is smooth, and `relax` (a sweep over the whole surface every so many events) carries it. The cost of an event does
not depend on the size of the specimen.
"""

from cython.parallel cimport prange
from libc.math cimport sqrt

import numpy as np

from apt_evap._core.journal cimport Journal
from apt_evap._core.octree cimport Octree
from apt_evap._core.robin cimport Patch
from apt_evap._core.sources cimport Sources, sources_field, sources_free, sources_init
from apt_evap._core.neighbourhood cimport MOST_NEAR
from apt_evap._core.interactions cimport InteractionLists
from apt_evap._core.chooser cimport Tournament


cdef extern from "kernels.h":
    const int GROUP, PATCH_LANES
    void patch_field(long, const float*, const float*, const float*, long, const float*, const float*, const float*,
                     const float*, float*, float*, float*) noexcept nogil


cdef enum:
    NOT_SETTLED = 1 << 30   # events since the last relaxation, while there is none
    FEW = 16384             # surface atoms up to which one thread builds: others cost more than they save
    MOST_PATCH = 4096       # slots at first within the update radius; 18 d_nn of fcc hold some 1,000
    STATUS_DONE = 0
    STATUS_SWEEP_DUE = 1
    STATUS_EXHAUSTED = 2
    STATUS_TOO_SHALLOW = 3

DONE, SWEEP_DUE, EXHAUSTED, TOO_SHALLOW = STATUS_DONE, STATUS_SWEEP_DUE, STATUS_EXHAUSTED, STATUS_TOO_SHALLOW


cdef class Start:
    """What a relaxation starts from; with the atoms that are left it makes the same charges again, bit by bit.

    Events so far, charges of the surface atoms in the order of their numbers (n,) [e], atoms that keep the normal they
    had since no neighbour pulls (m,), these normals (m, 3), and the point that has the potential (1, 3) [nm].
    """

    cdef readonly long n_removed
    cdef readonly object charges, lonely, lonely_normals, potential_point

    def __init__(self, long n_removed, charges, lonely, lonely_normals, potential_point):
        self.n_removed, self.charges, self.potential_point = n_removed, charges, potential_point
        self.lonely, self.lonely_normals = lonely, lonely_normals


cdef class Evaporation:
    """A charged surface from which atoms leave one by one.

    Parameters
    ----------
    atoms : Neighbourhood
        The atoms and their surface.
    rule : ChargingRule
        How charge settles.
    weights : ndarray, shape (n,)
        One over the evaporation field of each atom [nm/V]; 0 for atoms that may not leave.
    potential : float
        Potential of the specimen, over the Coulomb constant [e/nm].
    potential_point : ndarray, shape (3,)
        Point inside the specimen that has this potential [nm]; it moves down the axis as the surface comes close.
    bond_length : float
        Atoms closer than this are nearest neighbours [nm].
    patch_radius, update_radius : float
        Within the first the charges are solved after an event, within the second the fields are kept up to date [nm].
    opening_angle : float
        Of sweeps and of fields on newly exposed atoms [rad].
    """

    def __init__(self, Neighbourhood atoms, ChargingRule rule, const double[::1] weights, double potential,
                 potential_point, double bond_length, double patch_radius, double update_radius,
                 double opening_angle):
        self.atoms, self.rule = atoms, rule
        self.weight = np.array(weights)
        self.potential, self.bond_length = potential, bond_length
        self.patch_radius, self.update_radius, self.opening_angle = patch_radius, update_radius, opening_angle
        self.potential_point = np.array(potential_point, dtype=np.float64).reshape(1, 3)
        self.n_removed = self.n_clipped = self.n_unsettled = 0
        self.since_sweep = NOT_SETTLED
        self.clearance = 0.0
        self.has_support = bool(np.asarray(atoms.support).any())
        self.slot_of = np.full(atoms.n_atoms, -1, np.int32)
        self.make_room(MOST_PATCH)

    cdef void make_room(self, long most):
        # Buffers for so many slots around a hole, and the atoms that come to the surface.
        self.near = np.empty(most + MOST_NEAR, np.int32)
        self.near_float = np.empty((6, most + MOST_NEAR + GROUP), np.float32)
        self.patch_slot = np.empty(most + MOST_NEAR, np.int32)
        self.patch_charge = np.empty(most + MOST_NEAR)
        self.patch_float = np.empty((4, most + MOST_NEAR), np.float32)
        self.patch.slot, self.patch.charge = &self.patch_slot[0], &self.patch_charge[0]
        self.patch.x, self.patch.y = &self.patch_float[0, 0], &self.patch_float[1, 0]
        self.patch.z, self.patch.change = &self.patch_float[2, 0], &self.patch_float[3, 0]

    def take_over(self, Neighbourhood atoms, const double[::1] weights):
        """Go on with more atoms: the first of them are those held so far. Call `relax` next."""
        cdef int[::1] slot_of = np.full(atoms.n_atoms, -1, np.int32)
        np.asarray(slot_of)[:self.atoms.n_atoms] = self.slot_of
        self.since_sweep = NOT_SETTLED
        self.has_support = bool(np.asarray(atoms.support).any())
        self.atoms, self.weight, self.slot_of = atoms, np.array(weights), slot_of

    def relax(self, *, double tolerance=1e-4, int most_sweeps=200, bint double_precision=False, long extra=0,
              double opening_angle=0.0, int n_threads=1, start=None):
        """Build the tree anew and iterate over the whole surface; bring the potential to the voltage.

        Parameters
        ----------
        tolerance : float
            Largest change of a charge in a sweep, relative to the mean charge, at which to stop.
        most_sweeps : int
            Sweeps after which to stop in any case.
        double_precision : bool
            Sweeps in float64; needed for tolerances below 1e-6.
        extra : int
            Room for atoms that come to the surface before the next relaxation; by default an eighth of the surface.
        opening_angle : float
            Of the sweeps [rad]; by default that of the events.
        n_threads : int
            Threads.
        start : Start, optional
            What to start from; by default the surface as it is, or equal charges.

        Returns
        -------
        sweeps : int
            Sweeps done.
        residual : float
            Largest change of a charge in the last one, relative to the mean charge.
        """
        cdef long n, slot
        cdef int builders
        cdef int[::1] slot_of = np.full(self.atoms.n_atoms, -1, np.int32)
        cdef double[::1] rank
        surface = self.atoms.surface
        if len(surface) == 0:
            raise ValueError("the specimen has no surface atoms")
        builders = n_threads if len(surface) > FEW else 1
        self.since_sweep = NOT_SETTLED   # an interruption below leaves a surface that no atom may leave
        if start is None:
            start = self.start_here(surface, builders)
        elif len(start.charges) != len(surface):
            raise ValueError(f"start must have the charges of {len(surface)} surface atoms, got {len(start.charges)}")
        self.start, self.n_removed, self.potential_point = start, start.n_removed, start.potential_point
        tree = Octree(self.atoms.positions_of(surface, builders), start.charges, surface,
                      extra=extra or len(surface) // 8 + MOST_NEAR, n_threads=builders)
        surface = tree.atoms   # in the order of the slots from here on
        n, capacity = tree.n_slots, tree.capacity
        normals = np.zeros((capacity, 3))
        normals[:n] = self.atoms.normals_of(surface, builders)
        for slot in prange(n, nogil=True, schedule="static", num_threads=builders):
            slot_of[tree.atom[slot]] = <int>slot
        normals[np.asarray(slot_of)[start.lonely]] = start.lonely_normals
        lists = InteractionLists(tree, opening_angle or self.opening_angle, n_threads)
        outcome = self.rule.solve(tree, normals, lists, tolerance=tolerance, most_sweeps=most_sweeps,
                                  double_precision=double_precision, n_threads=n_threads)
        self.rule.scale(tree, self.potential / (tree.charges / self.keep_inside(tree)).sum())
        rank = np.full(capacity, -1.0)
        for slot in prange(n, nogil=True, schedule="static", num_threads=builders):
            rank[slot] = tree.q[slot] * self.weight[tree.atom[slot]]
        self.tree, self.normals, self.slot_of, self.tournament = tree, normals, slot_of, Tournament(tree, rank)
        self.since_sweep = 0
        return outcome

    def start_here(self, const long long[::1] surface, int n_threads=1):
        """What a relaxation of the surface as it is starts from; equal charges if it has none yet."""
        cdef double[::1] charges = np.ones(len(surface))
        cdef char[::1] alone = np.zeros(len(surface), np.int8)
        cdef long i, slot
        lonely, normals = np.empty(0, np.int64), np.empty((0, 3))
        if self.tree is not None:
            for i in prange(surface.shape[0], nogil=True, schedule="static", num_threads=n_threads):
                slot = self.slot_of[surface[i]]
                charges[i] = self.tree.q[slot] if slot >= 0 else 0.0
                alone[i] = slot >= 0 and self.atoms.count[surface[i]] == 0
            lonely = np.asarray(surface)[np.asarray(alone).view(bool)]
            normals = np.asarray(self.normals)[np.asarray(self.slot_of)[lonely]]
        return Start(self.n_removed, np.asarray(charges), lonely, normals, self.potential_point)

    def keep_inside(self, Octree tree):
        """Distances of the surface from the point of the potential; it goes down as evaporation comes close to it."""
        away = self.distances(tree)
        if self.clearance == 0.0:
            self.clearance = away.min()
        for _ in range(100):
            if away.min() >= 0.5 * self.clearance:
                break
            self.potential_point = self.potential_point - (0.0, 0.0, 0.25 * self.clearance)
            away = self.distances(tree)
        return np.maximum(away, 1e-3 * self.clearance)

    def distances(self, Octree tree):
        """Distances of the surface from the point of the potential [nm]."""
        columns = np.asarray(tree.x), np.asarray(tree.y), np.asarray(tree.z)
        return np.sqrt(sum((column[:tree.n_slots] - at) ** 2 for column, at in zip(columns, self.potential_point[0])))

    # ---- one event -------------------------------------------------------------------------------------------------

    cdef long strongest_neighbour(self, long atom) noexcept nogil:
        # The surface nearest neighbour with the highest charge; -1: there is none.
        cdef int[MOST_NEAR] others
        cdef int n = self.atoms.near(atom, others), i
        cdef long best = -1, other
        cdef double dx, dy, dz
        for i in range(n):
            other = others[i]
            dx = self.atoms.positions[other, 0] - self.atoms.positions[atom, 0]
            dy = self.atoms.positions[other, 1] - self.atoms.positions[atom, 1]
            dz = self.atoms.positions[other, 2] - self.atoms.positions[atom, 2]
            if self.slot_of[other] < 0 or dx * dx + dy * dy + dz * dz > self.bond_length * self.bond_length:
                continue
            if best < 0 or self.tree.q[self.slot_of[other]] > self.tree.q[self.slot_of[best]] or (
                    self.tree.q[self.slot_of[other]] == self.tree.q[self.slot_of[best]] and other < best):
                best = other
        return best

    cdef void join(self, int slot, double dx, double dy, double dz) noexcept nogil:
        # One more slot in the patch, at (dx, dy, dz) from the hole; its normal may have changed.
        cdef long n = self.patch.n
        self.patch.slot[n] = slot
        self.patch.x[n], self.patch.y[n], self.patch.z[n] = <float>dx, <float>dy, <float>dz
        self.atoms.normal(self.tree.atom[slot], &self.normals[slot, 0])
        self.patch.n = n + 1

    cdef int event(self, long atom, Journal journal) except -1 nogil:
        cdef Sources sources
        cdef int[MOST_NEAR] fresh
        cdef int gone = self.slot_of[atom], n_fresh, slot, best
        cdef double px = self.atoms.positions[atom, 0], py = self.atoms.positions[atom, 1]
        cdef double pz = self.atoms.positions[atom, 2], charge = self.tree.q[gone], s, nearest
        cdef double dx, dy, dz, over
        cdef Patch* patch = &self.patch
        cdef float *near_x, *near_y, *near_z, *field_x, *field_y, *field_z
        cdef long n_near, most, i, k, at
        self.n_removed += 1
        self.since_sweep += 1
        self.tree.take_out(gone)
        self.tree.refresh()
        self.slot_of[atom] = -1
        self.tournament.rank[gone] = -1.0
        self.tournament.settle(&gone, 1)
        n_fresh = self.atoms.remove(atom, fresh)

        # the slots around the hole, without the charge that left
        most = self.near.shape[0] - MOST_NEAR - PATCH_LANES
        n_near = self.tree.within(px, py, pz, self.update_radius, &self.near[0], most)
        if n_near > most:
            with gil:
                self.make_room(2 * n_near + PATCH_LANES)
            n_near = self.tree.within(px, py, pz, self.update_radius, &self.near[0], n_near)
        near_x, near_y, near_z = &self.near_float[0, 0], &self.near_float[1, 0], &self.near_float[2, 0]
        field_x, field_y, field_z = &self.near_float[3, 0], &self.near_float[4, 0], &self.near_float[5, 0]
        patch.n = 0
        for i in range(n_near):
            slot = self.near[i]
            dx, dy, dz = self.tree.x[slot] - px, self.tree.y[slot] - py, self.tree.z[slot] - pz
            s = dx * dx + dy * dy + dz * dz
            over = charge / (s * sqrt(s)) if s > 1e-12 else 0.0
            self.rule.field[slot, 0] -= over * dx
            self.rule.field[slot, 1] -= over * dy
            self.rule.field[slot, 2] -= over * dz
            near_x[i], near_y[i], near_z[i] = <float>dx, <float>dy, <float>dz
            if s <= self.patch_radius * self.patch_radius:
                self.join(slot, dx, dy, dz)

        # the atoms that came to the surface join the leaf of the slot nearest to them, without charge at first
        journal.room(patch.n + n_fresh + 1, n_fresh)
        journal.fresh_start[journal.n_events + 1] = journal.fresh_start[journal.n_events] + n_fresh
        if n_fresh:
            sources_init(&sources)
        for k in range(n_fresh):
            dx, dy = self.atoms.positions[fresh[k], 0], self.atoms.positions[fresh[k], 1]
            dz = self.atoms.positions[fresh[k], 2]
            nearest = 1e30
            best = gone
            for i in range(patch.n):
                slot = patch.slot[i]
                s = (self.tree.x[slot] - dx) ** 2 + (self.tree.y[slot] - dy) ** 2 + (self.tree.z[slot] - dz) ** 2
                if s < nearest:
                    nearest = s
                    best = slot
            at = journal.fresh_start[journal.n_events] + k
            journal.fresh_atom[at] = fresh[k]
            journal.fresh_leaf[at] = self.tree.leaf[best]
            slot = <int>self.tree.put_in(fresh[k], dx, dy, dz, self.tree.leaf[best])
            self.slot_of[fresh[k]] = slot
            self.tree.collect(dx, dy, dz, 0.0, self.opening_angle, &sources)
            sources_field(&sources, dx, dy, dz, &self.rule.field[slot, 0])
            self.near[n_near] = slot
            near_x[n_near], near_y[n_near], near_z[n_near] = <float>(dx - px), <float>(dy - py), <float>(dz - pz)
            n_near += 1
            self.join(slot, dx - px, dy - py, dz - pz)
        if n_fresh:
            sources_free(&sources)

        # new charges of the patch, and what they change in the fields around it
        at = journal.start[journal.n_events]
        journal.slot[at] = gone
        journal.charge[at] = 0.0
        journal.start[journal.n_events + 1] = at + 1 + patch.n
        patch.stride = (patch.n + PATCH_LANES - 1) // PATCH_LANES * PATCH_LANES
        for i in range(patch.n, patch.stride):
            patch.x[i] = patch.y[i] = patch.z[i] = 1e6
            patch.change[i] = 0.0
        if patch.n and self.rule.solve_patch(self.tree, self.normals, patch) > 0:
            self.n_unsettled += 1
        for i in range(patch.n):
            slot = patch.slot[i]
            if patch.charge[i] < 0.0:   # a cell's moments stand on its centre of charge: none may be negative
                patch.change[i] = <float>-self.tree.q[slot]
                patch.charge[i] = 0.0
                self.n_clipped += 1
            journal.slot[at + 1 + i] = slot
            journal.charge[at + 1 + i] = patch.charge[i]
            self.tree.set_charge(slot, patch.charge[i])
            self.tournament.rank[slot] = patch.charge[i] * self.weight[self.tree.atom[slot]]
        self.tournament.settle(patch.slot, patch.n)
        most = (n_near + GROUP - 1) // GROUP * GROUP
        for i in range(most):
            field_x[i] = field_y[i] = field_z[i] = 0.0
            if i >= n_near:
                near_x[i] = near_y[i] = near_z[i] = 1e6
        patch_field(most, near_x, near_y, near_z, patch.stride, patch.x, patch.y, patch.z, patch.change, field_x, field_y,
                    field_z)
        for i in range(n_near):
            slot = self.near[i]
            self.rule.field[slot, 0] += field_x[i]
            self.rule.field[slot, 1] += field_y[i]
            self.rule.field[slot, 2] += field_z[i]
        self.tree.refresh()
        journal.n_events += 1
        return 0

    def evaporate(self, Journal journal, long most, long sweep_interval, long long[::1] atom, double[::1] charge,
                  double[:, ::1] normal, long long[::1] neighbour):
        """Let atoms leave until `most` are in the journal, or something has to be done first.

        Parameters
        ----------
        journal : Journal
            Filled; must be new.
        most : int
            Events at most.
        sweep_interval : int
            Events after which a relaxation is due.
        atom, charge, normal, neighbour : ndarray, shapes (most,), (most,), (most, 3), (most,)
            Filled, for each event, with the atom that left, its charge [e], its normal, and its surface nearest
            neighbour of the highest charge (-1: none).

        Returns
        -------
        int
            DONE; SWEEP_DUE (call `relax`); EXHAUSTED (no atom may leave); TOO_SHALLOW (the next event would reach
            atoms that are held as support).
        """
        cdef long n, leaving
        cdef int status = STATUS_DONE, best, axis
        if journal.start.shape[0] <= most:
            raise ValueError(f"journal must have room for {most} events")
        with nogil:
            while journal.n_events < most:
                n = journal.n_events
                best = self.tournament.winner[1]
                if self.since_sweep < NOT_SETTLED and (best < 0 or not self.tournament.rank[best] > 0.0):
                    status = STATUS_EXHAUSTED
                    break
                if self.since_sweep >= sweep_interval or self.tree.n_slots + MOST_NEAR > self.tree.x.shape[0]:
                    status = STATUS_SWEEP_DUE
                    break
                leaving = self.tree.atom[best]
                if self.has_support and self.atoms.reaches_support(leaving):
                    status = STATUS_TOO_SHALLOW
                    break
                atom[n] = leaving
                charge[n] = self.tree.q[best]
                for axis in range(3):
                    normal[n, axis] = self.normals[best, axis]
                neighbour[n] = self.strongest_neighbour(leaving)
                self.event(leaving, journal)
        return status

    @property
    def slots(self):
        """Slots that hold an atom now, shape (n,)."""
        return np.flatnonzero(self.tree.atoms >= 0)

    @property
    def slot_normals(self):
        """Outward unit normals by slot, shape (capacity, 3)."""
        return np.asarray(self.normals)
