import math

import numpy as np
import pytest
from scipy import special, stats
from scipy.integrate import quad

from apt_evap._common.ion_random import IonRandom
from apt_evap.emission.energies import Thermal, TruncatedNormal, draw_energies, normal_probability
from apt_evap.emission.perturbations import RollUp
from apt_evap.units import BOLTZMANN


# the numbers the model is checked against: mean and standard deviation before and after the cut
@pytest.mark.parametrize(("before", "after"), [((0.155, 0.155), (0.200, 0.123)), ((0.3, 0.0948), (0.300, 0.0944))])
def test_moments_of_the_paper(before, after):
    energy = TruncatedNormal(*before)
    # three printed digits; the second pair is rounded down from 0.30026 and 0.09427 to the last digit
    assert energy.true_mean == pytest.approx(after[0], abs=6e-4)
    assert energy.true_standard_deviation == pytest.approx(after[1], abs=6e-4)


@pytest.mark.parametrize("ratio", [0.01, 0.0316, 0.1, 0.316, 1.0, 3.16, 100.0])
@pytest.mark.parametrize("mean", [0.01, 0.155, 0.3725])
def test_moments_agree_with_the_quantiles(mean, ratio):
    energy = TruncatedNormal(mean, mean * ratio)

    def moment(power):
        return quad(lambda u: float(energy.quantile(u)) ** power, 0, 1, epsabs=0, epsrel=1e-7, limit=200)[0]

    assert moment(1) == pytest.approx(energy.true_mean, rel=1e-6)  # of the quadrature
    spread = math.sqrt(moment(2) - moment(1) ** 2)
    assert spread == pytest.approx(energy.true_standard_deviation, rel=1e-6 / ratio**2 + 1e-6)  # cancellation


@pytest.mark.parametrize("ratio", [0.01, 0.1, 1.0, 3.16, 500.0])
def test_quantiles_against_scipy_into_the_tails(ratio):
    mean = 0.155
    energy = TruncatedNormal(mean, mean * ratio)
    u = np.array([1e-12, 1e-6, 1e-3, 0.1, 0.5, 0.9, 0.999, 1 - 1e-6, 1 - 1e-12])
    reference = stats.truncnorm(-1 / ratio, np.inf, loc=mean, scale=mean * ratio)
    found = energy.quantile(u)
    low = u < 0.5
    np.testing.assert_allclose(found[low], reference.ppf(u[low]), rtol=1e-11, atol=1e-15 * mean * ratio)
    # the upper tail against the error function (scipy's own is good to 1e-10 only); a rounding of x changes
    # the tail by deviate/ratio < 7/ratio times as much, and one of the deviate by deviate^2 < 60 times
    root = ratio * math.sqrt(2)
    survival = [math.erfc((x / mean - 1) / root) / math.erfc(-1 / root) for x in found]
    np.testing.assert_allclose(survival, 1 - u, rtol=(60 + 7 / ratio) * 1e-15)
    assert (np.diff(energy.quantile(np.linspace(1e-9, 1 - 1e-9, 10001))) >= 0).all()


def test_quantiles_are_above_zero():
    edge = np.array([2.0**-53, 0.5, 1 - 2.0**-53])
    for energy in (TruncatedNormal(0.0, 1.0), TruncatedNormal(1e-3, 100.0), Thermal(20.0)):
        found = energy.quantile(edge)
        assert (found > 0).all() and np.isfinite(found).all()
    np.testing.assert_array_equal(draw_energies(0.2, edge), [0.2] * 3)


def test_thermal_energy_is_that_of_two_normal_velocities():
    kelvin, n = 80.0, 40_000
    u = IonRandom(2, np.arange(n)).uniform(1)[:, 0]
    energy = Thermal(kelvin).quantile(u)
    velocities = IonRandom(3, np.arange(n)).normal(2)
    twin = 0.5 * BOLTZMANN * kelvin * (velocities**2).sum(axis=1)
    assert stats.ks_2samp(energy, twin).pvalue > 1e-4
    assert energy.mean() == pytest.approx(BOLTZMANN * kelvin, rel=5 / math.sqrt(n))  # 5 standard deviations


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TruncatedNormal(-0.1, 0.1), "mean must be"),
        (lambda: TruncatedNormal(0.1, 0), "standard_deviation must be"),
        (lambda: RollUp(-1), "energy must be"),
        (lambda: Thermal(0), "temperature must be"),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_probability_of_the_normal_distribution():
    for x in np.concatenate([np.linspace(-11.9, 11.9, 240), [0.0, 1e-300, -1e-9]]):
        # SciPy's own logarithm has an error of up to 1e-14 of its value here
        assert normal_probability(float(x)) == pytest.approx(np.exp(special.log_ndtr(x)), rel=3e-14)
    assert normal_probability(-12.1) == 0 and normal_probability(12.1) == 1
