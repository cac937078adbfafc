"""Second roll-ups: their targets, launches and responses."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.emission.emissions import Emissions, TangentialLaunches
from apt_evap.emission.surface_frame import launch_tangentially, rolled_positions, rollup_direction
from apt_evap.simulation.columns import hashed_columns_of

ENERGY = ae.TruncatedNormal(0.155, 0.155)
TWICE = ae.RollUp(ENERGY, second_roll=1.0)
FLOWN = (TWICE, ae.RollUp(0.5, 0.7, others=0.3, second_roll=0.5), ae.Combined(ENERGY, 0.6, second_roll=0.8))
WIDE = (
    ae.RollUp(ENERGY, sharpness=0.15, height=0.1, second_roll=1.0),
    ae.RollUp(0.35, 0.6, 2.0, 0.2, others=0.35, second_roll=0.5),
    ae.RollUp(0.35, sharpness=2.0),
)
D = 0.25


@pytest.fixture(scope="module")
def run(tip12):
    settings = ae.ResponseSettings(rolls=2)
    return ae.Simulation(tip12, seed=5, response_settings=settings).run(120, FLOWN, progress=False)


@pytest.fixture(scope="module")
def wide_run(tip12):
    settings = ae.ResponseSettings.wide(rolls=2)
    return ae.Simulation(tip12, seed=5, response_settings=settings).run(80, (*WIDE, TWICE), progress=False)


def line_of_atoms():
    """Two atoms with normal z: one rolls along x and then along y, one has no second target."""
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    positions = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    targets, ratios = np.full((2, 2, 3, 3), np.nan), np.full((2, 2, 3), np.nan)
    targets[:, 0, 0] = positions + np.array([D, 0.0, 0.0])
    targets[0, 0, 1] = [0.0, D, 0.0]
    targets[0, 1, :2] = [D, D, 0.0], [2 * D, 0.0, 0.0]
    ratios[:, 0, 0], ratios[0, 0, 1] = 0.9, 0.9
    ratios[0, 1, :2] = 0.8, 0.4
    neighbours = targets[:, 0, 0]
    return Emissions(positions, up, neighbours, [1, 1], [58.7, 58.7], [0, 1], D, targets, ratios)


def test_launches_by_hand():
    emissions = line_of_atoms()
    launches = ae.RollUp(0.3, second_roll=1.0).launch(emissions, ae.emission.IonRandom(1, emissions.ions))
    np.testing.assert_allclose(launches.positions, [[D, D, D], [5 + D, 0, D]], rtol=0, atol=1e-15)
    speed = np.linalg.norm(launches.velocities, axis=1)
    # the first one moves in the direction of its second step, the other in that of its only one
    np.testing.assert_allclose(launches.velocities / speed[:, None], [[0, 1, 0], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(speed, speed[0], rtol=1e-15)
    # means: (D, D)/2 first, then (D, D) and (2 D, 0) with the weights 1 and exp(-1/2 / 0.5)
    soft = ae.RollUp(0.3, sharpness=0.5, second_roll=1.0).launch(emissions, ae.emission.IonRandom(1, emissions.ions))
    weight = np.exp(-1.0) / (1 + np.exp(-1.0))
    place = np.array([D + weight * D, D - weight * D, D])
    np.testing.assert_allclose(soft.positions[0], place, rtol=1e-14)
    step = place[:2] - D / 2
    np.testing.assert_allclose(
        soft.velocities[0, :2] / np.linalg.norm(soft.velocities[0]), step / np.linalg.norm(step), atol=1e-14
    )


def test_no_second_roll_is_the_usual_roll_up():
    emissions = line_of_atoms()
    one, other = (
        each.tangential(emissions, ae.emission.IonRandom(1, emissions.ions))
        for each in (ae.RollUp(ENERGY, 0.5), ae.RollUp(ENERGY, 0.5, second_roll=1e-12))
    )
    for name in ("rolled", "first", "second"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.twice is None and not other.twice.any()


def test_the_share_of_second_rolls_is_the_probability():
    n = 4000
    few = line_of_atoms()
    many = few[np.zeros(n, int)]
    many = Emissions(
        **{name: getattr(many, name) for name in many.columns if name != "ions"},
        ions=np.arange(n),
        nearest_neighbour_distance=D,
    )
    launches = ae.RollUp(0.1, 0.6, second_roll=0.3).tangential(many, ae.emission.IonRandom(3, many.ions))
    # four standard deviations; the two decisions are independent
    assert abs(launches.rolled.mean() - 0.6) < 4 * np.sqrt(0.24 / n)
    assert abs(launches.twice.mean() - 0.18) < 4 * np.sqrt(0.15 / n)
    assert not (launches.twice & ~launches.rolled).any()


def deviations_from_flights(run, perturbation):
    """Distances between the hits of flights and of responses [mm]; most ions hit in both."""
    flown, fitted = run.hits(perturbation), run.hits(perturbation, by_response=True)
    both = flown.detected & fitted.detected
    assert both.mean() > 0.9
    return np.hypot(flown.x - fitted.x, flown.y - fitted.y)[both]


@pytest.mark.parametrize("perturbation", FLOWN, ids=repr)
def test_hits_are_those_of_flights(run, perturbation):
    deviations = deviations_from_flights(run, perturbation)
    # mm; measured 0.0003 and 0.006
    assert np.median(deviations) < 0.001 and deviations.max() < 0.01
    flown, once = run.hits(perturbation), run.hits(ae.RollUp(perturbation.energy))
    assert np.nanmedian(np.hypot(flown.x - once.x, flown.y - once.y)) > 1000 * np.median(deviations)


@pytest.mark.parametrize("perturbation", (*WIDE, TWICE), ids=repr)
def test_wide_hits_are_those_of_flights(wide_run, perturbation):
    deviations = deviations_from_flights(wide_run, perturbation)
    # mm; measured 0.09 and 0.27 for the worst of the four
    assert np.median(deviations) < 0.14 and deviations.max() < 0.4


def test_places_after_the_second_roll(run):
    emissions = run.emissions
    assert emissions.targets.shape == (120, 2, 3, 3) and emissions.charge_ratios.shape == (120, 2, 3)
    np.testing.assert_array_equal(emissions.targets[:, 0, 0], emissions.neighbours)
    twice, first, second = rollup_direction(emissions, roll=1)
    assert twice.sum() > 100
    np.testing.assert_allclose(np.hypot(first, second)[twice], 1.0, rtol=1e-12)
    # the last step of the path is one nearest neighbour distance long
    step = rolled_positions(emissions, roll=1) - rolled_positions(emissions)
    d = emissions.nearest_neighbour_distance
    np.testing.assert_allclose(np.linalg.norm(step[twice], axis=1), d, rtol=1e-6)
    # no neighbour of the site: the next shell of fcc is at 1.41 d
    distance = np.linalg.norm(emissions.targets[:, 1, 0] - emissions.positions, axis=1)
    assert distance[twice].min() > 1.4 * d


def test_a_run_comes_back_from_its_file(run, wide_run, tmp_path):
    for each in (run, wide_run):
        each.save(tmp_path / "twice.h5")
        loaded = ae.load(tmp_path / "twice.h5")
        assert loaded.fingerprint() == each.fingerprint()
        assert loaded.response_settings == each.response_settings
        assert loaded.perturbations == each.perturbations
        again = loaded.hits(TWICE, by_response=True)
        np.testing.assert_array_equal(again.x, each.hits(TWICE, by_response=True).x)
        further = loaded.on_detector(ae.Detector(distance=200.0, width=500.0))
        np.testing.assert_allclose(further.hits(TWICE, by_response=True).x, 2 * again.x, rtol=1e-6)


def test_the_fingerprint_has_one_array_for_each_roll_up(run, wide_run):
    hashed, of_wide = (hashed_columns_of(each, each.every_column) for each in (run, wide_run))
    both = {"emissions/second_targets", "emissions/second_charge_ratios", "responses/rolled", "responses/twice"}
    assert both < set(hashed) < set(of_wide)
    more = {"emissions/targets", "emissions/charge_ratios"}
    assert more < set(of_wide) and more.isdisjoint(hashed)
    np.testing.assert_array_equal(of_wide["emissions/second_targets"], wide_run.emissions.targets[:, 1])
    np.testing.assert_array_equal(hashed["responses/twice"], run.responses.rolled[:, 1])
    other = replace(run.emissions, targets=run.emissions.targets + np.array([0.0, 1e-9])[:, None, None])
    assert replace(run, emissions=other).fingerprint() != run.fingerprint()


def test_bits_depend_neither_on_batches_nor_on_threads(tip12, run):
    settings = ae.ResponseSettings(rolls=2)
    other = ae.Simulation(tip12, seed=5, response_settings=settings, n_threads=2).run(
        120, FLOWN, progress=False, batch_size=17
    )
    assert other.fingerprint() == run.fingerprint()


def test_the_first_roll_is_that_of_a_run_for_one_roll_up(tip12, run):
    once = ae.Simulation(tip12, seed=5).run(120, FLOWN[:0], progress=False)
    assert once.responses.rolled.shape == (120, 1, 3, 10) and run.responses.rolled.shape == (120, 2, 3, 10)
    assert once.emissions.targets is None
    np.testing.assert_array_equal(once.responses.rolled[:, 0], run.responses.rolled[:, 0])
    np.testing.assert_array_equal(once.hits(ae.RollUp(ENERGY)).x, run.hits(ae.RollUp(ENERGY)).x)
    assert once.responses.residuals.shape == (120, 2) and run.responses.residuals.shape == (120, 3)


def test_bad_fits_of_second_rolls_are_flagged(run):
    residuals = run.responses.residuals.copy()
    can = np.flatnonzero(run.emissions.can_roll_twice)[3]
    residuals[can, 2] = 1.0
    responses = replace(run.responses, residuals=residuals)
    assert np.flatnonzero(run.response_model.flagged(responses, run.emissions)).tolist() == [can]


@pytest.mark.parametrize("perturbation", [TWICE, WIDE[0]], ids=repr)
def test_runs_for_one_roll_up_say_so(tip12, perturbation):
    once = ae.Simulation(tip12, seed=5).run(20, progress=False)
    with pytest.raises(ValueError, match=r"rolls=2|ResponseSettings\.wide"):
        once.hits(perturbation)


def test_a_second_roll_of_a_users_own_needs_its_targets(tip12):
    once = ae.Simulation(tip12, seed=5).run(20, progress=False)
    n = len(once)
    with pytest.raises(ValueError, match="a second roll-up needs its targets"):
        launch_tangentially(once.emissions, np.ones(n, bool), np.zeros(n), np.zeros(n), twice=np.ones(n, bool))


def test_launches_that_the_responses_do_not_serve_are_refused(tip12):
    once = ae.Simulation(tip12, seed=5).run(20, progress=False)
    n = len(once)
    launches = TangentialLaunches(np.ones(n, bool), np.zeros(n), np.zeros(n), twice=np.ones(n, bool))
    with pytest.raises(ValueError, match=r"serve one roll-up, .*rolls=2"):
        once.response_model.evaluate(once.responses, launches, once.emissions.masses)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ae.RollUp(0.1, second_roll=1.5), "second_roll must be .* <= 1, got 1.5"),
        (lambda: ae.Combined(0.1, 0.5, second_roll=-0.1), "second_roll must be .*>= 0.*, got -0.1"),
        (lambda: ae.ResponseSettings(rolls=3), "rolls must be .*2, got 3"),
        (lambda: ae.ResponseSettings.wide(rolls=0), "rolls must be .*1.*, got 0"),
        (
            lambda: Emissions(
                np.zeros((1, 3)),
                [[0, 0, 1.0]],
                np.zeros((1, 3)),
                [1],
                [1.0],
                [0],
                D,
                targets=np.zeros((1, 2, 3, 3)),
            ),
            "targets and charge_ratios must be given together",
        ),
        (
            lambda: replace(line_of_atoms(), targets=np.zeros((2, 3, 3, 3)), charge_ratios=np.zeros((2, 3, 3))),
            "targets must be .*2 roll-ups, got 3",
        ),
    ],
)
def test_bad_options_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
