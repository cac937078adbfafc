import math

import numpy as np
import pytest
from scipy import stats

from apt_evap._common.ion_random import IonRandom

N = 50_000


def test_numbers_of_an_ion_do_not_depend_on_its_company():
    whole = IonRandom(9, np.arange(100)).uniform(6)
    one = IonRandom(9, [42])
    pieces = np.concatenate([one.uniform(1), one.uniform(3), one.uniform(2)], axis=1)
    np.testing.assert_array_equal(pieces[0], whole[42])


def test_bits_are_those_of_splitmix64():
    # the published first outputs of SplitMix64 seeded with 0 come out of an ion whose state is 0
    random = IonRandom(0, [0])
    random._state[:] = 0
    outputs = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    expected = [((output >> 12) + 0.5) * 2.0**-52 for output in outputs]
    np.testing.assert_array_equal(random.uniform(3)[0], expected)


@pytest.mark.parametrize("seed", [0, 1, 2**63, 12345])
@pytest.mark.parametrize("first", [0, 10**12])
def test_uniform_in_every_column(seed, first):
    u = IonRandom(seed, first + np.arange(N)).uniform(4)
    assert u.min() > 0 and u.max() < 1
    # 32 tests in all: a p-value below 1e-5 has one chance in 3000
    assert min(stats.kstest(column, "uniform").pvalue for column in u.T) > 1e-5


def test_neighbouring_ions_columns_and_seeds_are_independent():
    bound = 4.5 / math.sqrt(N)  # 4.5 standard deviations of a correlation
    ions = np.arange(N)
    u, other = IonRandom(7, ions).uniform(3), IonRandom(8, ions).uniform(3)
    pairs = [(u[:-lag, 0], u[lag:, 0]) for lag in (1, 2, 64)]
    pairs += [(u[:, 0], u[:, 1]), (u[:, 1], u[:, 2]), (u[:-1, 0], u[1:, 1]), (u[:, 0], other[:, 0])]
    pairs += [(u[1:, 0], other[:-1, 0])]
    for one, two in pairs:
        assert abs(np.corrcoef(one, two)[0, 1]) < bound
        counts = np.histogram2d(one, two, bins=16, range=[[0, 1], [0, 1]])[0]
        assert stats.chisquare(counts.ravel()).pvalue > 1e-5


def test_no_two_ions_or_seeds_share_a_number():
    ions = np.arange(1000)
    numbers = np.concatenate([IonRandom(seed, ions).uniform(4).ravel() for seed in range(50)])
    assert len(np.unique(numbers)) == numbers.size  # 200,000 of 2^52: a repeat has a chance of 4e-6


def test_normal_numbers():
    x = IonRandom(4, np.arange(N)).normal(2)
    assert stats.kstest(x.ravel(), "norm").pvalue > 1e-4
    assert np.isfinite(x).all()


@pytest.mark.parametrize(
    ("seed", "ions", "message"),
    [
        (-1, [0], "seed must be"),
        (2**64, [0], r"seed must be .* 0 to 18,446"),
        (1.5, [0], "seed must be"),
        (1, [0.5], "ions must contain integers"),
        (1, 3, r"ions must be an array of numbers of shape \(n,\)"),
    ],
)
def test_bad_keys_are_refused(seed, ions, message):
    with pytest.raises(ValueError, match=message):
        IonRandom(seed, ions)
