"""Emissions that keep what is computed from them give the same bits."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.emission.kept import KeptEmissions, KeptRandom, kept
from apt_evap.emission.surface_frame import rollup_direction


@pytest.fixture
def emissions(rng):
    n = 500
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    positions = 5 * normals
    neighbours = positions + rng.normal(size=(n, 3)) * 0.2
    neighbours[::7] = np.nan
    return ae.emission.Emissions(
        positions=positions,
        normals=normals,
        neighbours=neighbours,
        charge_states=np.ones(n, int),
        masses=np.full(n, 58.7),
        ions=np.arange(n) + 40,
        nearest_neighbour_distance=0.25,
    )


def test_random_numbers_are_those_of_ions(emissions):
    random = KeptRandom(7, emissions.ions)
    for _ in range(3):
        expected = ae.emission.IonRandom(7, emissions.ions)
        again = random.rewound()
        for columns in (2, 1, 3):
            assert np.array_equal(again.uniform(columns), expected.uniform(columns))
        assert np.array_equal(again.normal(), expected.normal())
    assert random.rewound().uniform(2) is random.rewound().uniform(2)
    with pytest.raises(ValueError, match="read-only"):
        random.rewound().uniform(2)[0] = 0.5


@pytest.mark.parametrize("perturbation", [ae.RollUp(ae.TruncatedNormal(0.2, 0.1)), ae.Combined(0.3, 0.4)], ids=repr)
def test_launches_have_the_same_bits(emissions, perturbation):
    same = KeptEmissions.of(emissions)
    for seed in (1, 2, 1):
        expected = perturbation.tangential(emissions, ae.emission.IonRandom(seed, emissions.ions))
        for _ in range(2):
            for one, other in zip(perturbation.tangential(same, same.random(seed)), expected, strict=True):
                assert np.array_equal(one, other)
    assert all(np.array_equal(*pair) for pair in zip(rollup_direction(same), rollup_direction(emissions), strict=True))
    assert rollup_direction(same)[1] is rollup_direction(same)[1]


def test_results_are_kept_for_the_last_arguments(emissions):
    calls = []

    @kept
    def scaled(emissions, factor, power=1):
        calls.append((factor, power))
        return (emissions.masses * factor**power,)

    same = KeptEmissions.of(emissions)
    for factor, power in ((2.0, 1), (2.0, 1), (3.0, 1), (3.0, 2), (3.0, 2), (2.0, 1)):
        assert np.array_equal(scaled(same, factor, power=power)[0], emissions.masses * factor**power)
    assert calls == [(2.0, 1), (3.0, 1), (3.0, 2), (2.0, 1)]
    calls.clear()
    scaled(emissions, 2.0), scaled(emissions, 2.0)
    assert len(calls) == 2  # other emissions keep nothing
