"""Roll-ups of a batch, and the random numbers of its ions, are computed once and have the same bits as new ones."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.emission import ion_random
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.ion_random import IonRandom
from apt_evap.emission.surface_frame import rollup_direction, target_shares

ENERGY = ae.TruncatedNormal(0.2, 0.1)


@pytest.fixture
def emissions(rng):
    """500 atoms with targets of two roll-ups; some have no neighbour, some no second target, some fewer than three."""
    n = 500
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    targets = 5 * normals[:, None, None] + rng.normal(size=(n, 2, 3, 3)) * 0.2
    ratios = -np.sort(-rng.uniform(0.1, 1.0, (n, 2, 3)), axis=2)
    missing = np.zeros((n, 2, 3), bool)
    missing[::5, :, 2] = missing[::9, 1] = missing[::7] = True
    targets[missing], ratios[missing] = np.nan, np.nan
    return Emissions(
        positions=5 * normals,
        normals=normals,
        neighbours=targets[:, 0, 0],
        charge_states=np.ones(n, int),
        masses=np.full(n, 58.7),
        ions=np.arange(n) + 40,
        nearest_neighbour_distance=0.25,
        targets=targets,
        charge_ratios=ratios,
    )


def test_launches_follow_every_option(emissions):
    random = IonRandom(3, emissions.ions)
    options = [{}, {"sharpness": 0.15}, {"second_roll": 0.4}, {"sharpness": 0.15, "second_roll": 0.4}]
    for values in (*options, {"sharpness": 2.0, "second_roll": 0.4}, *options):
        perturbation = ae.RollUp(ENERGY, 0.8, **values)
        found = perturbation.tangential(emissions, random.from_start())
        expected = perturbation.tangential(emissions[:], IonRandom(3, emissions.ions))
        for one, other in zip(found, expected, strict=True):
            assert (one is None and other is None) or np.array_equal(one, other)


def test_roll_ups_are_computed_once(emissions):
    kept = ae.emission.roll_ups(emissions, 0.2, 2)
    assert ae.emission.roll_ups(emissions, 0.2, 2) is kept
    assert ae.emission.roll_ups(emissions, 0.3, 2) is not kept and ae.emission.roll_ups(emissions, 0.2, 2) is not kept
    for array in kept:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_roll_ups_have_an_axis(emissions):
    shares = target_shares(emissions, 0.2, rolls=2)
    assert shares.shape == (500, 2, 3)
    possible, first, second, kept = ae.emission.roll_ups(emissions, 0.2, 2)
    np.testing.assert_array_equal(kept, shares)
    for roll in (0, 1):
        there, *along = rollup_direction(emissions, shares, roll)
        np.testing.assert_array_equal(possible[:, roll], there)
        np.testing.assert_array_equal(np.stack([first[:, roll], second[:, roll]]), along)
    np.testing.assert_array_equal(possible, np.isfinite(emissions.targets[:, :, 0]).all(axis=2))
    assert 0 < possible[:, 1].sum() < possible[:, 0].sum() < 500
    assert (
        ae.emission.roll_ups(emissions, 0.2).first.shape == (500, 1) and ae.emission.roll_ups(emissions).shares is None
    )


def test_unknown_targets_are_refused(emissions):
    columns = {name: getattr(emissions, name) for name in emissions.columns}
    columns["targets"], columns["charge_ratios"] = emissions.targets[:, :1], emissions.charge_ratios[:, :1]
    once = Emissions(**columns, nearest_neighbour_distance=0.25)
    del columns["targets"], columns["charge_ratios"]
    none = Emissions(**columns, nearest_neighbour_distance=0.25)
    for few, arguments, name in (
        (once, (0.2, 2), "rolls=2"),
        (once, (0.0, 2), "rolls=2"),
        (none, (0.2, 1), "wide"),
        (none, (0.0, 2), "rolls=2"),
    ):
        with pytest.raises(ValueError, match=name):
            ae.emission.roll_ups(few, *arguments)
    with pytest.raises(ValueError, match="wide"):
        rollup_direction(none, np.full((500, 1, 3), 1 / 3))


def test_random_numbers_are_computed_once(monkeypatch):
    calls, mix = [], ion_random.mix
    random, expected = IonRandom(7, np.arange(100)), IonRandom(7, np.arange(100)).uniform(6)
    monkeypatch.setattr(ion_random, "mix", lambda values: calls.append(1) or mix(values))
    for _ in range(3):
        again = random.from_start()
        np.testing.assert_array_equal(np.concatenate([again.uniform(n) for n in (2, 1, 3)], axis=1), expected)
    assert len(calls) == 6
    random.uniform(2)[:] = 0.5  # of the user
    np.testing.assert_array_equal(random.from_start().uniform(6), expected)
