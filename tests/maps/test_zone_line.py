import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import chi2

import apt_evap as ae
from apt_evap.maps.profiles import Profile, Rectangle, compare_profiles, zone_line_profile
from apt_evap.maps.zone_line import fit_zone_line

FULL_WIDTH = 2 * np.sqrt(2 * np.log(2))  # of a Gaussian, in standard deviations
EDGES = np.linspace(-15, 15, 41)


def expected(centre=0.7, sigma=2.5, height=-0.8, background=1.0, slope=0.02, edges=EDGES):
    """Densities averaged over bins, exactly."""
    away = edges - centre
    integral = background * away + slope * away**2 / 2 + height * np.sqrt(2 * np.pi) * sigma * ndtr(away / sigma)
    return np.diff(integral) / np.diff(edges)


def profile_of(counts, edges=EDGES):
    """As `zone_line_profile` makes it from counts."""
    mean = counts.mean()
    return Profile((edges[1:] + edges[:-1]) / 2, counts / mean, np.sqrt(np.maximum(counts, 1)) / mean)


@pytest.mark.parametrize("sigma", [0.4, 1.0, 2.5, 5.0])
@pytest.mark.parametrize("height", [-0.8, 3.0])
def test_an_exact_profile_is_fitted_exactly(sigma, height):
    profile = profile_of(1e4 * expected(sigma=sigma, height=height))
    line = fit_zone_line(profile)
    # as far as the least squares go; a Gaussian that is not averaged over bins would be 12 % off at 0.4 mm, half a bin
    assert line.width == pytest.approx(FULL_WIDTH * sigma, rel=1e-4)
    assert line.centre == pytest.approx(0.7, abs=1e-4)
    assert line.height / line.background == pytest.approx(height, rel=1e-4)
    assert line.kind == ("enhanced" if height > 0 else "depleted")
    assert line.chi_square < 1e-3
    fine = np.linspace(-15, 15, 3001)
    mean = line.density(fine).mean()
    assert mean == pytest.approx(1, rel=2e-3)  # the profile is one relative to its mean; a sum instead of an integral


@pytest.mark.parametrize("exponent", [1.5, 3.0, 6.0])
def test_a_line_that_is_flat_in_its_middle(exponent):
    fine = np.linspace(-15, 15, 40 * 2000 + 1)
    fine = (fine[1:] + fine[:-1]) / 2
    density = 1.0 - np.exp(-np.log(2) * np.abs((fine - 0.3) / 4.2) ** exponent)  # half of the depth at 4.2 mm
    profile = profile_of(1e4 * density.reshape(40, 2000).mean(axis=1))
    line = fit_zone_line(profile, exponent=None)
    assert line.width == pytest.approx(8.4, rel=1e-4) and line.exponent == pytest.approx(exponent, rel=1e-3)
    assert line.kind == "depleted" and line.height == pytest.approx(-line.background, rel=1e-3)
    assert line.exponent_error > 0 and line.degrees_of_freedom == 34
    gaussian = fit_zone_line(profile)
    assert gaussian.exponent == 2 and gaussian.exponent_error == 0 and gaussian.chi_square > 100


@pytest.mark.parametrize("n_fits", [30, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("height", [-0.8, pytest.param(2.0, marks=pytest.mark.slow)])
def test_errors_of_the_fit_are_those_of_counting(height, n_fits):
    random = np.random.default_rng(5)
    truth = FULL_WIDTH * 2.5
    mean = 60 * expected(height=height)
    pulls, chi_squares = [], []
    for _ in range(n_fits):
        line = fit_zone_line(profile_of(random.poisson(mean).astype(float)))
        pulls.append(((line.width - truth) / line.width_error, (line.centre - 0.7) / line.centre_error))
        chi_squares.append(line.chi_square)
    pulls = np.array(pulls)
    # a mean is known to 1 / sqrt(n), a standard deviation to 1 / sqrt(2 n); and the fit is not linear, so 5 times that
    assert np.abs(pulls.mean(axis=0)).max() < 5 / np.sqrt(n_fits)
    assert np.abs(pulls.std(axis=0) - 1).max() < 5 / np.sqrt(2 * n_fits)
    # chi-square of 35 has a standard deviation of 8.4: 5 times that of its mean
    assert np.mean(chi_squares) == pytest.approx(line.degrees_of_freedom, abs=5 * 8.4 / np.sqrt(n_fits))


@pytest.mark.parametrize("n_fits", [15, pytest.param(60, marks=pytest.mark.slow)])
def test_where_there_is_no_line_none_is_significant(n_fits):
    random = np.random.default_rng(6)
    mean = 100 * expected(height=0.0, slope=0.01)
    heights = []
    for _ in range(n_fits):
        try:
            line = fit_zone_line(profile_of(random.poisson(mean).astype(float)))
        except ValueError as error:
            assert "has no line" in str(error)
        else:
            heights.append(line.height / line.height_error)
    # the best of some 20 places for a line, 60 times over at most: 1,200 normal numbers stay below 4.5
    assert np.abs(heights).max() < 4.5


def test_a_profile_without_errors_is_fitted_without_weights():
    profile = profile_of(1e4 * expected())
    line = fit_zone_line(profile._replace(error=np.full(40, np.nan)))
    assert line.width == pytest.approx(FULL_WIDTH * 2.5, rel=1e-4)
    assert np.isnan(line.chi_square)


def test_bins_without_area_do_not_count():
    profile = profile_of(1e4 * expected())
    density = profile.density.copy()
    density[:4] = np.nan
    line = fit_zone_line(profile._replace(density=density))
    assert line.width == pytest.approx(FULL_WIDTH * 2.5, rel=1e-4)
    assert line.degrees_of_freedom == 31


def test_profiles_of_one_line_differ_by_noise_and_of_two_by_more():
    random = np.random.default_rng(7)
    mean = 100 * expected()
    same = [compare_profiles(*(profile_of(random.poisson(m)) for m in (mean, 3 * mean))) for _ in range(200)]
    # chi-square of 39 has a standard deviation of 8.8; the mean of 200 one of 0.6, and small counts add a little
    assert np.mean([compared.chi_square for compared in same]) == pytest.approx(39, abs=3)
    probabilities = np.array([compared.probability for compared in same])
    assert same[0].degrees_of_freedom == 39
    np.testing.assert_allclose(probabilities, [chi2.sf(compared.chi_square, 39) for compared in same])
    assert 0.3 < np.mean(probabilities < 0.5) < 0.7
    assert np.median([compared.relative for compared in same]) < 0.03
    wider = compare_profiles(profile_of(1e4 * mean), profile_of(1e6 * expected(sigma=3.0)))
    assert wider.probability < 1e-10
    difference = expected() / expected().mean() - expected(sigma=3.0) / expected(sigma=3.0).mean()
    assert wider.relative == pytest.approx(np.sqrt(np.mean(difference**2)), rel=1e-3)  # of 10^6 hits a bin
    assert np.sign(wider.difference[np.argmax(np.abs(difference))]) == np.sign(
        difference[np.argmax(np.abs(difference))]
    )


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda good: fit_zone_line(Profile(*(column[:7] for column in good))), "at least 8 bins to fit a line, got 7"),
        (lambda good: fit_zone_line(profile_of(1e4 * expected(centre=-19.0))), "has no line"),
        (lambda good: fit_zone_line(good, exponent=0.5), "exponent must be a finite number >= 1 and <= 12"),
        (lambda good: compare_profiles(good, good.density), "second must be a Profile"),
        (lambda good: compare_profiles(good, Profile(*(column[1:] for column in good))), "equal bins, got 40 and 39"),
        (lambda good: compare_profiles(good._replace(error=good.error * np.nan), good), "first must have errors"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(profile_of(1e4 * expected()))


@pytest.mark.slow
def test_nickel_has_bright_and_dark_lines(run20):
    """The lines of figure 7 of Shaikh et al.: with roll-up three are enhanced, and dark ones run between them."""
    hits = run20.hits(ae.RollUp(ae.TruncatedNormal(0.155, 0.155)))
    bright, dark = Rectangle((0, 28), 90, 24, 30), Rectangle((52, 0), 0, 36, 24)
    lines = {}
    for kind, rectangle in (("enhanced", bright), ("depleted", dark)):
        alike = [rectangle.turned(turn) for turn in (0, 120, 240)]
        line = lines[kind] = fit_zone_line(zone_line_profile(hits, alike, bins=20), exponent=None)
        assert line.kind == kind
        assert abs(line.height) > 5 * line.height_error
        assert abs(line.centre) < 3  # mm: by symmetry on the line, but for the turn that roll-up gives the dark ones
    assert abs(lines["enhanced"].centre) < 3 * lines["enhanced"].centre_error + 0.5
