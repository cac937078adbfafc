import numpy as np
import pytest
import twins
from hypothesis import given
from hypothesis import strategies as st

import apt_evap as ae
from apt_evap._core.interactions import InteractionLists
from apt_evap._core.morton import morton_order, split
from apt_evap._core.octree import Octree

DEFAULT_ANGLE = ae.evaporation.ChargeSettings().opening_angle


def rms(error, reference):
    return np.sqrt((error**2).sum() / (reference**2).sum())


def surface_points(surface, tip, rng, n=300):
    """Points from 0.3 nm to 30 nm over the surface, where ions fly."""
    positions, normals, _ = surface
    chosen = rng.choice(np.flatnonzero(positions[:, 2] > 0), n, replace=False)
    return positions[chosen] + normals[chosen] * 0.3 * 100 ** rng.random((n, 1))


def members(tree):
    """Slots [first, last) of every node. With unit charges a cell's charge is its number of atoms, in preorder."""
    tree = tree.copy()
    tree.charges = np.ones(tree.n_slots)
    _, cells, parents = tree.nodes
    n = np.rint(cells[:, 3]).astype(int)
    leaf = np.ones(len(n), bool)
    leaf[parents[1:]] = False
    before = np.concatenate([[0], np.cumsum(np.where(leaf, n, 0))])[:-1]
    return before, before + n


# ---- against direct sums -------------------------------------------------------------------------------------------


def test_exact_sums(surface12, tip12, rng):
    positions, _, charges = surface12
    tree, points = Octree(positions, charges), surface_points(surface12, tip12, rng)
    field, potential = twins.field(points, positions, charges), twins.potential(points, positions, charges)
    # rounding: 8,000 terms of one sign in the potential, in another order; 1e-16 sqrt(8000) and some cancellation
    assert rms(tree.fields(points, 0.0) - field, field) < 1e-13
    assert rms(tree.potentials(points, 0.0) - potential, potential) < 1e-13


def test_smaller_opening_angle_is_better(surface12, tip12, rng):
    positions, _, charges = surface12
    tree, points = Octree(positions, charges), surface_points(surface12, tip12, rng)
    field, potential = twins.field(points, positions, charges), twins.potential(points, positions, charges)
    angles = (0.8, 0.6, 0.4, 0.2)
    fields = [rms(tree.fields(points, angle) - field, field) for angle in angles]
    potentials = [rms(tree.potentials(points, angle) - potential, potential) for angle in angles]
    assert fields == sorted(fields, reverse=True)
    assert potentials == sorted(potentials, reverse=True)
    # quadrupoles leave an octupole, (theta/2)^3 of the monopole at worst in the potential, one power of the distance
    # more in the field: 0.4 against 0.8 gains a factor of 8, were the lists of cells the same; 4 allows for that
    assert fields[2] < fields[0] / 4
    assert potentials[2] < potentials[0] / 4


def test_a_cell_leaves_the_octupole(rng):
    """Charge, dipole and quadrupole of a cell are exact, so its relative error falls with the cube of the distance."""
    positions, charges = rng.random((16, 3)), rng.random(16)
    tree = Octree(positions, charges)
    direction = rng.normal(size=(20, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    distances, errors = 10.0 * 2.0 ** np.arange(4), []
    for distance in distances:
        points = 0.5 + distance * direction
        exact = twins.potential(points, positions, charges), twins.field(points, positions, charges)
        by_cell = tree.potentials(points, 1.0), tree.fields(points, 1.0)
        errors.append([rms(found - wanted, wanted) for found, wanted in zip(by_cell, exact, strict=True)])
    for slope in np.polyfit(np.log(distances), np.log(errors), 1)[0]:
        assert slope == pytest.approx(-3.0, abs=0.1)  # a wrong quadrupole would leave the square


@pytest.mark.parametrize("double", [False, True])
def test_sweep_is_the_field_of_all_others(surface12, double):
    positions, _, charges = surface12
    tree = Octree(positions, charges)
    field, some = np.empty((len(positions), 3)), slice(None, None, 8)
    expected = twins.field(tree.positions[some], tree.positions, tree.charges)
    InteractionLists(tree, 0.0).sweep(field, double_precision=double)
    # float32 carries 6e-8 per term, about a group's middle; its sums of 8,000 terms stay at 1e-6
    assert rms(field[some] - expected, expected) < (1e-13 if double else 2e-6)
    InteractionLists(tree, DEFAULT_ANGLE).sweep(field, double_precision=double)
    assert 1e-5 < rms(field[some] - expected, expected) < 1e-3  # as asked of the default; and cells were in use


def test_lists_with_another_angle_are_those_made_with_it(surface12):
    positions, _, charges = surface12
    tree = Octree(positions, charges)
    field, again = np.empty((2, len(positions), 3))
    made, derived = InteractionLists(tree, 0.8), InteractionLists(tree, 0.4).with_angle(0.8)
    made.sweep(field)
    derived.sweep(again)
    assert (field == again).all()
    assert made.pairs == derived.pairs != InteractionLists(tree, 0.4).pairs


def test_changes_by_their_atoms(surface12, rng):
    """Without cells: the field of changes of either sign, added once also where an atom pads its group."""
    positions, _, charges = surface12
    positions, changes = positions[:1003], rng.normal(size=1003)  # 31 groups and a part of one
    tree = Octree(positions, charges[:1003])
    field, before = np.zeros((2, 1003, 3)) + rng.normal(size=(1003, 3))
    InteractionLists(tree, 0.0).add_changes(field, changes)
    expected = twins.field(tree.positions, tree.positions, changes)
    assert rms(field - before - expected, expected) < 2e-6  # rounding of float32, as of a sweep


def test_changes_of_a_cell_are_a_charge_in_its_middle(rng):
    clump, away = rng.random((32, 3)), np.array([30.0, 0.0, 0.0])
    tree = Octree(np.concatenate([clump, clump + away]), np.ones(64), leaf_size=32)
    changes = np.where(np.arange(64) < 32, 0.0, rng.normal(size=64))  # slots go by clump
    field = np.zeros((64, 3))
    InteractionLists(tree, 0.8).add_changes(field, changes)
    middle = 0.5 * (tree.positions[32:].min(axis=0) + tree.positions[32:].max(axis=0))
    expected = twins.field(tree.positions[:32], middle[None], changes.sum(keepdims=True))
    assert rms(field[:32] - expected, expected) < 2e-6


def test_changes_of_a_smooth_charge_are_those_of_a_sweep(surface12):
    """Cells with a charge alone: the field of a smooth change within 5 %, which `Robin` relies on."""
    positions, _, charges = surface12
    tree = Octree(positions, charges)
    changes = 0.01 * tree.positions[:, 2] * tree.charges
    field = np.zeros((len(positions), 3))
    InteractionLists(tree, 0.6).add_changes(field, changes)
    some = slice(None, None, 8)
    expected = twins.field(tree.positions[some], tree.positions, changes)
    assert 1e-4 < rms(field[some] - expected, expected) < 0.05


def test_sweep_over_a_cell_leaves_the_octupole(rng):
    """As for points: two clumps, each a group of targets, at a distance."""
    clump, distances, errors = rng.random((32, 3)), np.array([20.0, 40.0, 80.0]), []
    charges = rng.random(64)
    for distance in distances:
        away = np.array([distance, 0.0, 0.0])
        tree = Octree(np.concatenate([clump, clump + away]), charges, leaf_size=32)
        own = np.arange(64) // 32  # slots go by clump; the field of the other clump is what is left without one's own
        field, expected = np.empty((64, 3)), twins.field(tree.positions, tree.positions, tree.charges)
        InteractionLists(tree, 0.8).sweep(field, double_precision=True)
        inner = np.concatenate([twins.field(*[tree.positions[own == k]] * 2, tree.charges[own == k]) for k in (0, 1)])
        errors.append(rms(field - expected, expected - inner))
    assert np.polyfit(np.log(distances), np.log(errors), 1)[0] == pytest.approx(-3.0, abs=0.2)


def test_sweep_better_with_smaller_angle(surface12):
    positions, _, charges = surface12
    tree = Octree(positions, charges)
    some = slice(None, None, 8)
    expected = twins.field(tree.positions[some], tree.positions, tree.charges)
    errors = []
    for angle in (0.8, 0.6, 0.4, 0.2):
        field = np.empty((len(positions), 3))
        InteractionLists(tree, angle).sweep(field, double_precision=True)
        errors.append(rms(field[some] - expected, expected))
    assert errors == sorted(errors, reverse=True)


# ---- moments -------------------------------------------------------------------------------------------------------


def test_moments_of_every_node(surface12, rng):
    positions, _, _ = surface12
    tree = Octree(positions, rng.random(len(positions)))
    first, last = members(tree)
    balls, cells, _ = tree.nodes
    where, charges = tree.positions, tree.charges
    assert last[0] == len(positions)
    assert ((last - first) <= tree.leaf_size).any()
    for node in range(tree.n_nodes):
        inside = slice(first[node], last[node])
        expected = twins.moments(where[inside], charges[inside])
        total, ball = expected[3], balls[node]
        # children are shifted to the parent's centre some 12 times: rounding of a few 1e-16 of q r^2 each
        scale = np.concatenate([[10.0] * 3, [total], [total * max(ball[3], 0.1) ** 2] * 6])
        assert np.abs((cells[node] - expected) / scale).max() < 1e-12
        assert abs(cells[node, 4] + cells[node, 7] + cells[node, 9]) < 1e-12 * scale[-1]  # no trace
        dipole = charges[inside] @ (where[inside] - cells[node, :3])
        assert np.abs(dipole).max() < 1e-12 * total * 10
        assert np.linalg.norm(where[inside] - ball[:3], axis=1).max() <= ball[3] * (1 + 1e-15)


def test_morton_order_goes_by_octants(rng):
    positions = rng.random((500, 3))
    order, keys = morton_order(positions)
    assert (np.diff(keys.astype(np.int64)) >= 0).all()
    low, edge = positions.min(axis=0), np.ptp(positions, axis=0).max()
    octant = ((positions[order] - low) / edge * (1 - 2**-21) >= 0.5) @ [4, 2, 1]
    assert (np.diff(octant) >= 0).all()


@pytest.fixture(scope="session")
def crowd():
    """70,000 places, several blocks of the sort and subtrees: a clump, duplicates and a place far away among them."""
    generator = np.random.default_rng(4)
    sphere = generator.normal(size=(60_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    clump, twice = generator.random((5_000, 3)) * 1e-3, sphere[generator.choice(60_000, 4_900)]
    places = np.concatenate([sphere, clump, twice, np.ones((99, 3)), [[40.0, 0.0, 0.0]]])
    return places[generator.permutation(len(places))]


@pytest.mark.parametrize("n_threads", [1, 2, 3])
def test_order_is_that_of_the_keys(crowd, n_threads):
    order, keys = morton_order(crowd, n_threads)
    expected = twins.morton_keys(crowd)
    assert np.array_equal(order, np.argsort(expected, kind="stable"))  # those of one key by their number
    assert np.array_equal(keys, expected[order])


@pytest.mark.slow
@pytest.mark.parametrize("leaf_size", [1, 16, 5000])
def test_nodes_are_those_of_a_plain_recursion(crowd, leaf_size):
    _, keys = morton_order(crowd)
    expected = np.array(twins.flat(twins.split(keys, leaf_size)))
    for n_threads in (1, 2, 3):
        assert np.array_equal(np.stack(split(keys, leaf_size, n_threads), axis=1), expected)


# ---- copies, threads -----------------------------------------------------------------------------------------------


def test_copy_is_equal_and_independent(surface12, tip12, rng):
    positions, _, charges = surface12
    tree, points = Octree(positions, charges, extra=10), surface_points(surface12, tip12, rng, 50)
    before = [part.copy() for part in (*tree.nodes, tree.positions, tree.charges, tree.atoms)]
    other = tree.copy()
    for ours, theirs in zip(before, (*other.nodes, other.positions, other.charges, other.atoms), strict=True):
        assert np.array_equal(ours, theirs)
    assert np.array_equal(tree.fields(points, 0.5), other.fields(points, 0.5))
    other.charges = rng.random(len(charges))
    assert not np.array_equal(other.nodes[1], before[1])
    for ours, now in zip(before, (*tree.nodes, tree.positions, tree.charges, tree.atoms), strict=True):
        assert np.array_equal(ours, now)


def test_threads_build_the_same_tree(crowd, rng):
    charges = rng.random(len(crowd))
    one, two = (Octree(crowd, charges, n_threads=n_threads) for n_threads in (1, 2))
    for ours, theirs in zip(
        (*one.nodes, one.positions, one.atoms), (*two.nodes, two.positions, two.atoms), strict=True
    ):
        assert np.array_equal(ours, theirs)
    assert np.array_equal(one.positions, crowd[one.atoms])


def test_threads_give_the_same_bits(surface12, tip12, rng):
    positions, _, charges = surface12
    tree, points = Octree(positions, charges), surface_points(surface12, tip12, rng)
    assert np.array_equal(tree.fields(points, 0.5, 1), tree.fields(points, 0.5, 2))
    assert np.array_equal(tree.potentials(points, 0.5, 1), tree.potentials(points, 0.5, 2))
    for double in (False, True):
        fields = []
        for threads in (1, 2):
            fields.append(np.empty((len(positions), 3)))
            InteractionLists(tree, DEFAULT_ANGLE, threads).sweep(fields[-1], double, threads)
        assert np.array_equal(*fields)


# ---- odd arrangements ----------------------------------------------------------------------------------------------

LINE = np.arange(300.0)[:, None] * [0.2, 0.0, 0.0]
ODD = {
    "one": np.array([[1.0, 2.0, 3.0]]),
    "two": np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]),
    "collinear": LINE,
    "a plane": np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), axis=-1).reshape(-1, 3),
    "duplicates": np.repeat(np.random.default_rng(1).random((40, 3)) * 5, 50, axis=0),
    "all in one place": np.ones((100, 3)),
    "a clump far away": np.concatenate([np.random.default_rng(2).random((200, 3)) * 1e-4, [[1e3, 0, 0]]]),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_arrangements(name, rng):
    positions = ODD[name]
    charges = rng.random(len(positions)) + 0.1
    tree = Octree(positions, charges)
    points = positions.mean(axis=0) + rng.normal(size=(40, 3)) * 3 * max(1.0, np.ptp(positions))
    field, potential = twins.field(points, positions, charges), twins.potential(points, positions, charges)
    assert rms(tree.fields(points, 0.0) - field, field) < 1e-13
    assert rms(tree.potentials(points, 0.0) - potential, potential) < 1e-13
    assert rms(tree.fields(points, 0.3) - field, field) < 1e-3
    swept = np.empty((len(positions), 3))
    InteractionLists(tree, 0.3).sweep(swept, double_precision=True)
    expected = twins.field(tree.positions, tree.positions, tree.charges)
    if len(positions) == 1 or name == "all in one place":
        assert not swept.any()
    else:
        assert rms(swept - expected, expected) < 1e-3


@given(n=st.integers(1, 200), leaf=st.integers(1, 32), seed=st.integers(0, 2**32 - 1), grid=st.booleans())
def test_any_arrangement(n, leaf, seed, grid):
    generator = np.random.default_rng(seed)
    positions = generator.normal(size=(n, 3)) * 10 ** generator.uniform(-1, 1, 3)
    if grid:
        positions = np.round(positions)  # many ties and duplicates
    charges = generator.random(n)
    tree = Octree(positions, charges, leaf_size=leaf)
    assert np.array_equal(np.sort(tree.atoms), np.arange(n))
    assert np.array_equal(positions[tree.atoms], tree.positions)
    assert np.array_equal(charges[tree.atoms], tree.charges)
    assert tree.nodes[1][0, 3] == pytest.approx(charges.sum(), rel=1e-13)
    points = generator.normal(size=(10, 3)) * 20
    expected = twins.field(points, positions, charges)
    # a point may be as near to an atom as it likes: per point, and relative to the sum of sizes
    size = np.array([(charges / ((point - positions) ** 2).sum(axis=1)).sum() for point in points])
    assert (np.linalg.norm(tree.fields(points, 0.0) - expected, axis=1) < 1e-12 * size).all()
    # what quadrupoles leave out, sum of (l + 1) x^l for l >= 3, of charges on the rim of a ball that appears under the
    # opening angle, x = 0.25: 0.09. Measured with 60,000 arrangements of 2 to 9 atoms: at most 0.047, 0.8 % above 0.02
    rest = sum((order + 1) * 0.25**order for order in range(3, 30))
    assert (np.linalg.norm(tree.fields(points, 0.5) - expected, axis=1) < rest * size).all()


def test_refuses_an_empty_tree():
    with pytest.raises(ValueError, match="at least one atom"):
        Octree(np.empty((0, 3)), np.empty(0))


def test_far_sources_of_a_ball_and_the_rest(surface12):
    """Every atom is in one part, once; the far ones and the rest, divided again, have the field of all atoms."""
    positions, normals, charges = surface12
    tree, top = Octree(positions, charges), int(positions[:, 2].argmax())
    first, last = members(tree)
    balls, cells, parents = tree.nodes
    place = positions[top] + 0.4 * normals[top]
    roots, far_slots, far_cells = [0], [], []
    for radius, beyond in ((1.0, 3.0), (0.3, 0.9)):  # the second in the rest of the first
        slots, nodes, rest = tree.parted(np.array([*place, radius]), 0.3, beyond, roots)
        assert len(slots) > 50 and len(nodes) > 20 and rest
        covered = np.zeros(tree.n_slots, int)
        np.add.at(covered, slots, 1)
        for node in nodes + rest:
            covered[first[node] : last[node]] += 1
        expected = np.zeros(tree.n_slots, int)
        for node in roots:
            expected[first[node] : last[node]] += 1
        assert np.array_equal(covered, expected)
        distances = np.linalg.norm(balls[nodes, :3] - place, axis=1)
        assert (2 * balls[nodes, 3] < 0.3 * (distances - radius)).all()
        assert np.linalg.norm(cells[nodes, :3] - place, axis=1).min() > beyond
        assert np.linalg.norm(tree.positions[slots] - place, axis=1).min() > beyond
        # nodes of the rest are not wholly within a larger one
        up = parents[[node for node in rest if node not in roots]]
        assert (np.linalg.norm(balls[up, :3] - place, axis=1) + balls[up, 3] > beyond).all()
        far_slots, far_cells, roots = far_slots + slots, far_cells + nodes, rest
    near = np.concatenate([np.arange(first[node], last[node]) for node in roots])
    atoms = np.concatenate([near, far_slots])
    found = twins.field(place[None], tree.positions[atoms], tree.charges[atoms])[0]
    for x, y, z, charge, xx, xy, xz, yy, yz, zz in cells[far_cells]:
        step = place - [x, y, z]
        moment, s = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ step, np.linalg.norm(step)
        found += (charge / s**3 + 2.5 * (moment @ step) / s**7) * step - moment / s**5
    exact = twins.field(place[None], positions, charges)[0]
    assert np.linalg.norm(found - exact) < 1e-4 * np.linalg.norm(exact)
