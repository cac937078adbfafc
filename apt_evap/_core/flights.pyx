"""Flights of ions from the surface to the end of the field.

Flights are in reduced units: charge and mass of the ion are 1, so velocities are in sqrt(V) and times in nm/sqrt(V);
the path of an ion depends only on its energy per charge. Flights that start together (one ion with many perturbations)
have common steps, with one walk through the tree per step: the sources for a ball around all flights are collected
once, then summed for every stage and flight.

The scheme is the Runge-Kutta-Nystrom pair of orders 8 and 6 of Dormand, El-Mikkawy and Prince (IMA J. Numer. Anal. 7,
423, 1987), nine stages per step.
"""

from libc.math cimport INFINITY, NAN, sqrt
from libc.stdlib cimport free, malloc

from apt_evap._core.far_field cimport SAMPLES, FarField
from apt_evap._core.index cimport Index
from apt_evap._core.journal cimport Journal
from apt_evap._core.octree cimport Octree
from apt_evap._core.sources cimport (
    SingleSources, Sources, single_field, single_free, sources_field, sources_free, sources_init,
)

cdef extern from "elementary.h":
    double inverse_seventh_root(double) noexcept nogil
    void sine_cosine(double, double*, double*) noexcept nogil


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

# Distance in radii of the ball of a step from which sources are expanded, for few flights and for many. Measured on
# Ni[111], R = 8 and 12 a: with 3.5, times of flight deviate by 1.1e-5 instead of 0.7e-5 (RMS), places by 1.6 instead of
# 1.4 um. Many flights are those of wide responses, whose polynomials deviate more: 2.0e-5, 2 um and above.
cdef double FAR = 4.5
cdef double FAR_OF_MANY = 3.5
cdef Index MANY = 32
cdef Index MOST_REFUSED = 12  # successive steps that hit an atom, each a tenth of the one before: it starts at one

cdef double[9] NODE = [0.0, 1 / 20.0, 1 / 10.0, 3 / 10.0, 1 / 2.0, 7 / 10.0, 9 / 10.0, 1.0, 1.0]
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
    cdef bint expanded
    cdef double coulomb, length, reach, opening_angle, tolerance
    cdef double[3] centre
    cdef Index max_steps, fewest
    cdef Index capacity
    cdef double* work          # (STAGES + 3, capacity, 3): accelerations, then position, velocity, trial position
    cdef Index* flying         # (capacity,) flights that have not ended
    cdef readonly Index n_steps, n_evaluations, n_pairs

    def __cinit__(self, *args, **kwargs):
        self.work = NULL
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
        cdef double time = 0.0, dt, largest, s, length, away
        cdef Index i, flying = m, steps, refused = 0
        cdef int stage, k, axis
        if m > self.capacity:
            free(self.work)
            free(self.flying)
            self.capacity = m
            self.work = <double*>malloc((STAGES + 3) * 3 * m * sizeof(double))
            self.flying = <Index*>malloc(m * sizeof(Index))
            if self.work == NULL or self.flying == NULL:
                with gil:
                    raise MemoryError
        a, x = self.work, self.work + STAGES * 3 * m
        v, trial = x + 3 * m, x + 6 * m
        for i in range(m):
            outcome[i] = ION_NEVER_LEFT
            for axis in range(3):
                x[3 * i + axis] = positions[3 * i + axis]
                v[3 * i + axis] = velocities[3 * i + axis]
                a[3 * i + axis] = 0.0
        # a first step of a tenth of an atomic distance, from the acceleration at the start
        self.gather(m, x, v, a, outcome, 0.0)
        self.evaluate(m, x, a, outcome)
        dt = 1e30
        for i in range(m):
            s = sqrt(a[3 * i] ** 2 + a[3 * i + 1] ** 2 + a[3 * i + 2] ** 2)
            length = sqrt(v[3 * i] ** 2 + v[3 * i + 1] ** 2 + v[3 * i + 2] ** 2)
            dt = min(dt, 0.2 * self.length / (length + sqrt(0.2 * self.length * s) + 1e-30))
        for steps in range(self.max_steps):
            # stages i of the step: positions x + dt (c_i v + dt sum_k a_ik f_k), and the accelerations f_i there
            dt = min(dt, self.time_to_reach(m, x, v, outcome))
            self.gather(m, x, v, a, outcome, dt)
            for stage in range(1, STAGES):   # the last stage of a step is the first of the next one
                for i in range(m):
                    if outcome[i] == ION_NEVER_LEFT:
                        for axis in range(3):
                            s = 0.0
                            for k in range(stage):
                                s += STAGE[9 * stage + k] * a[3 * (k * m + i) + axis]
                            trial[3 * i + axis] = x[3 * i + axis] + dt * (NODE[stage] * v[3 * i + axis] + dt * s)
                self.evaluate(m, trial, a + 3 * m * stage, outcome)
            # accept the step if the largest error is below the tolerance: v += dt sum_k b_k f_k
            largest = 0.0
            for i in range(m):
                if outcome[i] == ION_NEVER_LEFT:
                    largest = max(largest, self.step_error(i, m, dt, a, v, positions, trial))
            self.n_steps += 1
            if largest <= 1.0:
                refused = 0
                time += dt
                for i in range(m):
                    if outcome[i] != ION_NEVER_LEFT:
                        continue
                    away = 0.0
                    for axis in range(3):
                        s = 0.0
                        for k in range(STAGES):
                            s += VELOCITY[k] * a[3 * (k * m + i) + axis]
                        x[3 * i + axis] = trial[3 * i + axis]
                        v[3 * i + axis] += dt * s
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

    cdef double step_error(self, Index i, Index m, double dt, const double* a, const double* v, const double* origin,
                           const double* trial) noexcept nogil:
        # Largest error of the step, relative to the tolerance.
        cdef double dx, dv, ex = 0.0, ev = 0.0, path = 0.0, speed = 0.0, new
        cdef int axis, k
        for axis in range(3):
            dx = dv = 0.0
            new = v[3 * i + axis]
            for k in range(STAGES):
                dx += POSITION_ERROR[k] * a[3 * (k * m + i) + axis]
                dv += VELOCITY_ERROR[k] * a[3 * (k * m + i) + axis]
                new += dt * VELOCITY[k] * a[3 * (k * m + i) + axis]
            ex += dx * dx
            ev += dv * dv
            path += (trial[3 * i + axis] - origin[3 * i + axis]) ** 2
            speed += new * new
        ex = dt * dt * sqrt(ex) / (self.tolerance * (sqrt(path) + 0.1 * self.length))
        ev = dt * sqrt(ev) / (self.tolerance * sqrt(speed))
        return max(ex, ev) if ex == ex and ev == ev else INFINITY

    cdef int gather(self, Index m, const double* x, const double* v, const double* a, const signed char* outcome,
                    double dt) except -1 nogil:
        # Collects the sources for a ball that contains all flights until the end of the step.
        cdef double cx = 0.0, cy = 0.0, cz = 0.0, radius = 0.0, far, dx, dy, dz
        cdef double[3] origin, point
        cdef double[3 * SAMPLES] samples
        cdef Index i, n = 0
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                n += 1
                cx += x[3 * i] + 0.5 * dt * (v[3 * i] + 0.5 * dt * a[3 * i])
                cy += x[3 * i + 1] + 0.5 * dt * (v[3 * i + 1] + 0.5 * dt * a[3 * i + 1])
                cz += x[3 * i + 2] + 0.5 * dt * (v[3 * i + 2] + 0.5 * dt * a[3 * i + 2])
        cx /= n
        cy /= n
        cz /= n
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                dx, dy, dz = x[3 * i] - cx, x[3 * i + 1] - cy, x[3 * i + 2] - cz
                radius = max(radius, dx * dx + dy * dy + dz * dz)
                dx += dt * (v[3 * i] + 0.5 * dt * a[3 * i])
                dy += dt * (v[3 * i + 1] + 0.5 * dt * a[3 * i + 1])
                dz += dt * (v[3 * i + 2] + 0.5 * dt * a[3 * i + 2])
                radius = max(radius, dx * dx + dy * dy + dz * dz)
        radius = sqrt(radius)
        if self.opening_angle == 0.0:
            self.tree.collect(cx, cy, cz, radius, self.opening_angle, &self.sources)
            return 0
        self.expanded = n >= self.fewest and radius > 1e-3 * self.length
        far = radius * (FAR if n < MANY else FAR_OF_MANY)
        origin[0], origin[1], origin[2] = cx, cy, cz
        self.tree.collect_single(origin, radius, self.opening_angle, far if self.expanded else INFINITY,
                                 &self.sources, &self.near, &self.far)
        if self.expanded:
            self.far_field.centre[0], self.far_field.centre[1], self.far_field.centre[2] = cx, cy, cz
            self.far_field.radius = 1.05 * radius   # a stage may lie a little outside
            for i in range(SAMPLES):
                self.far_field.point(i, point)
                single_field(&self.far, point[0], point[1], point[2], samples + 3 * i)
            self.far_field.expand(samples)
            self.n_pairs += SAMPLES * (self.far.n_atoms + self.far.n_cells)
        return 0

    cdef void evaluate(self, Index m, const double* x, double* a, const signed char* outcome) noexcept nogil:
        # Accelerations [V/nm] of the unfinished flights.
        cdef Index i, n = 0
        cdef int axis
        for i in range(m):
            if outcome[i] == ION_NEVER_LEFT:
                if self.opening_angle > 0.0:
                    single_field(&self.near, x[3 * i], x[3 * i + 1], x[3 * i + 2], a + 3 * i)
                    self.n_pairs += self.near.n_atoms + self.near.n_cells
                else:
                    sources_field(&self.sources, x[3 * i], x[3 * i + 1], x[3 * i + 2], a + 3 * i)
                    self.n_pairs += self.sources.n_atoms + self.sources.n_cells
                self.flying[n] = i
                n += 1
        if self.opening_angle > 0.0 and self.expanded:
            self.far_field.add(n, x, self.flying, a)
        for i in range(n):
            for axis in range(3):
                a[3 * self.flying[i] + axis] *= self.coulomb
        self.n_evaluations += n
