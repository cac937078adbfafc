"""The apparent order by evaporation."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.types import Estimated
from apt_evap.studies.visibility.false_order import FalseOrder


@pytest.fixture(scope="session")
def alloy(made_once):
    nickel = ae.material("Ni")
    phase = ae.specimen.Phase("alloy", nickel, solutes={"Al": 0.1}, evaporation_field=nickel.evaporation_field)
    tip = ae.Tip(phases=[phase], apex_radius=3.0, axis=(1, 1, 1), shank_length=3.0, seed=1, offset_seed=1)
    return made_once(tip, 3000, [ae.Unperturbed()], responses=False, seed=1, n_threads=1)


@pytest.mark.slow
def test_a_random_alloy_with_equal_fields_has_no_order(alloy):
    order = ae.studies.false_order([alloy], "Al")
    for each in (order.reconstructed, order.true):
        assert abs(each.value) < 3.5 * each.error
    assert abs(order.shuffled.value) < 3.5 * order.shuffled.error / np.sqrt(50)
    # the bootstrap and the permutations agree on the error of a random alloy; both have errors of 20 %
    assert order.true.error == pytest.approx(order.shuffled.error, rel=0.6)


def test_the_parameter_of_unlike_pairs():
    like = Estimated(-0.2, 0.05)
    order = FalseOrder(like, like, like, ions=500, solutes=100)
    assert order.unlike == pytest.approx((0.2 * 0.2 / 0.8, 0.05 * 0.2 / 0.8))  # -alpha x / (1 - x)


@pytest.mark.parametrize(
    ("argument", "name"), [({"solute": "Cu"}, "solute"), ({"runs": []}, "runs"), ({"shell": -1.0}, "shell")]
)
def test_wrong_arguments_are_named(alloy, argument, name):
    with pytest.raises(ValueError, match=name):
        ae.studies.false_order(**{"runs": alloy, "solute": "Al"} | argument)


@pytest.mark.slow
def test_solutes_with_a_low_field_appear_ordered():
    nickel = ae.material("Ni")
    field = {"Al": 0.8 * nickel.evaporation_field}
    runs = []
    for seed in (1, 2):
        phase = ae.specimen.Phase("alloy", nickel, solutes={"Al": 0.1}, evaporation_field=field)
        tip = ae.Tip(
            phases=[phase], apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_length=20 * nickel.a, depth=6.0, seed=seed,
            offset_seed=seed,
        )  # fmt: skip
        simulation = ae.Simulation(tip, seed=seed, n_threads=1)
        runs.append(simulation.run(27_000, [ae.Unperturbed()], responses=False, progress=False))
    order = ae.studies.false_order(runs, "Al")
    # an independent measurement of one such run gave -0.177 +- 0.022
    assert order.reconstructed.value == pytest.approx(-0.177, abs=3 * np.hypot(0.022, order.reconstructed.error))
    assert order.reconstructed.value < -3 * order.reconstructed.error
    assert abs(order.true.value) < 3 * order.true.error
