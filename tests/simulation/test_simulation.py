import signal
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._core.evaporation import SWEEP_DUE
from apt_evap.simulation.columns import columns_of
from apt_evap.simulation.run import Run

ENERGY = ae.TruncatedNormal(0.155, 0.155)
FLOWN = (ae.RollUp(0.2), ae.LateralVelocity(ENERGY))


FIXED = ae.evaporation.ChargeSettings(potential_bound=1.0)  # no relaxation before an interval ends


def columns(run):
    named = columns_of(run, run.every_column)
    for perturbation in (ae.Unperturbed(), ae.RollUp(ENERGY)):
        hits = run.hits(perturbation)
        named |= {f"{perturbation} {name}": getattr(hits, name) for name in hits.columns}
    return named


def different(one, other):
    """Names of the columns of two runs that differ in any bit."""
    one, other = columns(one), columns(other)
    assert one.keys() == other.keys()
    return [
        name
        for name in one
        if not np.array_equal(one[name], other[name], equal_nan=np.asarray(one[name]).dtype.kind == "f")
    ]


def simulate(tip, n, *, batch_size=256, emissions=FLOWN, **options):
    return ae.Simulation(tip, seed=5, **options).run(n, emissions, progress=False, batch_size=batch_size)


# ---- bits ----------------------------------------------------------------------------------------------------------


PLAIN = 120  # ions


@pytest.fixture(scope="session")
def plain(small_tip):
    return simulate(small_tip, PLAIN, n_threads=1)  # past the first relaxation, which comes after 100 events


@pytest.mark.parametrize("batch_size", [7, *(pytest.param(size, marks=pytest.mark.slow) for size in (1, 100, 256))])
def test_batch_size_changes_no_bit(small_tip, plain, batch_size):
    assert different(plain, simulate(small_tip, PLAIN, n_threads=1, batch_size=batch_size)) == []


@pytest.mark.parametrize("n_threads", [2, pytest.param(3, marks=pytest.mark.slow)])
# more batches than may wait, and fewer
@pytest.mark.parametrize("batch_size", [7, pytest.param(64, marks=pytest.mark.slow)])
def test_threads_change_no_bit(small_tip, plain, n_threads, batch_size):
    assert different(plain, simulate(small_tip, PLAIN, n_threads=n_threads, batch_size=batch_size)) == []


@pytest.mark.parametrize("n_threads", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_tree_handed_out_now_and_then_changes_no_bit(small_tip, plain, n_threads, monkeypatch):
    monkeypatch.setattr("apt_evap.evaporation.emitter.RECORD", 20)
    assert different(plain, simulate(small_tip, PLAIN, n_threads=n_threads, batch_size=7)) == []


def test_a_run_goes_on_where_the_one_before_ended(small_tip, plain):
    simulation = ae.Simulation(small_tip, seed=5)
    parts = [simulation.run(PLAIN // 2, FLOWN, progress=False) for _ in range(2)]
    assert np.array_equal(parts[1].emissions.ions, np.arange(PLAIN // 2, PLAIN))
    assert different(plain, Run.join(parts)) == []


def test_the_seed_changes_the_perturbations_and_not_the_sequence(small_tip, plain):
    other = ae.Simulation(small_tip, seed=6).run(PLAIN, FLOWN, progress=False)
    assert np.array_equal(other.site, plain.site)
    assert np.array_equal(other.hits(ae.Unperturbed()).x, plain.hits(ae.Unperturbed()).x, equal_nan=True)
    lateral = ae.LateralVelocity(ENERGY)
    assert not np.array_equal(other.hits(lateral).x, plain.hits(lateral).x, equal_nan=True)


def test_what_is_flown_besides_changes_nothing(small_tip, plain):
    """An ion lands in the same place whatever else is flown of it: within the tolerance of steps that others share."""
    alone = simulate(small_tip, 100, emissions=[ae.RollUp(0.2), ae.LateralVelocity(1.0)], n_threads=1)
    a, b = alone.hits(ae.RollUp(0.2)), plain.hits(ae.RollUp(0.2))[:100]
    assert a.x == pytest.approx(b.x, abs=1e-9, nan_ok=True)
    assert np.array_equal(alone.site, plain.site[:100])


def test_the_sequence_is_that_of_the_emitter(small_tip, plain):
    """The simulation relaxes when the emitter asks for it, and not otherwise: the same atoms at the same charges."""
    emitter = ae.evaporation.Emitter(small_tip)
    sites, charges, sweeps = [], [], 0
    for batch in emitter.advance(PLAIN, batch_size=PLAIN):
        sites.append(batch.site)
        charges.append(batch.charges)
        sweeps += batch.status == SWEEP_DUE
    assert sweeps >= 1
    assert np.array_equal(np.concatenate(sites), plain.site)
    assert np.array_equal(np.concatenate(charges), plain.charges)


# ---- outcomes ------------------------------------------------------------------------------------------------------


def test_ions_that_miss_are_counted(small_tip, plain):
    landed = plain.hits(ae.Unperturbed())[:60]
    half = float(np.nanmedian(np.maximum(np.abs(landed.x), np.abs(landed.y))))
    tiny = simulate(small_tip, 60, detector=ae.Detector(distance=100.0, width=2 * half))
    hits = tiny.hits(ae.Unperturbed())
    on = (np.abs(hits.x) <= half) & (np.abs(hits.y) <= half)
    assert 20 < on.sum() < 40
    summary = replace(tiny, perturbations=(), flown=()).summary()
    assert (summary["hit"], summary["missed"], summary["never_left"]) == (on.sum(), 60 - on.sum(), 0)
    assert hits.counts[ae.detection.Outcome.MISSED] == 60 - on.sum()
    assert len(hits[hits.detected]) == on.sum()
    # where they land is not changed by how large the detector is
    assert np.array_equal(hits.x, landed.x, equal_nan=True)


@pytest.mark.slow
def test_a_detector_further_away_magnifies(small_tip):
    near, far = (simulate(small_tip, 40, detector=ae.Detector(distance=d, width=3 * d)) for d in (50.0, 100.0))
    a, b = near.hits(ae.Unperturbed()), far.hits(ae.Unperturbed())
    # as seen from the apex; flights end some um from it, where ions do not yet come straight from there: 1e-4 mm
    assert 2 * a.x == pytest.approx(b.x, abs=1e-3, nan_ok=True)


def test_ions_that_never_leave_are_counted(small_tip):
    run = simulate(
        small_tip, 20, flight_settings=ae.simulation.FlightSettings(max_steps=3), emissions=[ae.Unperturbed()]
    )
    assert run.summary()["never_left"] == 20
    hits = run.hits(ae.Unperturbed())
    assert (hits.outcome == ae.detection.Outcome.NEVER_LEFT).all()
    assert np.isnan(hits.x).all()
    assert not hits.detected.any()
    assert run.flagged.all()  # there is nothing to fit
    assert run.hits(ae.LateralVelocity(0.1)).counts[ae.detection.Outcome.NEVER_LEFT] == 20


@pytest.fixture(scope="session")
def isolated_tip(nickel, small_tip):
    """An atom on its own over the apex, further than a nearest neighbour distance from all others."""
    d = small_tip.nearest_neighbour_distance
    top = small_tip.positions[np.argmax(small_tip.positions[:, 2])] + [0, 0, 1.5 * d]
    species = np.zeros(len(small_tip) + 1, int)
    return ae.Tip.from_positions(np.concatenate([small_tip.positions, [top]]), species, [nickel])


def test_ions_without_a_neighbour_do_not_roll_and_are_counted(isolated_tip):
    flown = (ae.RollUp(0.3), ae.Combined(0.3, 0.5), ae.Unperturbed())
    run = ae.Simulation(isolated_tip, seed=2).run(40, flown, progress=False)
    isolated = ~np.isfinite(run.emissions.neighbours).all(axis=1)
    assert isolated[0]  # it sticks out furthest, so it goes first
    assert run.site[0] == len(isolated_tip) - 1
    assert run.summary()["without_neighbour"] == isolated.sum() < 40
    assert not run.flagged[0]  # a roll-up that cannot be is no bad fit
    unflown = replace(run, perturbations=(), flown=())
    still = run.hits(ae.Unperturbed())
    for source in (run, unflown):
        rolled = source.hits(ae.RollUp(0.3))
        assert rolled.x[isolated] == pytest.approx(still.x[isolated], abs=0.01)
        assert np.isfinite(source.hits(ae.Combined(0.3, 0.5)).x[0])
    moved = np.hypot(rolled.x - still.x, rolled.y - still.y)
    assert np.nanmedian(moved[~isolated]) > 1.0  # the others land elsewhere


def few_atoms(nickel, small_tip, n):
    may = np.zeros(len(small_tip), bool)
    may[np.argsort(-small_tip.positions[:, 2], kind="stable")[:n]] = True
    return ae.Tip.from_positions(small_tip.positions, small_tip.species, [nickel], evaporable=may)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.RunWarning")  # more ions than atoms
def test_an_exhausted_specimen_ends_the_run(nickel, small_tip):
    simulation = ae.Simulation(few_atoms(nickel, small_tip, 12))
    run = simulation.run(100, progress=False)
    assert run.ended == "no atom is left that may evaporate"
    assert 3 <= len(run) <= 12
    assert run.summary()["ended"] == run.ended
    assert run.ended in repr(run)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.RunWarning")  # more ions than atoms
def test_a_run_after_the_end_is_empty(nickel, small_tip):
    simulation = ae.Simulation(few_atoms(nickel, small_tip, 12))
    simulation.run(100, progress=False)
    again = simulation.run(5, progress=False)
    assert len(again) == 0
    assert again.ended == "no atom is left that may evaporate"


@pytest.mark.slow
def test_a_shell_gives_the_ions_of_the_whole_specimen(nickel):
    """Holding only what is near the surface changes no bit, as far as the run goes."""
    shape = {"apex_radius": 10 * nickel.a, "axis": (1, 1, 1)}
    shell, whole = ae.Tip(nickel, **shape, depth=5.2 * nickel.a), ae.Tip(nickel, **shape)
    assert len(shell) < 0.9 * len(whole)
    held = ae.Simulation(shell).run(500, responses=False, progress=False)
    full = ae.Simulation(whole).run(len(held), responses=False, progress=False)
    assert len(held) > 300
    assert np.array_equal(held.emissions.positions, full.emissions.positions)
    assert np.array_equal(held.charges, full.charges)
    assert np.array_equal(held.hits(ae.Unperturbed()).x, full.hits(ae.Unperturbed()).x, equal_nan=True)


def test_ctrl_c_keeps_what_is_done(small_tip):
    class Interrupting:
        def launch(self, emissions, random):
            if emissions.ions[0] >= 20:
                signal.raise_signal(signal.SIGINT)
            return ae.Unperturbed().launch(emissions, random)

    before = signal.getsignal(signal.SIGINT)
    run = ae.Simulation(small_tip, charge_settings=FIXED).run(80, [Interrupting()], progress=False, batch_size=10)
    assert run.ended == "interrupted"
    assert len(run) == 30  # the batch under way is kept
    assert signal.getsignal(signal.SIGINT) is before


# ---- refusals ------------------------------------------------------------------------------------------------------


class Half:
    def launch(self, emissions, random):
        n = len(emissions) // 2
        return ae.emission.Launches(emissions.positions[:n], np.zeros((n, 3)), np.zeros(n, bool))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda tip: ae.Simulation(tip).run(0), "n_ions must be an integer >= 1, got 0"),
        (lambda tip: ae.Simulation(tip).run(10.5), "n_ions must be an integer"),
        (lambda tip: ae.Simulation(tip).run(10, batch_size=0), "batch_size must be an integer"),
        (lambda tip: ae.Simulation(tip).run(10, [3]), "emissions must be perturbations with a method launch, got 3"),
        (lambda tip: ae.Simulation(tip).run(10, [Half()]), r"must launch \d+ ions, one per emission, got \d"),
        (
            lambda tip: ae.Simulation(tip, voltage=-1.0),
            r"voltage must be .* \[V\] > 0 and <= 1e\+06, got -1.0",
        ),
        (lambda tip: ae.Simulation(tip, seed=-1), "seed must be an integer"),
        (lambda tip: ae.Simulation(tip, n_threads=0), "n_threads must be an integer"),
        (lambda tip: ae.simulation.FlightSettings(opening_angle=2.0), "opening_angle must be a finite number"),
        (lambda tip: ae.simulation.FlightSettings(tolerance=0.0), "tolerance must be a finite number"),
        (lambda tip: ae.evaporation.ChargeSettings(patch_radius=0.5), "patch_radius must be a finite number"),
        (lambda tip: ae.evaporation.ChargeSettings(update_radius=3.0), "update_radius must be a finite number"),
        (lambda tip: ae.evaporation.ChargeSettings(sweep_interval=0), "sweep_interval must be an integer"),
    ],
)
def test_bad_input_gets_one_clear_sentence(small_tip, call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call(small_tip)
    assert "\n" not in str(caught.value)


# ---- as a user writes it -------------------------------------------------------------------------------------------


def test_the_names_users_rely_on(tmp_path):
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), shank_angle=1.5, shank_length=6 * nickel.a)
    simulation = ae.Simulation(tip, voltage=1000.0, seed=1, detector=ae.Detector(distance=100.0, width=300.0))
    run = simulation.run(60, progress=False)
    run.save(tmp_path / "ni111.h5")
    run = ae.load(tmp_path / "ni111.h5")
    run.hits(ae.Unperturbed())
    rolled = run.hits(ae.RollUp(ae.TruncatedNormal(0.155, 0.155)))
    both = run.hits(ae.Combined(ae.TruncatedNormal(0.3, 0.1), rollup_fraction=0.75))
    assert len(rolled.x) == len(rolled.y) == len(rolled.time_of_flight) == len(rolled.site) == len(both.x) == 60
    ae.write(tmp_path / "ni.epos", rolled)
    measured = ae.read(tmp_path / "ni.epos")
    assert isinstance(measured, ae.Hits)
    assert len(measured) == rolled.counts[ae.detection.Outcome.HIT]
    emitter = simulation.emitter
    n = len(emitter)
    assert emitter.positions.shape == emitter.normals.shape == (n, 3)
    assert emitter.charges.shape == emitter.fields.shape == (n,)
    assert rolled.map(bins=16).ions <= 60


def test_charge_states_and_masses_change_times_and_not_paths(nickel, small_tip):
    """The path of an ion from rest depends on nothing but the field; its time goes with sqrt(m/z)."""
    heavy = replace(nickel, mass=4 * nickel.mass, charge_state=2)
    tip = ae.Tip.from_positions(small_tip.positions, small_tip.species, [heavy], potential_point=(0, 0, 0))
    light = ae.Tip.from_positions(small_tip.positions, small_tip.species, [nickel], potential_point=(0, 0, 0))
    a, b = (ae.Simulation(t).run(30, responses=False, progress=False).hits(ae.Unperturbed()) for t in (tip, light))
    assert np.array_equal(a.x, b.x, equal_nan=True)
    assert a.time_of_flight == pytest.approx(np.sqrt(2.0) * b.time_of_flight, rel=1e-12, nan_ok=True)


# ---- the patterns of Ni[111] ---------------------------------------------------------------------------------------

INNER, OUTER = 10.0, 40.0  # mm, on a detector at 100 mm


def fourier(hits, most=12):
    """Amplitudes and phases [degrees] of the azimuthal profile, and the Poisson error of an amplitude."""
    profile = ae.maps.azimuthal_profile(hits, inner=INNER, outer=OUTER, bins=72)
    angle = np.radians(profile.position)
    parts = np.array([2 * np.mean(profile.density * np.exp(-1j * m * angle)) for m in range(most + 1)])
    # each of both parts of an amplitude has the variance 2/N: N hits of weight 2/N cos(m angle)
    return np.abs(parts), -np.degrees(np.angle(parts)), np.sqrt(2 * np.mean(profile.error**2) / len(angle))


def test_the_pole_is_dark(few20):
    plain = few20.hits(ae.Unperturbed())
    profile = ae.maps.radial_profile(plain, outer=60.0, bins=12)
    ring = (profile.position > 25) & (profile.position < 50)
    assert (profile.density[0] + 3 * profile.error[0]) < 0.6 * profile.density[ring].mean()
    assert profile.density[1] + 3 * profile.error[1] < 0.6 * profile.density[ring].mean()


def test_roll_up_gives_six_bright_lines(few20):
    amplitude, phase, error = fourier(few20.hits(ae.RollUp(ENERGY)))
    assert amplitude[6] > 20 * error  # measured 1.0 with an error of 0.02
    assert amplitude[6] > 5 * amplitude[1:6].max()
    # <110> is along x, mirror planes of {111} stand 30 degrees from it: lines at 30 + 60 k
    assert (phase[6] / 6) % 60 == pytest.approx(30.0, abs=5.0)


def test_the_lines_are_dark_without_perturbation(few20):
    amplitude, phase, error = fourier(few20.hits(ae.Unperturbed()))
    assert amplitude[6] > 5 * error  # measured 0.33 with an error of 0.02
    assert amplitude[6] > 3 * amplitude[1:6].max()
    assert abs((phase[6] / 6 + 30) % 60 - 30) < 5.0  # bright between the lines, dark on them
    lines = []
    for perturbation in (ae.Unperturbed(), ae.RollUp(ENERGY)):
        profile = ae.maps.azimuthal_profile(few20.hits(perturbation), inner=INNER, outer=OUTER, bins=36)
        on = np.abs((profile.position % 60) - 30) <= 5.0  # twelve sectors, two on each line
        n = on.sum()
        lines.append((profile.density[on].mean(), np.sqrt((profile.error[on] ** 2).sum()) / n))
    (dark, dark_error), (bright, bright_error) = lines
    assert dark < 1 - 5 * dark_error
    assert bright > 1 + 5 * bright_error


def test_every_ion_of_the_large_run_is_accounted_for(few20):
    summary = few20.summary()
    assert summary["ions"] == 6_000
    assert summary["hit"] + summary["missed"] + summary["never_left"] == 6_000
    assert summary["never_left"] == 0
    assert summary["ended"] == ""


@pytest.mark.slow
def test_flights_follow_an_emitter_that_was_driven_by_hand(nickel):
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), shank_length=6 * nickel.a)
    by_hand, whole = ae.Simulation(tip, seed=1), ae.Simulation(tip, seed=1)
    list(by_hand.emitter.advance(60))
    later = by_hand.run(20, responses=False, progress=False).hits(ae.Unperturbed())
    run = whole.run(80, responses=False, progress=False).hits(ae.Unperturbed())
    assert np.array_equal(later.x, run.x[60:]) and np.array_equal(later.site, run.site[60:])


@pytest.mark.parametrize("element", ["W", *(pytest.param(name, marks=pytest.mark.slow) for name in ("Ni", "Si"))])
def test_ions_roll_onto_nearest_neighbours(element):
    material = ae.material(element)
    tip = ae.Tip(material, apex_radius=8 * material.nearest_neighbour_distance, axis=(0, 1, 1))
    emissions = ae.Simulation(tip, seed=1).run(60, responses=False, progress=False).emissions
    distances = np.linalg.norm(emissions.neighbours - emissions.positions, axis=1)
    assert np.isfinite(distances).sum() > 40
    assert np.nanmax(np.abs(distances / material.nearest_neighbour_distance - 1)) < 1e-9


@pytest.mark.slow
def test_evaporation_past_the_point_of_the_potential(nickel):
    # the cap's centre, where the voltage is defined, is an atom of this tip: all of the cap goes
    tip = ae.Tip(nickel, apex_radius=1.0, axis=(1, 1, 1), shank_length=6.0)
    simulation = ae.Simulation(tip, seed=1)
    run = simulation.run(400, responses=False, progress=False)
    assert len(run) == 400 and run.emissions.positions[:, 2].min() < -0.5
    assert np.isfinite(run.fields).all() and run.fields.min() > 0
    # deep inside the shank the potential is the voltage within the few percent that it varies along it
    deep = simulation.emitter.potential_at([[0.0, 0.0, -4.0]])[0]
    assert deep == pytest.approx(1000.0, rel=0.1)


@pytest.mark.slow
def test_settings_do_not_depend_on_threads_when_a_shell_deepens(nickel):
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), depth=3.5 * nickel.a)
    settings, sites = [], []
    for n_threads in (1, 2):
        simulation = ae.Simulation(tip, seed=1, n_threads=n_threads)
        run = simulation.run(900, responses=False, progress=False)
        assert len(simulation.tip) > len(tip)  # it has deepened
        assert np.array_equal(simulation.tip.positions[run.site], run.emissions.positions)
        settings.append(run.settings)
        sites.append(run.site)
    assert settings[0] == settings[1] and settings[0]["tip"] == tip.settings
    assert np.array_equal(*sites)


class Breaking:
    """Raises once it has launched a hundred ions."""

    def launch(self, emissions, random):
        if emissions.ions[-1] >= 100:
            raise RuntimeError("broken on purpose")
        return ae.Unperturbed().launch(emissions, random)


def test_an_exception_keeps_what_is_done(small_tip):
    with pytest.raises(
        ae.simulation.RunInterrupted, match="broken on purpose; the attribute `run` contains the 100 ions"
    ) as caught:
        simulation = ae.Simulation(small_tip, seed=1, charge_settings=FIXED)
        simulation.run(200, [Breaking()], responses=False, progress=False, batch_size=50)
    assert len(caught.value.run) == 100
    assert caught.value.run.ended == "RuntimeError: broken on purpose"
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_reach_must_be_beyond_the_specimen(small_tip):
    with pytest.raises(ValueError, match="reach"):
        tip = ae.Tip("Ni", apex_radius=10.0, shank_length=60.0, depth=1.5)
        ae.Simulation(tip, flight_settings=ae.simulation.FlightSettings(reach=120.0))
