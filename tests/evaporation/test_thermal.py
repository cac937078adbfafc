"""Evaporation at a temperature: rates, the sequence drawn from them, its times, and the control of the voltage."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

import apt_evap as ae
from apt_evap._core.evaporation import SWEEP_DUE, TOO_SHALLOW
from apt_evap._core.law import BARRIERS
from apt_evap.units import BOLTZMANN

FREQUENCY = 1e13
STEADY = ae.evaporation.VoltageControl(rate=1.0, pulse_fraction=0.0)
# for a p-value of random numbers from a fixed seed: each test below would fail for 1 seed in 1,000
CHANCE = 1e-3


def emitter_of(tip, law, **options):
    """An emitter of one thread: tests run side by side."""
    return ae.evaporation.Emitter(tip, law=law, **{"n_threads": 1} | options)


def history_of(emitter, n, batch_size=256):
    """Columns of n events: sites, charges, waits and voltages."""
    batches = list(emitter.advance(n, batch_size))
    columns = ("site", "charges", "waits", "voltages")
    joined = [[getattr(batch, name) for batch in batches] for name in columns]
    return [None if parts[0] is None else np.concatenate(parts) for parts in joined]


def same(one, other, **options):
    return [np.array_equal(a, b, **options) for a, b in zip(one, other, strict=True)]


def one_by_one(emitter, n):
    """Yield before each of n events what the twins need; the event follows when the batch is asked for."""
    done = 0
    while done < n:
        before = emitter._core.chooser.rate, emitter._core.control.rise, emitter.atoms, emitter.fields
        batch = emitter.evaporate(1)
        done += len(batch)
        if len(batch):
            yield *before, batch
        else:
            assert batch.status == SWEEP_DUE
            emitter.relax()


def twin(barrier, x, s, w):
    """Slow twin of Q/kT: C/kT = s, and w at the working point."""
    x = np.asarray(x)
    beyond = np.where(x > 1, -1.0, 1.0)
    return {
        "linear": s * (1 - x),
        "image_hump": 2 * s * (1 - np.sqrt(x)),
        "parabolic": beyond * s**2 / (4 * w) * (1 / x - 1) ** 2,
        "quadratic": beyond * s**2 / (4 * w) * (1 - x) ** 2,
    }[barrier]


def log_rates(law, tip, x, control=None):
    """ln k of the compiled law for evaporable atoms of the first species at x = F/F_evap."""
    atom = int(np.flatnonzero(tip.evaporable & (tip.species == 0))[0])
    fields = np.atleast_1d(x) * tip.elements[0].evaporation_field
    n = len(fields)
    return law.kernel(tip, control).evaluate(fields, np.full(n, atom), np.zeros(n, np.int32))


@pytest.fixture
def shell(nickel):
    """A shell that deepens after about 200 events."""
    return ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), depth=3.5 * nickel.a)


# ---- barriers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("barrier", BARRIERS)
@pytest.mark.parametrize(("temperature", "sensitivity"), [(20.0, 1.0), (80.0, 0.6), (300.0, 2.5)])
def test_rates_of_the_kernel_are_those_of_the_formulas(small_tip, barrier, temperature, sensitivity):
    law = ae.Arrhenius(temperature, sensitivity, FREQUENCY, barrier)
    x = np.linspace(0.2, 2.0, 200)
    w, _ = law.working_point(sensitivity, ae.evaporation.VoltageControl())
    expected = np.log(FREQUENCY) - twin(barrier, x, sensitivity / (BOLTZMANN * temperature), w)
    # a handful of roundings of terms that are at most 40 times larger than their sum
    assert log_rates(law, small_tip, x) == pytest.approx(expected, rel=1e-13, abs=1e-11)
    assert (np.diff(expected) > 0).all()  # a higher field is a higher rate, also beyond x = 1


@pytest.mark.parametrize("barrier", BARRIERS)
def test_without_a_field_or_of_a_fixed_atom_there_is_no_rate(small_tip, barrier):
    law = ae.Arrhenius(50.0, barrier=barrier)
    assert (log_rates(law, small_tip, [0.0, -0.5]) == -np.inf).all()
    fixed = np.flatnonzero(~small_tip.evaporable)[:2]
    assert (law.kernel(small_tip).evaluate(np.full(2, 40.0), fixed, np.zeros(2, np.int32)) == -np.inf).all()


@pytest.mark.parametrize("temperature", [20.0, 50.0, 80.0])
@pytest.mark.parametrize(
    ("barrier", "point", "slope"),
    [  # x at the working point, where Q/kT = w, and the slope there over C
        ("linear", lambda r: 1 - r, lambda r: 1.0),
        ("quadratic", lambda r: 1 - 2 * r, lambda r: 1.0),
        ("image_hump", lambda r: (1 - r / 2) ** 2, lambda r: 1 / (1 - r / 2)),  # C at x = 1
        ("parabolic", lambda r: 1 / (1 + 2 * r), lambda r: (1 + 2 * r) ** 2),  # C to the zeroth order of r
    ],
)
def test_slopes_at_the_working_point(small_tip, temperature, barrier, point, slope):
    law, h = ae.Arrhenius(temperature, barrier=barrier), 1e-5
    w, _ = law.working_point(1.0, ae.evaporation.VoltageControl())
    thermal = BOLTZMANN * temperature
    r = w * thermal  # Q_op / C
    x = point(r)
    low, middle, high = log_rates(law, small_tip, [x - h, x, x + h])
    assert np.log(FREQUENCY) - middle == pytest.approx(w, rel=1e-12)  # roundings of terms of up to s = 600
    # a central difference: h^2/6 of the third derivative, below 1e-8, and roundings of 600 * 1e-16 / h
    assert (high - low) / (2 * h) * thermal == pytest.approx(slope(r), rel=1e-7)


def test_the_image_hump_has_the_slope_c_at_the_evaporation_field(small_tip):
    law, h = ae.Arrhenius(50.0, 0.7, barrier="image_hump"), 1e-5
    low, high = log_rates(law, small_tip, [1 - h, 1 + h])
    assert (high - low) / (2 * h) * BOLTZMANN * 50.0 == pytest.approx(0.7, rel=1e-7)  # as above


def spread(tip, law):
    """Mean of how far the field of a leaving atom is below the largest one, over 250 events."""
    return np.mean(
        [
            1 - batch.fields[0] / fields[tip.evaporable[atoms]].max()
            for _, _, atoms, fields, batch in one_by_one(emitter_of(tip, law, seed=2), 250)
        ]
    )


def probabilities(law, emitter):
    """Probability of each surface atom to evaporate next, at the voltage of the wanted rate."""
    control = ae.evaporation.VoltageControl()
    kernel, (_, length) = law.kernel(emitter.tip, control), law.working_point(1.0, control)
    fields, atoms, none = emitter.fields, emitter.atoms, np.zeros(len(emitter), np.int32)

    def keys(log_factor):
        return kernel.evaluate(fields * np.exp(log_factor), atoms, none)

    goal = np.log(control.rate / length)
    found = keys(brentq(lambda log_factor: np.logaddexp.reduce(keys(log_factor)) - goal, -4, 1))
    rates = np.exp(found - found.max())
    return rates / rates.sum()


@pytest.mark.slow
def test_all_barriers_choose_nearly_the_same_atoms(tip12):
    """Only C/kT at the working point matters: half of the summed differences is the share of other choices."""
    emitter, shares, more = emitter_of(tip12, ae.Extremal()), {barrier: [] for barrier in BARRIERS}, []
    for _ in range(5):
        assert sum(map(len, emitter.advance(200))) == 200
        emitter.relax()
        linear = probabilities(ae.Arrhenius(50.0), emitter)
        for barrier in BARRIERS:
            other = probabilities(ae.Arrhenius(50.0, barrier=barrier), emitter)
            shares[barrier].append(np.abs(other - linear).sum() / 2)
        more.append(np.abs(probabilities(ae.Arrhenius(100.0), emitter) - linear).sum() / 2)
    # dlnk/dlnF at the working point is (C - Q), (C - Q/2), (C + 2 Q) and (C - 2 Q) over kT with Q = 0.073 C: 0, +4, +24
    # and -8 % of the linear one, and as many percent times 0.4 are other choices. Measured: 0.02, 0.10 and 0.10
    assert max(shares["linear"]) == 0
    assert 0 < max(shares["image_hump"]) < 0.04
    assert 0 < max(shares["parabolic"]) < 0.15
    assert 0 < max(shares["quadratic"]) < 0.15
    # of twice the temperature; measured 0.27 to 0.35, and 0.02 at one surface, where one atom is far ahead
    assert sorted(more)[1] > 0.15


@pytest.mark.slow
def test_the_spread_of_the_order_grows_with_the_temperature(tip12):
    spreads = [spread(tip12, ae.Arrhenius(temperature)) for temperature in (10.0, 30.0, 90.0)]
    # in proportion to kT/C, were there atoms at all fields
    assert 0 < 2 * spreads[0] < spreads[1] and 2 * spreads[1] < spreads[2]
    assert spreads[2] < 10 * BOLTZMANN * 90.0


# ---- the limits of the law -----------------------------------------------------------------------------------------


def test_at_zero_temperature_the_law_is_the_extremal_one_bit_by_bit(tip12):
    extremal, cold = emitter_of(tip12, ae.Extremal()), emitter_of(tip12, ae.Arrhenius(0.0), seed=7)
    assert same(history_of(extremal, 250), history_of(cold, 250)) == [True] * 4
    assert cold.control is None and cold.pulse_length is None and cold.control_voltage == cold.voltage == 1000.0
    for barrier in BARRIERS:
        assert type(ae.Arrhenius(0.0, barrier=barrier).kernel(tip12)) is type(ae.Extremal().kernel(tip12))


def test_close_to_zero_temperature_the_sites_are_those_of_the_extremal_law(tip12):
    # kT/C = 1e-8 at 1e-4 K; the two largest of 6,000 fields differed by 9e-7 or more in all 250 events
    extremal, cold = emitter_of(tip12, ae.Extremal()), emitter_of(tip12, ae.Arrhenius(1e-4), seed=7)
    sites, charges, waits, _ = history_of(cold, 250)
    assert same(history_of(extremal, 250)[:2], (sites, charges)) == [True, True]
    assert (waits >= 0).all() and np.isfinite(waits).all()
    warm = history_of(emitter_of(tip12, ae.Arrhenius(20.0), seed=7), 250)[0]
    assert not np.array_equal(warm, sites)


@pytest.mark.parametrize(("barrier", "control"), list(zip(BARRIERS, (None, STEADY, STEADY, None), strict=True)))
def test_only_the_ratio_of_sensitivity_and_temperature_matters(small_tip, barrier, control):
    """All numbers depend on C/kT: twice of both is an exact factor of two, and every bit is the same."""

    def emitter(temperature, sensitivity):
        law = ae.Arrhenius(temperature, sensitivity, barrier=barrier)
        return emitter_of(small_tip, law, control=control, seed=3)

    one, two = emitter(50.0, 1.0), emitter(100.0, 2.0)
    columns = history_of(one, 120)
    assert one.pulse_length == two.pulse_length
    assert same(columns, history_of(two, 120)) == [True] * 4
    assert not np.array_equal(columns[0], history_of(emitter(100.0, 1.0), 120)[0])


def test_a_higher_attempt_frequency_lowers_the_voltage(tip12):
    """A factor of the frequency is one of the rates, which the control compensates: ln(10) kT/(C x) of the voltage."""
    voltages = []
    for frequency in (1e12, 1e13):
        law = ae.Arrhenius(50.0, attempt_frequency=frequency)
        emitter = emitter_of(tip12, law, control=STEADY)
        voltages.append(emitter.control_voltage)
        x = emitter.fields.max() * emitter.control_voltage / emitter.voltage / 35.0
    # linear between the two, whose x differ by 1 %
    assert np.log(voltages[0] / voltages[1]) == pytest.approx(np.log(10) * BOLTZMANN * 50.0 / x, rel=0.015)


# ---- the sequence --------------------------------------------------------------------------------------------------


def test_atoms_are_drawn_from_the_rates_of_all_atoms(tip12, rng):
    """Before every event the rates by a twin: their sum, and the part of (0, 1) from which the atom was drawn."""
    s, parts = 1.0 / (BOLTZMANN * 80.0), []
    emitter = emitter_of(tip12, ae.Arrhenius(80.0), seed=9)
    for rate, _, atoms, fields, batch in one_by_one(emitter, 500):
        x = fields * emitter._core.control.voltage_factor / 35.0
        rates = np.where(tip12.evaporable[atoms], FREQUENCY * np.exp(-s * (1 - x)), 0.0)
        # keys of up to s = 145 are rounded to 145 * 2^-53 each, and every step of the twin's as well
        assert rate == pytest.approx(rates.sum(), rel=1e-12)
        chosen = np.flatnonzero(atoms == batch.site[0])[0]
        parts.append((rates[:chosen].sum() + rng.random() * rates[chosen]) / rates.sum())
    assert stats.kstest(parts, "uniform").pvalue > CHANCE


@pytest.mark.slow
@pytest.mark.parametrize("memory", [1_000_000, 20])
def test_waits_are_exponential(tip12, memory):
    """The rate times the wait is an Exp(1) number; with a short memory the rate rises exponentially while waiting."""
    emitter = emitter_of(tip12, ae.Arrhenius(80.0), control=ae.evaporation.VoltageControl(memory=memory), seed=5)
    speed = emitter.control.rate / emitter.pulse_length / memory
    numbers, plain = [], []
    for rate, rise, *_, batch in one_by_one(emitter, 1000):
        wait = batch.waits[0]
        numbers.append(rate * np.exp(rise) * np.expm1(speed * wait) / speed)
        plain.append(rate * wait)
    assert stats.kstest(numbers, "expon").pvalue > CHANCE
    assert abs(np.corrcoef(numbers[1:], numbers[:-1])[0, 1]) < 4 / np.sqrt(1000)  # four standard deviations
    if memory == 1_000_000:  # the rates change so slowly that each surface is a frozen one
        assert stats.kstest(plain, "expon").pvalue > CHANCE


def test_the_seed_changes_the_sequence_and_nothing_else_does(small_tip):
    law = ae.Arrhenius(60.0)
    columns = history_of(emitter_of(small_tip, law, seed=1), 120)
    assert same(columns, history_of(emitter_of(small_tip, law, seed=1), 120)) == [True] * 4
    assert same(columns, history_of(emitter_of(small_tip, law, seed=2), 120)) == [False] * 4


@pytest.mark.parametrize(
    ("batch_size", "n_threads"),
    [(7, 2), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((256, 2), (1, 1)))],
)
def test_threads_and_batches_leave_the_bits(shell, batch_size, n_threads):
    def columns(batch_size=256, n_threads=1):
        emitter = emitter_of(shell, ae.Arrhenius(60.0), seed=11, n_threads=n_threads)
        events = history_of(emitter, 260, batch_size)
        assert len(emitter.tip) > len(shell)  # it was deepened
        return [*events, emitter.charges, emitter.control_voltage]

    assert same(columns(), columns(batch_size, n_threads)) == [True] * 6


def test_events_and_the_starts_of_ions_have_different_random_numbers(tip12):
    """Otherwise the energy of an ion would tell the place that it came from: both begin at number (seed, ion, 0)."""
    emitter = emitter_of(tip12, ae.Arrhenius(300.0), seed=5)
    alike = 0
    for ion in range(40):
        slot = emitter._core.chooser.chosen(ae.emission.IonRandom(5, [ion]).uniform()[0, 0])
        alike += int(emitter._core.tree.atoms[slot] == emitter.evaporate(1).site[0])
    assert alike < 10  # one of about 180 candidates is the same by chance once in 100 events


# ---- the control of the voltage ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate", "temperature"),
    [
        (0.002, 25.0),
        (0.05, 80.0),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((0.002, 80.0), (0.05, 25.0))),
    ],
)  # fmt: skip
def test_the_first_voltage_gives_the_wanted_rate(tip12, temperature, rate):
    control = ae.evaporation.VoltageControl(rate=rate)
    emitter = emitter_of(tip12, ae.Arrhenius(temperature), control=control)
    # 1e-15 of the voltage, where a bisection ends, is 4e-13 of the rate at 25 K
    assert emitter._core.chooser.rate * emitter.pulse_length == pytest.approx(rate, rel=2e-12)
    assert emitter.control_voltage == emitter.voltage * emitter._core.control.voltage_factor


def test_the_voltage_follows_the_waits(tip12):
    """Between two relaxations dlnV = s (wait over its mean - 1)/memory, with s = dlnV/dlnK = kT/(C <x>)."""
    control = ae.evaporation.VoltageControl(memory=40)
    emitter = emitter_of(tip12, ae.Arrhenius(50.0), control=control, seed=2)
    x = np.where(tip12.evaporable[emitter.atoms], emitter.fields * emitter._core.control.voltage_factor / 35.0, -np.inf)
    weights = np.exp((x - x.max()) / (BOLTZMANN * 50.0))
    slope = BOLTZMANN * 50.0 / np.average(np.maximum(x, 0.0), weights=weights)
    batch = emitter.evaporate(90)
    assert len(batch) == 90
    steps = (batch.waits[1:] * control.rate / emitter.pulse_length - 1) / control.memory
    # the compiled slope is a difference over 1e-6 of the voltage; its error is half of that times the variance of
    # ln k over its slope, about 1/220
    assert np.diff(np.log(batch.voltages)) == pytest.approx(slope * steps, rel=1e-6, abs=1e-13)
    assert batch.voltages[0] > emitter.voltage * emitter._core.control.voltage_factor  # it rose until the first event


@pytest.mark.parametrize("barrier", BARRIERS)
def test_a_relaxation_keeps_the_rate(tip12, barrier):
    """The new factor of the voltage gives the rate that the control had reached, on the surface before."""
    law = ae.Arrhenius(50.0, barrier=barrier)
    emitter = emitter_of(tip12, law, settings=ae.evaporation.ChargeSettings(sweep_interval=60), seed=2)
    kernel = law.kernel(tip12)
    for _ in range(2):
        assert emitter.evaporate(60).status != TOO_SHALLOW
        reached = np.log(emitter._core.chooser.rate) + emitter._core.control.rise
        atoms, fields = emitter.atoms, emitter.fields
        emitter.relax()
        factor = emitter._core.control.voltage_factor
        rates = np.exp(kernel.evaluate(fields * factor, atoms, np.zeros(len(atoms), np.int32)))
        assert np.log(rates.sum()) == pytest.approx(reached, abs=1e-3)  # where the iteration stops
        assert emitter.control_voltage == emitter.voltage * factor
        assert emitter.voltage == 1000.0  # charges and fields stay those of the applied voltage


def test_a_relaxation_changes_the_voltage_only_to_the_second_order(tip12):
    """Between two relaxations the voltage is linear in the logarithm of the rates."""
    control = ae.evaporation.VoltageControl(memory=1000)
    emitter = emitter_of(tip12, ae.Arrhenius(50.0), control=control, seed=2)
    assert sum(map(len, emitter.advance(370))) == 370
    before, after = emitter._core.control.voltage_factor * emitter.voltage, emitter.control_voltage
    emitter.relax()
    assert abs(after / before - 1) > 1e-3  # measured 2.2e-3
    # measured 2e-5, of a change of 0.6 of the logarithm; 5e-6 is where the iteration stops
    assert emitter.control_voltage == pytest.approx(after, rel=5e-5)


def test_the_mean_rate_is_the_wanted_one(tip12):
    """Ions per pulse, after the control has found the voltage of the first surface."""
    control = ae.evaporation.VoltageControl(rate=0.01, memory=10)
    emitter = emitter_of(tip12, ae.Arrhenius(50.0), control=control, seed=1)
    _, _, waits, voltages = history_of(emitter, 1800)
    pulses = np.floor(np.cumsum(waits) / emitter.pulse_length)
    n = len(waits) - 300
    rate = n / (pulses[-1] - pulses[299])
    # the sum of (wait over its mean - 1) is the memory times the growth of the logarithm of all rates
    assert 10 * abs(np.log(voltages[-1] / voltages[299])) / 0.0046 < 0.02 * n
    assert rate == pytest.approx(control.rate, rel=1 / np.sqrt(n))  # the statistical error of n ions, 2.6 %


@pytest.mark.slow
def test_a_longer_memory_is_a_smoother_voltage(small_tip):
    noise = []
    for memory in (10, 50, 250):
        emitter = emitter_of(
            small_tip, ae.Arrhenius(50.0), control=ae.evaporation.VoltageControl(memory=memory), seed=1
        )
        noise.append(np.diff(np.log(history_of(emitter, 300)[3])).std())
    assert noise == sorted(noise, reverse=True)


def test_the_voltage_does_not_depend_on_the_applied_one(tip12):
    """Charges are in proportion to the voltage, so the control finds the same one from any."""
    one = history_of(ae.evaporation.Emitter(tip12, 1000.0, law=ae.Arrhenius(50.0), seed=1, n_threads=1), 100)
    two = history_of(ae.evaporation.Emitter(tip12, 2000.0, law=ae.Arrhenius(50.0), seed=1, n_threads=1), 100)
    assert np.array_equal(one[0], two[0])
    assert two[1] == pytest.approx(2 * one[1], rel=1e-9)  # charges converge to rounding in the same steps
    assert two[3] == pytest.approx(one[3], rel=1e-9)


def test_an_event_that_does_not_happen_does_not_change_the_voltage(shell):
    emitter, status = emitter_of(shell, ae.Arrhenius(50.0), seed=1), None
    while status != TOO_SHALLOW:
        voltage = emitter.control_voltage
        batch = emitter.evaporate(1)
        status = batch.status
        if status == SWEEP_DUE:
            emitter.relax()
    assert len(batch) == 0
    assert emitter.control_voltage == voltage


# ---- the working point ---------------------------------------------------------------------------------------------


def test_numbers_of_the_working_point():
    law = ae.Arrhenius(50.0)
    barrier, length = law.working_point(1.0, STEADY)
    # one ion per second of 100 candidates at 1e13 1/s: ln(1e15); equal but for the rounding of logarithms
    assert (barrier, length) == (pytest.approx(np.log(1e15), rel=1e-14), 0.0)
    assert barrier * BOLTZMANN * 50.0 == pytest.approx(0.149, abs=5e-4)  # to the last digit
    barrier, length = law.working_point(1.0, ae.evaporation.VoltageControl())
    # x = 0.927 there; with x = 1 it would be 0.20 ns
    assert length == pytest.approx(0.209e-9, abs=5e-13)
    assert barrier == pytest.approx(np.log(1e13 * length / 0.01 * 100), rel=1e-12)  # the fixed point has converged
    # the rate between pulses over that at their top
    x = 1 - barrier * BOLTZMANN * 50.0
    assert x * 0.2 / 1.2 / (BOLTZMANN * 50.0) == pytest.approx(36, abs=0.5)


@pytest.mark.parametrize(("temperature", "energy"), [(50.0, 0.079), (80.0, 0.127)])
def test_the_barrier_at_a_pulse_of_one_nanosecond(temperature, energy):
    thermal, barrier = BOLTZMANN * temperature, np.log(1e13 * 1e-9 / 0.01 * 100)
    assert barrier == pytest.approx(18.4, abs=0.05)
    assert barrier * thermal == pytest.approx(energy, abs=5e-4)
    x = 1 - barrier * thermal
    width = 1e-9 / ae.evaporation.VoltageControl(pulse_width=1.0).effective_width(thermal / x)  # ns for a pulse of 1 ns
    found, length = ae.Arrhenius(temperature).working_point(1.0, ae.evaporation.VoltageControl(pulse_width=width))
    # a fixed point that converges to 1e-12
    assert (found, length) == (pytest.approx(barrier, rel=1e-11), pytest.approx(1e-9, rel=1e-11))


@pytest.mark.parametrize("barrier", BARRIERS)
def test_the_working_point_does_not_depend_on_the_form_of_the_barrier(barrier):
    expected = ae.Arrhenius(50.0).working_point(1.0, STEADY)
    assert ae.Arrhenius(50.0, barrier=barrier).working_point(1.0, STEADY) == expected


# ---- alloys --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def alloy():
    return ae.Tip("Al", apex_radius=2.0, axis=(1, 1, 1), shank_length=2.0, solutes={"Cu": 0.2}, seed=1)


def test_sensitivities_by_element(alloy):
    law = ae.Arrhenius(50.0, {"Cu": 2.0, "Al": 0.5})
    assert law.sensitivities(alloy).tolist() == [0.5, 2.0]
    assert ae.Arrhenius(50.0, 0.7).sensitivities(alloy).tolist() == [0.7, 0.7]
    kernel = law.kernel(alloy)
    for species, c in enumerate((0.5, 2.0)):
        atoms = np.flatnonzero(alloy.evaporable & (alloy.species == species))[:2]
        fields = np.array([0.9, 0.95]) * alloy.evaporation_fields[species]
        low, high = kernel.evaluate(fields, atoms, np.zeros(2, np.int32))
        # roundings of keys of up to 460
        assert (high - low) / 0.05 * BOLTZMANN * 50.0 == pytest.approx(c, rel=1e-11)
        assert high == pytest.approx(np.log(FREQUENCY) - 0.05 * c / (BOLTZMANN * 50.0), rel=1e-12)


@pytest.mark.parametrize(
    ("sensitivity", "message"),
    [
        ({"Al": 1.0}, "sensitivity must have a value for Cu, got {'Al': 1.0}"),
        ({}, "sensitivity must have a value for Al, got {}"),
        ({"Al": 1.0, "Cu": 1.0, "Ni": 1.0}, "sensitivity must be of the elements Al, Cu, got 'Ni'"),
    ],
)
def test_sensitivities_that_do_not_fit_the_specimen(alloy, sensitivity, message):
    with pytest.raises(ValueError, match=message):
        emitter_of(alloy, ae.Arrhenius(50.0, sensitivity))


# ---- laser ---------------------------------------------------------------------------------------------------------


def test_temperatures_of_both_sides():
    positions = np.array([[5.0, 0, 0], [0, 0, 5.0], [-5.0, 0, 0], [0, 5.0, 0], [8.0, 0, -9.0]])
    laser = ae.evaporation.Laser(100.0, direction=(3.0, 0.0), asymmetry=1.0)
    assert laser.temperatures(positions, 5.0, 40.0) == pytest.approx([140, 90, 40, 90, 140], rel=1e-15)  # one rounding
    laser = ae.evaporation.Laser(100.0, direction=(0.0, -0.1), asymmetry=0.25)
    assert laser.temperatures(positions, 5.0, 40.0)[[1, 3]] == pytest.approx([120, 100], rel=1e-15)
    assert (ae.evaporation.Laser(100.0).temperatures(positions, 5.0, 40.0) == 140.0).all()


def test_an_even_laser_is_a_higher_temperature(tip12):
    law, rate = ae.Arrhenius(30.0, laser=ae.evaporation.Laser(100.0, 100.0)), 1e-6
    heated = emitter_of(tip12, law, control=ae.evaporation.VoltageControl(rate=rate, pulse_fraction=0.0), seed=3)
    assert heated.pulse_length == law.working_point(1.0, heated.control)[1]
    per_second = ae.evaporation.VoltageControl(rate=rate / heated.pulse_length, pulse_fraction=0.0)
    warm = emitter_of(tip12, ae.Arrhenius(130.0), control=per_second, seed=3)
    assert same(history_of(heated, 150), history_of(warm, 150)) == [True] * 4
    assert emitter_of(tip12, law).control == ae.evaporation.VoltageControl(
        pulse_fraction=0.0
    )  # of a laser, without a choice


@pytest.mark.slow
def test_more_ions_come_from_the_hot_side(tip12):
    fractions = []
    for asymmetry in (0.0, 1.0):
        laser = ae.evaporation.Laser(100.0, 1.0, direction=(1.0, 1.0), asymmetry=asymmetry)
        sites = history_of(emitter_of(tip12, ae.Arrhenius(30.0, laser=laser), seed=1), 700)[0]
        fractions.append((tip12.positions[sites][:, :2] @ [1.0, 1.0] > 0).mean())
    # 1.9 % is a standard deviation of 700 draws; neighbouring events are correlated, so four times of it
    assert fractions[0] == pytest.approx(0.5, abs=0.076)
    assert fractions[1] > 0.7  # measured 0.81 of 1,000


@pytest.mark.parametrize(("base", "rise", "decay"), [(30.0, 100.0, 1.0), (50.0, 200.0, 0.5)])
def test_time_of_a_laser_pulse(base, rise, decay):
    """The first order of 1/T against an integral of the rate while the specimen cools."""
    law = ae.Arrhenius(base, laser=ae.evaporation.Laser(rise, decay))
    barrier, length = law.working_point(1.0, law.default_control())
    t = np.linspace(0, 5 * decay, 100_001)
    temperature = base + rise * np.exp(-t / decay)
    rate = np.exp(-barrier * ((base + rise) / temperature - 1))
    integral = 1e-9 * np.trapezoid(rate, t)
    # the second order: measured 4.0 and 4.5 % longer; Q/kT, a logarithm, changes by 0.05 of 16
    assert length == pytest.approx(integral, rel=0.05)
    peak = base + rise
    assert length == pytest.approx(1e-9 * decay * peak / (barrier * rise), rel=1e-9)  # kT^2/(Q dT), converged


def test_light_on_one_side_of_a_cold_specimen(small_tip):
    """The far side stays at 0 K: its atoms hardly leave, those of the hot side do.

    Measured: 0.94 from x > -0.6 nm, as with a relaxation after every event; the cold side then carries more field.
    """
    laser = ae.evaporation.Laser(100.0, asymmetry=1.0)
    emitter = emitter_of(small_tip, ae.Arrhenius(5.0, laser=laser), seed=1)
    sites, _, waits, voltages = history_of(emitter, 100)
    assert np.isfinite(waits).all() and np.isfinite(voltages).all()
    assert (small_tip.positions[sites, 0] > -0.6).mean() > 0.9
    # measured: 0.97 with the charges as they are between relaxations
    unbounded = ae.evaporation.ChargeSettings(potential_bound=1.0)
    emitter = emitter_of(small_tip, ae.Arrhenius(5.0, laser=laser), seed=1, settings=unbounded)
    sites = history_of(emitter, 100)[0]
    assert (small_tip.positions[sites, 0] > 0).mean() > 0.9


def test_a_laser_needs_a_temperature():
    with pytest.raises(ValueError, match="temperature"):
        ae.Arrhenius(0.0, laser=ae.evaporation.Laser(100.0))


# ---- continuing ----------------------------------------------------------------------------------------------------


def test_a_restored_emitter_continues_with_the_same_bits(shell):
    def emitter(seed=4):
        return emitter_of(
            shell, ae.Arrhenius(60.0), settings=ae.evaporation.ChargeSettings(sweep_interval=80), seed=seed
        )

    first = emitter()
    history_of(first, 275)  # deepened once, and 35 events after a relaxation
    assert len(first.tip) > len(shell)
    state = first.state()
    n = len(state.sites)
    assert 0 < 275 - n < 80 and state.voltage_factor != 1.0
    columns = history_of(emitter(), 400)
    second, other = emitter(), emitter(seed=5)
    second.restore(state), other.restore(state)
    assert same([values[n:] for values in columns], history_of(second, 400 - n)) == [True] * 4
    assert not np.array_equal(columns[0][n:], history_of(other, 400 - n)[0])


def simulation(**options):
    tip = ae.Tip("Ni", apex_radius=1.5, axis=(1, 1, 1), shank_length=1.5)
    options = {
        "law": ae.Arrhenius(60.0),
        "charge_settings": ae.evaporation.ChargeSettings(sweep_interval=40),
        "seed": 5,
    } | options
    return ae.Simulation(tip, n_threads=1, **options)


def run(n_ions, path=None, **options):
    checkpoint = None if path is None else ae.simulation.Checkpoint(path, minutes=0, resume=True)
    return simulation(**options).run(n_ions, responses=False, progress=False, batch_size=25, checkpoint=checkpoint)


@pytest.mark.slow
def test_a_run_that_is_resumed_between_two_relaxations_has_the_same_bits(tmp_path):
    whole = run(130)
    for n_ions in (30, 65, 100, 130):  # relaxations at 40, 80 and 120
        part = run(n_ions, tmp_path / "run.h5")
        assert len(part) == n_ions
    assert part.fingerprint() == whole.fingerprint()
    assert same(part.clock, whole.clock) == [True, True]
    assert same(part.cap, whole.cap, equal_nan=True) == [True] * 5  # NaN where no cap could be fitted
    assert part.clock.waits.shape == part.clock.voltages.shape == (130,)
    assert ae.load(tmp_path / "run.h5").fingerprint() == whole.fingerprint()


def test_times_and_voltages_are_in_the_fingerprint():
    """Before the first relaxation the control only sets the time: the memory changes no site."""
    one, two = (
        run(20, control=ae.evaporation.VoltageControl(pulse_fraction=0, rate=1.0, memory=m)) for m in (1000, 1_000_000)
    )
    assert np.array_equal(one.site, two.site) and np.array_equal(one.charges, two.charges)
    assert not np.array_equal(one.clock.voltages, two.clock.voltages)
    assert one.fingerprint() != two.fingerprint()


def test_law_control_and_pulse_length_are_in_the_settings():
    law = ae.Arrhenius(60.0, {"Ni": 0.8}, 1e12, "parabolic", ae.evaporation.Laser(50.0, 2.0, (0.0, 1.0), 0.5))
    settings = run(5, law=law, control=ae.evaporation.VoltageControl(rate=0.02, pulse_fraction=0.0)).settings
    assert settings["law"] == {
        "name": "Arrhenius",
        "temperature": 60.0,
        "sensitivity": {"Ni": 0.8},
        "attempt_frequency": 1e12,
        "barrier": "parabolic",
        "laser": {"name": "Laser", "temperature_rise": 50.0, "decay": 2.0, "direction": [0.0, 1.0], "asymmetry": 0.5},
        "bonds": None,
    }
    assert settings["control"]["rate"] == 0.02 and settings["control"]["pulse_fraction"] == 0.0
    assert (
        settings["pulse_length"]
        == law.working_point(0.8, ae.evaporation.VoltageControl(rate=0.02, pulse_fraction=0.0))[1]
    )


def test_a_run_without_a_temperature_has_no_times(small_tip):
    still = ae.Simulation(small_tip, law=ae.Arrhenius(0.0)).run(5, responses=False, progress=False)
    assert still.clock is None and still.settings["control"] is None and still.settings["pulse_length"] is None
    assert (still.voltages == 1000.0).all()


# ---- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ae.Arrhenius(-1.0), "temperature must be a finite number .K. >= 0"),
        (lambda: ae.Arrhenius("cold"), "temperature must be a finite number"),
        (lambda: ae.Arrhenius(50.0, 0.0), "sensitivity must be a finite number .eV. > 0"),
        (lambda: ae.Arrhenius(50.0, {"Ni": -1.0}), "sensitivity of Ni must be a finite number .eV. > 0"),
        (lambda: ae.Arrhenius(50.0, attempt_frequency=0.0), "attempt_frequency must be a finite number .1/s. > 0"),
        (lambda: ae.Arrhenius(50.0, barrier="cubic"), "barrier must be one of linear, image_hump, .*, got 'cubic'"),
        (lambda: ae.Arrhenius(50.0, laser=50.0), "laser must be a Laser or None, got 50.0"),
        (lambda: ae.Arrhenius(50.0, bonds=3), "bonds must be an evaporation field by bonds .*, got 3"),
        (lambda: ae.evaporation.Laser(0.0), "temperature_rise must be a finite number .K. > 0"),
        (lambda: ae.evaporation.Laser(50.0, decay=0.0), "decay must be a finite number .ns. > 0"),
        (lambda: ae.evaporation.Laser(50.0, asymmetry=1.5), "asymmetry must be a finite number >= 0 and <= 1, got 1.5"),
        (lambda: ae.evaporation.Laser(50.0, direction=(0.0, 0.0)), r"direction must not be zero, got \(0.0, 0.0\)"),
        (
            lambda: ae.evaporation.Laser(50.0, direction=(1.0, 0.0, 0.0)),
            r"direction must have shape \(2,\), got \(3,\)",
        ),
    ],
)
def test_bad_laws_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"control": 0.01}, "control must be a VoltageControl, got 0.01"),
        ({"seed": -1}, "seed must be an integer"),
    ],
)
def test_bad_controls_are_refused(small_tip, options, message):
    with pytest.raises(ValueError, match=message):
        emitter_of(small_tip, ae.Arrhenius(50.0), **options)
