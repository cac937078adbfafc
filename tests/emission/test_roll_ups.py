"""Roll-ups of a batch, and the random numbers of its ions, are computed once and have the same bits as new ones."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common import ion_random
from apt_evap._common.ion_random import IonRandom
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.surface_frame import roll_ups, rollup_direction, target_shares

ENERGY = ae.TruncatedNormal(0.2, 0.1)


@pytest.fixture
def emissions(rng):
    """500 atoms with targets; some have no neighbour, some fewer than three targets."""
    n = 500
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    targets = 5 * normals[:, None] + rng.normal(size=(n, 3, 3)) * 0.2
    ratios = -np.sort(-rng.uniform(0.1, 1.0, (n, 3)), axis=1)
    missing = np.zeros((n, 3), bool)
    missing[::5, 2] = missing[::9, 1:] = missing[::7] = True
    targets[missing], ratios[missing] = np.nan, np.nan
    return Emissions(
        positions=5 * normals,
        normals=normals,
        neighbours=targets[:, 0],
        charge_states=np.ones(n, int),
        masses=np.full(n, 58.7),
        ions=np.arange(n) + 40,
        nearest_neighbour_distance=0.25,
        targets=targets,
        charge_ratios=ratios,
    )


def test_launches_follow_every_option(emissions):
    random = IonRandom(3, emissions.ions)
    options = [{}, {"sharpness": 0.15}, {"height": 0.1}, {"sharpness": 0.15, "height": 0.1}]
    for values in (*options, {"sharpness": 2.0}, *options):
        perturbation = ae.RollUp(ENERGY, 0.8, **values)
        found = perturbation.tangential(emissions, random.from_start())
        expected = perturbation.tangential(emissions[:], IonRandom(3, emissions.ions))
        for one, other in zip(found, expected, strict=True):
            assert (one is None and other is None) or np.array_equal(one, other)


def test_roll_ups_are_computed_once(emissions):
    kept = roll_ups(emissions, 0.2)
    assert roll_ups(emissions, 0.2) is kept
    assert roll_ups(emissions, 0.3) is not kept and roll_ups(emissions, 0.2) is not kept
    for array in kept:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_roll_ups_have_the_shares_of_their_targets(emissions):
    shares = target_shares(emissions, 0.2)
    possible, *along, kept = roll_ups(emissions, 0.2)
    np.testing.assert_array_equal(kept, shares)
    np.testing.assert_array_equal([possible, *along], rollup_direction(emissions, shares))
    np.testing.assert_array_equal(possible, np.isfinite(emissions.targets[:, 0]).all(axis=1))
    assert 0 < possible.sum() < 500
    assert roll_ups(emissions).shares is None


def test_unknown_targets_are_refused(emissions):
    columns = {name: getattr(emissions, name) for name in emissions.columns}
    with pytest.raises(ValueError, match="targets and charge_ratios must be given together"):
        Emissions(**(columns | {"targets": None}), nearest_neighbour_distance=0.25)
    del columns["targets"], columns["charge_ratios"]
    without = Emissions(**columns, nearest_neighbour_distance=0.25)
    assert roll_ups(without).possible.any()
    with pytest.raises(ValueError, match="the `targets` and `charge_ratios` of the emissions"):
        roll_ups(without, 0.2)
    with pytest.raises(ValueError, match="the `targets` and `charge_ratios` of the emissions"):
        rollup_direction(without, np.full((500, 3), 1 / 3))


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
