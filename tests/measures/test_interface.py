"""Width of an interface and excess of a segregated element, for ions with known probabilities."""

import json

import numpy as np
import pytest
from scipy.special import ndtr

import apt_evap as ae

N = 20_000


def ions(model, seed=1):
    """Distances of ions up to 3 nm, and which of them are of the element, with a probability at each distance."""
    rng = np.random.default_rng(seed)
    distances = 6 * rng.random(N) - 3
    return distances, rng.random(N) < model(distances)


@pytest.mark.parametrize(("sigma", "before", "after"), [(0.1, 0.95, 0.05), (0.4, 0.2, 0.7)])
def test_the_width_of_a_step(sigma, before, after):
    found = ae.measures.interface_profile(
        *ions(lambda d: before + (after - before) * ndtr((d - 0.2) / sigma)), reach=2.0, bin_width=0.25
    )
    # four standard errors: one of 16,000 fits fails
    assert abs(found.sigma - sigma) < 4 * found.sigma_error < 0.5 * sigma
    assert abs(found.centre - 0.2) < 4 * found.centre_error < 0.5 * sigma
    assert (found.before, found.after) == pytest.approx((before, after), abs=0.03)
    assert found.width / found.sigma == pytest.approx(2.563, abs=1e-3)  # from a table of the normal distribution
    assert found.width_error / found.sigma_error == pytest.approx(2.563, abs=1e-3)
    z = (found.fraction - found.fitted(found.centres)) / found.fraction_errors
    away = np.abs(found.centres - 0.2) > 2 * sigma + 0.25  # a bin there has the fraction of its centre
    assert 0.3 < np.mean(z[away] ** 2) < 2.0  # 8 and 12 bins: errors that are twice too large give a fourth
    assert np.abs(z[away]).max() < 4


@pytest.mark.slow
def test_errors_are_those_of_repeated_measurements():
    def once(seed):
        return ae.measures.interface_profile(*ions(lambda d: 0.1 + 0.8 * ndtr(d / 0.3), seed), reach=1.5)

    found = [once(seed) for seed in range(30)]
    spread = np.std([each.sigma for each in found], ddof=1)
    # the standard deviation of 30 numbers has a relative error of 13 %: three of them
    assert np.mean([each.sigma_error for each in found]) == pytest.approx(spread, rel=0.4)


def test_a_sharp_step_has_no_width():
    distances = np.linspace(-1.005, 1.005, 202)
    found = ae.measures.interface_profile(distances, distances > 0)
    assert found.width < 0.02  # two distances of the ions
    assert (found.before, found.after) == pytest.approx((0, 1), abs=0.02)


def test_the_excess_of_a_segregated_element():
    found = ae.measures.segregation_profile(*ions(lambda d: 0.02 + 0.2 * np.exp(-(d**2) / (2 * 0.35**2))), reach=2.5)
    assert abs(found.width - 0.35) < 4 * found.width_error < 0.1
    assert abs(found.centre) < 4 * found.centre_error < 0.1
    assert (found.bulk, found.peak) == pytest.approx((0.02, 0.22), abs=0.03)
    assert abs(found.excess - 0.2 * 0.35 * np.sqrt(2 * np.pi)) < 4 * found.excess_error < 0.05
    assert found.fitted(found.centre) == pytest.approx(found.peak)


def test_results_are_json():
    found = ae.measures.segregation_profile(*ions(lambda d: 0.05 + 0.2 * np.exp(-(d**2))))
    content = json.loads(json.dumps(found.to_dict()))
    assert content["excess"] == found.excess and len(content["fraction"]) == len(content["edges"]) - 1


def test_refusals():
    distances, chosen = ions(lambda d: 0.5 + 0 * d)
    with pytest.raises(ValueError, match="at least 10 ions on each side within 1 nm, got 0 and"):
        ae.measures.interface_profile(np.abs(distances), chosen)
    with pytest.raises(ValueError, match="chosen"):
        ae.measures.interface_profile(distances, np.zeros(N, bool))
    with pytest.raises(ValueError, match="reach"):
        ae.measures.segregation_profile(distances, chosen, reach=0)
    with pytest.raises(ValueError, match="bin_width"):
        ae.measures.interface_profile(distances, chosen, bin_width=3.0)


def test_the_intervals_of_the_excess_cover_the_truth():
    """A segregation of 0.1 nm 50 nm^-3 = 5 atoms / nm^2 less the bulk, 1000 times: 95 % intervals cover 95 %."""
    covered, values, density, area = 0, [], 50.0, 60.0
    true = (0.25 - 0.03) * 0.3 * np.sqrt(2 * np.pi) * density
    for seed in range(1000):
        rng = np.random.default_rng(seed)
        n = rng.poisson(density * area * 8 * 0.4)  # of an efficiency of 0.4
        distances = 8 * rng.random(n) - 4
        chosen = rng.random(n) < 0.03 + 0.22 * np.exp(-0.5 * (distances / 0.3) ** 2)
        excess = ae.measures.interfacial_excess(distances, chosen, area, window=1.2, reach=4.0, efficiency=0.4)
        covered += abs(excess.value - true) <= 1.96 * excess.error
        values.append(excess.value)
    assert 930 <= covered <= 975  # three standard deviations of 950 are 21
    assert np.mean(values) == pytest.approx(true, rel=0.01)  # 0.3 % by the draws


def test_a_step_without_segregation_has_no_excess():
    rng = np.random.default_rng(1)
    distances = 6 * rng.random(50_000) - 3
    excess = ae.measures.interfacial_excess(distances, rng.random(50_000) < np.where(distances < 0, 0.7, 0.1), 100.0)
    assert abs(excess.value) < 3 * excess.error
    with pytest.raises(ValueError, match="at least 10 ions on each side between window = 1 and reach = 3 nm, got 0"):
        ae.measures.interfacial_excess(np.abs(distances), distances > 1, 100.0)


def test_the_ladder_rises_by_the_excess():
    distances = np.array([0.2, -0.1, np.nan, 0.1, -0.3])
    places, counted = ae.measures.ladder_diagram(distances, np.array([True, True, True, False, False]))
    assert places.tolist() == [-0.3, -0.1, 0.1, 0.2] and counted.tolist() == [0, 1, 1, 2]
