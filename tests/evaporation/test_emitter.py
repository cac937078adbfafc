"""The loop over events: batches, relaxations and deepening by `Emitter.advance`."""

from contextlib import contextmanager

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._core.evaporation import DONE, EXHAUSTED, SWEEP_DUE, TOO_SHALLOW


def by_hand(emitter, n):
    """The loop, spelled out."""
    sites = []
    while n:
        batch = emitter.evaporate(n)
        sites.append(batch.site)
        n -= len(batch)
        if batch.status == SWEEP_DUE:
            emitter.relax_due()
        elif batch.status == TOO_SHALLOW:
            emitter.extend_shell()
        elif batch.status == EXHAUSTED:
            break
    return np.concatenate(sites)


@pytest.mark.slow
@pytest.mark.parametrize("batch_size", [1, 7, 256])
def test_advance_is_the_loop(nickel, batch_size):
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), depth=3.5 * nickel.a)
    hand, emitter = ae.evaporation.Emitter(tip), ae.evaporation.Emitter(tip)
    statuses, sites = [], []
    for batch in emitter.advance(500, batch_size):
        statuses.append(batch.status)
        sites.append(batch.site)
    assert {SWEEP_DUE, TOO_SHALLOW, DONE} == set(statuses)
    assert np.array_equal(np.concatenate(sites), by_hand(hand, 500))
    assert np.array_equal(emitter.charges, hand.charges)


def test_relaxations_and_deepening_are_paused_for(nickel):
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), depth=3.5 * nickel.a)
    emitter, paused = ae.evaporation.Emitter(tip), []

    @contextmanager
    def pause():
        before = len(emitter.tip)
        yield
        paused.append(len(emitter.tip) > before)

    statuses = [batch.status for batch in emitter.advance(300, pause=pause)]
    assert len(paused) == sum(status in (SWEEP_DUE, TOO_SHALLOW) for status in statuses)
    assert sum(paused) == statuses.count(TOO_SHALLOW) >= 1


def test_advance_ends_when_no_atom_is_left(nickel, small_tip):
    may = np.zeros(len(small_tip), bool)
    may[np.argsort(-small_tip.positions[:, 2], kind="stable")[:20]] = True
    tip = ae.Tip.from_positions(small_tip.positions, small_tip.species, [nickel], evaporable=may)
    batches = list(ae.evaporation.Emitter(tip).advance(10_000))
    assert batches[-1].status == EXHAUSTED
    assert sum(map(len, batches)) <= 20


def test_bonds_are_those_of_the_atoms_left(tip12):
    emitter = ae.evaporation.Emitter(tip12)
    gone = np.concatenate([batch.site for batch in emitter.advance(80)])
    left = np.setdiff1d(np.arange(len(tip12)), gone)
    some = np.random.default_rng(1).choice(len(emitter.atoms), 200, replace=False)
    for atom, bonds in zip(emitter.atoms[some], emitter.bonds[some], strict=True):
        distance = np.linalg.norm(tip12.positions[left] - tip12.positions[atom], axis=1)
        assert bonds == np.count_nonzero((distance > 0) & (distance <= tip12.bond_length))
