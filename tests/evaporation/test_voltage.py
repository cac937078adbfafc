"""The applied voltage and its control: settings, and the width of a pulse."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.evaporation.voltage import check_voltage
from apt_evap.units import BOLTZMANN


def integral(control, thermal, x):
    """Rate over that at the top of the pulse, integrated over the pulse [s]; the barrier is linear, C = 1 eV."""
    t = np.linspace(-6, 6, 40_001) * control.pulse_width
    p = control.pulse_fraction
    relative = (1 + p * np.exp(-((t / control.pulse_width) ** 2) / 2)) / (1 + p)
    return 1e-9 * np.trapezoid(np.exp(-x * (1 - relative) / thermal), t)


@pytest.mark.parametrize(("temperature", "deviation"), [(20.0, 0.005), (50.0, 0.012), (80.0, 0.020)])
def test_width_of_a_pulse_is_the_integral_of_the_rate(temperature, deviation):
    control = ae.evaporation.VoltageControl()
    thermal = BOLTZMANN * temperature
    barrier, length = ae.Arrhenius(temperature).working_point(1.0, control)
    x = 1 - barrier * thermal
    assert length == pytest.approx(control.effective_width(thermal / x), rel=1e-9)
    # the field is a Gaussian, of which the formula takes the second order: measured -0.40, -1.08 and -1.85 %
    assert -deviation < length / integral(control, thermal, x) - 1 < -0.8 * deviation


def test_a_softer_barrier_is_further_from_the_second_order():
    """The error of the next order is in proportion to kT/(C x)."""
    for fraction in (0.1, 0.2, 0.3):
        control = ae.evaporation.VoltageControl(pulse_fraction=fraction)
        errors = [control.effective_width(thermal) / integral(control, thermal, 1.0) - 1 for thermal in (1e-3, 2e-3)]
        assert errors[1] < errors[0] < 0
        assert errors[1] / errors[0] == pytest.approx(2.0, rel=0.05)  # and the order after it: 2 % at 2e-3


def test_width_of_a_pulse_by_its_parameters():
    width = ae.evaporation.VoltageControl().effective_width(0.004)
    # second derivative p/(1 + p)/s^2 of a field with the relative width 0.004, of a Gaussian; a few roundings
    assert width == pytest.approx(0.5e-9 * np.sqrt(2 * np.pi * 0.004 * 1.2 / 0.2), rel=1e-14)
    assert ae.evaporation.VoltageControl(pulse_width=1.5).effective_width(0.004) == pytest.approx(3 * width, rel=1e-14)
    assert ae.evaporation.VoltageControl().effective_width(0.016) == pytest.approx(2 * width, rel=1e-14)
    higher = ae.evaporation.VoltageControl(pulse_fraction=0.3).effective_width(0.004)
    assert higher == pytest.approx(width * np.sqrt(1.3 / 0.3 * 0.2 / 1.2), rel=1e-14)
    # 0.20 ns for 50 K, 1 eV, 20 % and 0.5 ns, at x = 1
    assert ae.evaporation.VoltageControl().effective_width(BOLTZMANN * 50.0) == pytest.approx(0.20e-9, abs=5e-12)


def test_numbers_are_plain_ones():
    control = ae.evaporation.VoltageControl(1, 0, 2, np.int64(100), np.int32(20))
    assert vars(control) == {
        "rate": 1.0,
        "pulse_fraction": 0.0,
        "pulse_width": 2.0,
        "pulse_frequency": 100.0,
        "memory": 20,
    }
    assert [type(value) for value in vars(control).values()] == [float, float, float, float, int]
    assert control == ae.evaporation.VoltageControl(1.0, 0.0, 2.0, 100.0, 20)
    assert hash(control) == hash(ae.evaporation.VoltageControl(1.0, 0.0, 2.0, 100.0, 20))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "rate must be a finite number > 0 and <= .*, got 0.0"),
        ({"rate": np.nan}, "rate must be a finite number > 0 and <= .*, got nan"),
        ({"rate": "fast"}, "rate must be a finite number > 0 and <= .*, got 'fast'"),
        ({"pulse_fraction": -0.1}, "pulse_fraction must be a finite number >= 0 and <= 1, got -0.1"),
        ({"pulse_fraction": 1.2}, "pulse_fraction must be a finite number >= 0 and <= 1, got 1.2"),
        ({"pulse_width": 0.0}, "pulse_width must be a finite number .ns. > 0"),
        ({"pulse_frequency": -200.0}, "pulse_frequency must be a finite number .kHz. > 0"),
        ({"memory": 0}, "memory must be an integer from 1 to 1,000,000, got 0"),
        ({"memory": 2.5}, "memory must be an integer from 1 to 1,000,000, got 2.5"),
    ],
)
def test_bad_controls_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ae.evaporation.VoltageControl(**options)


@pytest.mark.parametrize("voltage", [0, -5.0, 1.1e6, np.inf, "1 kV", None])
def test_bad_voltages_are_refused(voltage):
    with pytest.raises(ValueError, match="voltage"):
        check_voltage(voltage)
    assert check_voltage(np.int64(2000)) == 2000.0


# ---- of a measurement ------------------------------------------------------------------------------------------------


def test_the_control_of_a_measurement(small_tip):
    """Rate and pulses of a run in real units come back from its hits, for all ions that leave."""
    control = ae.evaporation.VoltageControl(rate=0.02, pulse_fraction=0.15)
    run = ae.Simulation(small_tip, seed=1, n_threads=1, control=control).run(
        400, [ae.Unperturbed()], responses=False, progress=False
    )
    hits = run.at_evaporation_field().hits(ae.Unperturbed())
    found = ae.evaporation.VoltageControl.of_hits(hits, pulse_width=0.7)
    # the pulses before the first ion are not counted
    assert found.rate == pytest.approx(0.02, rel=0.15)
    assert found.pulse_fraction == pytest.approx(0.15, rel=1e-12) and found.pulse_width == 0.7
    seen = run.at_evaporation_field().record(ae.Instrument(efficiency=0.5, field_of_view=120.0))
    share = len(seen) / len(run)
    assert ae.evaporation.VoltageControl.of_hits(seen, share).rate == pytest.approx(0.02, rel=0.15)


def test_a_measurement_without_pulses_has_no_control():
    ions = ae.Hits(voltage=np.full(5, 5e3), pulse_voltage=np.zeros(5), pulses=np.zeros(5, int))
    with pytest.raises(ValueError, match="hits"):
        ae.evaporation.VoltageControl.of_hits(ions)
    with pytest.raises(ValueError, match="seen"):
        ae.evaporation.VoltageControl.of_hits(replace(ions, pulses=np.ones(5, int)), 1.5)
    with pytest.raises(ValueError, match="pulses"):
        ae.evaporation.VoltageControl.of_hits(ae.Hits(voltage=np.ones(5), pulse_voltage=np.ones(5)))
