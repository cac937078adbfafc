"""The radius of a tip from its map: the fit of a family, its interval, and twins."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.fit.radius import _fit

ENERGY = ae.TruncatedNormal(0.1, 0.1)
EMISSIONS = [ae.Unperturbed(), ae.RollUp(ENERGY, probability=0.5)]


def members(random, radii, values=9, scatter=0.03):
    """Values of a made-up family: smooth in ln R, with a scatter from one specimen to another."""
    x = np.log(np.atleast_1d(radii))[:, None] - 3.0
    k = np.arange(values)
    return 0.5 + 0.2 * np.cos(k) * x + 0.05 * np.sin(k) * x * x + scatter * random.normal(size=(len(x), values))


@pytest.mark.parametrize("runs", [5, 8, 20])
def test_intervals_contain_the_radius(runs):
    random, inside = np.random.default_rng(5), []
    radii = np.exp(np.linspace(np.log(8.0), np.log(60.0), runs))
    for _ in range(200):
        hidden = np.exp(random.uniform(np.log(12.0), np.log(40.0)))
        fit = _fit(radii, members(random, radii), members(random, hidden)[0], np.zeros(9))
        inside.append(fit.interval[0] <= hidden <= fit.interval[1])
        assert fit.interval[0] <= fit.radius <= fit.interval[1]
    assert np.mean(inside) > 0.9  # of 95 %; few runs have wide intervals


def test_a_member_without_scatter_is_found():
    random = np.random.default_rng(1)
    radii = np.array([10.0, 14.0, 20.0, 28.0, 40.0, 56.0])
    fit = _fit(radii, members(random, radii, scatter=1e-6), members(random, 23.0, scatter=1e-6)[0], np.zeros(9))
    assert fit.radius == pytest.approx(23.0, rel=0.005)
    assert not any(fit.open_ends)
    assert "23 nm" in repr(fit)


def test_a_radius_beyond_the_family_has_an_open_end():
    random = np.random.default_rng(1)
    radii = np.array([10.0, 14.0, 20.0, 28.0, 40.0, 56.0])
    fit = _fit(radii, members(random, radii), members(random, 90.0)[0], np.zeros(9))
    assert fit.open_ends == (False, True) and "at least 56" in repr(fit)


def tip(radius, number):
    nickel = ae.material("Ni")
    size = radius * nickel.a
    return ae.Tip(nickel, size, axis=(1, 1, 1), shank_length=size, offset_seed=number, depth=5 * nickel.a)


def run_of(radius, number, ions):
    simulation = ae.Simulation(tip(radius, number), seed=number)
    return simulation.run(ions, EMISSIONS, responses=False, progress=False)


@pytest.fixture(scope="session")
def family(made_once):
    return [made_once(tip(radius, radius), 1000, EMISSIONS, responses=False, seed=radius) for radius in (8, 10, 12, 14)]


@pytest.fixture(scope="session")
def pretended(made_once):
    """The first of the family as if it were of four tips, for tests of what is refused."""
    run = made_once(tip(8, 8), 1000, EMISSIONS, responses=False, seed=8)
    tips = [run.settings["tip"] | {"apex_radius": radius * 0.352} for radius in (8, 10, 12, 14)]
    return [replace(run, settings=run.settings | {"tip": tip}) for tip in tips]


def window(run):
    extent = {"extent": (-150, 150, -150, 150), "position_step": None, "mask": np.ones((400, 400), bool)}
    return run.hits(ae.RollUp(ENERGY, probability=0.5)).map(400, **extent)


@pytest.mark.slow
def test_runs_and_a_map(family):
    measured = family[2]
    projection = ae.simulation.image_compression(measured).projection
    fit = ae.fit.fit_radius(
        family,
        window(measured),
        projection,
        ae.RollUp(ENERGY, probability=0.5),
        (1, 1, 1),
        fold=3,
        rings=((10, 18), (18, 28)),
        radii=(0, 4, 8, 12, 16),
    )
    assert fit.values.shape == (4, 6) and fit.run_radii[2] == pytest.approx(12 * 0.352)
    # a member of the family: its own values, but for the bins of the map
    np.testing.assert_allclose(fit.values[2], fit.measured, atol=0.05)  # measured: 0.00; 0.25 with half the bins
    assert fit.interval[0] <= 12 * 0.352 <= fit.interval[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"runs": 3}, "runs must be at least 4 with at least 3 radii"),
        ({"perturbations": [ae.Unperturbed()] * 3}, "perturbations must be one or 4, one for each run, got 3"),
        ({"draws": 0}, "draws must be .*1, got 0"),
        ({"draws": 2}, "draws must be 1 for runs without responses.*, got 2"),
    ],
)
def test_bad_arguments_are_refused(pretended, change, message):
    measured = window(pretended[0])
    projection = ae.simulation.image_compression(pretended[0]).projection
    runs = pretended[: change.pop("runs", 4)]
    arguments = {"perturbations": ae.RollUp(ENERGY, probability=0.5), "plane": (1, 1, 1)} | change
    with pytest.raises(ValueError, match=message):
        ae.fit.fit_radius(runs, measured, projection, **arguments)


def test_a_run_without_a_radius_is_refused(pretended):
    settings = dict(pretended[0].settings) | {"tip": {"positions": "of a file"}}
    runs = [replace(pretended[0], settings=settings), *pretended[1:]]
    with pytest.raises(ValueError, match="apex radius of a run"):
        ae.fit.fit_radius(
            runs,
            window(pretended[0]),
            ae.detection.Projection(50.0),
            ae.RollUp(ENERGY, probability=0.5),
            (1, 1, 1),
            fold=3,
        )
