"""Late departures after laser pulses."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

import apt_evap as ae
from apt_evap.detection import Cooling, Timing
from apt_evap.evaporation import Laser

SHARES = (np.arange(20_000) + 0.5) / 20_000


def later(cooling, time):
    """Twin: the share of the ions that leave later, by adaptive quadrature of the rate."""
    peak = cooling.temperature + cooling.temperature_rise

    def rate(t):
        share = t / cooling.time_constant
        fall = math.exp(-share) if cooling.decay == "exponential" else 1 / math.sqrt(1 + share)
        hot, cold = cooling.temperature + cooling.temperature_rise * fall, cooling.temperature
        return math.exp(-cooling.barrier * (peak / hot - 1)) - math.exp(-cooling.barrier * (peak / cold - 1))

    unit = cooling.time_constant * peak / (cooling.barrier * cooling.temperature_rise)
    ends = unit * np.geomspace(1.0, 3e3, 40)
    tail = sum(quad(rate, max(low, time), high)[0] for low, high in zip([0, *ends], ends, strict=False) if high > time)
    return tail, sum(quad(rate, low, high)[0] for low, high in zip([0, *ends], ends, strict=False))


@pytest.mark.parametrize("decay", ["exponential", "conduction"])
@pytest.mark.parametrize(("base", "rise", "barrier"), [(50.0, 150.0, 20.0), (80.0, 60.0, 25.0), (20.0, 400.0, 17.0)])
def test_delays_have_the_density_of_the_rate(decay, base, rise, barrier):
    cooling = Cooling(base, rise, 3.0, barrier, decay)
    for share, delay in zip((0.9, 0.5, 0.1, 1e-3), cooling.delays([0.9, 0.5, 0.1, 1e-3]), strict=True):
        tail, whole = later(cooling, delay)
        # the table is linear between 4,001 points
        assert tail / whole == pytest.approx(share, rel=1e-3)


@pytest.mark.parametrize(("decay", "factor"), [("exponential", 1.0), ("conduction", 2.0)])
def test_of_the_first_order_delays_are_exponential(decay, factor):
    """A high barrier: ions leave before the temperature has changed much."""
    cooling = Cooling(50.0, 150.0, 3.0, 900.0, decay)
    delays = cooling.delays(SHARES)
    mean = factor * 3.0 * 200.0 / (900.0 * 150.0)
    assert delays.mean() == pytest.approx(mean, rel=0.01)  # the next order is 1/900 times a number of a few
    assert np.median(delays) == pytest.approx(mean * math.log(2), rel=0.01)


def test_a_fast_cooling_delays_nothing():
    assert Cooling(50.0, 150.0, 1e-6).delays(SHARES).max() < 1e-5
    without, fast = (Timing(0.2, cooling=cooling) for cooling in (None, Cooling(50.0, 150.0, 1e-9)))
    u = np.random.default_rng(1).random((100, 2))
    assert fast.errors(u)[1] == pytest.approx(without.errors(u)[1], abs=1e-8)


def test_the_tail_of_conduction_is_longer():
    short, long = (
        Cooling(50.0, 150.0, 1.0, decay=decay).delays([0.5, 1e-4]) for decay in ("exponential", "conduction")
    )
    assert long[1] / long[0] > 1.5 * short[1] / short[0]


def test_the_middle_of_a_heated_zone_cools_as_a_gaussian_spreads():
    """The heat equation, by its Green's function: standard deviation 1 micrometre, 97 mm^2/s."""
    cooling = Cooling.of_zone(1e3, 97.0, temperature=50.0, temperature_rise=100.0)
    time, diffusivity = 7.0, 97.0e3  # ns, nm^2/ns

    def spread(x):
        width = math.sqrt(2 * diffusivity * time)
        return (
            100.0 * math.exp(-0.5 * (x / 1e3) ** 2) * math.exp(-0.5 * (x / width) ** 2) / width / math.sqrt(2 * math.pi)
        )

    assert cooling.temperatures(time) == pytest.approx(50.0 + quad(spread, -1e4, 1e4, points=[0.0])[0], rel=1e-9)


def test_a_law_with_a_laser_has_its_cooling(small_tip):
    law = ae.Arrhenius(50.0, laser=Laser(150.0, decay=2.0))
    cooling = law.cooling(small_tip)
    assert (cooling.temperature, cooling.temperature_rise, cooling.time_constant) == (50.0, 150.0, 2.0)
    assert cooling.barrier == law.working_point(1.0, law.default_control())[0]
    with pytest.raises(ValueError, match="laser"):
        ae.Arrhenius(50.0).cooling(small_tip)


def test_spectra_have_the_tail(small_tip):
    """m/n of the ions of a run: late only, by twice the share of the delay in the time of flight."""
    run = ae.Simulation(small_tip, seed=1, n_threads=1).run(150, [ae.Unperturbed()], responses=False, progress=False)
    timings = [Timing(0.0, cooling=cooling) for cooling in (None, Cooling(50.0, 150.0, 2.0))]
    sharp, tailed = (run.at_evaporation_field(timing=each).hits(ae.Unperturbed()) for each in timings)
    late = tailed.time_of_flight[sharp.detected] - sharp.time_of_flight[sharp.detected]
    assert late.min() > 0 and late.mean() == pytest.approx(2.0 * 200 / (20 * 150), rel=0.3)  # 1/sqrt(150) and 6 %
    shares = (tailed.mass_to_charge / sharp.mass_to_charge - 1)[sharp.detected]
    assert shares == pytest.approx((1 + late / sharp.time_of_flight[sharp.detected]) ** 2 - 1, rel=1e-9)


def test_cooling_excludes_the_deficits_of_voltage_pulses():
    with pytest.raises(ValueError, match="temperature"):
        Timing(temperature=50.0, cooling=Cooling(50.0, 150.0, 1.0))
    for wrong in ({"time_constant": 0.0}, {"temperature_rise": -1.0}, {"decay": "linear"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Cooling(**{"temperature": 50.0, "temperature_rise": 150.0, "time_constant": 1.0, **wrong})
    with pytest.raises(ValueError, match="diffusivity"):
        Cooling.of_zone(1e3, 0.0, temperature=50.0, temperature_rise=100.0)
