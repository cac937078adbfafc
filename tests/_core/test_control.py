"""The interface of a control of the voltage: what it is asked, when, and what the events make of its answer."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._core.control import Control, SteadyRate
from apt_evap._core.evaporation import SWEEP_DUE, Evaporation
from apt_evap._core.events import Events
from apt_evap.units import COULOMB


class Stepwise(SteadyRate):
    """Raises the voltage by 1 % in every relaxation, and records what it is asked."""

    def __init__(self):
        super().__init__(rate=1e3, memory=20.0)
        self.calls = []

    def before_relaxation(self, log_rate, log_rate_at):
        self.calls.append(("before", log_rate, self.rise, log_rate_at(self.voltage_factor)))
        return self.voltage_factor

    def after_relaxation(self, log_rate_at):
        factor = 1.01 * self.voltage_factor
        self.calls.append(("after", log_rate_at(factor), log_rate_at(1.1 * factor)))
        return factor


def surface(tip, control=None):
    """A relaxed surface with the rates at 80 K, at a voltage where the field is about the evaporation field."""
    emitter, law = ae.evaporation.Emitter(tip, n_threads=1), ae.Arrhenius(80.0)
    voltage = emitter.voltage * 35.0 / emitter.fields.max()
    neighbours = ae.evaporation.Emitter(tip, n_threads=1)._core.atoms
    distance = tip.nearest_neighbour_distance
    radii = emitter.settings.patch_radius * distance, emitter.settings.update_radius * distance
    options = (voltage / COULOMB, COULOMB, *radii, emitter.settings.opening_angle, 1.0)
    core = Evaporation(neighbours, ae.Robin().kernel(tip), law.kernel(tip), *options, control=control)
    core.relax(tolerance=1e-3)
    return core


def test_a_control_is_asked_around_each_relaxation(small_tip):
    control = Stepwise()
    core = surface(small_tip, control)
    assert core.control is control
    assert [call[0] for call in control.calls] == ["after"]  # there were no events before the first relaxation
    events = Events(small_tip.positions, 30)
    core.evaporate(events, 1000)
    rise, log_rate = control.rise, np.log(core.chooser.rate)
    assert rise == events.columns()["rises"][-1] - 1 / control.memory != 0
    core.relax()
    assert [call[0] for call in control.calls[1:]] == ["before", "after"]
    _, told, told_rise, recomputed = control.calls[1]
    assert (told, told_rise) == (pytest.approx(log_rate, rel=1e-13), rise)
    assert recomputed == pytest.approx(log_rate, rel=1e-12)  # keys are kept up to date from event to event
    assert control.rise == 0
    core.relax(start=core.start)  # a restored state has the voltage of the control
    assert [call[0] for call in control.calls[3:]] == ["after"]


def test_keys_have_the_voltage_that_the_control_leaves(small_tip):
    control = Stepwise()
    core = surface(small_tip, control)
    for factor in (1.01, 1.01 * 1.01):
        _, here, higher = control.calls[-1]
        assert control.voltage_factor == factor
        assert here < higher  # the last one asked for was another voltage
        assert np.log(core.chooser.rate) == pytest.approx(here, rel=1e-13)
        core.evaporate(Events(small_tip.positions, 5), 1000)
        # the keys around the holes, computed after the events, have the same voltage
        assert np.log(core.chooser.rate) == pytest.approx(core.log_rate_at(factor), rel=1e-13)
        core.relax()


def test_an_interrupted_relaxation_does_not_change_the_voltage(small_tip):
    def voltage(interrupted):
        emitter = ae.evaporation.Emitter(small_tip, law=ae.Arrhenius(80.0), seed=1, n_threads=1)
        assert sum(map(len, emitter.advance(20))) == 20
        assert emitter._core.control.rise != 0
        if interrupted:
            with pytest.raises(ValueError, match="negative"):
                emitter._core.relax(extra=-1_000_000)
            assert emitter.evaporate(1).status == SWEEP_DUE
        emitter.relax()
        return emitter.control_voltage

    assert voltage(True) == voltage(False)


def test_without_a_control_events_take_no_time(small_tip):
    plain, controlled = surface(small_tip), surface(small_tip, SteadyRate(1e3, 20.0))
    assert type(plain.control) is Control and plain.control.voltage_factor == 1
    columns = []
    for core in (plain, controlled):
        events = Events(small_tip.positions, 30)
        core.evaporate(events, 1000)
        columns.append(events.columns())
    assert (columns[0]["waits"] == 0).all() and (columns[0]["rises"] == 0).all()
    assert (columns[1]["waits"] > 0).all()
    assert np.array_equal(columns[0]["site"], columns[1]["site"])  # one factor of all rates changes no probability


def test_the_rate_rises_while_nothing_happens(small_tip):
    """Rise before an event - rise after the last one = wait * rate / memory; each event lowers it by 1 / memory."""
    control = SteadyRate(1e3, 20.0)
    core = surface(small_tip, control)
    events = Events(small_tip.positions, 50)
    core.evaporate(events, 1000)
    waits, rises = events.columns()["waits"], events.columns()["rises"]
    after = np.concatenate([[0.0], rises[:-1] - 1 / control.memory])
    # rises of up to a few units are rounded to 2^-53 of them each
    np.testing.assert_allclose(rises - after, waits * control.rate / control.memory, rtol=1e-12, atol=1e-14)
