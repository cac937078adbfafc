import json
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import apt_evap as ae
from apt_evap._common.codec import to_plain
from apt_evap._common.ion_random import IonRandom
from apt_evap.emission.emissions import Emissions, Launches, TangentialLaunches
from apt_evap.emission.energies import Thermal, TruncatedNormal
from apt_evap.emission.perturbations import (
    Combined,
    LateralVelocity,
    Mixture,
    RollUp,
    Unperturbed,
    described,
    perturbation_of,
)
from apt_evap.emission.surface_frame import launch_tangentially, rollup_direction, tangent_frame
from apt_evap.simulation.config.perturbation_text import read_perturbation, title_of, write_perturbation
from apt_evap.units import SPEED

D = 0.249
ENERGY = TruncatedNormal(0.155, 0.155)


class Kick:
    """A perturbation of a user's own: a push outwards, half the ions also sideways."""

    def launch(self, emissions, random):
        u = random.uniform(3)
        normal = emissions.normals * (100 * u[:, :1])
        sideways = np.where(u[:, 1:2] < 0.5, tangent_frame(emissions.normals)[0] * 50, 0.0)
        return Launches(emissions.positions, normal + sideways, np.zeros(len(emissions), dtype=bool))


BUILT_IN = [
    Unperturbed(),
    LateralVelocity(ENERGY),
    LateralVelocity(0.3),
    LateralVelocity(Thermal(60.0)),
    RollUp(ENERGY),
    Combined(ENERGY, 0.75),
    Combined(ENERGY, 0.0),
    Combined(0.2, 1.0),
]
MIXED = Mixture((RollUp(ENERGY, 0.4), LateralVelocity(0.1), Unperturbed()), (0.6, 0.3, 0.1))


def emissions(n=400, seed=1, isolated=0.2):
    """Atoms on a ball, each with a neighbour at the distance D in a random direction; some have none."""
    generator = np.random.default_rng(seed)
    normals = generator.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    steps = generator.normal(size=(n, 3))
    steps *= D / np.linalg.norm(steps, axis=1)[:, None]
    neighbours = 7 * normals + steps
    neighbours[generator.random(n) < isolated] = np.nan
    masses = generator.choice([26.982, 58.693], n)
    return Emissions(7 * normals, normals, neighbours, np.ones(n), masses, np.arange(n) + 1000 * seed, D)


def part(batch, rows):
    columns = ("positions", "normals", "neighbours", "charge_states", "masses", "ions")
    return Emissions(*[getattr(batch, name)[rows] for name in columns], batch.nearest_neighbour_distance)


def kinetic_energy(launches, masses):
    return (np.linalg.norm(launches.velocities, axis=1) / SPEED) ** 2 * masses


def drawn(batch, seed=11):
    u = IonRandom(seed, batch.ions).uniform(2)
    return u[:, 0], u[:, 1]


@pytest.mark.parametrize("perturbation", [*BUILT_IN, MIXED, Kick()], ids=lambda one: repr(one)[:40])
class TestContractOfEveryPerturbation:
    def test_a_launch_for_every_emission(self, perturbation):
        batch = emissions()
        launches = perturbation.launch(batch, IonRandom(11, batch.ions))
        assert isinstance(launches, Launches) and len(launches) == len(batch)
        assert np.isfinite(launches.positions).all() and np.isfinite(launches.velocities).all()

    def test_bits_do_not_depend_on_the_batch(self, perturbation):
        batch = emissions()
        whole = perturbation.launch(batch, IonRandom(11, batch.ions))
        for rows in (np.arange(17), np.array([333]), np.random.default_rng(2).permutation(len(batch))):
            some = part(batch, rows)
            launches = perturbation.launch(some, IonRandom(11, some.ions))
            for name in ("positions", "velocities", "rolled"):
                np.testing.assert_array_equal(getattr(launches, name), getattr(whole, name)[rows])

    def test_empty_batch(self, perturbation):
        none = part(emissions(), np.arange(0))
        assert len(perturbation.launch(none, IonRandom(1, none.ions))) == 0

    def test_emissions_are_left_as_they_were(self, perturbation):
        batch, twin = emissions(), emissions()
        perturbation.launch(batch, IonRandom(11, batch.ions))
        for name in ("positions", "normals", "neighbours", "masses"):
            np.testing.assert_array_equal(getattr(batch, name), getattr(twin, name))

    def test_plain_ions_start_from_their_site(self, perturbation):
        batch = emissions()
        launches = perturbation.launch(batch, IonRandom(11, batch.ions))
        np.testing.assert_array_equal(launches.positions[~launches.rolled], batch.positions[~launches.rolled])
        assert not launches.rolled[np.isnan(batch.neighbours[:, 0])].any()

    def test_it_can_be_told_from_its_settings(self, perturbation):
        told = json.loads(json.dumps(described(perturbation)))
        if isinstance(perturbation, Kick):
            assert told["name"] == "Kick"
            with pytest.raises(ValueError, match="Kick"):
                perturbation_of(told)
        else:
            assert perturbation_of(told) == perturbation
            assert repr(perturbation_of(told)) == repr(perturbation)


@pytest.mark.parametrize("perturbation", BUILT_IN, ids=repr)
class TestContractOfTheBuiltIn:
    def test_velocities_are_along_the_surface(self, perturbation):
        batch = emissions()
        velocities = perturbation.launch(batch, IonRandom(11, batch.ions)).velocities
        normal = np.abs((velocities * batch.normals).sum(axis=1))
        assert (normal <= 1e-13 * np.linalg.norm(velocities, axis=1) + 1e-300).all()  # rounding of unit vectors

    def test_both_doors_agree(self, perturbation):
        batch = emissions()
        rolled, first, second, *_ = perturbation.tangential(batch, IonRandom(11, batch.ions))
        launches = perturbation.launch(batch, IonRandom(11, batch.ions))
        np.testing.assert_array_equal(rolled, launches.rolled)
        for component, tangent in zip((first, second), tangent_frame(batch.normals), strict=True):
            along = (launches.velocities * tangent).sum(axis=1)
            np.testing.assert_allclose(along, component, rtol=0, atol=1e-12 * SPEED)  # rounding, speeds near 1e3

    def test_two_numbers_are_drawn_or_none(self, perturbation):
        batch = emissions(5)
        random = IonRandom(3, batch.ions)
        perturbation.tangential(batch, random)
        rest = IonRandom(3, batch.ions).uniform(3)[:, 2 * (not isinstance(perturbation, Unperturbed))]
        np.testing.assert_array_equal(random.uniform(1)[:, 0], rest)


def test_unperturbed_ions_are_at_rest():
    batch = emissions()
    launches = Unperturbed().launch(batch, IonRandom(11, batch.ions))
    assert not launches.velocities.any() and not launches.rolled.any()


def test_lateral_velocity_has_its_energy_and_azimuth():
    batch = emissions()
    quantile, turn = drawn(batch)
    launches = LateralVelocity(ENERGY).launch(batch, IonRandom(11, batch.ions))
    np.testing.assert_allclose(kinetic_energy(launches, batch.masses), ENERGY.quantile(quantile), rtol=1e-12)
    first, second = tangent_frame(batch.normals)
    angle = np.arctan2((launches.velocities * second).sum(axis=1), (launches.velocities * first).sum(axis=1))
    np.testing.assert_allclose(np.mod(angle - 2 * np.pi * turn + 1, 2 * np.pi), 1, atol=1e-12)
    assert not launches.rolled.any()


def test_rolled_ions_sit_on_their_neighbour_and_move_on_the_same_way():
    batch = emissions()
    launches = RollUp(ENERGY).launch(batch, IonRandom(11, batch.ions))
    rolled = launches.rolled
    np.testing.assert_array_equal(rolled, np.isfinite(batch.neighbours[:, 0]))
    assert 0 < rolled.sum() < len(batch)
    place = batch.neighbours + D * batch.normals
    np.testing.assert_allclose(launches.positions[rolled], place[rolled], rtol=1e-15)
    moved = (place - batch.positions)[rolled]
    across = moved - (moved * batch.normals[rolled]).sum(axis=1)[:, None] * batch.normals[rolled]
    speed = np.linalg.norm(launches.velocities[rolled], axis=1)
    expected = across / np.linalg.norm(across, axis=1)[:, None] * speed[:, None]
    # the part across may be a hundredth of the step: it keeps 13 digits
    np.testing.assert_allclose(launches.velocities[rolled], expected, atol=1e-12 * SPEED)
    energy = ENERGY.quantile(drawn(batch)[0])
    np.testing.assert_allclose(kinetic_energy(launches, batch.masses)[rolled], energy[rolled], rtol=1e-11)
    assert not launches.velocities[~rolled].any()


def test_neighbour_straight_above_gives_no_direction():
    up = np.array([[0.0, 0.0, 1.0]])
    batch = Emissions(up, up, up * (1 + D), [1], [58.7], [0], D)
    launches = RollUp(0.3).launch(batch, IonRandom(1, [0]))
    assert launches.rolled.all() and not launches.velocities.any()
    np.testing.assert_allclose(launches.positions, [[0, 0, 1 + 2 * D]], rtol=1e-15)
    _, first, second = rollup_direction(batch)
    assert first == second == 0


def test_combined_is_the_sum_of_its_parts():
    batch = emissions()
    share = 0.6
    both = Combined(0.3, share).launch(batch, IonRandom(11, batch.ions))
    rolling = RollUp(0.3 * share).launch(batch, IonRandom(11, batch.ions))
    lateral = LateralVelocity(0.3 * (1 - share)).launch(batch, IonRandom(11, batch.ions))
    np.testing.assert_allclose(both.velocities, rolling.velocities + lateral.velocities, atol=1e-12 * SPEED)
    np.testing.assert_array_equal(both.positions, rolling.positions)
    np.testing.assert_array_equal(both.rolled, rolling.rolled)


def test_combined_with_all_the_energy_in_the_rollup_is_rollup():
    batch = emissions()
    one = Combined(ENERGY, 1.0).launch(batch, IonRandom(11, batch.ions))
    other = RollUp(ENERGY).launch(batch, IonRandom(11, batch.ions))
    np.testing.assert_array_equal(one.velocities, other.velocities)
    np.testing.assert_array_equal(one.positions, other.positions)


def test_every_perturbation_sees_the_same_draws():
    batch = emissions(isolated=0)
    energies = [
        kinetic_energy(one(ENERGY).launch(batch, IonRandom(11, batch.ions)), batch.masses)
        for one in (LateralVelocity, RollUp)
    ]
    np.testing.assert_allclose(*energies, rtol=1e-11)


def test_azimuth_is_uniform_and_independent_of_the_energy():
    n = 20_000
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    batch = Emissions(up, up, up * np.nan, np.ones(n), np.full(n, 58.7), np.arange(n), D)
    velocities = LateralVelocity(ENERGY).launch(batch, IonRandom(5, batch.ions)).velocities
    angle = np.arctan2(velocities[:, 1], velocities[:, 0]) / math.tau + 0.5
    assert stats.kstest(angle, "uniform").pvalue > 1e-4  # one unlucky seed in 10,000
    speed = np.linalg.norm(velocities, axis=1)
    assert abs(stats.spearmanr(speed, angle).statistic) < 4 / math.sqrt(n)  # 4 standard deviations


@given(
    z=st.one_of(st.floats(-1, 1), st.floats(-1, -1 + 1e-6), st.sampled_from([-1.0, -0.9, 0.0, 1.0])),
    azimuth=st.floats(0, 6.3),
)
def test_tangent_frame_is_orthonormal_and_right_handed(z, azimuth):
    rho = math.sqrt(max(0.0, 1 - z * z))
    normal = np.array([rho * math.cos(azimuth), rho * math.sin(azimuth), z])
    normal /= np.linalg.norm(normal)
    first, second = (tangent[0] for tangent in tangent_frame(normal[None]))
    frame = np.array([first, second, normal])
    # the worst division is by 1 - 0.9 (n_z just above -0.9), which costs one or two digits
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(np.cross(first, second), normal, atol=1e-13)


def test_tangent_frame_is_x_and_y_at_the_apex_and_continuous_above_the_seam():
    first, second = tangent_frame([[0, 0, 1]])
    np.testing.assert_array_equal([first[0], second[0]], [[1, 0, 0], [0, 1, 0]])
    generator = np.random.default_rng(3)
    normals = generator.normal(size=(5000, 3))
    normals[::2, 2] = 0  # the equator, where the published frame has its seam
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals = normals[normals[:, 2] > -0.85]
    nearby = normals + generator.normal(0, 1e-6, normals.shape)
    nearby /= np.linalg.norm(nearby, axis=1)[:, None]
    for one, other in zip(tangent_frame(normals), tangent_frame(nearby), strict=True):
        # it turns about the normal tan(theta/2) < 3.6 times as fast as that moves, here 6e-6 at most
        assert np.abs(one - other).max() < 5 * 6e-6


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LateralVelocity("0.3"), r"energy must be a number \[eV\] or have a method quantile"),
        (lambda: RollUp(None), "energy must be"),
        (lambda: Combined(0.3, 1.2), "rollup_fraction must be .* <= 1, got 1.2"),
        (lambda: perturbation_of({"name": "Rollup", "energy": 0.1}), "'Rollup' .*'RollUp'"),
        (lambda: perturbation_of({"name": "RollUp"}), "energy"),
        (lambda: perturbation_of({"name": "RollUp", "energy": 1.0, "x": 2}), "'x'"),
        (lambda: perturbation_of({}), "name"),
    ],
)
def test_bad_settings_are_refused_in_one_sentence(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_plain_number_in_settings_is_a_fixed_energy():
    assert perturbation_of({"name": "RollUp", "energy": 0.3}) == RollUp(0.3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normals": [[0, 0, 2.0]]}, "normals must have length 1"),
        ({"masses": [0.0]}, "masses must be > 0"),
        ({"charge_states": [0]}, "charge_states must be > 0"),
        ({"masses": [1.0, 2.0]}, r"masses must have shape \(1,\)"),
        ({"positions": [[0, 0, np.inf]]}, "positions must be finite"),
        ({"nearest_neighbour_distance": 0.0}, "nearest_neighbour_distance must be"),
    ],
)
def test_bad_emissions_are_refused(change, message):
    good = {
        "positions": [[0, 0, 1.0]],
        "normals": [[0, 0, 1.0]],
        "neighbours": [[np.nan] * 3],
        "charge_states": [1],
        "masses": [58.7],
        "ions": [0],
        "nearest_neighbour_distance": D,
    }
    Emissions(**good)
    with pytest.raises(ValueError, match=message):
        Emissions(**(good | change))


def test_distribution_of_a_users_own_is_checked():
    class Negative:
        def quantile(self, u):
            return u - 0.5

    class Short:
        def quantile(self, u):
            return u[:3]

    batch = emissions()
    with pytest.raises(ValueError, match=r"must be >= 0 \[eV\], got -0\."):
        LateralVelocity(Negative()).launch(batch, IonRandom(1, batch.ions))
    with pytest.raises(ValueError, match=r"must have shape \(400,\), got \(3,\)"):
        RollUp(Short()).launch(batch, IonRandom(1, batch.ions))


def test_launches_are_checked():
    with pytest.raises(ValueError, match="velocities"):
        Launches([[0, 0, 0]], [0, 0, 0], [True])
    batch = emissions(3, isolated=1)
    with pytest.raises(ValueError, match="positions"):
        launch_tangentially(batch, np.ones(3, dtype=bool), np.zeros(3), np.zeros(3))


def test_ions_that_do_not_roll_can_have_a_height_of_their_own():
    batch = emissions(400)
    random = IonRandom(5, batch.ions)
    usual, own = (
        RollUp(0.3, 0.5, height=0.2, others=0.1, others_height=each).tangential(batch, random.from_start())
        for each in (None, 0.05)
    )
    assert 50 < usual.rolled.sum() < 350 and (usual.heights == 0.2).all()
    np.testing.assert_array_equal(own.heights, np.where(own.rolled, 0.2, 0.05))
    for name in ("rolled", "first", "second"):
        np.testing.assert_array_equal(getattr(own, name), getattr(usual, name))
    low = RollUp(0.3, 0.5, others_height=0.1).tangential(batch, random.from_start())
    np.testing.assert_array_equal(low.heights, np.where(low.rolled, 0.0, 0.1))
    assert RollUp(0.3, 0.5, others_height=0.0).tangential(batch, random.from_start()).heights is None


# ---- mixtures: each ion follows one perturbation, as if it were alone ----------------------------------------------

THREE = (RollUp(0.4, 0.5), LateralVelocity(0.1, 0.05), Unperturbed())


class Pushed:
    """A perturbation of a user's own, along t1, with seven random numbers."""

    def tangential(self, emissions, random):
        u = random.uniform(7)
        return np.zeros(len(u), bool), 1e4 + u[:, 6], np.zeros(len(u))


def columns(perturbation, batch):
    launches = TangentialLaunches(*perturbation.tangential(batch, IonRandom(5, batch.ions)))
    heights = np.zeros(len(batch)) if launches.heights is None else launches.heights
    return np.column_stack([launches.rolled, launches.first, launches.second, heights])


def followed(mixture, batch):
    """Which perturbation each ion follows; none of its launches is equal to that of another one."""
    found = columns(mixture, batch)
    alone = np.stack([columns(each, batch) for each in mixture.perturbations])
    same = (alone == found).all(axis=2)
    assert (same.sum(axis=0) == 1).all()
    return same.argmax(axis=0)


def test_each_ion_is_launched_as_by_one_of_the_perturbations():
    batch = emissions(20_000, isolated=0.0)
    mixture = Mixture((LateralVelocity(0.3), LateralVelocity(0.1), Unperturbed()), (5, 3, 2))
    counts = np.bincount(followed(mixture, batch), minlength=3)
    assert stats.chisquare(counts, len(batch) * np.array([0.5, 0.3, 0.2])).pvalue > 1e-3
    equal = np.bincount(followed(Mixture(mixture.perturbations), batch), minlength=3)
    assert stats.chisquare(equal).pvalue > 1e-3


def test_the_choice_does_not_depend_on_the_energy():
    """It has a random number of its own, whatever the perturbations take, also in a mixture of mixtures."""
    batch = emissions(20_000, isolated=0.0)
    energy = ae.TruncatedNormal(0.2, 0.2)
    for mixture in (
        Mixture((LateralVelocity(energy), Pushed())),
        Mixture((Mixture((LateralVelocity(energy), Unperturbed())), LateralVelocity(0.7))),
    ):
        launches = columns(mixture, batch)
        speeds = np.hypot(launches[:, 1], launches[:, 2])
        alone = columns(LateralVelocity(energy), batch)
        own = np.hypot(alone[:, 1], alone[:, 2])
        chosen = speeds == own
        # the energies of the ions that follow are a fair sample of all energies
        assert 0.2 < chosen.mean() < 0.55
        assert stats.ks_2samp(own[chosen], own[~chosen]).pvalue > 1e-3
    outer = Mixture((Mixture((Pushed(), Unperturbed())), Mixture((LateralVelocity(0.2), LateralVelocity(0.3)))))
    speeds = np.hypot(*columns(outer, batch)[:, 1:3].T)
    quarters = [np.mean(speeds == 0), np.mean(speeds >= 1e4)]
    assert quarters == pytest.approx([0.25, 0.25], abs=4 * np.sqrt(0.25 * 0.75 / len(batch)))


def test_defaults_are_filled_in_where_one_perturbation_has_its_own():
    batch = emissions(300, isolated=0.0)
    mixture = Mixture(THREE)
    launches = mixture.tangential(batch, IonRandom(5, batch.ions))
    assert launches.shares is None
    assert set(np.unique(launches.heights)) == {0.0, 0.05}

    class Shared(Pushed):
        def tangential(self, emissions, random):
            rolled, first, second = super().tangential(emissions, random)
            return TangentialLaunches(~rolled, first, second, np.tile([0.2, 0.5, 0.3], (len(emissions), 1)))

    both = Mixture((Shared(), Unperturbed())).tangential(batch, IonRandom(5, batch.ions))
    assert both.shares.shape == (300, 3) and both.heights is None
    np.testing.assert_array_equal(both.shares[both.rolled], np.tile([0.2, 0.5, 0.3], (both.rolled.sum(), 1)))
    np.testing.assert_array_equal(both.shares[~both.rolled], np.tile([1.0, 0.0, 0.0], ((~both.rolled).sum(), 1)))
    assert 100 < both.rolled.sum() < 200


def test_hits_of_responses_are_those_of_flights():
    tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1), offset_seed=2)
    run = ae.Simulation(tip, seed=3).run(100, progress=False)
    mixture = Mixture((RollUp(0.3, sharpness=0.4), LateralVelocity(0.2, 0.1), Combined(0.2, 0.5)), (2, 1, 1))
    flown, fitted = run.hits(mixture), run.hits(mixture, by_response=True)
    both = flown.detected & fitted.detected
    assert both.sum() > 80
    deviations = np.hypot(flown.x - fitted.x, flown.y - fitted.y)[both]
    assert np.median(deviations) < 0.02  # mm; measured 0.005


def test_a_mixture_is_settings():
    mixture = Mixture(THREE, (6, 3, 1))
    assert mixture.weights == (6.0, 3.0, 1.0)
    assert perturbation_of(to_plain(mixture)) == mixture
    assert read_perturbation(write_perturbation(mixture)) == mixture
    assert title_of(mixture) == (
        "0.6 roll-up, 0.4 eV, probability 0.5; 0.3 lateral velocity, 0.1 eV, height 0.05 nm; 0.1 unperturbed"
    )
    names = {"Mixture": Mixture, "RollUp": RollUp, "LateralVelocity": LateralVelocity, "Unperturbed": Unperturbed}
    assert eval(repr(mixture), names) == mixture


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((RollUp(0.2),), "perturbations must be two or more perturbations with a method `tangential`"),
        (((RollUp(0.2),),), "perturbations must be two or more"),
        (((RollUp(0.2), "Unperturbed"),), "perturbations must be two or more"),
        ((THREE, (1, 2)), "weights must be 3 numbers, got 2"),
        ((THREE, (1, 0, 2)), "weights must be a finite number > 0, got 0"),
        ((THREE, 0.3), "weights must"),
    ],
)
def test_errors(arguments, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        Mixture(*arguments)
