import numpy as np
import pytest
import twins
from scipy.integrate import solve_ivp

import apt_evap as ae
from apt_evap._core.flights import LEFT, NEVER_LEFT, Flights
from apt_evap._core.journal import Journal
from apt_evap._core.octree import Octree
from apt_evap.units import COULOMB, NM_PER_MM

DEFAULT = ae.simulation.FlightSettings()


def fly(tree, positions, velocities, groups=None, **options):
    """Ends (m, 7), outcomes (m,) and the object, of launches in a field in which no event happens."""
    settings = {
        "coulomb": COULOMB,
        "length": 0.249,
        "centre": (0.0, 0.0, 0.0),
        "reach": 8000 * 0.352,
        "opening_angle": 0.0,
        "tolerance": DEFAULT.tolerance,
        "max_steps": DEFAULT.max_steps,
    }
    flights = Flights(tree, **(settings | options))
    m = len(positions)
    start = np.arange(m + 1) if groups is None else np.asarray(groups, np.int64)
    end, outcome = np.empty((m, 7)), np.empty(m, np.int8)
    before_all = np.full(len(start) - 1, -1)  # an event before the first: the surface as it is
    flights.fly(
        Journal(np.zeros((1, 3)), 1),
        before_all,
        start,
        np.ascontiguousarray(positions),
        np.ascontiguousarray(velocities),
        end,
        outcome,
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
    )
    return end, outcome, flights


def landing(end, apex, distance=100.0):
    """Place on a plane `distance` mm in front of the apex [mm], (m, 2)."""
    ahead = (apex + distance * NM_PER_MM - end[:, 2]) / end[:, 5]
    return (end[:, :2] + end[:, 3:5] * ahead[:, None]) / NM_PER_MM


# ---- a single charge: closed form ----------------------------------------------------------------------------------

POINT = Octree(np.zeros((1, 3)), np.array([2.0]))
START, PUSH = np.array([[1.0, 0.3, 0.2]]), np.array([[-0.5, 0.8, 0.1]])  # inwards at first


def errors_against_hyperbola(end, strength=2.0, position=START[0], velocity=PUSH[0]):
    """Errors of place, velocity and time, all relative, at the radius where a flight ended."""
    radius = np.linalg.norm(end[:3])
    where, speed, time = twins.hyperbola(strength, position, velocity, radius)
    return np.array(
        [
            np.linalg.norm(where - end[:3]) / radius,
            np.linalg.norm(speed - end[3:6]) / np.linalg.norm(speed),
            abs(time / end[6] - 1),
        ]
    )


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-10])
def test_hyperbola(tolerance):
    end, outcome, _ = fly(POINT, START, PUSH, coulomb=1.0, length=0.05, reach=1e4, tolerance=tolerance)
    assert outcome[0] == LEFT
    # the tolerance is one of each step; what is kept is the better solution, of order 8; 1e-13 is rounding
    assert errors_against_hyperbola(end[0]).max() < max(tolerance, 1e-13)
    assert 1e4 < np.linalg.norm(end[0, :3]) < 1.01e4  # ends where it was asked to


@pytest.mark.parametrize(("opening_angle", "bound"), [(0.0, 2e-9), (0.3, 2e-4)])
def test_hyperbolas_of_a_bundle_whose_flights_end_in_different_steps(opening_angle, bound):
    random = np.random.default_rng(3)
    starts = START[0] + random.uniform(-0.1, 0.1, size=(23, 3))
    push = START[0] + random.normal(size=(23, 3)) * np.linspace(0.1, 2.0, 23)[:, None]
    settings = {"coulomb": 1.0, "length": 0.05, "reach": 200.0, "opening_angle": opening_angle, "tolerance": 1e-7}
    end, outcome, flights = fly(POINT, starts, push, groups=[0, 23], **settings)
    assert (outcome == LEFT).all()
    assert len(np.unique(end[:, 6])) > 3  # some end earlier than others, and the rest go on without them
    assert flights.n_evaluations < 23 * (8 * flights.n_steps + 1)
    for launch in range(23):
        # measured 6e-10; with expansions 7.7e-5, from a single charge that is 3 radii away
        assert errors_against_hyperbola(end[launch], position=starts[launch], velocity=push[launch]).max() < bound


def test_at_rest_in_the_field_of_a_charge():
    end, _, _ = fly(POINT, START, np.zeros((1, 3)), coulomb=1.0, reach=1e4, tolerance=1e-9)
    r0, r = np.linalg.norm(START), np.linalg.norm(end[0, :3])
    # straight out: t = sqrt(r0^3/(2 k q)) (sqrt(x (x - 1)) + arcosh(sqrt(x))), x = r/r0
    x = r / r0
    time = np.sqrt(r0**3 / 4.0) * (np.sqrt(x * (x - 1)) + np.arccosh(np.sqrt(x)))
    assert end[0, 6] == pytest.approx(time, rel=1e-9)
    assert np.linalg.norm(np.cross(end[0, :3], START[0])) < 1e-12 * r
    assert np.linalg.norm(end[0, 3:6]) == pytest.approx(np.sqrt(4.0 / r0 * (1 - 1 / x)), rel=1e-9)


def test_order_of_one_step():
    """One step h of a scheme of order p misses the closed form by h^(p + 1); the scheme is a Nystrom pair 8(6)."""
    lengths = 0.18 * 2.0 ** -np.arange(0.0, 2.5, 0.5)
    outwards = np.array([[0.5, 0.8, 0.1]])
    steps, errors = [], []
    for length in lengths:  # the first step is set by a length; a tolerance without bound accepts it
        end, outcome, _ = fly(POINT, START, outwards, coulomb=1.0, length=length, tolerance=1e30, max_steps=1)
        assert outcome[0] == NEVER_LEFT
        steps.append(end[0, 6])
        errors.append(errors_against_hyperbola(end[0], velocity=outwards[0])[:2].max())
    steps, errors = np.array(steps), np.array(errors)
    good = errors > 1e-14  # above rounding
    assert good.sum() >= 4
    slope = np.polyfit(np.log(steps[good]), np.log(errors[good]), 1)[0]
    assert slope > 8.0  # order 7 at least, as asked; 9 in the limit, measured 8.3 here and rising
    assert slope < 10.0


def test_smaller_tolerance_is_better():
    errors, evaluations = [], []
    for tolerance in 10.0 ** -np.arange(3, 10):
        end, _, flights = fly(POINT, START, PUSH, coulomb=1.0, length=0.01, reach=50.0, tolerance=tolerance)
        errors.append(errors_against_hyperbola(end[0]).max())
        evaluations.append(flights.n_evaluations)
    assert errors == sorted(errors, reverse=True)
    slope = np.polyfit(np.log(evaluations), np.log(errors), 1)[0]
    assert slope < -7.0  # an error of the order 7 or better in the number of steps


def test_a_charge_state_only_rescales_time():
    """In reduced units a path depends on energy over charge: four times the field, half the time, twice the speed."""
    one = fly(POINT, START, PUSH, coulomb=1.0, reach=1e3)[0][0]
    four = fly(POINT, START, 2 * PUSH, coulomb=4.0, reach=1e3)[0][0]
    # steps follow the path, but for rounding
    assert four[:3] == pytest.approx(one[:3], rel=1e-9)
    assert four[3:6] == pytest.approx(2 * one[3:6], rel=1e-9)
    assert four[6] == pytest.approx(one[6] / 2, rel=1e-9)


# ---- outcomes ------------------------------------------------------------------------------------------------------


def test_an_ion_without_steps_never_leaves():
    end, outcome, _ = fly(POINT, START, PUSH, max_steps=5)
    assert outcome[0] == NEVER_LEFT
    assert np.isfinite(end).all()
    _, outcome, _ = fly(POINT, START, PUSH)
    assert outcome[0] == LEFT


def test_no_field_no_acceleration():
    nothing = Octree(np.zeros((1, 3)), np.zeros(1))
    end, outcome, _ = fly(nothing, START, PUSH, reach=100.0)
    assert outcome[0] == LEFT
    assert np.array_equal(end[0, 3:6], PUSH[0])
    assert end[0, :3] == pytest.approx(START[0] + PUSH[0] * end[0, 6], rel=1e-12)
    _, outcome, _ = fly(nothing, START, 0 * PUSH)
    assert outcome[0] == NEVER_LEFT


# ---- spheres: radial -----------------------------------------------------------------------------------------------


def test_radial_by_symmetry():
    """Charges of octahedral symmetry: an axis of four is a path."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    axes = np.concatenate([np.eye(3), -np.eye(3)]) * 1.5
    tree = Octree(3 * np.concatenate([corner, axes]), np.ones(14))
    for axis in (np.eye(3)[0], np.eye(3)[2], np.ones(3) / np.sqrt(3)):
        end, _, _ = fly(tree, [axis * 6.0], np.zeros((1, 3)))
        # asked: 1e-6; rounding grows along the way, as in a field that diverges
        assert np.linalg.norm(np.cross(axis, end[0, :3])) < 1e-12 * np.linalg.norm(end[0, :3])


def test_radial_on_a_dense_sphere():
    """The field of 20,000 even points, some spacings away, is a sphere's: ripples fall as exp(-2 pi height/spacing)."""
    n, radius = 20_000, 7.0
    k = np.arange(n) + 0.5
    z, azimuth = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    points = np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1)
    tree = Octree(radius * points, np.full(n, 0.1))
    spacing = radius * np.sqrt(4 * np.pi / n)
    starts = points[5000:15000:500] * (radius + 3 * spacing)  # away from the poles, where the spiral is uneven
    end, outcome, _ = fly(tree, starts, np.zeros_like(starts))
    assert (outcome == LEFT).all()
    away = np.linalg.norm(np.cross(starts, end[:, :3]), axis=1)
    away /= np.linalg.norm(starts, axis=1) * np.linalg.norm(end[:, :3], axis=1)
    assert away.max() < 1e-5  # exp(-6 pi) = 7e-9 for the ripple; the rest is the unevenness at the poles, 1/n
    # and the energy is that of the sphere
    energy = 0.5 * np.linalg.norm(end[:, 3:6], axis=1) ** 2 + COULOMB * 0.1 * n / np.linalg.norm(end[:, :3], axis=1)
    assert energy == pytest.approx(COULOMB * 0.1 * n / (radius + 3 * spacing), rel=1e-5)


# ---- a specimen ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def scene(surface12, tip12):
    """Tree of the surface of `tip12` after its most charged atom has left, and launches of it and of other atoms."""
    positions, normals, charges = surface12
    top = np.flatnonzero(positions[:, 2] > 0.5 * tip12.apex)
    ions = top[np.argsort(-charges[top])[:12]]
    left = np.ones(len(positions), bool)
    left[ions[0]] = False
    # launches just above the atoms, but for the one whose site is empty
    starts = positions[ions] + normals[ions] * 0.5 * tip12.nearest_neighbour_distance
    starts[0] = positions[ions[0]]
    generator = np.random.default_rng(5)
    push = generator.normal(size=(12, 3)) * 0.4
    push[::3] = 0.0
    return positions[left], charges[left], starts, push


def options(tip, **more):
    d = tip.nearest_neighbour_distance
    return {"length": d, "centre": (0.0, 0.0, tip.apex), "reach": DEFAULT.reach * d} | more


def total_energy(end, atoms, charges):
    return 0.5 * (end[:, 3:6] ** 2).sum(axis=1) + COULOMB * twins.potential(end[:, :3], atoms, charges)


def energy_drift(scene, tip, **more):
    atoms, charges, starts, push = scene
    end, outcome, _ = fly(Octree(atoms, charges), starts, push, **options(tip, **more))
    assert (outcome == LEFT).all()
    before = 0.5 * (push**2).sum(axis=1) + COULOMB * twins.potential(starts, atoms, charges)
    return np.abs(total_energy(end, atoms, charges) / before - 1).max()


def test_energy_is_conserved(scene, tip12):
    # asked: 1e-6 with exact sums; the default tolerance, 1e-3, is for the step of order 6, and order 8 is kept: 1.2e-7
    assert energy_drift(scene, tip12) < 1e-6
    assert energy_drift(scene, tip12, tolerance=1e-9) < 1e-11
    # by the tree the field is no exact gradient: measured 5e-6 at the default angle, 2e-7 at 0.1
    by_tree = energy_drift(scene, tip12, opening_angle=DEFAULT.opening_angle)
    assert 1e-7 < by_tree < 5e-5
    assert energy_drift(scene, tip12, opening_angle=0.1) < by_tree


def dop853(atoms, charges, start, push, centre, reach):
    """Twin: DOP853 by SciPy with direct sums, rtol 1e-10, stopped at `reach`."""

    def derivative(t, y):
        return np.concatenate([y[3:], COULOMB * twins.field(y[None, :3], atoms, charges)[0]])

    def away(t, y):
        return np.linalg.norm(y[:3] - centre) - reach

    away.terminal = True
    found = solve_ivp(derivative, (0, 1e9), [*start, *push], "DOP853", rtol=1e-10, atol=1e-12, events=away)
    return np.array([*found.y[:, -1], found.t[-1]])


@pytest.fixture(scope="session")
def reference(scene, tip12):
    atoms, charges, starts, push = scene
    centre, reach = np.array([0.0, 0.0, tip12.apex]), DEFAULT.reach * tip12.nearest_neighbour_distance
    return np.array(
        [dop853(atoms, charges, start, v, centre, reach) for start, v in zip(starts[:6], push[:6], strict=True)]
    )


def test_places_on_the_detector(scene, tip12, reference):
    atoms, charges, starts, push = scene
    tree, expected = Octree(atoms, charges), landing(reference, tip12.apex)
    exact, *_ = fly(tree, starts[:6], push[:6], **options(tip12))
    error = np.linalg.norm(landing(exact, tip12.apex) - expected, axis=1)
    assert error.max() < 0.01  # asked, mm on a flight of 100 mm
    assert np.median(error) < 0.001
    fine, *_ = fly(tree, starts[:6], push[:6], **options(tip12, tolerance=1e-9))
    assert np.linalg.norm(landing(fine, tip12.apex) - expected, axis=1).max() < 1e-6
    # time of flight to the plane: neither ends exactly at `reach`, the field beyond is as good as nothing
    times = [e[:, 6] + (tip12.apex + 1e8 - e[:, 2]) / e[:, 5] for e in (fine, reference)]
    assert times[0] == pytest.approx(times[1], rel=1e-6)
    by_tree, *_ = fly(tree, starts[:6], push[:6], **options(tip12, opening_angle=DEFAULT.opening_angle))
    assert np.linalg.norm(landing(by_tree, tip12.apex) - expected, axis=1).max() < 0.05


def test_the_verlet_of_the_paper(scene, tip12, reference):
    """It converges to where these flights end as its steps get smaller.

    Not with their square: far out, where |v| hardly changes, c |v|/|a| grows with the square of the distance, and from
    R/(2 c) on a step is longer than the way so far. The deflection left there falls with c, and so does the error.
    """
    atoms, charges, starts, push = scene
    d, expected = tip12.nearest_neighbour_distance, landing(reference[:2], tip12.apex)
    centre = np.array([0.0, 0.0, tip12.apex])

    def acceleration(x):
        return COULOMB * twins.field(x[None], atoms, charges)[0]

    errors, counts = [], []
    for factor in (0.16, 0.08, 0.04):
        ends = [
            twins.verlet(acceleration, starts[i], push[i], centre, DEFAULT.reach * d, factor, 1e-6 * 0.352)
            for i in range(2)
        ]
        places = landing(np.array([[*x, *v, t] for x, v, t, _ in ends]), tip12.apex)
        errors.append(np.linalg.norm(places - expected, axis=1).max())
        counts.append(ends[0][3])
    assert 80 < counts[1] < 250  # of 117 steps from rest the paper's prototype knows
    assert errors == sorted(errors, reverse=True)
    assert errors[1] < errors[0] / 1.8
    assert errors[2] < errors[1] / 1.8
    assert errors[1] < 0.2  # mm at the factor of the paper, 0.08
    # and at its smallest step it is still worse than this scheme at the default tolerance, with fewer evaluations
    ours, _, flights = fly(Octree(atoms, charges), starts[:2], push[:2], **options(tip12))
    assert np.linalg.norm(landing(ours, tip12.apex) - expected, axis=1).max() < errors[2]
    assert flights.n_evaluations / 2 < 2 * counts[2]


def test_flights_that_share_their_steps(scene, tip12):
    """Launches of one group land where each would alone, within what the steps differ."""
    atoms, charges, starts, push = scene
    tree = Octree(atoms, charges)
    starts = np.repeat(starts[:3], 4, axis=0)
    push = np.random.default_rng(2).normal(size=(12, 3)) * 0.5
    alone, *_ = fly(tree, starts, push, **options(tip12))
    together, outcome, _ = fly(tree, starts, push, groups=[0, 4, 8, 12], **options(tip12))
    assert (outcome == LEFT).all()
    error = np.linalg.norm(landing(alone, tip12.apex) - landing(together, tip12.apex), axis=1)
    assert error.max() < 0.02  # both within 0.01 mm of the exact place
    assert np.median(error) < 0.002


def test_sums_with_the_flights_in_the_vector_lanes(scene, tip12):
    """A group at one place has the accelerations of two flights there, whose sums have the sources in the lanes."""
    atoms, charges, starts, _ = scene
    tree = Octree(atoms, charges)
    for opening_angle, height in ((1e-3, 0.3), (0.3, 0.3), (0.3, 30.0)):  # atoms; near cells too; cells only
        flights = fly(tree, starts[:1], 0 * starts[:1], **options(tip12, opening_angle=opening_angle))[2]
        for n in (6, 16, 17, 40):
            offsets = 1e-5 * np.random.default_rng(n).normal(size=(n, 3))
            places = starts[1] + [0.0, 0.0, height] + offsets
            together = flights.accelerations(places)
            two = np.concatenate([flights.accelerations(np.stack([place, place]))[:1] for place in places])
            # the gradients are below 1e3 V/nm^2; single precision
            np.testing.assert_allclose(together, two, rtol=0, atol=3e-6 * np.linalg.norm(two, axis=1).max())
            assert not np.array_equal(together[0], together[1])


def test_the_field_of_a_group_against_direct_sums(scene, tip12):
    """Near sources and the expansion of distant ones, for launches that lie up to 0.3 nm apart."""
    atoms, charges, starts, _ = scene
    tree = Octree(atoms, charges)
    for height, bound in ((0.0, 2e-4), (2.0, 5e-5), (20.0, 5e-5)):
        flights = fly(tree, starts[:1], 0 * starts[:1], **options(tip12, opening_angle=0.3))[2]
        places = starts[1] + [0.0, 0.0, height] + np.random.default_rng(3).uniform(-0.15, 0.15, size=(50, 3))
        expected = COULOMB * twins.field(places, atoms, charges)
        error = np.linalg.norm(flights.accelerations(places) - expected, axis=1) / np.linalg.norm(expected, axis=1)
        assert error.max() < bound  # measured 9e-5, 1e-5 and 2e-5


def test_the_field_at_the_start_of_a_flight_alone_against_direct_sums(scene, tip12):
    """Its sources are those of a ball around the start that contains its first steps, too."""
    atoms, charges, starts, _ = scene
    flights = fly(Octree(atoms, charges), starts[:1], 0 * starts[:1], **options(tip12, opening_angle=0.3))[2]
    expected = COULOMB * twins.field(starts, atoms, charges)
    alone = np.concatenate([flights.accelerations(start[None]) for start in starts])
    two = np.concatenate([flights.accelerations(np.stack([start, start]))[:1] for start in starts])
    errors = [np.linalg.norm(field - expected, axis=1) / np.linalg.norm(expected, axis=1) for field in (alone, two)]
    assert errors[0].max() < 5e-5  # measured 1.2e-5
    assert np.median(errors[0]) < np.median(errors[1])  # of a ball without extent, with the smaller angle


def test_a_flight_alone_collects_its_sources_anew_on_a_bent_way(scene, tip12):
    """Launches with all their energy along the surface or into it leave the ball of their first sources sidewards."""
    atoms, charges, starts, _ = scene
    push = np.random.default_rng(5).normal(size=starts.shape)
    push *= np.sqrt(2 * 1.5) / np.linalg.norm(push, axis=1, keepdims=True)
    exact, out, _ = fly(Octree(atoms, charges), starts, push, **options(tip12, opening_angle=0.0))
    end, outcome, _ = fly(Octree(atoms, charges), starts, push, **options(tip12, opening_angle=0.3))
    both = (out == LEFT) & (outcome == LEFT)
    error = np.linalg.norm(landing(end, tip12.apex) - landing(exact, tip12.apex), axis=1)[both]
    assert both.sum() > 0.8 * len(starts)
    assert np.median(error) < 0.002  # measured 0.0008 mm, largest 0.0013 mm
    assert error.max() < 0.004


def test_a_bundle_lands_where_its_launches_do_alone(scene, tip12):
    """The launches of responses, from places 0.3 nm apart, against exact sums for each alone."""
    atoms, charges, starts, _ = scene
    tree, random = Octree(atoms, charges), np.random.default_rng(8)
    starts = starts[1] + random.uniform(-0.12, 0.12, size=(60, 3)) + [0.0, 0.0, 0.1]
    push = random.normal(size=(60, 3)) * 0.7
    together, outcome, _ = fly(tree, starts, push, groups=[0, 60], **options(tip12, opening_angle=0.3))
    assert (outcome == LEFT).all()
    exact, *_ = fly(tree, starts[::6], push[::6], **options(tip12, tolerance=1e-9))
    error = np.linalg.norm(landing(together[::6], tip12.apex) - landing(exact, tip12.apex), axis=1)
    assert np.median(error) < 0.002  # mm; measured 0.0008
    assert error.max() < 0.003  # measured 0.0014


def test_a_bundle_above_a_dense_sphere():
    """It leaves radially, with the energy of the field of a sphere."""
    n, radius = 20_000, 7.0
    k = np.arange(n) + 0.5
    z, azimuth = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    tree = Octree(
        radius * np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1),
        np.full(n, 0.1),
    )
    starts = np.array([7.2, 2.0, 0.5]) + np.random.default_rng(1).uniform(-0.15, 0.15, size=(40, 3))
    end, outcome, _ = fly(tree, starts, np.zeros((40, 3)), groups=[0, 40], opening_angle=0.3)
    assert (outcome == LEFT).all()
    away = np.linalg.norm(np.cross(starts, end[:, :3]), axis=1)
    away /= np.linalg.norm(starts, axis=1) * np.linalg.norm(end[:, :3], axis=1)
    energy = 0.5 * np.linalg.norm(end[:, 3:6], axis=1) ** 2 + COULOMB * 0.1 * n / np.linalg.norm(end[:, :3], axis=1)
    error = np.abs(energy / (COULOMB * 0.1 * n / np.linalg.norm(starts, axis=1)) - 1)
    assert away.max() < 4e-5  # measured 1.5e-5
    assert error.max() < 1.5e-5  # measured 4e-6


def test_flights_follow_the_events(tip12):
    """Each ion flies in the field that its own event left behind: in a copy of the surface, replayed so far."""
    emitter = ae.evaporation.Emitter(tip12)
    batch = emitter.evaporate(30)
    starts = tip12.positions[batch.site]
    flights = Flights(batch.tree, coulomb=COULOMB, opening_angle=0.3, tolerance=1e-3, max_steps=500, **options(tip12))
    end, outcome = np.empty((30, 7)), np.empty(30, np.int8)
    flights.fly(
        batch.journal,
        np.arange(30),
        np.arange(31),
        starts,
        np.zeros((30, 3)),
        end,
        outcome,
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
    )
    copy = batch.tree.copy()
    for event in range(30):
        batch.journal.replay_on(copy, event)
        alone, *_ = fly(copy, starts[event : event + 1], np.zeros((1, 3)), **options(tip12, opening_angle=0.3))
        assert np.array_equal(alone[0], end[event])


def test_a_group_starts_at_the_place_of_a_leaf_whose_atom_is_gone():
    """The empty cell there has no field: the flights of the group leave together, in the usual number of steps."""
    random = np.random.default_rng(4)
    for _ in range(40):
        atoms = random.normal(size=(60, 3))
        charges = np.ones(60)
        charges[0] = 0.0
        atoms[0] *= 2.5 / np.linalg.norm(atoms[0])
        starts = atoms[0] * (1 + 0.04 * np.array([0.0, 1, 1, 1, 1, 1, 1]))[:, None]
        launches = random.normal(scale=0.5, size=(7, 3))
        tree = Octree(atoms, charges, leaf_size=1)
        end, outcome, flights = fly(tree, starts, launches, groups=[0, 7], opening_angle=0.3)
        alone, *_ = fly(tree, starts, launches)
        assert (outcome == LEFT).all() and flights.n_steps < 25  # 13 to 16; 500 and more if one of them hits an atom
        # directions: the opening angle of 0.3 against direct sums
        directions = [each[:, 3:6] / np.linalg.norm(each[:, 3:6], axis=1)[:, None] for each in (end, alone)]
        assert np.abs(directions[0] - directions[1]).max() < 2e-3


def test_a_launch_that_starts_at_an_atom_is_given_up_soon():
    end, outcome, flights = fly(POINT, np.zeros((1, 3)), np.zeros((1, 3)), opening_angle=0.3)
    assert outcome[0] == NEVER_LEFT and flights.n_steps < 20 and np.isfinite(end[0, :3]).all()


def test_flights_halt_and_go_on(tip12):
    """Halted, they take no ion; batch by batch the surface is followed to the state it has after all events."""
    emitter = ae.evaporation.Emitter(tip12)
    first, second = emitter.evaporate(10), emitter.evaporate(10)
    flights = Flights(first.tree, coulomb=COULOMB, opening_angle=0.3, tolerance=1e-3, max_steps=500, **options(tip12))
    expected = Flights(first.tree, coulomb=COULOMB, opening_angle=0.3, tolerance=1e-3, max_steps=500, **options(tip12))
    ends = []
    for flier, halts in ((flights, [1, 0, 1, 0]), (expected, [0, 0])):
        for batch in (first, second):
            end, outcome, counter = np.full((10, 7), np.nan), np.full(10, NEVER_LEFT, np.int8), np.zeros(1, np.int64)
            for halt in halts[: len(halts) // 2]:
                taken = counter[0]
                flier.fly(
                    batch.journal,
                    np.arange(10),
                    np.arange(11),
                    tip12.positions[batch.site],
                    np.zeros((10, 3)),
                    end,
                    outcome,
                    counter,
                    np.array([halt]),
                )
                assert (counter[0] == taken) == bool(halt)
            flier.follow(batch.journal)
            assert (outcome == LEFT).all()
            ends.append(end)
    assert np.array_equal(ends[0], ends[2])
    assert np.array_equal(ends[1], ends[3])
