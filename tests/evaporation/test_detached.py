"""Atoms without hold: whatever has no chain of bonds to the body leaves at once."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap._core.neighbourhood import Neighbourhood

ALLOYS = {
    "Al-2Cu": {"material": "Al", "solutes": {"Cu": 0.02}},
    "Al-10W": {"material": "Al", "solutes": {"W": 0.1}},
    "Ni-5W": {"material": "Ni", "solutes": {"W": 0.05}},
}


def floating(tip, removed):
    """Atoms that are left without a chain of bonds to an atom that never evaporates."""
    left = np.setdiff1d(np.arange(len(tip)), removed)
    pairs = cKDTree(tip.positions[left]).query_pairs(tip.bond_length, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(left), len(left)))
    n, part = connected_components(graph, directed=False)
    held = np.zeros(n, bool)
    held[part[~tip.evaporable[left]]] = True
    return left[~held[part]]


def check_alloy(name, n_events, step):
    tip = ae.Tip(apex_radius=3.0, axis=(1, 1, 1), shank_length=9.0, seed=1, **ALLOYS[name])
    emitter = ae.evaporation.Emitter(tip, n_threads=1)
    removed, detached = [], []
    while sum(map(len, removed)) < n_events:
        for batch in emitter.advance(step):
            removed.append(batch.site)
            detached.append(batch.detached)
        # those that were cut off by the last event are the next ones
        assert np.array_equal(floating(tip, np.concatenate(removed)), emitter._core.atoms.waiting_atoms)
    detached = np.concatenate(detached)
    assert emitter.counts["detached"] == detached.sum() > 0
    fresh = ae.evaporation.Emitter(tip, n_threads=1, settings=ae.evaporation.ChargeSettings(start_tolerance=1e-6))
    fresh._core.atoms.remove_atoms(np.concatenate(removed))
    fresh.relax(1e-6), emitter.relax(1e-6)
    return emitter, fresh


@pytest.mark.slow
@pytest.mark.parametrize("name", ALLOYS)
def test_nothing_floats(name):
    check_alloy(name, 1500, 100)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALLOYS)
def test_nothing_floats_after_ten_thousand_events_and_charges_have_no_history(name):
    emitter, fresh = check_alloy(name, 10_000, 500)
    order, other = np.argsort(emitter.atoms), np.argsort(fresh.atoms)
    assert np.array_equal(emitter.atoms[order], fresh.atoms[other])
    # the point inside that has the potential follows the surface in steps: a common factor of all charges
    charges, others = emitter.charges[order], fresh.charges[other]
    assert np.abs(charges / charges.mean() - others / others.mean()).max() < 1e-4


def test_the_part_that_is_anchored_stays():
    positions = np.array([[0.0, 0, k] for k in range(6)])  # a chain; the lowest atom never evaporates
    anchored = np.array([1, 0, 0, 0, 0, 0], np.int8)
    atoms = Neighbourhood(positions, 1.5, 0.1, np.zeros(6, np.int8), 1.1, anchored=anchored)
    atoms.remove_atom(2)
    assert atoms.waiting_atoms.tolist() == [3, 4, 5]
    atoms.remove_atom(3)
    assert atoms.waiting_atoms.tolist() == [4, 5] and atoms.n_detached == 1


@pytest.mark.parametrize(("cut", "waiting"), [(1, [0]), (4, [5]), (2, [0, 1]), (0, [])])
def test_without_anchored_atoms_the_larger_part_stays(cut, waiting):
    positions = np.array([[0.0, 0, k] for k in range(6)])
    atoms = Neighbourhood(positions, 1.5, 0.1, np.zeros(6, np.int8), 1.1)
    atoms.remove_atom(cut)
    assert atoms.waiting_atoms.tolist() == waiting


def test_parts_that_meet_elsewhere_stay():
    angle = 2 * np.pi * np.arange(20) / 20
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    atoms = Neighbourhood(ring, 0.4, 0.1, np.zeros(20, np.int8), 0.35)
    atoms.remove_atom(3)
    assert atoms.waiting_atoms.tolist() == []  # the ring is open
    atoms.remove_atom(9)
    assert atoms.waiting_atoms.tolist() == [4, 5, 6, 7, 8]


@pytest.mark.slow
def test_a_run_with_detached_atoms_is_resumed_with_the_same_bits(tmp_path):
    tip = ae.Tip("Al", 2.0, (1, 1, 1), shank_length=5.0, solutes={"W": 0.1}, seed=1)
    whole = ae.Simulation(tip, n_threads=1).run(600, responses=False, progress=False)
    checkpoint = ae.simulation.Checkpoint(tmp_path / "run.h5", resume=True)
    for ions in (151, 320, 600):
        run = ae.Simulation(tip, n_threads=1).run(ions, responses=False, progress=False, checkpoint=checkpoint)
        run.save(tmp_path / "run.h5")
    assert run.fingerprint() == whole.fingerprint()
