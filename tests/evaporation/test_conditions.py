"""Losses between voltage pulses."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

import apt_evap as ae
from apt_evap.evaporation import conditions
from apt_evap.evaporation.losses import between_pulses
from apt_evap.units import BOLTZMANN

BARRIERS = {
    "linear": lambda x, stiffness, reach: stiffness * (1 - x),
    "image_hump": lambda x, stiffness, reach: 2 * stiffness * (1 - math.sqrt(x)),
    "parabolic": lambda x, stiffness, reach: stiffness**2 / (4 * reach) * (1 / x - 1) ** 2,
    "quadratic": lambda x, stiffness, reach: stiffness**2 / (4 * reach) * (1 - x) ** 2,
}


@pytest.mark.parametrize("form", BARRIERS)
@pytest.mark.parametrize(("sensitivity", "kelvin", "fraction"), [(0.6, 50.0, 0.2), (0.5, 80.0, 0.1), (1.0, 100.0, 0.3)])
def test_losses_are_those_of_a_whole_cycle(form, sensitivity, kelvin, fraction):
    """Twin: the rate of one atom, integrated over a Gaussian pulse and over the rest of the cycle."""
    law, control = ae.Arrhenius(kelvin, barrier=form), ae.evaporation.VoltageControl(pulse_fraction=fraction)
    found, x = between_pulses(sensitivity, law, control)
    reach, _ = law.working_point(sensitivity, control)
    stiffness, width = sensitivity / (BOLTZMANN * kelvin), 1e-9 * control.pulse_width

    def rate(t):
        field = x * (1 + fraction * math.exp(-0.5 * (t / width) ** 2)) / (1 + fraction)
        return math.exp(reach - BARRIERS[form](field, stiffness, reach))

    assert BARRIERS[form](x, stiffness, reach) == pytest.approx(reach, rel=1e-9)
    resting = math.exp(reach - BARRIERS[form](x / (1 + fraction), stiffness, reach))
    pulse = quad(lambda t: rate(t) - resting, -8 * width, 8 * width, limit=200, epsabs=0.0)[0]
    assert found == pytest.approx(resting / (1e3 * control.pulse_frequency) / pulse, rel=1e-6)


def test_the_linear_barrier_has_a_closed_form():
    law, control = ae.Arrhenius(60.0), ae.evaporation.VoltageControl(pulse_fraction=0.25, pulse_frequency=100.0)
    reach, length = law.working_point(0.7, control)
    thermal = BOLTZMANN * 60.0
    x = 1 - reach * thermal / 0.7
    expected = math.exp(-0.7 * x * 0.25 / 1.25 / thermal) / (1e5 * length)
    # the effective width is of the second order about the top
    assert between_pulses(0.7, law, control) == pytest.approx((expected, x), rel=0.1)
    assert between_pulses(0.7, law, control)[1] == pytest.approx(x, rel=1e-12)


def test_trends():
    """More is lost at higher temperatures, smaller pulses and lower frequencies."""
    found = conditions({"Al": 0.5, "Cu": 0.5}, law=ae.Arrhenius(50.0, sensitivity={"Al": 1.0, "Cu": 0.5}))
    assert (np.diff(found.lost, axis=1) > 0).all() and (np.diff(found.lost, axis=2) < 0).all()
    assert (found.lost[1] >= found.lost[0]).all() and found.lost[0, 0, -1] < 1e-20
    slow = conditions({"Al": 1.0}, temperatures=80.0, control=ae.evaporation.VoltageControl(pulse_frequency=2.0))
    usual = conditions({"Al": 1.0}, temperatures=80.0)
    assert (slow.lost / (1 - slow.lost)) / (usual.lost / (1 - usual.lost)) == pytest.approx(100.0, rel=1e-9)


def test_equal_sensitivities_have_no_bias():
    found = conditions({"Al": 0.9, "Cu": 0.1}, temperatures=[50.0, 300.0], law=ae.Arrhenius(1.0, sensitivity=0.5))
    assert found.lost[0].max() > 0.5 and np.array_equal(found.lost[0], found.lost[1])
    assert found.bias == pytest.approx(0.0, abs=1e-15)
    assert found.measured.sum(axis=0) == pytest.approx(1.0, rel=1e-15)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"composition": {"Al": 0.5}}, "composition"),
        ({"composition": {"Al": 1.5, "Cu": -0.5}}, "composition of Cu"),
        ({"composition": "Al"}, "composition"),
        ({"temperatures": [0.0, 10.0]}, "temperatures"),
        ({"pulse_fractions": [0.2, 0.0]}, "pulse_fractions"),
        ({"law": ae.Arrhenius(50.0, sensitivity={"Cu": 1.0})}, "sensitivity"),
        ({"law": ae.Arrhenius(50.0, laser=ae.evaporation.Laser(100.0))}, "law"),
        ({"law": ae.Extremal()}, "law"),
        ({"control": 0.2}, "control"),
    ],
)
def test_wrong_arguments_are_named(arguments, name):
    given = {"composition": {"Al": 1.0}, **arguments}
    with pytest.raises(ValueError, match=name):
        conditions(given.pop("composition"), **given)


def test_a_picture_needs_two_axes():
    with pytest.raises(ValueError, match="result"):
        ae.plot.conditions(conditions({"Al": 1.0}, temperatures=50.0))
    with pytest.raises(ValueError, match="element"):
        ae.plot.conditions(conditions({"Al": 1.0}), "Cu")
