"""An instrument records a part of the ions, at measured places: each effect by itself, and all of them in a file."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import apt_evap as ae
from apt_evap.detection.binning import find_quantisations
from apt_evap.detection.instrument import INSTRUMENT_PRESETS, Detection

STEPS = (0.02725, 0.02602)  # mm, of a delay-line detector


def ions(n, rng, pulse_id=None, spread=30.0):
    """Ions on a plane at 100 mm with random places and times; each in a pulse of its own by default."""
    x, y = rng.uniform(-spread, spread, (2, n))
    return ae.Hits(
        x=x,
        y=y,
        time_of_flight=rng.uniform(500.0, 700.0, n),
        mass_to_charge=np.full(n, 26.98),
        pulse_id=np.arange(n) if pulse_id is None else pulse_id,
        ion=np.arange(n),
        source="test",
    )


def poisson_pulses(n_pulses, mean, rng):
    """Pulses of independent ions, with `mean` ions in each."""
    return np.repeat(np.arange(n_pulses), rng.poisson(mean, n_pulses))


def dead_ions(hits, dead_time, dead_zone):
    """The losses of every pulse, ion after ion in the order of arrival: an oracle."""
    lost = np.zeros(len(hits), bool)
    for pulse in np.unique(hits.pulse_id):
        here = np.flatnonzero(hits.pulse_id == pulse)
        recorded = []
        for k in here[np.argsort(hits.time_of_flight[here], kind="stable")]:
            lost[k] = any(
                hits.time_of_flight[k] - hits.time_of_flight[j] < dead_time
                and abs(hits.x[k] - hits.x[j]) < dead_zone
                and abs(hits.y[k] - hits.y[j]) < dead_zone
                for j in recorded
            )
            if not lost[k]:
                recorded.append(k)
    return lost


@pytest.fixture(scope="session")
def real(made_once, nickel):
    tip = ae.Tip(nickel, 8 * nickel.a, axis=(1, 1, 1), shank_length=8 * nickel.a, offset_seed=1)
    return made_once(tip, 400, seed=1).at_evaporation_field()


# ---- one effect after the other --------------------------------------------------------------------------------------


@pytest.mark.parametrize("efficiency", [0.37, 0.8])
def test_the_efficiency_is_binomial(rng, efficiency):
    n = 100_000
    recording = ae.Instrument(efficiency=efficiency, field_of_view=200.0).record(ions(n, rng))
    deviation = np.sqrt(n * efficiency * (1 - efficiency))
    assert abs(recording.counts[Detection.RECORDED] - n * efficiency) < 4 * deviation
    assert recording.counts[Detection.NOT_DETECTED] == n - recording.counts[Detection.RECORDED]
    # ions are independent: variance of sums of 100 ions, with the relative standard error sqrt(2 / 1000) = 4.5 %
    sums = recording.recorded.reshape(-1, 100).sum(axis=1)
    assert sums.var() == pytest.approx(100 * efficiency * (1 - efficiency), rel=4 * 0.045)


@pytest.mark.parametrize(("mean", "efficiency"), [(0.01, 1.0), (0.3, 1.0), (0.3, 0.5)])
def test_multiple_hits_of_independent_ions(rng, mean, efficiency):
    """Ions of a Poisson distribution remain one after thinning, with the mean mu = efficiency * mean."""
    pulse = poisson_pulses(round(60_000 / mean), mean, rng)
    seen = ae.Instrument(efficiency=efficiency, field_of_view=200.0).hits(ions(len(pulse), rng, pulse))
    mu = mean * efficiency
    pulses = len(np.unique(seen.pulse_id))
    # ions per pulse that is not empty, mu / (1 - exp(-mu)); its variance is below that of a Poisson distribution
    assert len(seen) / pulses == pytest.approx(mu / (1 - np.exp(-mu)), abs=4 * np.sqrt(mu / pulses))
    share = 1 - np.exp(-mu)  # of the ions that have others in their pulse
    n_multiple = np.count_nonzero(seen.multiplicity > 1)
    # they come in pairs or more: twice the variance and a little more
    assert n_multiple == pytest.approx(len(seen) * share, abs=4 * np.sqrt(2.5 * len(seen) * share))


def test_the_dead_zone_removes_the_pairs_within_both_limits():
    first = (0.0, 0.0, 600.0)
    seconds = {
        (1.9, -1.9, 602.9): True,
        (1.9, -1.9, 603.0): False,  # later
        (2.0, 0.0, 600.0): False,  # beside it in x
        (0.0, -2.0, 600.0): False,  # and in y
        (-1.0, 1.0, 598.0): True,  # the other ion arrives first
        (0.0, 0.0, 600.0): True,
    }
    for (x, y, time), lost in seconds.items():
        pair = ae.Hits(x=[first[0], x], y=[first[1], y], time_of_flight=[first[2], time], pulse_id=[7, 7], ion=[0, 1])
        instrument = ae.Instrument(dead_time=3.0, dead_zone=2.0)
        dead = instrument.record(pair).detection == Detection.DEAD
        later = int(time >= first[2])
        assert dead.tolist() == [lost and later == k for k in (0, 1)], (x, y, time)
        # not in two pulses
        assert instrument.record(replace(pair, pulse_id=[7, 8])).recorded.all()


def test_dead_times_as_the_oracle_finds_them(rng):
    pulse = poisson_pulses(400, 3.0, rng)
    hits = ions(len(pulse), rng, pulse, spread=5.0)
    hits = replace(hits, time_of_flight=600.0 + rng.uniform(0.0, 10.0, len(hits)))
    lost = dead_ions(hits, 3.0, 2.5)
    recording = ae.Instrument(dead_time=3.0, dead_zone=2.5).record(hits)
    assert np.array_equal(recording.detection == Detection.DEAD, lost) and lost.sum() > 50
    # an ion that is lost, or not detected, does not hide another one
    weak = ae.Instrument(dead_time=3.0, dead_zone=2.5, efficiency=0.5).record(hits)
    detected = weak.detection != Detection.NOT_DETECTED
    assert np.array_equal(weak.detection[detected] == Detection.DEAD, dead_ions(hits[detected], 3.0, 2.5))
    assert not ae.Instrument(dead_time=3.0).record(hits).counts[Detection.DEAD]


def test_many_ions_of_one_pulse_are_quick(rng):
    hits = ions(20_000, rng, np.zeros(20_000, int))
    recording = ae.Instrument(dead_time=0.5, dead_zone=1.0).record(hits)
    assert 0 < recording.counts[Detection.DEAD] < len(hits)


def test_the_quantisation_is_found_by_the_reader(rng):
    hits = ions(50_000, rng)
    seen = ae.Instrument(quantisation=STEPS, field_of_view=200.0).hits(hits)
    for step, found in zip(STEPS, find_quantisations(seen.x, seen.y), strict=True):
        assert found.spacing == pytest.approx(step, rel=1e-9)  # rounding of the line through 2000 levels
        assert abs(found.origin / step - round(found.origin / step)) < 1e-6
    # to the nearest step; rounding of the product
    assert np.abs(seen.x - hits.x).max() < STEPS[0] / 2 + 1e-12
    assert np.abs(seen.y - hits.y).max() < STEPS[1] / 2 + 1e-12


def test_the_blur_has_its_standard_deviation(rng):
    hits = ions(100_000, rng)
    # and does not depend on whether an ion is detected
    seen = ae.Instrument(resolution=0.14, efficiency=0.5, field_of_view=200.0).hits(hits)
    n = len(seen)
    errors = np.column_stack([seen.x - hits.x[seen.ion], seen.y - hits.y[seen.ion]])
    # standard errors: of a standard deviation 1 / sqrt(2 n), of a mean and of a correlation 1 / sqrt(n)
    assert errors.std(axis=0) == pytest.approx(0.14, rel=4 / np.sqrt(2 * n))
    assert np.abs(errors.mean(axis=0)).max() < 4 * 0.14 / np.sqrt(n)
    assert abs(np.corrcoef(errors.T)[0, 1]) < 4 / np.sqrt(n)


def test_the_measured_mass_follows_from_the_measured_place(rng):
    hits = ions(1000, rng)
    assert np.array_equal(ae.Instrument(field_of_view=200.0).hits(hits).mass_to_charge, hits.mass_to_charge)
    seen = ae.Instrument(resolution=0.14, field_of_view=200.0).hits(hits)
    ratio = (100.0**2 + hits.x**2 + hits.y**2) / (100.0**2 + seen.x**2 + seen.y**2)
    assert seen.mass_to_charge == pytest.approx(hits.mass_to_charge * ratio, rel=1e-14)  # rounding
    assert np.abs(ratio - 1).max() > 1e-4
    curved = ae.Instrument(resolution=0.14, projection="equidistant", field_of_view=200.0).hits(hits)
    assert np.array_equal(curved.mass_to_charge, hits.mass_to_charge)


def test_the_field_of_view_is_a_circle(rng):
    hits = ions(10_000, rng)
    hits.x[:3], hits.y[:3] = (np.nan, 40.0, 0.0), (0.0, 0.0, -20.0)
    instrument = ae.Instrument(field_of_view=40.0)
    recording = instrument.record(hits)
    assert np.array_equal(recording.recorded, np.hypot(hits.x, hits.y) <= 20.0)
    assert recording.detection[:3].tolist() == [Detection.OUTSIDE, Detection.OUTSIDE, Detection.RECORDED]
    assert instrument.hits(hits).extent == (-20.0, 20.0, -20.0, 20.0)


def test_timing_errors_are_those_of_the_instrument(rng):
    n = 20_000
    hits = ions(n, rng)
    seen = ae.Instrument(timing=ae.detection.Timing(jitter=0.3), field_of_view=200.0).hits(hits)
    late = seen.time_of_flight - hits.time_of_flight
    assert late.std() == pytest.approx(0.3, rel=4 / np.sqrt(2 * n))  # standard error
    assert seen.mass_to_charge == pytest.approx(26.98 * (seen.time_of_flight / hits.time_of_flight) ** 2, rel=1e-14)


# ---- images ----------------------------------------------------------------------------------------------------------


def test_the_image_scales_with_the_distance(rng):
    hits = ions(1000, rng)
    seen = ae.Instrument(distance=42.0, field_of_view=200.0).hits(hits, 100.0)
    for name in ("x", "y", "time_of_flight"):
        assert getattr(seen, name) == pytest.approx(0.42 * getattr(hits, name), rel=1e-14)


def test_equidistant_images_are_those_of_the_detector(real):
    curved = real.on_detector(ae.Detector(90.0, 1e6, projection="equidistant"))
    plain = curved.hits(ae.Unperturbed())
    seen = real.record(ae.Instrument(90.0, 1e6, projection="equidistant"), ae.Unperturbed())
    kept = np.isin(plain.ion, seen.ion)
    assert kept.sum() > 300
    # rounding: near the plane through the apex, tan(theta) magnifies it
    assert seen.x == pytest.approx(plain.x[kept], rel=1e-12, abs=1e-12)
    assert seen.time_of_flight == pytest.approx(plain.time_of_flight[kept], rel=1e-6)  # coefficients are float32


def test_an_own_map(rng):
    hits = ions(2000, rng)
    hits.x[0] = np.nan

    def mirrored(points):
        assert np.isfinite(points).all()
        places = -1.1 * points
        places[points[:, 0] > 20.0] = np.nan
        return places

    instrument = ae.Instrument(projection=mirrored, field_of_view=200.0)
    seen = instrument.hits(hits)
    kept = hits.x <= 20.0
    assert np.array_equal(seen.ion, hits.ion[kept])
    assert np.array_equal(seen.x, -1.1 * hits.x[kept])
    # of paths of equal length
    radius = np.hypot(hits.x, hits.y)[kept]
    assert seen.time_of_flight == pytest.approx(hits.time_of_flight[kept] / np.hypot(1, radius / 100), rel=1e-14)
    longer = replace(instrument, flight_path=382.0).hits(hits)
    assert longer.time_of_flight == pytest.approx(3.82 * seen.time_of_flight, rel=1e-14)
    for wrong in (lambda points: points[:, 0], lambda points: points[1:], lambda points: "x"):
        with pytest.raises(ValueError, match="result of projection"):
            ae.Instrument(projection=wrong).record(hits)


# ---- a run -----------------------------------------------------------------------------------------------------------


def test_a_perfect_instrument_is_the_detector(real):
    plain = real.on_detector(ae.Detector(real.detector.distance, 1e6)).hits(ae.Unperturbed())
    seen = real.record(ae.Instrument(real.detector.distance, 1e6))
    hit = plain.detected
    assert hit.sum() > 300
    for name in plain.columns:
        assert np.array_equal(getattr(seen, name), getattr(plain, name)[hit]), name
    for name, values in plain.extra.items():
        assert np.array_equal(seen.extra[name], values[hit]), name


def test_truth_and_counts_go_with_the_ions(real):
    instrument = ae.Instrument(field_of_view=150.0, efficiency=0.6, dead_time=50.0, dead_zone=20.0)
    seen = real.record(instrument)
    recording = instrument.record(real.hits(ae.Unperturbed()), real.detector.distance, seed=real.seed)
    assert np.array_equal(seen.ion, real.emissions.ions[recording.recorded])
    assert np.array_equal(seen.site, real.site[recording.recorded])
    assert np.array_equal(seen.positions, real.emissions.positions[recording.recorded])
    assert np.array_equal(seen.extra["species"], real.species[recording.recorded])
    assert np.array_equal(seen.extra["charge_state"], real.flight_charges[recording.recorded])
    counts = recording.counts
    assert sum(counts.values()) == len(real) and min(counts.values()) > 0
    assert seen.source.endswith(
        f"{len(seen)} recorded, {counts[Detection.OUTSIDE]} outside, "
        f"{counts[Detection.NOT_DETECTED]} not detected, {counts[Detection.DEAD]} dead"
    )
    assert seen.detected.all() and f"{counts[Detection.DEAD]} dead" in repr(recording)
    # pulses and multiplicities of the recorded ions
    begins = np.flatnonzero(np.diff(seen.pulse_id, prepend=-1))
    assert np.array_equal(np.repeat(np.diff(begins, append=len(seen)), seen.multiplicity[begins]), seen.multiplicity)
    assert seen.pulses.sum() == seen.pulse_id[-1] - seen.pulse_id[0]
    assert (np.delete(seen.pulses, begins) == 0).all()


def test_the_same_ions_in_any_selection_and_order(real):
    instrument = ae.Instrument(efficiency=0.5, resolution=0.1, timing=ae.detection.Timing(), field_of_view=200.0)
    hits = real.hits(ae.Unperturbed())
    whole = instrument.hits(hits, seed=3)
    parts = [instrument.hits(hits[part], seed=3) for part in (slice(250, None), slice(0, 250))]
    for name in ("ion", "x", "y", "time_of_flight"):
        joined = np.concatenate([getattr(part, name) for part in reversed(parts)])
        assert np.array_equal(joined, getattr(whole, name)), name
    # alike for other energies, and with another blur or efficiency
    here, there = (instrument.record(each, seed=3).detection for each in (hits, real.hits(ae.RollUp(0.1))))
    inside = (here != Detection.OUTSIDE) & (there != Detection.OUTSIDE)
    assert np.array_equal(here[inside], there[inside]) and inside.sum() > 100
    better = replace(instrument, efficiency=0.9, resolution=0.0).hits(hits, seed=3)
    assert np.isin(whole.ion, better.ion).all()
    other = instrument.hits(hits, seed=4)
    assert not np.array_equal(other.ion, whole.ion)
    assert np.array_equal(real.record(instrument, seed=3).ion, whole.ion)


def test_the_errors_of_the_times_are_not_applied_twice(real):
    sharp = real.record(ae.Instrument(timing=ae.detection.Timing(jitter=0.0)))
    plain = real.record(ae.Instrument())
    assert np.array_equal(sharp.time_of_flight, plain.time_of_flight)
    timed = real.simulated().at_evaporation_field(timing=ae.detection.Timing(jitter=0.5))
    assert np.array_equal(
        timed.record(ae.Instrument(timing=ae.detection.Timing(jitter=0.0))).time_of_flight, plain.time_of_flight
    )
    assert np.array_equal(
        timed.record(ae.Instrument(field_of_view=1e6)).time_of_flight,
        timed.hits(ae.Unperturbed()).time_of_flight,
    )


def test_an_epos_is_read_as_it_was_written(real, tmp_path):
    instrument = ae.Instrument(
        field_of_view=150.0,
        efficiency=0.8,
        dead_time=3.0,
        dead_zone=2.0,
        resolution=0.1,
        quantisation=STEPS,
        timing=ae.detection.Timing(temperature=50.0),
    )
    # voltages below 100 V, of a tip this small in the model, would be read as kV
    seen = real.at_evaporation_field(field_factor=3.3).record(instrument, ae.RollUp(0.1))
    ae.write(tmp_path / "seen.epos", seen)
    read = ae.read(tmp_path / "seen.epos")
    for name in ("x", "y", "time_of_flight", "voltage", "pulse_voltage", "mass_to_charge", "positions"):
        assert np.array_equal(getattr(read, name), getattr(seen, name).astype(np.float32)), name
    assert np.array_equal(read.pulses, seen.pulses) and np.array_equal(read.multiplicity, seen.multiplicity)
    assert np.array_equal(np.diff(read.pulse_id) == 0, np.diff(seen.pulse_id) == 0)


def test_maps_of_recorded_ions_cover_the_detector(real):
    map = real.record(ae.Instrument(field_of_view=150.0)).map(bins=20)
    assert map.extent == (-75.0, 75.0, -75.0, 75.0)


def test_an_instrument_needs_real_units(real):
    with pytest.raises(ValueError, match=r"an instrument needs a run in real units: use run\.at_evaporation_field\(\)"):
        real.simulated().record(ae.Instrument())
    with pytest.raises(ValueError, match="detector"):
        real.on_detector(ae.Instrument())
    with pytest.raises(ValueError, match="instrument"):
        real.record(ae.Detector())
    hits = real.hits(ae.Unperturbed())
    with pytest.raises(ValueError, match="no column 'pulse_id'"):
        ae.Instrument().record(replace(hits, pulse_id=None))
    with pytest.raises(ValueError, match="pulse_id"):
        ae.Instrument(field_of_view=1e6).hits(hits[::-1])


def test_a_distance_that_is_no_flight_path_is_refused(real):
    with pytest.raises(ValueError, match="distance"):
        ae.Instrument(distance=1e-300)
    with pytest.raises(ValueError, match="distance"):
        ae.Instrument().record(real.hits(ae.Unperturbed()), distance=1e-300)


def test_presets():
    assert ae.Instrument.preset("straight, 100 mm") == ae.Instrument(100.0, 80.0, efficiency=0.8)
    changed = ae.Instrument.preset("reflectron, 42 mm", dead_time=3.0, efficiency=0.4)
    assert (changed.distance, changed.dead_time, changed.efficiency) == (42.0, 3.0, 0.4)
    with pytest.raises(ValueError, match=r"did you mean 'straight, 100 mm'"):
        ae.Instrument.preset("straight")
    assert all(ae.Instrument.preset(name) for name in INSTRUMENT_PRESETS)


# ---- invariants ------------------------------------------------------------------------------------------------------

INSTRUMENTS = st.builds(
    ae.Instrument,
    distance=st.floats(20.0, 400.0),
    field_of_view=st.floats(5.0, 100.0),
    projection=st.sampled_from(["plane", "equidistant"]),
    efficiency=st.floats(0.1, 1.0),
    dead_time=st.floats(0.0, 300.0),
    dead_zone=st.floats(0.0, 30.0),
    resolution=st.just(0.0) | st.floats(0.01, 1.0),
    quantisation=st.none() | st.tuples(st.floats(0.01, 1.0), st.floats(0.01, 1.0)),
    timing=st.none()
    | st.builds(ae.detection.Timing, jitter=st.floats(0.0, 1.0), temperature=st.none() | st.floats(20.0, 100.0)),
)


@given(INSTRUMENTS, st.integers(0, 2**64 - 1))
def test_what_holds_for_every_instrument(instrument, seed):
    rng = np.random.default_rng(seed)
    hits = ions(200, rng, np.sort(rng.integers(0, 80, 200)))
    recording = instrument.record(hits, seed=seed)
    seen = instrument.hits(hits, seed=seed)
    assert np.array_equal(recording.recorded, recording.detection == Detection.RECORDED)
    assert np.array_equal(seen.ion, hits.ion[recording.recorded])
    assert sum(recording.counts.values()) == len(hits)
    # the first ion of a pulse that is detected is always recorded
    detected = np.isin(recording.detection, (Detection.RECORDED, Detection.DEAD))
    assert set(hits.pulse_id[detected]) == set(seen.pulse_id)
    # without dead time more ions are recorded, and nothing else changes
    fast = replace(instrument, dead_time=0.0)
    assert np.array_equal(fast.record(hits, seed=seed).recorded, detected)
    kept = np.isin(hits.ion[detected], seen.ion)
    assert np.array_equal(fast.hits(hits, seed=seed).x[kept], seen.x)
    if instrument.resolution == 0 and instrument.quantisation is None:
        # rounding of the square root
        assert (np.hypot(seen.x, seen.y) <= instrument.field_of_view / 2 * (1 + 1e-12)).all()
    # what is recorded once is recorded again
    ideal = replace(instrument, projection="plane", resolution=0.0, quantisation=None, timing=None)
    once = ideal.hits(hits, seed=seed)
    twice = ideal.hits(once, seed=seed)
    for name in ("ion", "x", "time_of_flight", "mass_to_charge", "pulses", "multiplicity"):
        assert np.array_equal(getattr(twice, name), getattr(once, name)), name
