import math

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from apt_evap._common.ion_random import IonRandom
from apt_evap.detection.timing import MASS_TO_CHARGE, Timing, mass_to_charge
from apt_evap.units import BOLTZMANN, FLIGHT_TIME, NM_PER_MM

ALUMINIUM = 26.9815
DISTANCE = 100.0


def flights(n, charge=1, seed=1):
    """Voltages, times of straight flights and positions of Al ions on a plane detector."""
    u = IonRandom(seed, np.arange(n)).uniform(3)
    voltage = 3000.0 + 4000.0 * u[:, 0]
    x, y = 40.0 * (2 * u[:, 1:].T - 1)
    path = np.sqrt(DISTANCE**2 + x**2 + y**2)
    return voltage, path / np.sqrt(MASS_TO_CHARGE * voltage) * math.sqrt(ALUMINIUM / charge), x, y


def measured(timing, n, charge=1, seed=1):
    """Measured m/n of Al ions with the errors of a `Timing`."""
    voltage, time, x, y = flights(n, charge, seed)
    deficits, delays = timing.errors(IonRandom(seed + 1, np.arange(n)).uniform(2))
    return mass_to_charge(voltage, time / np.sqrt(1 - deficits) + delays, x, y, DISTANCE)


def test_constant_of_the_mass_spectrum():
    assert MASS_TO_CHARGE == pytest.approx(1.929707e-4, rel=3e-7)  # seven digits


@pytest.mark.parametrize(("mass", "charge"), [(26.98, 1), (26.98, 2), (183.95, 3)])
def test_mass_of_a_straight_flight(mass, charge):
    voltage, x, y = 5000.0, 30.0, -20.0
    path = math.sqrt(DISTANCE**2 + x**2 + y**2)
    # reduced time of a flight with constant speed: path / sqrt(2 V) for m = charge = 1
    time = FLIGHT_TIME * math.sqrt(mass / charge) * path * NM_PER_MM / math.sqrt(2 * voltage)
    assert mass_to_charge(voltage, time, x, y, DISTANCE) == pytest.approx(mass / charge, rel=1e-14)


def test_all_paths_to_a_curved_detector_are_equal():
    x = np.array([0.0, 10.0, 50.0])
    found = mass_to_charge(5000.0, 500.0, x, -x, DISTANCE, curved=True)
    np.testing.assert_array_equal(found, [found[0]] * 3)
    flat = mass_to_charge(5000.0, 500.0, x, -x, DISTANCE)
    np.testing.assert_allclose(flat, found * DISTANCE**2 / (DISTANCE**2 + 2 * x**2), rtol=1e-15)


def test_a_missing_position_is_a_missing_mass():
    for curved in (False, True):
        found = mass_to_charge([5000.0, 5000.0], [500.0, 500.0], [0.0, np.nan], [0.0, np.nan], DISTANCE, curved=curved)
        np.testing.assert_array_equal(np.isnan(found), [False, True])


def test_acceleration_near_a_sphere_adds_little_to_the_path():
    radius, length = 50.0, DISTANCE * NM_PER_MM
    # integral of 1 / sqrt(1 - R / r) with r = R / (1 - s^2), minus the path
    extra = quad(lambda s: 2 * radius * (1 - s) / (1 - s * s) ** 2, 0, math.sqrt(1 - radius / length), limit=500)[0]
    assert extra == pytest.approx(radius / 2 * (1 + math.log(4 * length / radius)), rel=1e-4)  # next order R / L
    assert extra / length == pytest.approx(4e-6, abs=0.5e-6)


@pytest.mark.parametrize(("charge", "peak"), [(1, 26.98), (2, 13.49)])
def test_peaks_of_aluminium(charge, peak):
    masses = measured(Timing(jitter=0.2), 100_000, charge)
    # times of about 600 ns: one standard deviation is 2 * 0.2 / 600 of the mass; printed digits
    assert np.median(masses) == pytest.approx(peak, abs=0.005)
    assert abs(masses / (ALUMINIUM / charge) - 1).max() < 6 * 2 * 0.2 / 300


def test_width_of_a_peak_from_the_jitter():
    n = 200_000
    _, time, *_ = flights(n)
    excess = (measured(Timing(jitter=0.2), n) / ALUMINIUM - 1) * time / (2 * 0.2)
    # relative errors of a standard deviation: 1 / sqrt(2 n) = 0.16 %; second order of the delay: 0.2 / 300
    assert excess.std() == pytest.approx(1, rel=0.008)
    assert abs(excess.mean()) < 5 / math.sqrt(n) + 1e-3


@pytest.mark.parametrize(("temperature", "sensitivity"), [(25.0, 1.0), (50.0, 1.0), (50.0, 1.4)])
def test_sensitivity_from_the_tail_of_a_peak(temperature, sensitivity):
    n = 1_000_000
    timing = Timing(jitter=0.0, temperature=temperature, sensitivity=sensitivity)
    excess = measured(timing, n) / ALUMINIUM - 1
    mean = BOLTZMANN * temperature / sensitivity
    assert timing.mean_deficit == pytest.approx(mean, rel=1e-15)
    # log-linear fit as to a measured spectrum, from half a mean to four means; weights: standard deviations of ln N
    counts, edges = np.histogram(excess, np.linspace(0.5 * mean, 4 * mean, 50))
    slope = np.polyfit((edges[1:] + edges[:-1]) / 2, np.log(counts), 1, w=np.sqrt(counts))[0]
    # relative excess delta / (1 - delta) instead of delta: about 2 (1 - mean) - 2 k T / C, below 1 %; statistics 0.2 %
    assert slope == pytest.approx(-sensitivity / (BOLTZMANN * temperature), rel=0.02)
    # without this difference: the mean of an exponential distribution, 5 standard deviations
    deficits = excess / (1 + excess)
    assert deficits.mean() == pytest.approx(mean, rel=5 / math.sqrt(n))
    assert stats.kstest(deficits[:100_000], stats.expon(scale=mean).cdf).pvalue > 1e-3  # 3 draws at a fixed seed


def test_mean_deficit_at_50_kelvin():
    assert Timing(temperature=50.0).mean_deficit == pytest.approx(0.0043, abs=0.5e-4)  # printed digits


def test_a_stiff_barrier_gives_a_sharp_peak():
    widths = []
    for sensitivity in (1.0, 10.0, 1e3, 1e9):
        masses = measured(Timing(jitter=0.0, temperature=50.0, sensitivity=sensitivity), 10_000)
        assert masses.min() > ALUMINIUM * (1 - 1e-14)  # a deficit never lowers m/n
        widths.append(masses.std())
    assert widths[0] > widths[1] > widths[2] > widths[3]
    # the largest deficit is at most 37 k T / C
    np.testing.assert_allclose(masses, ALUMINIUM, rtol=37 * BOLTZMANN * 50.0 / 1e9)


def test_nothing_is_wrong_without_jitter_and_temperature():
    u = IonRandom(4, np.arange(100)).uniform(2)
    deficits, delays = Timing(jitter=0.0).errors(u)
    np.testing.assert_array_equal(deficits, 0)
    np.testing.assert_array_equal(delays, 0)


def test_delays_are_normal():
    n = 100_000
    _, delays = Timing(jitter=0.3).errors(IonRandom(6, np.arange(n)).uniform(2))
    assert stats.kstest(delays, stats.norm(scale=0.3).cdf).pvalue > 1e-3


def test_deficits_stay_below_the_voltage():
    highest = 1.0 / 37 / BOLTZMANN
    deficits, delays = Timing(temperature=highest * (1 - 1e-12)).errors([[2.0**-53, 2.0**-53], [1 - 2.0**-53] * 2])
    assert 0 < deficits[1] < deficits[0] < 1
    assert np.isfinite(delays).all()
    with pytest.raises(ValueError, match="temperature"):
        Timing(temperature=highest * 1.001)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Timing(jitter=-0.1), "jitter must be"),
        (lambda: Timing(temperature=0.0), "temperature must be"),
        (lambda: Timing(sensitivity=0.0), "sensitivity must be"),
        (lambda: Timing().errors(np.full((3, 1), 0.5)), "u must have shape"),
        (lambda: Timing().errors([[0.0, 0.5]]), "u must be in"),
        (lambda: mass_to_charge(5000.0, 500.0, 0.0, 0.0, 0.0), "distance must be"),
        (lambda: mass_to_charge(5000.0, 500.0, 0.0, 0.0, 100.0, curved="no"), "curved must be True or False"),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
