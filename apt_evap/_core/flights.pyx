"""Flights of ions from the surface to the end of the field.

Flights are in reduced units: charge and mass of the ion are 1, so velocities are in sqrt(V) and times in nm/sqrt(V);
the path of an ion depends only on its energy per charge. Flights that start together (one ion with many perturbations)
have common steps, with one walk through the tree per step: the sources for a ball around all flights are collected
once. For a group of flights, the field of distant sources is expanded about a ball around each part of the step (see
`far_field`), because the group is narrow and the step is long; near sources are summed for every stage, with the
flights in the vector lanes.

The scheme is the Runge-Kutta-Nystrom pair of orders 8 and 6 of Dormand, El-Mikkawy and Prince (IMA J. Numer. Anal. 7,
423, 1987), nine stages per step.
"""

from libc.math cimport INFINITY, NAN, sqrt
from libc.stdlib cimport free, malloc

import numpy as np

from apt_evap._core.far_field cimport SAMPLES, Expansion, FarField, add_expanded
from apt_evap._core.index cimport Index
from apt_evap._core.journal cimport Journal
from apt_evap._core.octree cimport Octree
from apt_evap._core.sources cimport (
    SingleSources, Sources, single_field, single_free, single_pad, sources_field, sources_free, sources_init,
)

cdef extern from "elementary.h":
    double inverse_seventh_root(double) noexcept nogil
    void sine_cosine(double, double*, double*) noexcept nogil


cdef extern from "kernels.h":
    const int SINGLE_LANES
    void bundle_atoms(Index, Index, const float*, Index, const float*, float*) noexcept nogil
    void bundle_cells(Index, Index, const float*, Index, const float*, float*) noexcept nogil
    void weighted_sum(Index, int, const double*, const double*, Index, double*) noexcept nogil


cdef extern from *:
    """
    #include "index.h"

    /* The next piece of work of several threads. */
    static Index fetch_next(Index *counter) { return (Index)__atomic_fetch_add(counter, 1, __ATOMIC_RELAXED); }
    static int is_set(Index *flag) { return __atomic_load_n(flag, __ATOMIC_RELAXED) != 0; }
    """
    Index fetch_next(Index* counter) nogil
    bint is_set(Index* flag) nogil

cdef enum:
    STAGES = 9
    PARTS = 3            # of a step, each with its own expansion
    FEWEST = 6           # flights of a bundle from which an expansion of the field costs less than sums for each flight
    ION_LEFT = 0
    ION_NEVER_LEFT = 1   # also the value during the flight
    ION_NOT_FLOWN = 2
    AZIMUTHS = 16        # of the velocities for which the linear response of a scout is evaluated
    SPEEDS = 4

LEFT, NEVER_LEFT, NOT_FLOWN = ION_LEFT, ION_NEVER_LEFT, ION_NOT_FLOWN

# Accuracy of scouts unless the flights are less accurate. Measured on Ni[111], R = 20 a: directions deviate by 0.01
# degrees (median) and 0.06 degrees (largest of 2,400).
cdef double SCOUT_ANGLE = 0.8
cdef double SCOUT_TOLERANCE = 3e-2

# The field of distant sources is expanded about one ball for each part of a step, or about one for the whole step if
# the balls of the parts are not smaller than SPLIT of it. FAR is the distance in radii of a ball from which sources
# are expanded. Measured on Ni[111], R = 80 a, 119 launches of an ion, 450 launches against direct sums: with 2.5 /
# 2.75 / 3 / 3.5, places deviate by 0.56 / 0.43 / 0.36 / 0.32 um (median) and 2.7 / 1.4 / 1.2 / 1.0 um (largest), in
# 1.02 / 1.14 / 1.21 / 1.40 ms an ion.
cdef double FAR = 3.0
cdef double SPLIT = 0.8

# A flight alone has one list of sources for several steps: at the start for a ball of AT_START lengths, later for the
# way of AHEAD times the next step. Inside such a ball, most places see the cells under smaller angles than the
# largest one, so LONE times the opening angle has the same error. Measured on Ni[111], R = 80 a, 300 flights against
# direct sums, half of them at rest and half with up to 1 eV; with lists for every step / (2, 6, 1.2) / (5, 6, 1.25) /
# (1, 8, 1.25) / (12, 5, 1.3), places deviate by 0.69 / 0.69 / 0.66 / 0.71 / 0.64 um (median) and 1.86 / 1.55 / 1.60 /
# 1.78 / 1.53 um (95 %), in 133 / 96 / 94 / 92 / 122 us.
cdef double AHEAD = 5.0
cdef double AT_START = 6.0
cdef double LONE = 1.25

cdef Index MOST_REFUSED = 12  # successive steps that hit an atom, each a tenth of the one before: it starts at one

cdef double[9] NODE = [0.0, 1 / 20.0, 1 / 10.0, 3 / 10.0, 1 / 2.0, 7 / 10.0, 9 / 10.0, 1.0, 1.0]
# The parts of a step: which one a stage belongs to, and its first and last node.
cdef int[9] PART = [0, 0, 0, 0, 1, 1, 2, 2, 2]
cdef double[3] BEGIN = [0.0, 0.5, 0.9]
cdef double[3] END = [0.3, 0.7, 1.0]
cdef double[81] STAGE = [
    0, 0, 0, 0, 0, 0, 0, 0, 0,
    1 / 800.0, 0, 0, 0, 0, 0, 0, 0, 0,
    1 / 600.0, 1 / 300.0, 0, 0, 0, 0, 0, 0, 0,
    9 / 200.0, -9 / 100.0, 9 / 100.0, 0, 0, 0, 0, 0, 0,
    -66701 / 197352.0, 28325 / 32892.0, -2665 / 5482.0, 2170 / 24669.0, 0, 0, 0, 0, 0,
    227015747 / 304251000.0, -54897451 / 30425100.0, 12942349 / 10141700.0, -9499 / 304251.0, 539 / 9250.0, 0, 0, 0, 0,
    -1131891597 / 901789000.0, 41964921 / 12882700.0, -6663147 / 3220675.0, 270954 / 644135.0, -108 / 5875.0,
    114 / 1645.0, 0, 0, 0,
    13836959 / 3667458.0, -17731450 / 1833729.0, 1063919505 / 156478208.0, -33213845 / 39119552.0, 13335 / 28544.0,
    -705 / 14272.0, 1645 / 57088.0, 0, 0,
    223 / 7938.0, 0, 1175 / 8064.0, 925 / 6048.0, 41 / 448.0, 925 / 14112.0, 1175 / 72576.0, 0, 0,
]
cdef double[9] VELOCITY = [
    223 / 7938.0, 0, 5875 / 36288.0, 4625 / 21168.0, 41 / 224.0, 4625 / 21168.0, 5875 / 36288.0, 223 / 7938.0, 0,
]
# Differences to the embedded solution of order 6.
cdef double[9] POSITION_ERROR = [
    -0.044557986852984274, 0, 0.10965442077101599, -0.14620589436135464, 0.1315853049252192, -0.06265966901200913,
    0.012183824530112887, 0, 0,
]
cdef double[9] VELOCITY_ERROR = [
    -0.044557986852984274, 0, 0.12183824530112887, -0.2088655633733638, 0.2631706098504384, -0.2088655633733638,
    0.12183824530112887, 0.10544201314701572, -0.15,
]


cdef class Flights:
    """Flights of ions over one copy of the charged surface.

    Parameters
    ----------
    tree : Octree
        The surface; this object keeps a copy and replays the events on it.
    coulomb : float
        Coulomb constant [V nm/e].
    length : float
        Length on the atomic scale, for the first step [nm].
    centre : ndarray, shape (3,)
        The apex, from which `reach` is measured [nm].
    reach : float
        Distance at which a flight ends; the ion then continues in a straight line [nm].
    opening_angle : float
        Largest full angle of a cell that replaces its atoms [rad]; the sums are then in single precision, relative to a
        point near the ions. 0 sums over all atoms in double precision.
    tolerance : float
        Error of a step, of the position relative to the path and of the velocity.
    max_steps : int
        Number of steps after which an ion counts as one that never left.
    """

    cdef Octree tree
    cdef Index n_replayed
    cdef Sources sources
    cdef SingleSources near, far
    cdef FarField far_field
    cdef Expansion[PARTS] expansions
    cdef int n_parts           # 0 if the sources are not expanded
    cdef bint in_lanes         # whether the flights are in the vector lanes of the sums
    cdef double[4] kept        # ball for which the sources of a flight alone were collected; radius -1: none
    cdef double coulomb, length, reach, opening_angle, tolerance
    cdef double[3] centre
    cdef Index max_steps, fewest
    cdef Index capacity
    cdef double* work          # (STAGES + 4, capacity, 3): accelerations, then position, velocity, trial position, sums
    cdef float* lanes          # (6, capacity + SINGLE_LANES): places relative to the centre of the sources, and fields
    cdef Index* flying         # (capacity,) flights that have not ended
    cdef readonly Index n_steps, n_evaluations, n_pairs

    def __cinit__(self, *args, **kwargs):
        self.work = NULL
        self.lanes = NULL
        self.flying = NULL
        self.capacity = 0
        sources_init(&self.sources)
        self.near.atoms = self.near.cells = self.far.atoms = self.far.cells = NULL

    def __init__(self, Octree tree, *, double coulomb, double length, centre, double reach, double opening_angle,
                 double tolerance, Index max_steps):
        self.coulomb, self.length, self.reach = coulomb, length, reach
        self.opening_angle, self.tolerance, self.max_steps = opening_angle, tolerance, max_steps
        self.centre[0], self.centre[1], self.centre[2] = centre
        self.n_steps = self.n_evaluations = self.n_pairs = 0
        self.fewest = FEWEST
        self.far_field = FarField((0.0, 0.0, 0.0), 1.0)
        self.begin(tree)

    def __dealloc__(self):
        sources_free(&self.sources)
        single_free(&self.near)
        single_free(&self.far)
        free(self.work)
        free(self.lanes)
        free(self.flying)

    def begin(self, Octree tree):
        """Copy the surface before the first event of a journal."""
        self.tree = tree.copy()
        self.n_replayed = 0

    def follow(self, Journal journal):
        """Replay the remaining events of a journal, before the next journal."""
        with nogil:
            while self.n_replayed < journal.n_events:
                journal.replay(self.n_replayed, self.tree)
                self.n_replayed += 1
        self.n_replayed = 0

    def fly(self, Journal journal, const Index[::1] event, const Index[::1] start,
            const double[:, ::1] positions, const double[:, ::1] velocities, double[:, ::1] end,
            signed char[::1] outcome, Index[::1] counter, Index[::1] halt,
            const Index[::1] families=None, Index scouts=-1, double rim=0.0, double margin=0.0, double plane=0.0):
        """Fly groups of launches, each in the field after its event.

        Several objects can work in parallel threads: `counter` distributes the ions. Call `follow` before another
        journal.

        The group with the number `scouts` of each ion decides whether the later ones are flown. Its launches are
        families: at rest, with the largest velocity in each of two directions, and further ones at rest. They predict
        the directions of all launches, as linear functions of the velocity that are equal for all places of a family.

        Parameters
        ----------
        journal : Journal
            The next events.
        event : ndarray, shape (n,)
            Event of each ion, not decreasing.
        start : ndarray, shape (n g + 1,)
            Begin of the launches of each of g groups of each ion.
        positions, velocities : ndarray, shape (m, 3)
            Launches [nm], [sqrt(V)].
        end : ndarray, shape (m, 7)
            Filled with the position, velocity and time at the end of each flight [nm], [sqrt(V)], [nm/sqrt(V)].
        outcome : ndarray, shape (m,)
            Filled with LEFT, NEVER_LEFT or NOT_FLOWN.
        counter : ndarray, shape (1,)
            Number of the next ion.
        halt : ndarray, shape (1,)
            If not 0, stop before the next ion.
        families : ndarray, shape (f,), optional
            Number of launches of each family of scouts.
        scouts : int
            Number of the group of scouts; -1 if there are none.
        rim : float
            Length of stereographic directions at the rim of the field of view.
        margin : float
            Later groups are not flown if all predicted directions end this far outside, in units of the largest
            predicted deviation from the first scout.
        plane : float
            z of the plane on which ions arrive [nm].
        """
        cdef Index ion, group, k, n = event.shape[0], n_groups = (start.shape[0] - 1) // max(1, event.shape[0])
        with nogil:
            while not is_set(&halt[0]):
                ion = fetch_next(&counter[0])
                if ion >= n:
                    break
                while self.n_replayed <= event[ion]:
                    journal.replay(self.n_replayed, self.tree)
                    self.n_replayed += 1
                group = n_groups * ion
                while group < n_groups * (ion + 1):
                    k = start[group]
                    if group == n_groups * ion + scouts and start[group + 1] > k:
                        self.fly_scouts(start[group + 1] - k, &positions[k, 0], &velocities[k, 0], &end[k, 0],
                                        &outcome[k])
                        if self.stays_outside(families, &end[k, 0], &outcome[k], rim, margin, plane):
                            for k in range(start[group + 1], start[n_groups * (ion + 1)]):
                                outcome[k] = ION_NOT_FLOWN
                                end[k, :] = NAN
                            break
                    else:
                        self.fly_with_retries(start[group], start[group + 1], positions, velocities, end, outcome)
                    group += 1

    cdef int fly_scouts(self, Index m, const double* positions, const double* velocities, double* end,
                        signed char* outcome) except -1 nogil:
        cdef double opening_angle = self.opening_angle, tolerance = self.tolerance
        self.opening_angle, self.tolerance = max(opening_angle, SCOUT_ANGLE), max(tolerance, SCOUT_TOLERANCE)
        self.fewest = m + 1   # with few sources an expansion costs more than the sums
        self.fly_group(m, positions, velocities, end, outcome)
        self.opening_angle, self.tolerance, self.fewest = opening_angle, tolerance, FEWEST
        return 0

    cdef int fly_with_retries(self, Index first, Index last, const double[:, ::1] positions,
                              const double[:, ::1] velocities, double[:, ::1] end, signed char[::1] outcome
                              ) except -1 nogil:
        cdef Index k
        if last > first:
            self.fly_group(last - first, &positions[first, 0], &velocities[first, 0], &end[first, 0], &outcome[first])
        if last > first + 1:   # a launch that hits an atom stops its whole group
            for k in range(first, last):
                if outcome[k] == ION_NEVER_LEFT:
                    self.fly_group(1, &positions[k, 0], &velocities[k, 0], &end[k, 0], &outcome[k])
        return 0

    def accelerations(self, const double[:, ::1] positions):
        """Accelerations [V/nm] at n places in the present field, as of the flights of one group; shape (n, 3)."""
        cdef Index m = positions.shape[0]
        cdef double[:, ::1] result = np.zeros((m, 3)), at_rest = np.zeros((m, 3))
        cdef signed char[::1] outcome = np.full(m, ION_NEVER_LEFT, np.int8)
        if m:
            self.reserve(m)
            self.kept[3] = -1.0
            self.gather(m, &positions[0, 0], &at_rest[0, 0], &at_rest[0, 0], &outcome[0], 0.0)
            self.evaluate(m, &positions[0, 0], &result[0, 0], &outcome[0], 0)
        return np.asarray(result)

    cdef bint stays_outside(self, const Index[::1] families, const double* end, const signed char* outcome,
                            double rim, double margin, double plane) noexcept nogil:
        # Whether no launch of the ion can arrive within the rim, from the ends of its scouts.
        cdef double[2] origin, s
        cdef double[3][2] base
        cdef double x, y, sine, cosine, speed, away, least = INFINITY, largest = 0.0
        cdef Index family, k, first = 0
        cdef int azimuth, step
        for family in range(families.shape[0]):
            for k in range(families[family]):
                if outcome[first + k] != ION_LEFT:
                    return False
            for k in range(3):
                self.direction(end + 7 * (first + k), plane, base[k])
            if family == 0:
                origin[0], origin[1] = base[0][0], base[0][1]
            for k in range(families[family]):
                if k == 1 or k == 2:
                    continue
                self.direction(end + 7 * (first + k), plane, s)
                for azimuth in range(AZIMUTHS):
                    sine_cosine(6.283185307179586 / AZIMUTHS * azimuth, &sine, &cosine)
                    for step in range(SPEEDS + 1):
                        speed = step / <double>SPEEDS
                        x = s[0] + speed * (cosine * (base[1][0] - base[0][0]) + sine * (base[2][0] - base[0][0]))
                        y = s[1] + speed * (cosine * (base[1][1] - base[0][1]) + sine * (base[2][1] - base[0][1]))
                        away = (x - origin[0]) ** 2 + (y - origin[1]) ** 2
                        if not away < INFINITY:
                            return False
                        least, largest = min(least, x * x + y * y), max(largest, away)
            first += families[family]
        return sqrt(least) - margin * sqrt(largest) > rim

    cdef void direction(self, const double* end, double plane, double* s) noexcept nogil:
        # Stereographic direction in which the plane is reached, as `Detector.directions`.
        cdef double[3] place
        cdef double remaining
        cdef int axis
        for axis in range(3):
            place[axis] = end[3 + axis]
        if place[2] > 0.0:
            remaining = (plane - end[2]) / place[2]
            for axis in range(3):
                place[axis] = end[axis] - self.centre[axis] + remaining * place[axis]
        remaining = sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2) + place[2]
        s[0], s[1] = place[0] / remaining, place[1] / remaining

    cdef int fly_group(self, Index m, const double* positions, const double* velocities, double* end,
                       signed char* outcome) except -1 nogil:
        cdef double* a
        cdef double* x
        cdef double* v
        cdef double* trial
        cdef double* sums
        cdef double time = 0.0, dt, largest, s, length, away
        cdef Index i, j, flying = m, steps, refused = 0
        cdef int stage, axis
        self.reserve(m)
        a, x = self.work, self.work + STAGES * 3 * m
        v, trial, sums = x + 3 * m, x + 6 * m, x + 9 * m
        for j in range(3 * m):
            x[j], v[j], a[j] = positions[j], velocities[j], 0.0
        for i in range(m):
            outcome[i] = ION_NEVER_LEFT
        self.kept[3] = -1.0
        self.gather(m, x, v, a, outcome, 0.0)
        self.evaluate(m, x, a, outcome, 0)
        # a first step of an atomic distance at most, from the acceleration at the start
        dt = 1e30
        for i in range(m):
            s = sqrt(a[3 * i] ** 2 + a[3 * i + 1] ** 2 + a[3 * i + 2] ** 2)
            length = sqrt(v[3 * i] ** 2 + v[3 * i + 1] ** 2 + v[3 * i + 2] ** 2)
            dt = min(dt, 2.0 * self.length / (length + sqrt(2.0 * self.length * s) + 1e-30))
        for steps in range(self.max_steps):
            # stages of the step: positions x + dt (c_i v + dt sum_k a_ik f_k), and the accelerations f_i there
            dt = min(dt, self.time_to_reach(m, x, v, outcome))
            self.gather(m, x, v, a, outcome, dt)
            for stage in range(1, STAGES):   # the last stage of a step is the first of the next one
                weighted_sum(3 * m, stage, &STAGE[9 * stage], a, 3 * m, sums)
                for j in range(3 * m):
                    trial[j] = x[j] + dt * (NODE[stage] * v[j] + dt * sums[j])
                self.evaluate(m, trial, a + 3 * m * stage, outcome, stage)
            # accept the step if the largest error is below the tolerance: v += dt sum_k b_k f_k
            largest = self.step_error(m, dt, a, v, positions, trial, sums, outcome)
            self.n_steps += 1
            if largest <= 1.0:
                refused = 0
                time += dt
                weighted_sum(3 * m, STAGES, VELOCITY, a, 3 * m, sums)
                for i in range(m):
                    if outcome[i] != ION_NEVER_LEFT:
                        continue
                    away = 0.0
                    for axis in range(3):
                        x[3 * i + axis] = trial[3 * i + axis]
                        v[3 * i + axis] += dt * sums[3 * i + axis]
                        away += (x[3 * i + axis] - self.centre[axis]) ** 2
                        a[3 * i + axis] = a[3 * (8 * m + i) + axis]
                    if away > self.reach * self.reach:
                        outcome[i] = ION_LEFT
                        flying -= 1
                    if outcome[i] == ION_LEFT or steps == self.max_steps - 1:
                        for axis in range(3):
                            end[7 * i + axis] = x[3 * i + axis]
                            end[7 * i + 3 + axis] = v[3 * i + axis]
                        end[7 * i + 6] = time
                if flying == 0:
                    return 0
            # next step: the error of a step of the embedded pair increases with dt^7
            if not largest < 1e30:   # a stage hit an atom
                dt *= 0.1
                refused += 1
                if refused == MOST_REFUSED:
                    break
            else:
                dt *= min(4.0, max(0.2, 0.9 * inverse_seventh_root(max(largest, 1e-12))))
        # flights that never left: where they are after the last step
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                for axis in range(3):
                    end[7 * i + axis] = x[3 * i + axis]
                    end[7 * i + 3 + axis] = v[3 * i + axis]
                end[7 * i + 6] = time
        return 0

    cdef int reserve(self, Index m) except -1 nogil:
        # Memory for m flights.
        if m > self.capacity:
            free(self.work)
            free(self.lanes)
            free(self.flying)
            self.capacity = m
            self.work = <double*>malloc((STAGES + 4) * 3 * m * sizeof(double))
            self.lanes = <float*>malloc(6 * (m + SINGLE_LANES) * sizeof(float))
            self.flying = <Index*>malloc(m * sizeof(Index))
            if self.work == NULL or self.lanes == NULL or self.flying == NULL:
                with gil:
                    raise MemoryError
        return 0

    cdef double time_to_reach(self, Index m, const double* x, const double* v,
                              const signed char* outcome) noexcept nogil:
        # Time in which the slowest flight close to `reach` crosses it in a straight line, so that no flight ends far
        # beyond; flights that need more than the largest step are ignored.
        cdef double rr, rv, vv, dx, longest = 0.0
        cdef Index i
        cdef int axis
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                rr = rv = vv = 0.0
                for axis in range(3):
                    dx = x[3 * i + axis] - self.centre[axis]
                    rr += dx * dx
                    rv += dx * v[3 * i + axis]
                    vv += v[3 * i + axis] ** 2
                if vv == 0.0:
                    return INFINITY
                longest = max(longest, (sqrt(max(0.0, rv * rv + vv * (self.reach * self.reach - rr))) - rv) / vv)
        return 1.0001 * longest

    cdef double step_error(self, Index m, double dt, const double* a, const double* v, const double* origin,
                           const double* trial, double* sums, const signed char* outcome) noexcept nogil:
        # Largest error of the step of all flights, relative to the tolerance.
        cdef double s, path, speed, largest = 0.0
        cdef Index i
        cdef int axis
        weighted_sum(3 * m, STAGES, POSITION_ERROR, a, 3 * m, sums)
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                s = path = 0.0
                for axis in range(3):
                    s += sums[3 * i + axis] ** 2
                    path += (trial[3 * i + axis] - origin[3 * i + axis]) ** 2
                s = dt * dt * sqrt(s) / (self.tolerance * (sqrt(path) + 0.1 * self.length))
                largest = max(largest, s) if s == s else INFINITY
        weighted_sum(3 * m, STAGES, VELOCITY_ERROR, a, 3 * m, sums)
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                s = speed = 0.0
                for axis in range(3):
                    s += sums[3 * i + axis] ** 2
                    # the acceleration at the end of the step is that of the last stage
                    speed += (v[3 * i + axis] + 0.5 * dt * (a[3 * i + axis] + a[3 * (8 * m + i) + axis])) ** 2
                s = dt * sqrt(s) / (self.tolerance * sqrt(speed))
                largest = max(largest, s) if s == s else INFINITY
        return largest

    cdef int gather(self, Index m, const double* x, const double* v, const double* a, const signed char* outcome,
                    double dt) except -1 nogil:
        # Collects the sources for a ball that contains all flights until the end of the step.
        cdef double[4] whole
        cdef double[4 * PARTS] balls
        cdef double[3] point
        cdef double[3 * SAMPLES] samples
        cdef double largest = 0.0
        cdef Index i, n = 0
        cdef int part, axis
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                self.flying[n] = i
                n += 1
        self.enclose(n, x, v, a, 0.0, dt, whole)
        if self.opening_angle == 0.0:
            self.tree.collect(whole[0], whole[1], whole[2], whole[3], self.opening_angle, &self.sources)
            return 0
        self.n_parts = 0
        self.in_lanes = n >= self.fewest
        if m == 1:
            if self.is_kept(whole):
                return 0
            self.keep_ahead(x, v, a, dt, whole)
        if self.in_lanes and whole[3] > 1e-3 * self.length:
            self.n_parts = PARTS
            for part in range(PARTS):
                self.enclose(n, x, v, a, BEGIN[part] * dt, END[part] * dt, balls + 4 * part)
                largest = max(largest, balls[4 * part + 3])
            if dt == 0.0 or largest > SPLIT * whole[3]:   # they would overlap
                self.n_parts = 1
                for axis in range(4):
                    balls[axis] = whole[axis]
            for part in range(self.n_parts):
                self.expansions[part].radius = 1.05 * balls[4 * part + 3]   # a stage may lie a little outside
                for axis in range(3):
                    self.expansions[part].centre[axis] = balls[4 * part + axis]
                    balls[4 * part + axis] -= whole[axis]
                balls[4 * part + 3] *= FAR
        self.tree.collect_single(whole, whole[3], self.opening_angle * (LONE if m == 1 else 1.0), self.n_parts, balls,
                                 &self.sources, &self.near, &self.far)
        if not self.in_lanes:
            single_pad(&self.near)
        if self.n_parts:
            single_pad(&self.far)
        for part in range(self.n_parts):
            for i in range(SAMPLES):
                self.far_field.point(&self.expansions[part], i, point)
                single_field(&self.far, point[0], point[1], point[2], samples + 3 * i)
            self.far_field.expand(&self.expansions[part], samples)
            self.n_pairs += SAMPLES * (self.far.n_atoms + self.far.n_cells)
        return 0

    cdef bint is_kept(self, const double* ball) noexcept nogil:
        # Whether a ball lies in that for which the sources were collected.
        cdef double s = 0.0, space = self.kept[3] - ball[3]
        cdef int axis
        for axis in range(3):
            s += (ball[axis] - self.kept[axis]) ** 2
        return space >= 0.0 and s <= space * space

    cdef void keep_ahead(self, const double* x, const double* v, const double* a, double dt,
                         double* ball) noexcept nogil:
        # Widens the ball of a step of a flight alone to the way that follows: straight on from the end of the step.
        cdef double[3] centre
        cdef double s = 0.0, apart = 0.0, way
        cdef int axis
        if dt == 0.0:
            ball[3] = AT_START * self.length
        else:
            for axis in range(3):
                way = AHEAD * dt * v[axis] + (AHEAD - 0.5) * dt * dt * a[axis]
                centre[axis] = x[axis] + 0.5 * way
                s += way * way
                apart += (centre[axis] - ball[axis]) ** 2
                ball[axis] = centre[axis]
            ball[3] = max(0.5 * sqrt(s), ball[3] + sqrt(apart)) * 1.0001
        for axis in range(4):
            self.kept[axis] = ball[axis]

    cdef void enclose(self, Index n, const double* x, const double* v, const double* a, double begin, double end,
                      double* ball) noexcept nogil:
        # Centre and radius of a ball around all flights at two times of the step, and between.
        cdef double s, first, last
        cdef Index k, i
        cdef int axis
        ball[0] = ball[1] = ball[2] = ball[3] = 0.0
        for k in range(n):
            i = 3 * self.flying[k]
            for axis in range(3):
                ball[axis] += (x[i + axis] + 0.5 * (begin + end) * v[i + axis]
                               + 0.25 * (begin * begin + end * end) * a[i + axis])
        for axis in range(3):
            ball[axis] /= n
        for k in range(n):
            i = 3 * self.flying[k]
            first = last = 0.0
            for axis in range(3):
                s = x[i + axis] - ball[axis]
                first += (s + begin * (v[i + axis] + 0.5 * begin * a[i + axis])) ** 2
                last += (s + end * (v[i + axis] + 0.5 * end * a[i + axis])) ** 2
            ball[3] = max(ball[3], first, last)
        ball[3] = sqrt(ball[3])

    cdef void evaluate(self, Index m, const double* x, double* a, const signed char* outcome, int stage) noexcept nogil:
        # Accelerations [V/nm] of the unfinished flights at the places of a stage.
        cdef Index i, k, n = 0, width
        cdef int axis
        cdef float* field
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                self.flying[n] = i
                n += 1
        if self.opening_angle == 0.0:
            for k in range(n):
                i = 3 * self.flying[k]
                sources_field(&self.sources, x[i], x[i + 1], x[i + 2], a + i)
            self.n_pairs += n * (self.sources.n_atoms + self.sources.n_cells)
        elif not self.in_lanes:
            for k in range(n):
                i = 3 * self.flying[k]
                single_field(&self.near, x[i], x[i + 1], x[i + 2], a + i)
            self.n_pairs += n * (self.near.n_atoms + self.near.n_cells)
        else:
            width = (n + SINGLE_LANES - 1) // SINGLE_LANES * SINGLE_LANES
            field = self.lanes + 3 * width
            for axis in range(3):
                for k in range(width):   # the last flight fills the lanes
                    i = 3 * self.flying[min(k, n - 1)]
                    self.lanes[axis * width + k] = <float>(x[i + axis] - self.near.origin[axis])
                    field[axis * width + k] = 0.0
            bundle_atoms(self.near.n_atoms, self.near.capacity, self.near.atoms, width, self.lanes, field)
            bundle_cells(self.near.n_cells, self.near.capacity, self.near.cells, width, self.lanes, field)
            for axis in range(3):
                for k in range(n):
                    a[3 * self.flying[k] + axis] = field[axis * width + k]
            self.n_pairs += n * (self.near.n_atoms + self.near.n_cells)
            if self.n_parts:
                add_expanded(&self.expansions[PART[stage] if self.n_parts > 1 else 0], n, x, self.flying, a)
        for k in range(n):
            for axis in range(3):
                a[3 * self.flying[k] + axis] *= self.coulomb
        self.n_evaluations += n
