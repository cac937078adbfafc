"""Flights of ions from the surface to the end of the field.

Flights are in reduced units: charge and mass of the ion are 1, so velocities are in sqrt(V) and times in nm/sqrt(V);
the path of an ion depends only on its energy per charge. Flights that start together (one ion with many perturbations)
have common steps, with one walk through the tree per step: the sources for a ball around all flights are collected
once. For a group of flights, the field of distant sources is expanded about a ball around each part of the step (see
`far_field`), because the group is narrow and the step is long. It contains that of larger balls, each for one or more
steps, whose sources are summed once. Near sources are summed for every stage, with the flights in the vector lanes.

The scheme is the Runge-Kutta-Nystrom pair of orders 8 and 6 of Dormand, El-Mikkawy and Prince (IMA J. Numer. Anal. 7,
423, 1987), nine stages per step.
"""

from libc.math cimport INFINITY, NAN, sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy

import numpy as np

from apt_evap._core.far_field cimport SAMPLES, Expansion, FarField, add_expanded
from apt_evap._core.index cimport Index
from apt_evap._core.journal cimport Journal
from apt_evap._core.octree cimport Octree
from apt_evap._core.sources cimport (
    Nodes, SingleSources, Sources, nodes_reserve, single_field, single_free, single_pad, single_part, sources_field,
    sources_free, sources_init,
)

cdef extern from "elementary.h":
    double inverse_seventh_root(double) noexcept nogil
    void sine_cosine(double, double*, double*) noexcept nogil


cdef extern from "kernels.h":
    const int SINGLE_LANES
    void bundle_atoms(Index, Index, const float*, Index, const float*, float*) noexcept nogil
    void bundle_cells(Index, Index, const float*, Index, const float*, float*) noexcept nogil
    void weighted_sum(Index, int, const double*, const double*, Index, double*) noexcept nogil
    void stage_places(Index, double, double, const double*, const double*, const double*, double*) noexcept nogil
    void into_lanes(Index, const double*, const double*, float*) noexcept nogil
    void out_of_lanes(Index, double, const float*, double*) noexcept nogil
    void enclosing_ball(Index, const double*, const double*, const double*, double, double, double*) noexcept nogil
    void relative_lengths(Index, double, double, const double*, const double*, const double*, double*) noexcept nogil


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
    PADDED = (SAMPLES + 15) // 16 * 16   # samples in full vector lanes
    LEVELS = 2           # nested balls, each with an expansion of the field of the sources beyond
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
# are expanded. Measured on Ni[111], R = 40 a, 240 ions after 4,000 events, 140 launches of an ion, 1,200 launches
# against direct sums, with TOGETHER = 10: with 2.8 / 2.9 / 3, places deviate by 0.72 / 0.70 / 0.68 um (median) and
# 1.71 / 1.64 / 1.55 um (95 %), with 479 / 524 / 569 thousand pairs an ion. With 3 / 3.2 and TOGETHER = 30, by 0.61 /
# 0.57 and 1.48 / 1.43 um, with 574 / 663 thousand pairs.
cdef double FAR = 3.0
cdef double SPLIT = 0.9

# A flight alone has one list of sources for several steps: at the start for a ball of AT_START lengths, later for the
# way of AHEAD times the next step. Inside such a ball, most places see the cells under smaller angles than the
# largest one, so LONE times the opening angle has the same error. Measured on Ni[111], R = 80 a, 300 flights against
# direct sums, half of them at rest and half with up to 1 eV; with lists for every step / (2, 6, 1.2) / (5, 6, 1.25) /
# (1, 8, 1.25) / (12, 5, 1.3), places deviate by 0.69 / 0.69 / 0.66 / 0.71 / 0.64 um (median) and 1.86 / 1.55 / 1.60 /
# 1.78 / 1.53 um (95 %), in 133 / 96 / 94 / 92 / 122 us.
cdef double AHEAD = 5.0
cdef double AT_START = 6.0
cdef double LONE = 1.25

# Sources far from a bundle are summed once for balls that contain one or some of its steps: at the start for balls of
# AROUND lengths, later for a ball around the step, unless it is larger than LARGEST lengths. If there are at most FEW
# sources, they are summed for every flight. Measured at R = 80 a with FAR = 3, 450 launches: with (8, 2.5) / (6, 2) /
# (10, 3.5), places deviate by 0.48 / 0.43 / 0.47 um (median) in the same time; without a bound, by 0.68 um in 0.97 of
# the time.
cdef double[2] AROUND = [6.0, 2.0]
cdef double LARGEST = 30.0
cdef Index FEW = 8

# Tolerance of a bundle, whose errors come from cells and expansions, over that of a flight alone. Measured at R = 40 a
# (the ions of FAR): with 1 / 3 / 10 / 30, places deviate by 0.64 / 0.61 / 0.68 / 0.61 um (median), 1.55 / 1.42 / 1.55 /
# 1.48 um (95 %) and 2.9 / 2.7 / 2.4 / 3.5 um (largest), in 925 / 871 / 830 / 822 us an ion.
cdef double TOGETHER = 10.0

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
cdef double[9] ENDS = [1, 0, 0, 0, 0, 0, 0, 0, 1]
# Differences to the embedded solution of order 6.
cdef double[9] POSITION_ERROR = [
    -0.044557986852984274, 0, 0.10965442077101599, -0.14620589436135464, 0.1315853049252192, -0.06265966901200913,
    0.012183824530112887, 0, 0,
]
cdef double[9] VELOCITY_ERROR = [
    -0.044557986852984274, 0, 0.12183824530112887, -0.2088655633733638, 0.2631706098504384, -0.2088655633733638,
    0.12183824530112887, 0.10544201314701572, -0.15,
]


cdef struct Level:
    # A ball that contains some steps, the field inside of all sources beyond FAR radii, and the nodes of all others.
    double[4] ball
    Expansion expansion
    Nodes rest


cdef bint is_inside(const double* inner, const double* outer) noexcept nogil:
    # Whether a ball lies in another one.
    cdef double s = 0.0, space = outer[3] - inner[3]
    cdef int axis
    for axis in range(3):
        s += (inner[axis] - outer[axis]) ** 2
    return space >= 0.0 and s <= space * space


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
    cdef SingleSources[PARTS] inside, outside   # those near each part of the step, and those near the other parts only
    cdef Nodes everything                       # the root of the tree
    cdef Level[LEVELS] levels
    cdef int n_levels                           # that contain the present step
    cdef FarField far_field
    cdef Expansion[PARTS] expansions
    cdef int n_parts           # 0 if the sources are not expanded
    cdef bint in_lanes         # whether the flights are in the vector lanes of the sums
    cdef double[4] kept        # ball for which the sources of a flight alone were collected; radius -1: none
    cdef double coulomb, length, reach, opening_angle, tolerance
    cdef double[3] centre
    cdef Index max_steps, fewest
    cdef Index capacity
    cdef double* work          # the rows that follow, each (3, width), of at most `capacity` flights
    cdef double* a             # accelerations of the stages
    cdef double* x
    cdef double* v
    cdef double* trial         # places of a stage
    cdef double* sums
    cdef double* origin        # places at the start
    cdef double* ratios        # (width,)
    cdef double* spare         # (12, width)
    cdef double* none          # zeros
    cdef float* lanes          # (6, width): places relative to the centre of the sources, and fields
    cdef Index* flying         # (n_flying,) numbers of the flights that have not ended
    cdef Index n_flying, width
    cdef bint alone            # whether the group has one flight
    cdef readonly Index n_steps, n_evaluations, n_pairs

    def __cinit__(self, *args, **kwargs):
        cdef int part, level
        self.work = NULL
        self.lanes = NULL
        self.flying = NULL
        self.capacity = 0
        sources_init(&self.sources)
        self.near.atoms = self.near.cells = self.far.atoms = self.far.cells = NULL
        for part in range(PARTS):
            self.inside[part].atoms = self.inside[part].cells = NULL
            self.outside[part].atoms = self.outside[part].cells = NULL
        for level in range(LEVELS):
            self.levels[level].rest.node = NULL
            self.levels[level].rest.capacity = self.levels[level].rest.n = 0
        self.everything.node = NULL
        self.everything.capacity = 0
        nodes_reserve(&self.everything, 1)
        self.everything.n, self.everything.node[0] = 1, 0

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
        cdef int part, level
        sources_free(&self.sources)
        single_free(&self.near)
        single_free(&self.far)
        for part in range(PARTS):
            single_free(&self.inside[part])
            single_free(&self.outside[part])
        for level in range(LEVELS):
            free(self.levels[level].rest.node)
        free(self.everything.node)
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
        cdef Index m = positions.shape[0], k
        cdef int axis
        cdef double[:, ::1] result = np.zeros((m, 3))
        if m:
            self.reserve(m)
            self.alone = m == 1
            self.arrange(m)
            for axis in range(3):
                for k in range(self.width):
                    self.x[axis * self.width + k] = positions[min(k, m - 1), axis]
                    self.v[axis * self.width + k] = self.a[axis * self.width + k] = 0.0
            self.kept[3] = -1.0
            self.n_levels = 0
            self.gather(0.0)
            self.evaluate(self.x, self.a, 0)
            for axis in range(3):
                for k in range(m):
                    result[k, axis] = self.a[axis * self.width + k]
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
        cdef double* origin
        cdef double time = 0.0, dt, largest, s, length, away
        cdef double tolerance
        cdef Index i, k, n, flying = m, _, refused = 0
        cdef int stage, axis
        self.reserve(m)
        self.alone = m == 1
        for i in range(m):
            outcome[i] = ION_NEVER_LEFT
            self.flying[i] = i
        self.arrange(m)
        n = 3 * self.width
        a, x, v, trial, sums, origin = self.a, self.x, self.v, self.trial, self.sums, self.origin
        for axis in range(3):
            for k in range(self.width):
                i = 3 * min(k, m - 1) + axis
                x[axis * self.width + k] = origin[axis * self.width + k] = positions[i]
                v[axis * self.width + k], a[axis * self.width + k] = velocities[i], 0.0
        self.kept[3] = -1.0
        self.n_levels = 0
        self.gather(0.0)
        self.evaluate(x, a, 0)
        # a first step of an atomic distance at most, from the acceleration at the start
        tolerance = self.tolerance * (TOGETHER if self.in_lanes else 1.0)
        dt = 1e30
        for k in range(m):
            s = length = 0.0
            for axis in range(3):
                s += a[axis * self.width + k] ** 2
                length += v[axis * self.width + k] ** 2
            dt = min(dt, 2.0 * self.length / (sqrt(length) + sqrt(2.0 * self.length * sqrt(s)) + 1e-30))
        for _ in range(self.max_steps):
            # stages of the step: positions x + dt (c_i v + dt sum_k a_ik f_k), and the accelerations f_i there
            dt = min(dt, self.time_to_reach())
            self.gather(dt)
            for stage in range(1, STAGES):   # the last stage of a step is the first of the next one
                weighted_sum(n, stage, &STAGE[9 * stage], a, n, sums)
                stage_places(n, dt, NODE[stage], x, v, sums, trial)
                self.evaluate(trial, a + n * stage, stage)
            # accept the step if the largest error is below the tolerance: v += dt sum_k b_k f_k
            largest = self.step_error(dt, tolerance)
            self.n_steps += 1
            if largest <= 1.0:
                refused = 0
                time += dt
                weighted_sum(n, STAGES, VELOCITY, a, n, sums)
                memcpy(x, trial, n * sizeof(double))
                stage_places(n, dt, 1.0, v, sums, self.none, trial)
                memcpy(v, trial, n * sizeof(double))
                memcpy(a, a + n * (STAGES - 1), n * sizeof(double))
                # flights that end
                flying = 0
                for k in range(self.n_flying):
                    i = self.flying[k]
                    away = 0.0
                    for axis in range(3):
                        away += (x[axis * self.width + k] - self.centre[axis]) ** 2
                    if away > self.reach * self.reach:
                        outcome[i] = ION_LEFT
                        self.finish(k, time, end + 7 * i)
                    else:
                        flying += 1
                if flying == 0:
                    return 0
                if flying < self.n_flying:
                    self.leave_out(outcome)
                    n = 3 * self.width
                    a, x, v, trial, sums = self.a, self.x, self.v, self.trial, self.sums
            # next step: the error of a step of the embedded pair increases with dt^7
            if not largest < 1e30:   # a stage hit an atom
                dt *= 0.1
                refused += 1
                if refused == MOST_REFUSED:
                    break
            else:
                dt *= min(4.0, max(0.2, 0.9 * inverse_seventh_root(max(largest, 1e-12))))
        # flights that never left: where they are after the last step
        for k in range(self.n_flying):
            self.finish(k, time, end + 7 * self.flying[k])
        return 0

    cdef void finish(self, Index k, double time, double* end) noexcept nogil:
        cdef int axis
        for axis in range(3):
            end[axis], end[3 + axis] = self.x[axis * self.width + k], self.v[axis * self.width + k]
        end[6] = time

    cdef void arrange(self, Index m) noexcept nogil:
        # Rows for m flights; in vector lanes, copies of the last flight fill them.
        self.n_flying = m
        self.in_lanes = m >= self.fewest and self.opening_angle > 0.0
        self.width = (m + SINGLE_LANES - 1) // SINGLE_LANES * SINGLE_LANES if self.in_lanes else m
        self.a = self.work
        self.x = self.a + STAGES * 3 * self.width
        self.v = self.x + 3 * self.width
        self.trial = self.v + 3 * self.width
        self.sums = self.trial + 3 * self.width
        self.origin = self.sums + 3 * self.width
        self.ratios = self.origin + 3 * self.width

    cdef void leave_out(self, const signed char* outcome) noexcept nogil:
        # Removes the flights that have ended from the rows.
        cdef Index k, at, m = 0, width = self.width, i
        cdef int axis
        cdef double* x = self.x
        cdef double* v = self.v
        cdef double* origin = self.origin
        cdef double* spare = self.spare
        for k in range(self.n_flying):
            i = self.flying[k]
            if outcome[i] == ION_NEVER_LEFT:
                for axis in range(3):
                    at = axis * width + k
                    spare[12 * m + axis], spare[12 * m + 3 + axis] = x[at], v[at]
                    spare[12 * m + 6 + axis], spare[12 * m + 9 + axis] = self.a[at], origin[at]
                self.flying[m] = i
                m += 1
        self.arrange(m)
        for k in range(self.width):
            i = min(k, m - 1)
            for axis in range(3):
                at = axis * self.width + k
                self.x[at], self.v[at] = spare[12 * i + axis], spare[12 * i + 3 + axis]
                self.a[at], self.origin[at] = spare[12 * i + 6 + axis], spare[12 * i + 9 + axis]

    cdef int reserve(self, Index m) except -1 nogil:
        # Memory for m flights.
        cdef Index width = (m + SINGLE_LANES - 1) // SINGLE_LANES * SINGLE_LANES, k
        if width > self.capacity:
            free(self.work)
            free(self.lanes)
            free(self.flying)
            self.capacity = width
            self.work = <double*>malloc(((STAGES + 5) * 3 + 1 + 12 + 3) * width * sizeof(double))
            self.lanes = <float*>malloc(6 * width * sizeof(float))
            self.flying = <Index*>malloc(width * sizeof(Index))
            if self.work == NULL or self.lanes == NULL or self.flying == NULL:
                with gil:
                    raise MemoryError
            self.spare = self.work + ((STAGES + 5) * 3 + 1) * width
            self.none = self.spare + 12 * width
            for k in range(3 * width):
                self.none[k] = 0.0
        return 0

    cdef double time_to_reach(self) noexcept nogil:
        # Time in which the slowest flight close to `reach` crosses it in a straight line, so that no flight ends far
        # beyond; flights that need more than the largest step are ignored.
        cdef double rr, rv, vv, dx, speed, longest = 0.0
        cdef Index k
        cdef int axis
        for k in range(self.n_flying):
            rr = rv = vv = 0.0
            for axis in range(3):
                dx, speed = self.x[axis * self.width + k] - self.centre[axis], self.v[axis * self.width + k]
                rr += dx * dx
                rv += dx * speed
                vv += speed ** 2
            if vv == 0.0:
                return INFINITY
            longest = max(longest, (sqrt(max(0.0, rv * rv + vv * (self.reach * self.reach - rr))) - rv) / vv)
        return 1.0001 * longest

    cdef double step_error(self, double dt, double tolerance) noexcept nogil:
        # Largest error of the step of all flights, relative to the tolerance.
        cdef Index n = 3 * self.width
        cdef double largest
        cdef double* speeds = self.spare + n
        weighted_sum(n, STAGES, POSITION_ERROR, self.a, n, self.sums)
        relative_lengths(self.width, dt * dt / tolerance, 0.1 * self.length, self.sums, self.trial, self.origin,
                         self.ratios)
        largest = self.largest_ratio(0.0)
        # the acceleration at the end of the step is that of the last stage
        weighted_sum(n, STAGES, VELOCITY_ERROR, self.a, n, self.sums)
        weighted_sum(n, STAGES, ENDS, self.a, n, self.spare)
        stage_places(n, 0.5 * dt, 1.0, self.v, self.spare, self.none, speeds)
        relative_lengths(self.width, dt / tolerance, 0.0, self.sums, speeds, self.none, self.ratios)
        return self.largest_ratio(largest)

    cdef double largest_ratio(self, double largest) noexcept nogil:
        cdef Index k
        cdef double s
        for k in range(self.n_flying):
            s = self.ratios[k]
            largest = max(largest, s) if s == s else INFINITY
        return largest

    cdef int gather(self, double dt) except -1 nogil:
        # Collects the sources for a ball that contains all flights until the end of the step.
        cdef double[4] whole
        cdef double[4 * PARTS] balls
        cdef double angle, largest = 0.0
        cdef const Nodes* roots
        cdef int part, axis
        enclosing_ball(self.width, self.x, self.v, self.a, 0.0, dt, whole)
        if self.opening_angle == 0.0:
            self.tree.collect(whole[0], whole[1], whole[2], whole[3], self.opening_angle, &self.sources)
            return 0
        if self.alone:
            if is_inside(whole, self.kept):
                return 0
            self.keep_ahead(dt, whole)
        self.n_parts = 0
        roots = &self.everything
        if self.in_lanes and whole[3] > 1e-3 * self.length:
            self.n_parts = PARTS
            for part in range(PARTS):
                enclosing_ball(self.width, self.x, self.v, self.a, BEGIN[part] * dt, END[part] * dt, balls + 4 * part)
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
            self.nest(whole, dt)
            if self.n_levels:
                roots = &self.levels[self.n_levels - 1].rest
        angle = self.opening_angle * (LONE if self.alone else 1.0)
        self.tree.walk_from(roots.n, roots.node, whole[0], whole[1], whole[2], whole[3], angle, &self.sources)
        self.tree.copy_single(whole, self.n_parts, balls, &self.sources, &self.near, &self.far)
        if self.n_parts and self.n_levels == 0 and self.far.n_atoms + self.far.n_cells <= FEW:
            self.tree.copy_single(whole, 0, NULL, &self.sources, &self.near, &self.far)
            self.n_parts = 0
        if not self.in_lanes:
            single_pad(&self.near)
        for part in range(self.n_parts):
            if self.n_parts > 1:
                single_part(&self.near, balls + 4 * part, &self.inside[part], &self.outside[part])
            self.expand(&self.expansions[part], self.n_levels, &self.far,
                        &self.outside[part] if self.n_parts > 1 else NULL)
        return 0

    cdef int nest(self, const double* whole, double dt) except -1 nogil:
        # Levels whose balls contain the ball of the step: two at the start, later one for a step outside all of them.
        cdef int number
        while self.n_levels and not is_inside(whole, self.levels[self.n_levels - 1].ball):
            self.n_levels -= 1
        if dt == 0.0:
            for number in range(LEVELS):
                self.add_level(whole, AROUND[number] * self.length)
        elif self.n_levels == 0 and whole[3] < LARGEST * self.length:
            self.add_level(whole, whole[3])
        return 0

    cdef int add_level(self, const double* centre, double radius) except -1 nogil:
        # A level inside of the present ones.
        cdef Level* level = &self.levels[self.n_levels]
        cdef const Nodes* roots = &self.levels[self.n_levels - 1].rest if self.n_levels else &self.everything
        cdef int axis
        for axis in range(3):
            level.ball[axis] = level.expansion.centre[axis] = centre[axis]
        level.ball[3] = level.expansion.radius = 1.05 * radius   # a stage may lie a little outside
        self.tree.part(roots, level.ball, self.opening_angle, FAR * level.ball[3], &self.sources, &level.rest)
        self.tree.copy_single(level.ball, 0, NULL, &self.sources, &self.far, &self.near)
        self.expand(&level.expansion, self.n_levels, &self.far, NULL)
        self.n_levels += 1
        return 0

    cdef int expand(self, Expansion* expansion, int n_levels, SingleSources* first, SingleSources* second
                    ) except -1 nogil:
        # Expands the field of sources, and of those beyond some levels.
        cdef double[3 * SAMPLES] samples
        cdef double[3] point, field
        cdef float[3 * PADDED] targets, above
        cdef int i, axis
        single_pad(first)
        if second != NULL:
            single_pad(second)
        for i in range(SAMPLES):
            self.far_field.point(expansion, i, point)
            single_field(first, point[0], point[1], point[2], samples + 3 * i)
            if second != NULL:
                single_field(second, point[0], point[1], point[2], field)
                for axis in range(3):
                    samples[3 * i + axis] += field[axis]
            for axis in range(3):
                targets[axis * PADDED + i] = <float>(point[axis] - expansion.centre[axis])
        self.n_pairs += SAMPLES * (first.n_atoms + first.n_cells)
        if second != NULL:
            self.n_pairs += SAMPLES * (second.n_atoms + second.n_cells)
        if n_levels:
            for i in range(3 * PADDED):
                above[i] = 0.0
            for axis in range(3):
                for i in range(SAMPLES, PADDED):
                    targets[axis * PADDED + i] = 0.0
            add_expanded(&self.levels[n_levels - 1].expansion, expansion.centre, PADDED, targets, above)
            for axis in range(3):
                for i in range(SAMPLES):
                    samples[3 * i + axis] += above[axis * PADDED + i]
        self.far_field.expand(expansion, samples)
        return 0

    cdef void keep_ahead(self, double dt, double* ball) noexcept nogil:
        # Widens the ball of a step of a flight alone to the way that follows: straight on from the end of the step.
        cdef double[3] centre
        cdef double s = 0.0, apart = 0.0, way
        cdef int axis
        if dt == 0.0:
            ball[3] = AT_START * self.length
        else:
            for axis in range(3):
                way = AHEAD * dt * self.v[axis] + (AHEAD - 0.5) * dt * dt * self.a[axis]
                centre[axis] = self.x[axis] + 0.5 * way
                s += way * way
                apart += (centre[axis] - ball[axis]) ** 2
                ball[axis] = centre[axis]
            ball[3] = max(0.5 * sqrt(s), ball[3] + sqrt(apart)) * 1.0001
        for axis in range(4):
            self.kept[axis] = ball[axis]

    cdef void evaluate(self, const double* x, double* a, int stage) noexcept nogil:
        # Accelerations [V/nm] of the flights at the places of a stage.
        cdef Index j, k, width = self.width
        cdef int axis, part = PART[stage] if self.n_parts > 1 else 0
        cdef float* field = self.lanes + 3 * width
        cdef double[3] one
        cdef SingleSources* near = &self.inside[part] if self.n_parts > 1 else &self.near
        self.n_evaluations += self.n_flying
        if self.in_lanes:
            into_lanes(width, x, near.origin, self.lanes)
            for j in range(3 * width):
                field[j] = 0.0
            bundle_atoms(near.n_atoms, near.capacity, near.atoms, width, self.lanes, field)
            bundle_cells(near.n_cells, near.capacity, near.cells, width, self.lanes, field)
            if self.n_parts:
                add_expanded(&self.expansions[part], near.origin, width, self.lanes, field)
            out_of_lanes(3 * width, self.coulomb, field, a)
            self.n_pairs += self.n_flying * (near.n_atoms + near.n_cells)
            return
        for k in range(width):
            if self.opening_angle == 0.0:
                sources_field(&self.sources, x[k], x[width + k], x[2 * width + k], one)
                self.n_pairs += self.sources.n_atoms + self.sources.n_cells
            else:
                single_field(near, x[k], x[width + k], x[2 * width + k], one)
                self.n_pairs += near.n_atoms + near.n_cells
            for axis in range(3):
                a[axis * width + k] = self.coulomb * one[axis]


# The kernels of a step alone, for tests: rows of any lengths.

def sum_of_rows(const double[::1] weights, const double[:, ::1] rows):
    """Weighted sum of rows, shape (n,)."""
    cdef double[::1] sums = np.empty(rows.shape[1])
    weighted_sum(rows.shape[1], <int>rows.shape[0], &weights[0], &rows[0, 0], rows.shape[1], &sums[0])
    return np.asarray(sums)


def places_of_stage(double dt, double node, const double[::1] x, const double[::1] v, const double[::1] sums):
    """Places x + dt (node v + dt sums), shape (n,)."""
    cdef double[::1] places = np.empty(x.shape[0])
    stage_places(x.shape[0], dt, node, &x[0], &v[0], &sums[0], &places[0])
    return np.asarray(places)


def ball_of_flights(const double[:, ::1] x, const double[:, ::1] v, const double[:, ::1] a, double begin, double end):
    """Centre and radius of a ball around flights at two times, shape (4,); x, v and a have the shape (3, n)."""
    cdef double[::1] ball = np.empty(4)
    enclosing_ball(x.shape[1], &x[0, 0], &v[0, 0], &a[0, 0], begin, end, &ball[0])
    return np.asarray(ball)


def lengths_in_steps(double scale, double more, const double[:, ::1] sums, const double[:, ::1] p,
                     const double[:, ::1] q):
    """The ratios scale |sums| / (|p - q| + more), shape (n,), of vectors of the shape (3, n)."""
    cdef double[::1] ratios = np.empty(p.shape[1])
    relative_lengths(p.shape[1], scale, more, &sums[0, 0], &p[0, 0], &q[0, 0], &ratios[0])
    return np.asarray(ratios)
