from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import apt_evap as ae
from apt_evap.detection.hits import Outcome
from apt_evap.simulation.flight import response
from apt_evap.simulation.flight.response import Responses, directions_and_times, fit_quantities

ENERGY = ae.TruncatedNormal(0.155, 0.155)
WIDE = ae.TruncatedNormal(0.4, 0.3)  # up to the 1.5 eV of the designs and somewhat beyond
FLOWN = (
    ae.Unperturbed(),
    ae.LateralVelocity(ENERGY),
    ae.LateralVelocity(WIDE),
    ae.RollUp(ENERGY),
    ae.Combined(ENERGY, 0.5),
    ae.Combined(WIDE, 0.25),
)


# ---- designs -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["site", "rolled"])
def test_designs_fix_their_polynomials(name):
    design = getattr(ae.ResponseSettings(), name)
    matrix = design.monomials(design.launches)
    assert len(matrix) == design.number == len(np.unique(design.launches, axis=0))
    assert np.linalg.matrix_rank(matrix) == matrix.shape[1] == len(np.unique(design.exponents, axis=0))
    assert len(matrix) > 1.3 * matrix.shape[1]  # some are left over, to tell a bad fit
    assert np.linalg.cond(matrix) < 2000  # coefficients in single precision lose about three of seven digits
    velocities = design.launches[:, -3:-1]
    assert np.hypot(*velocities.T).max() == pytest.approx(1.0)
    # the first launches are those of most rules: the velocities of the rings
    first = sum(number for _, number in design.rings)
    assert not design.launches[:first, [*range(design.launches.shape[1] - 3), -1]].any()
    np.testing.assert_allclose(np.hypot(*velocities[:first].T), np.repeat(*zip(*design.rings, strict=True)), atol=1e-15)


def test_monomials_are_those_of_the_degrees():
    design = ae.simulation.Design((3, 2, 1, 0), ((0.0, 1), (0.6, 5), (1.0, 7)), 78, place=True)
    totals = np.sum(design.exponents, axis=1)
    assert totals.max() == 3 and len(totals) == 56  # of total degree 3 in five variables
    design = ae.simulation.Design((2, 0), ((0.0, 1), (1.0, 6)), 8)
    assert {tuple(row) for row in design.exponents.tolist()} == {
        (0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (1, 1, 0), (0, 2, 0), (0, 0, 1),
    }  # fmt: skip


def test_a_design_that_fixes_nothing_is_refused():
    with pytest.raises(ValueError, match="must determine the 7 coefficients"):
        ae.simulation.Design((2, 0), ((0.0, 1), (1.0, 4)), 6)  # six launches for seven numbers
    with pytest.raises(ValueError, match="must determine"):
        ae.simulation.Design((2, 0), ((1.0, 12),), 24)  # on a circle u^2 + v^2 = 1 adds nothing
    with pytest.raises(
        ValueError, match="number must be at most 12, the launches of the grid of these degrees and rings"
    ):
        ae.simulation.Design((2, 0), ((0.0, 1), (1.0, 5)), 13)
    ae.simulation.Design((2, 0), ((0.0, 1), (1.0, 5)), 7)


@given(
    degree=st.integers(0, 4),
    coefficients=arrays(np.float64, (2, 3, 16), elements=st.floats(-1, 1)),
    seed=st.integers(0, 1000),
)
def test_polynomials_are_found_again(degree, coefficients, seed):
    design = ae.simulation.Design((degree, 0), ((0.0, 1), (0.5, 11), (1.0, 13)), 40)
    exponents = design.exponents
    coefficients = coefficients[:, :, : len(exponents)]
    values = np.einsum("mc,nkc->nmk", design.monomials(design.launches), coefficients)
    fitted, residual = design.fit(values)
    # coefficients are kept in float32: half of 2^-23 of 1, and twice that by the 16 columns of the fit
    assert np.abs(fitted - coefficients).max() < 2e-7
    assert residual.max() < 1e-12
    variables = np.random.default_rng(seed).uniform(-1, 1, (2, 3))
    expected = np.einsum("nc,nkc->nk", np.prod(variables[:, None] ** exponents, axis=2), coefficients)
    assert np.abs(design.evaluate(fitted, variables, np.arange(2)) - expected).max() < 16 * 2e-7


def test_the_fit_is_weighted_least_squares():
    """Launches without a height count three times as much as the others."""
    design = ae.simulation.Design((1, 0), ((0.0, 1), (1.0, 8)), 16)
    values = np.random.default_rng(1).normal(size=(2, 16, 3))
    weights = np.where(np.arange(16) < 9, 3.0, 1.0)
    matrix = design.monomials(design.launches)
    expected = np.linalg.lstsq(matrix * weights[:, None], values[0] * weights[:, None], rcond=None)[0]
    fitted, residual = design.fit(values)
    np.testing.assert_allclose(fitted[0], expected.T, atol=1e-6)
    misfits = (matrix @ expected - values[0])[:, :2]
    assert residual[0] == pytest.approx(np.sqrt((misfits**2).sum() / (16 - 4)), rel=1e-6)


# ---- what is fitted ------------------------------------------------------------------------------------------------


@given(
    radius=arrays(np.float64, 7, elements=st.floats(0, 0.999)),
    azimuth=arrays(np.float64, 7, elements=st.floats(0, 2 * np.pi)),
    times=arrays(np.float64, 7, elements=st.floats(0.1, 1e6)),
)
def test_flattened_and_back(radius, azimuth, times):
    directions = radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    values = fit_quantities(directions, times)
    assert values.shape == (7, 3)
    back, again = directions_and_times(values)
    assert np.array_equal(back, directions)
    assert again == pytest.approx(times, rel=1e-13)


def test_ions_along_the_plane_never_get_there():
    _, times = directions_and_times(np.array([[1.0, 0.0, 3.0], [2.0, 0.0, 3.0], [0.0, 0.0, 3.0]]))
    assert np.array_equal(times, [np.inf, np.inf, 3.0])


def test_a_straight_flight_of_one_speed_is_flat():
    """Time to a plane goes with 1/cos of the angle; times the cosine it does not."""
    detector = ae.Detector(100.0, 300.0)
    angle = np.radians([0.0, 30.0, 60.0])
    velocities = np.stack([np.sin(angle), np.zeros(3), np.cos(angle)], axis=1)
    directions, times = detector.directions(np.zeros((3, 3)), velocities, 0.0)
    assert directions[:, 0] == pytest.approx(np.tan(angle / 2), abs=1e-15)
    assert fit_quantities(directions, times)[:, 2] == pytest.approx(times[0], rel=1e-14)
    x, y, at, _ = detector.impacts(directions, times)
    assert x == pytest.approx(100 * np.tan(angle), rel=1e-13)
    assert np.array_equal(at, times)
    assert not y.any()


def test_an_equidistant_detector_keeps_angles_and_times():
    """Places at D theta, all reached after the same time by ions of one speed: a sphere around the apex."""
    angle, azimuth = np.radians([0.0, 30.0, 60.0, 89.0, 91.0]), np.radians([0.0, 0.0, 90.0, 200.0, 0.0])
    velocities = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=1)
    plane = ae.Detector(100.0, 300.0)
    sphere = replace(plane, projection="equidistant")
    directions, times = plane.directions(np.zeros((5, 3)), velocities, 0.0)
    x, y, at, outcome = sphere.impacts(directions, times)
    ahead = slice(0, 4)
    assert np.hypot(x, y)[ahead] == pytest.approx(100 * angle[ahead], rel=1e-12)
    assert y[2] == pytest.approx(100 * angle[2], rel=1e-12)
    assert at[ahead] == pytest.approx(times[0], rel=1e-12)
    assert [Outcome(each).name for each in outcome] == ["HIT"] * 4 + ["MISSED"]
    # near the axis the two are one
    small = [[1e-4, 0.0]]
    assert sphere.impacts(np.array(small), np.ones(1))[0] == pytest.approx(
        plane.impacts(np.array(small), np.ones(1))[0]
    )
    with pytest.raises(ValueError, match="projection"):
        ae.Detector(projection="conical")


# ---- against flights -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def run(tip12):
    return ae.Simulation(tip12, seed=3).run(400, emissions=FLOWN, progress=False)


@pytest.mark.parametrize("perturbation", FLOWN, ids=repr)
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")  # a few energies are above the limit
def test_responses_say_where_ions_land(run, perturbation):
    flown = run.hits(perturbation)
    by_response = replace(run, perturbations=(), flown=()).hits(perturbation)
    error = np.hypot(flown.x - by_response.x, flown.y - by_response.y)[flown.detected]
    assert error.size > 300
    assert (error > 0).all()  # two ways to the answer, not one
    # asked: 0.03 mm and 0.2 mm on a flight of 100 mm; measured here 0.0004 and 0.001
    assert np.median(error) < 0.005
    assert np.quantile(error, 0.95) < 0.02
    assert error.max() < run.response_settings.bound
    times = np.abs(by_response.time_of_flight / flown.time_of_flight - 1)[flown.detected]
    assert np.median(times) < 1e-4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")  # a few energies are above the limit
def test_higher_degree_is_better(tip12):
    """What the polynomials leave over shrinks with their degree."""
    perturbation = ae.Combined(WIDE, 0.25)
    errors = []
    rings = (0.0, 1), (0.55, 7), (1.0, 9)
    for degree in (1, 2, 3):
        degrees = tuple(range(degree, -1, -1))
        site = ae.simulation.Design(degrees, rings, 30)
        rolled = ae.simulation.Design(degrees, rings, 80, place=True)
        settings = ae.ResponseSettings(site=site, rolled=rolled)
        run = ae.Simulation(tip12, seed=3, response_settings=settings).run(100, [perturbation], progress=False)
        flown, by_response = run.hits(perturbation), replace(run, perturbations=(), flown=()).hits(perturbation)
        errors.append(np.nanmedian(np.hypot(flown.x - by_response.x, flown.y - by_response.y)))
    assert errors[1] < errors[0] / 2
    assert errors[2] < errors[1] / 2


def test_bad_fits_are_flagged(run):
    assert not run.flagged.any()
    bad = run.responses.residuals.copy()
    bad[3, 0], bad[5, 1], bad[7, 0] = 0.3, 0.3, np.nan
    flagged = replace(run, responses=Responses(run.responses.site, run.responses.rolled, bad)).flagged
    assert np.flatnonzero(flagged).tolist() == [3, 5, 7]


def test_a_launch_that_never_meets_the_plane_leaves_no_infinite_time():
    """Ions at a wide angle meet an equidistant detector though one of their launches flies away from its plane."""
    design = ae.simulation.Design((1, 0), ((0.0, 1), (1.0, 4)), 7)
    values = np.zeros((2, 7, 3))
    values[:, :, 0] = design.launches[:, 0]
    values[:, :, 2] = 100.0
    values[1, 2, 2] = np.inf
    coefficients, residual = design.fit(values)
    assert np.isfinite(coefficients).all()
    assert residual[0] < 1e-12 and np.isinf(residual[1])  # which flags the ion
    assert coefficients[1, 2] == pytest.approx([100.0, 0.0, 0.0, 0.0], abs=1e-4)


# ---- in files ------------------------------------------------------------------------------------------------------


def test_rounded_coefficients_move_no_hit(tip12, monkeypatch):
    perturbations = ae.LateralVelocity(1.0, height=0.1), ae.RollUp(1.0, sharpness=0.5, height=0.1)
    rounded = ae.Simulation(tip12, seed=3).run(100, progress=False)
    steps = rounded.responses.rolled[:, :2].astype(float) * 2.0**20
    np.testing.assert_array_equal(steps, np.rint(steps))
    monkeypatch.setattr(response, "_rounded", lambda coefficients: coefficients)
    exact = ae.Simulation(tip12, seed=3).run(100, progress=False)
    for perturbation in perturbations:
        one, two = rounded.hits(perturbation), exact.hits(perturbation)
        apart = np.hypot(one.x - two.x, one.y - two.y)[one.detected & two.detected]
        assert 0 < np.sqrt(np.mean(apart**2)) < 5e-4 and apart.max() < 2e-3  # mm; measured 3e-4, 8e-4
        assert np.nanmax(np.abs(one.time_of_flight / two.time_of_flight - 1)) < 6e-6


@pytest.mark.slow
def test_a_file_has_700_bytes_an_ion(tip12, tmp_path):
    run = ae.Simulation(tip12, seed=3).run(800, progress=False)
    sizes = []
    for part in (run[:200], run[:800]):
        part.save(tmp_path / "run.h5")
        sizes.append((tmp_path / "run.h5").stat().st_size)
    assert 400 < (sizes[1] - sizes[0]) / 600 < 700  # measured 682, of thousands of ions 620 to 650; 1,500 in memory
