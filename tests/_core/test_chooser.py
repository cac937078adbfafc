"""Choosers of the next slot: the largest key, or at random in proportion to the rates."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import apt_evap as ae
from apt_evap._core.chooser import Largest, RateSum
from apt_evap._core.evaporation import SWEEP_DUE
from apt_evap._core.octree import Octree
from apt_evap.units import BOLTZMANN

# the twin adds up to 1,024 rates one by one: 1,024 roundings of 2^-53
ROUNDING = 1024 * 2.0**-53


def tree_of(n):
    return Octree(np.random.default_rng(1).normal(size=(n, 3)), np.ones(n))


def rate_sum(keys):
    return RateSum(tree_of(len(keys)), np.array(keys, np.float64))


def shares(keys):
    """Slow twin: the part of (0, 1) that belongs to each slot, in the order of the slots: its beginning and its end."""
    rates = np.exp(keys - np.max(keys))
    ends = np.cumsum(rates) / rates.sum()
    return np.concatenate([[0.0], ends[:-1]]), ends


def check_choices(keys, u):
    """Every random number belongs to the part of the slot that it chooses, and that slot can evaporate."""
    slots = rate_sum(keys).chosen(u)
    begins, ends = shares(keys)
    assert (keys[slots] > -np.inf).all()
    assert (begins[slots] - ROUNDING <= u).all() and (u <= ends[slots] + ROUNDING).all()
    return slots


def some_empty(keys, generator):
    return np.where(generator.random(len(keys)) < 0.3, -np.inf, keys)


# ---- rates ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 700, 1024])
@pytest.mark.parametrize(
    "draw",
    [
        lambda n, generator: generator.uniform(-3, 3, n),
        lambda n, generator: some_empty(generator.uniform(20, 40, n), generator),
        lambda n, generator: generator.uniform(0, math.log(1e300), n),
        lambda n, generator: some_empty(generator.uniform(-1e6, 1e6, n), generator),
        lambda n, generator: generator.choice([-1e6, 1e6], n) + generator.uniform(-2, 2, n),
        lambda n, generator: np.full(n, -700.0),
    ],
    ids=["similar", "with empty slots", "ratios of 1e300", "up to 1e6", "at both ends", "equal"],
)
def test_choices_are_those_of_a_cumulative_sum(n, draw, rng):
    keys = draw(n, rng)
    keys[rng.integers(n)] = max(keys.max(), -1e6)  # at least one slot can evaporate
    check_choices(keys, np.concatenate([rng.random(3000), [2.0**-53, 0.5, 1 - 2.0**-53]]))


@given(
    st.lists(st.one_of(st.just(-math.inf), st.floats(-1e6, 1e6)), min_size=1, max_size=40).filter(
        lambda keys: max(keys) > -math.inf
    ),
    st.lists(st.floats(2.0**-53, 1 - 2.0**-53), min_size=1, max_size=20),
)
def test_a_slot_that_cannot_evaporate_is_never_chosen(keys, u):
    check_choices(np.array(keys), np.array(u))


def test_equal_keys_divide_the_interval_evenly(rng):
    # the sums of equal rates are exact, if their number is a power of two
    u = rng.random(5000)
    assert np.array_equal(rate_sum(np.full(256, 12.5)).chosen(u), np.floor(256 * u))


@pytest.mark.parametrize("shift", [0.0, -1e6, 1e6])
def test_a_common_factor_of_all_rates_changes_nothing(shift, rng):
    keys, u = rng.integers(-20, 20, 500) * 0.5, rng.random(5000)  # halves: the sum of key and shift is exact
    begins, ends = shares(keys)
    slots = rate_sum(keys + shift).chosen(u)
    assert (begins[slots] - ROUNDING <= u).all() and (u <= ends[slots] + ROUNDING).all()


@pytest.mark.parametrize("keys", [[-np.inf], [-np.inf] * 5, [-np.inf] * 64])
def test_without_a_rate_no_slot_is_chosen(keys):
    chooser = rate_sum(keys)
    assert chooser.chosen() == -1
    assert chooser.chosen(np.array([[0.1, 0.9]])).tolist() == [[-1, -1]]
    assert chooser.rate == 0.0


def test_the_sum_of_the_rates(rng):
    keys = rng.uniform(-40, 40, 1000)
    keys[::7] = -np.inf
    # ten levels of sums, each rounded to 2^-53, and the errors of both exponential functions, 4e-16 and 1e-16
    assert rate_sum(keys).rate == pytest.approx(math.fsum(np.exp(keys)), rel=10 * 2.0**-53 + 5e-16)


@pytest.mark.parametrize(("level", "rate"), [(1e6, np.inf), (-1e6, 0.0)])
def test_rates_beyond_the_numbers_of_float64_are_still_compared(level, rate):
    chooser = rate_sum([level, level + math.log(3.0)])
    assert chooser.rate == rate
    # a quarter of the interval is that of the first slot; a key of 1e6 is rounded by up to 6e-11
    assert chooser.chosen([0.25 - 1e-9, 0.25 + 1e-9]).tolist() == [0, 1]


def test_the_limit_of_a_low_temperature_is_the_largest_key(rng):
    """Keys over kT, as kT decreases: the choice does not depend on the random number any more."""
    x, u = rng.uniform(0.5, 1.0, 600), rng.random(2000)
    best = Largest(tree_of(600), x).chosen()
    gap = x[best] - np.sort(x)[-2]
    others = [np.count_nonzero(rate_sum(x / width).chosen(u) != best) for width in (100 * gap, gap, gap / 40)]
    assert best == np.argmax(x)
    assert others == sorted(others, reverse=True)
    assert others[0] > 1000  # tens of keys within a width of the largest one
    assert 2000 * 0.2 < others[1] < 2000 * 0.8  # the second one alone has the share 1/(1 + e) = 0.27
    assert others[2] == 0  # exp(-40) = 4e-18


# ---- of an emitter -------------------------------------------------------------------------------------------------


def test_the_sum_at_the_root_does_not_drift(tip12):
    settings = ae.evaporation.ChargeSettings(sweep_interval=100_000, potential_bound=1.0)
    emitter = ae.evaporation.Emitter(tip12, law=ae.Arrhenius(50.0), settings=settings)
    batch = emitter.evaporate(5000)  # until there is no more space for exposed atoms: no sum is ever rebuilt
    assert batch.status == SWEEP_DUE and emitter._core.since_relaxation == len(batch) > 500
    # 240 slots change per event: 2e5 updates, of rates that differ by many orders of magnitude. 13 levels of sums,
    # each rounded to 2^-53; differences would lose the small rates next to the large ones
    assert emitter._core.chooser.root_error < 13 * 2.0**-53


@pytest.mark.parametrize("temperature", [50.0, 300.0])
def test_frequencies_on_a_frozen_surface_are_the_probabilities(tip12, temperature):
    emitter = ae.evaporation.Emitter(tip12, law=ae.Arrhenius(temperature), seed=1)
    assert sum(map(len, emitter.advance(400))) == 400
    x = emitter.fields * emitter._core.control.voltage_factor / tip12.evaporation_fields[tip12.species[emitter.atoms]]
    keys = np.where(tip12.evaporable[emitter.atoms], -(1 - x) / (BOLTZMANN * temperature), -np.inf)
    probability = np.exp(keys - keys.max())
    probability /= probability.sum()
    n = 100_000
    slots = emitter._core.chooser.chosen(np.random.default_rng(4).random(n))
    of_slot = np.bincount(slots, minlength=emitter._core.tree.n_slots)[emitter._core.slots]
    assert of_slot.sum() == n  # empty slots are never chosen
    many = n * probability >= 10  # the others form one class
    counts = np.append(of_slot[many], of_slot[~many].sum())
    expected = n * np.append(probability[many], probability[~many].sum())
    assert len(counts) > 5 and expected.min() > 5
    # one number per test with a fixed seed: 1e-3 is a chance of 1 in 500 for both
    assert stats.chisquare(counts, expected).pvalue > 1e-3


# ---- the largest key -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 100, 1024])
def test_the_largest_key_wins_and_ties_go_by_atom(n, rng):
    tree = tree_of(n)
    for _ in range(20):
        keys = rng.integers(1, 6, n).astype(float)  # many are equal
        best = np.flatnonzero(keys == keys.max())
        assert Largest(tree, keys).chosen() == best[np.argmin(tree.atoms[best])]


@pytest.mark.parametrize("keys", [[0.0, -1.0], [-np.inf] * 3, [-0.0]])
def test_without_a_positive_key_no_slot_is_chosen(keys):
    chooser = Largest(tree_of(len(keys)), np.array(keys))
    assert chooser.chosen() == -1
    assert chooser.rate == 0.0
