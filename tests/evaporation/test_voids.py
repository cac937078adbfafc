"""Vacancies, voids and boundaries: which atoms are surface atoms, and which have no hold."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap._core.neighbourhood import Neighbourhood

AL = ae.material("Al")
D = AL.nearest_neighbour_distance
SHAPE = {"apex_radius": 4.0, "shank_length": 4.0, "axis": (1, 1, 1)}
VOID = ae.specimen.Sphere((0.3, 0, 1.2), 1.3)


def with_void(**more):
    return ae.Tip(
        phases=[ae.specimen.Phase("matrix", AL), ae.specimen.Phase("void", AL, VOID, vacancies=1)], **SHAPE, **more
    )


def grains(**more):
    second = ae.specimen.Phase(
        "second", AL, ae.specimen.HalfSpace((0.1, 0, 0), (1, 0, 0.3)), axis=(0, 0, 1), evaporation_field=16.0
    )
    return ae.Tip(phases=[ae.specimen.Phase("first", AL), second], **SHAPE, **more)


def precipitate(**more):
    ball = ae.specimen.Phase("ball", "W", ae.specimen.Sphere((0, 0, 2.5), 1.6), axis=(0, 1, 1))
    return ae.Tip(phases=[ae.specimen.Phase("matrix", AL, vacancies=0.03), ball], seed=2, **SHAPE, **more)


def depth_of_surface(emitter):
    return -emitter.tip.signed_distance(emitter.positions).min()


@pytest.mark.parametrize("fraction", [0.001, 0.01, 0.05])
def test_vacancies_expose_nothing_deep(fraction):
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", AL, vacancies=fraction)], seed=1, **SHAPE)
    assert depth_of_surface(ae.evaporation.Emitter(tip, n_threads=1)) < 3 * D


def test_a_boundary_exposes_nothing_deep():
    assert depth_of_surface(ae.evaporation.Emitter(grains(), n_threads=1)) < 3 * D


@pytest.mark.slow
def test_the_wall_of_a_closed_void_is_no_surface_until_it_opens():
    tip = with_void()
    emitter = ae.evaporation.Emitter(tip, n_threads=1)
    assert depth_of_surface(emitter) < 3 * D
    wall = np.flatnonzero((np.abs(VOID.distance(tip.positions)) < 0.3 * D) & (tip.positions[:, 2] < 1.0))
    sizes, opened = [], None
    for _ in emitter.advance(7000, 100):
        exposed = np.isin(emitter.atoms, wall).sum()
        sizes.append(exposed)
        if opened is None and exposed:
            # at once, as a whole, when the cover is thinner than one neighbourhood
            top = emitter.positions[np.hypot(*emitter.positions[:, :2].T) < 1][:, 2].max()
            opened = top - (VOID.centre[2] + VOID.radius)
            assert exposed > 0.9 * len(wall)
    assert opened is not None and sizes[0] == 0
    assert opened < tip.neighbour_radius + D
    # opened, the wall has a field like any other part of the surface
    assert np.isfinite(emitter.charges).all() and emitter.charges.min() >= 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ChargesWarning")  # a long interval between relaxations
def test_a_void_that_opens_is_the_same_in_a_deeper_shell_and_after_a_resume(tmp_path):
    tip = with_void(depth=1.7)
    simulation = ae.Simulation(tip, n_threads=1)
    whole = simulation.run(3500, responses=False, progress=False)
    assert whole.state.extensions
    checkpoint = ae.simulation.Checkpoint(tmp_path / "run.h5", resume=True)
    for ions in (1900, 3500):
        run = ae.Simulation(tip, n_threads=1).run(ions, responses=False, progress=False, checkpoint=checkpoint)
    assert run.fingerprint() == whole.fingerprint()


def floating(tip, removed):
    """Atoms without a chain of bonds to an atom that never evaporates; bonds have the mean length of both phases."""
    left = np.setdiff1d(np.arange(len(tip)), removed)
    lengths = np.array([criterion.bond_length for criterion in tip.criteria])[tip.phase[left]]
    pairs = cKDTree(tip.positions[left]).query_pairs(lengths.max(), output_type="ndarray")
    distance = np.linalg.norm(tip.positions[left[pairs[:, 0]]] - tip.positions[left[pairs[:, 1]]], axis=1)
    pairs = pairs[distance <= 0.5 * (lengths[pairs[:, 0]] + lengths[pairs[:, 1]])]
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(left), len(left)))
    n, part = connected_components(graph, directed=False)
    held = np.zeros(n, bool)
    held[part[~tip.evaporable[left]]] = True
    return left[~held[part]]


def check_hold(tip, n_events, step):
    emitter = ae.evaporation.Emitter(tip, n_threads=1)
    removed = [np.empty(0, np.int64)]
    assert np.array_equal(floating(tip, removed[0]), emitter._core.atoms.waiting_atoms)
    while sum(map(len, removed)) < n_events:
        removed += [batch.site for batch in emitter.advance(step)]
        assert np.array_equal(floating(tip, np.concatenate(removed)), emitter._core.atoms.waiting_atoms)
    return emitter


@pytest.mark.slow
@pytest.mark.parametrize("make", [grains, precipitate, with_void], ids=lambda make: make.__name__)
def test_nothing_floats(make):
    check_hold(make(), 1200, 150)


@pytest.mark.slow
@pytest.mark.parametrize("make", [grains, precipitate, with_void], ids=lambda make: make.__name__)
def test_nothing_floats_after_many_events(make):
    check_hold(make(), 6000, 500)  # all but a few hundred of the atoms that can evaporate


def test_a_part_that_has_no_hold_from_the_beginning_leaves_first():
    gap = ae.specimen.Phase("gap", AL, ae.specimen.Layer(3.2, 3.6), vacancies=1)  # the top of the cap floats above it
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", AL), gap], **SHAPE)
    top = np.flatnonzero(tip.positions[:, 2] > 3.4)
    emitter = ae.evaporation.Emitter(tip, n_threads=1)
    batches = list(emitter.advance(len(top)))
    assert len(top) > 20 and all(batch.detached.all() for batch in batches)
    assert sorted(site for batch in batches for site in batch.site) == top.tolist()
    assert emitter.counts["detached"] == len(top)


def test_neighbourhoods_of_several_kinds_are_those_of_a_slow_twin():
    rng = np.random.default_rng(5)
    n = 400
    positions = rng.uniform(0, 3, (n, 3))
    kinds = rng.integers(0, 3, n).astype(np.int8)
    radius, threshold, bond = np.array([0.8, 1.0, 0.6]), np.array([0.15, 0.2, 0.1]), np.array([0.4, 0.5, 0.3])
    atoms = Neighbourhood(positions, radius, threshold, np.zeros(n, np.int8), bond, kinds=kinds)
    left = np.ones(n, bool)
    exposed = np.zeros(n, bool)
    for atom in [None, *rng.permutation(n)[:50].tolist()]:
        if atom is not None:
            atoms.remove_atom(atom)
            left[atom] = exposed[atom] = False
        distance = np.linalg.norm(positions[:, None] - positions, axis=2)
        np.fill_diagonal(distance, np.inf)
        distance[:, ~left] = np.inf
        near = distance <= radius[kinds][:, None]
        count = near.sum(axis=1)
        offset = np.where(near[..., None], positions - positions[:, None], 0).sum(axis=1)
        mean = np.linalg.norm(offset, axis=1) / np.maximum(count, 1)
        bonds = (distance <= 0.5 * (bond[kinds][:, None] + bond[kinds])).sum(axis=1)
        exposed |= left & ((mean > threshold[kinds]) | (count == 0))
        np.testing.assert_array_equal(atoms.counts[left], count[left])
        np.testing.assert_array_equal(atoms.bond_counts[left], bonds[left])
        np.testing.assert_allclose(atoms.offsets[left], mean[left], rtol=0, atol=1e-12)  # sums of 50 steps of 1 nm
        np.testing.assert_array_equal(atoms.surface, np.flatnonzero(exposed))
