"""Polynomial terms of a registration: recovered from points and from maps, and not from noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import apt_evap as ae
from apt_evap._common.codec import for_json, from_plain
from apt_evap.maps.registration.polynomial import Distortion, fit_polynomial, terms_of

TRUE = ae.Registration(
    17.0, 0.4, (3.0, -2.0),
    distortion=Distortion(2, (2.5, -1.5), 20.0, (0.3 + 0.1j, 0.9 - 0.5j, -0.6 + 0.4j, 0.2j)),
)  # fmt: skip


def points_of(rng, n, noise=0.0, registration=TRUE, mirror=False):
    """Pairs of points on a detector of 50 mm radius, shapes (n, 2)."""
    simulated = rng.uniform(-50, 50, (n, 2))
    x, y = registration.points(*(simulated * [1, -1 if mirror else 1]).T)
    return simulated, np.column_stack([x, y]) + noise * rng.normal(size=(n, 2))


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("degree", [2, 3, None])
def test_exact_points_give_the_exact_map(rng, degree, mirror):
    simulated, measured = points_of(rng, 30, mirror=mirror)
    found = ae.maps.register_points(simulated, measured, degree=degree)
    assert found.mirror == mirror and found.distortion.degree == (degree or 2)
    other, places = points_of(rng, 50, mirror=mirror)
    assert np.column_stack(found.points(*other.T)) == pytest.approx(places, abs=1e-9)
    assert np.column_stack(found.inverse_points(*places.T)) == pytest.approx(
        other, abs=1e-4
    )  # 1e-6 of 20 mm over the scale
    assert found.residual < 1e-9


def test_errors_are_those_of_new_measurements(rng):
    """50 sets of 25 points with an error of 0.3 mm; a similarity leaves 0.8 mm."""
    simulated, exact = points_of(rng, 25)
    found = [
        ae.maps.register_points(simulated, exact + 0.3 * rng.normal(size=(25, 2)), degree=2).distortion
        for _ in range(50)
    ]
    coefficients = np.array([each.coefficients for each in found])
    scatter = np.sqrt((coefficients.real.var(axis=0, ddof=1) + coefficients.imag.var(axis=0, ddof=1)) / 2)
    told = np.sqrt(np.mean(np.square([each.errors for each in found]), axis=0))
    # 100 numbers: 7 %, three times; centre and unit of length follow the noise, by 2 %
    assert told == pytest.approx(scatter, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("n, noise", [(12, 0.2), (40, 0.2), (40, 1.0)])
def test_noise_is_not_fitted(rng, n, noise):
    """Of 200 sets of points without a distortion, 1 % per degree pass the test; the second guard lets fewer pass."""
    straight = ae.Registration(17.0, 0.4, (3.0, -2.0))
    fitted = sum(
        ae.maps.register_points(*points_of(rng, n, noise, straight), mirror=False, degree=None).distortion is not None
        for _ in range(200)
    )
    assert fitted <= 14  # 3 degrees of 1 %: 6 expected, three standard deviations of a binomial number


def test_a_degree_is_chosen_by_its_significance(rng):
    """The quadratic map is found where it matters, and predicts points that were not fitted."""
    simulated, measured = points_of(rng, 30, 0.15)
    chosen, plain = (ae.maps.register_points(simulated, measured, mirror=False, degree=d) for d in (None, 1))
    assert chosen.distortion.degree == 2
    other, places = points_of(rng, 500)
    errors = [np.sqrt(np.mean((np.column_stack(each.points(*other.T)) - places) ** 2)) for each in (chosen, plain)]
    assert errors[0] < 0.12 < 0.35 < errors[1]
    fit = fit_polynomial(simulated @ [1, 1j], measured @ [1, 1j], None)
    assert fit.residual < fit.validated < 0.3 and fit.probabilities[2] < 0.01 < fit.probabilities[3]


def test_distorted_poles_are_warned_of(rng):
    simulated, measured = points_of(rng, 12, 0.05)
    with pytest.warns(
        ae.warnings.RegistrationWarning, match="has a systematic part: terms of degree 2 reduce it to 0.0"
    ):
        ae.maps.register_points(simulated, measured, mirror=False)


def test_too_few_points(rng):
    for degree, n in ((1, 3), (2, 6), (3, 10)):
        simulated, measured = points_of(rng, n)
        with pytest.raises(ValueError, match=f"degree {degree} needs more than {n} points, got {n}"):
            ae.maps.register_points(simulated, measured, degree=degree)
        assert ae.maps.register_points(simulated, measured, mirror=False, degree=None).residual >= 0
    with pytest.raises(ValueError, match="degree"):
        ae.maps.register_points(simulated, measured, degree=4)


@given(st.integers(0, 1000))
def test_back_is_the_inverse(seed):
    rng = np.random.default_rng(seed)
    coefficients = 0.4 * (rng.normal(size=8) + 1j * rng.normal(size=8))
    registration = ae.Registration(
        rng.uniform(-180, 180), 0.5, (1.0, 2.0), bool(seed % 2),
        distortion=Distortion(3, (0.0, 0.0), 20.0, tuple(coefficients)),
    )  # fmt: skip
    x, y = rng.uniform(-12, 12, (2, 100))
    u, v = registration.inverse_points(*registration.points(x, y))
    # not where a distortion of up to 8 x 0.5 mm over 20 mm folds the plane over: that is NaN
    good = np.isfinite(u)
    assert good.mean() > 0.9 and np.abs(u - x)[good].max() < 1e-3 and np.abs(v - y)[good].max() < 1e-3
    plain = for_json(registration)
    assert for_json(from_plain(plain, ae.Registration)) == plain
    with pytest.raises(ValueError, match="no inverse Registration, use inverse_points"):
        registration.inverse  # noqa: B018


def test_terms():
    assert len(terms_of(0)) == 0 and len(terms_of(1)) == 1 and len(terms_of(2)) == 4 and len(terms_of(3)) == 8
    with pytest.raises(ValueError, match="coefficients"):
        Distortion(2, (0, 0), 1.0, (1.0,))


@pytest.mark.slow
def test_a_distortion_is_found_from_maps(run20):
    """Ions of one half of a run, distorted by 0.5 mm (RMS) against the other half."""
    hits = run20.hits(ae.Unperturbed())
    first, second = hits[: len(hits) // 2], hits[len(hits) // 2 :]
    measured = TRUE.hits(second).within_circle(24.0, (3.0, -2.0))
    start = ae.register(first, measured, rotations=(10, 24), scales=(0.38, 0.42), mirrors=(False,))
    found = ae.maps.register_distortion(start, first, measured)
    x, y = np.random.default_rng(0).uniform(-36, 36, (2, 500))
    off = [np.sqrt(np.mean(np.sum((np.array(each.points(x, y)) - TRUE.points(x, y)) ** 2, axis=0)))
           for each in (start, found)]  # fmt: skip
    assert found.distortion is not None and off[1] < 0.6 * off[0]
    # better than any similarity transform can be: 0.47 mm for this distortion in this square
    source, target = x + 1j * y, np.array(TRUE.points(x, y))
    assert off[1] < fit_polynomial(source, target[0] + 1j * target[1], 0).residual
    # maps without a distortion of their own: what is fitted is no larger than the error of the registration
    straight = ae.Registration(17.0, 0.4, (3.0, -2.0))
    plain = ae.maps.register_distortion(straight, first, straight.hits(second).within_circle(24.0, (3.0, -2.0)))
    off = np.array(plain.points(x, y)) - straight.points(x, y)
    assert np.sqrt(np.mean(np.sum(off**2, axis=0))) < 0.4
