import warnings

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.simulation.monitor import charge_residuals
from apt_evap.warnings import ChargesWarning, ResponseWarning, RunWarning

FIXED = ae.evaporation.ChargeSettings(potential_bound=1.0)  # no relaxation before an interval ends


def simulate(tip, n=400, responses=False, batch_size=256, n_threads=1, emissions=(), **options):
    monitor = ae.simulation.Monitor(**{"interval": 100} | options.pop("monitor", {}))
    options = {"charge_settings": FIXED} | options
    simulation = ae.Simulation(tip, seed=3, n_threads=n_threads, monitor=monitor, **options)
    return simulation.run(n, emissions, responses=responses, progress=False, batch_size=batch_size)


# ---- residuals -----------------------------------------------------------------------------------------------------


def test_residuals_are_those_of_robins_equation(small_tip):
    emitter = ae.evaporation.Emitter(small_tip, n_threads=1)
    emitter.evaporate(50)
    positions, normals, charges = emitter.positions, emitter.normals, emitter.charges
    expected = []
    for i in np.flatnonzero(small_tip.evaporable[emitter.atoms]):
        apart = positions[i] - np.delete(positions, i, axis=0)
        field = (np.delete(charges, i) / np.linalg.norm(apart, axis=1) ** 3) @ apart
        expected.append(emitter.area_per_atom / (2 * np.pi) * normals[i] @ field - charges[i])
    got = charge_residuals(emitter, sample=10**6, seed=0)
    # sums of 2,100 terms in another order, relative to a mean of 1
    assert got == pytest.approx(np.array(expected) / charges.mean(), abs=1e-10)
    assert np.isin(charge_residuals(emitter, 20, seed=4), got).all()


def test_residuals_tell_settled_charges_from_others(small_tip):
    """Relaxed with direct sums they are as small as the tolerance, a thousand times less than after events."""
    exact = ae.evaporation.ChargeSettings(
        opening_angle=0.0, relaxation_angle=0.0, start_tolerance=1e-8, sweep_interval=10_000
    )
    emitter = ae.evaporation.Emitter(small_tip, settings=exact, n_threads=1)
    seen = []
    for _ in range(4):
        seen.append(np.sqrt(np.mean(charge_residuals(emitter, 500, seed=0) ** 2)))
        emitter.evaporate(100)
    assert seen[0] < 1e-7
    assert min(seen[1:]) > 1e-4
    emitter.relax(1e-8)
    assert np.abs(charge_residuals(emitter, 500, seed=0)).max() < 1e-7


def test_residuals_are_about_the_error(small_tip):
    """RMS error of the charges, against converged ones, from half to three times the residual (0.8 to 2.5 measured)."""
    emitter = ae.evaporation.Emitter(small_tip, n_threads=1)
    assert sum(len(batch) for batch in emitter.advance(300, batch_size=300)) == 300
    residual = np.sqrt(np.mean(charge_residuals(emitter, 128, seed=0) ** 2))
    may, before = small_tip.evaporable[emitter.atoms], dict(zip(emitter.atoms, emitter.charges, strict=True))
    emitter.relax(1e-7)
    after = dict(zip(emitter.atoms, emitter.charges, strict=True))
    scale = sum(before.values()) / sum(after.values())  # the potential is brought to the voltage besides
    atoms = np.array(sorted(set(before) & set(np.flatnonzero(small_tip.evaporable))))
    error = np.array([before[atom] - scale * after[atom] for atom in atoms]) / np.mean(list(before.values()))
    assert may.sum() == len(atoms)
    assert 0.5 < np.sqrt(np.mean(error**2)) / residual < 3


# ---- history -------------------------------------------------------------------------------------------------------


def test_the_history_is_that_of_the_ions(small_tip, tmp_path):
    detector = ae.Detector(distance=100.0, width=120.0)
    run = simulate(small_tip, responses=True, detector=detector)
    history = run.history
    assert history.ions.tolist() == [100, 200, 300]  # each before a relaxation, none at the end
    assert ((history.residual_rms > 1e-5) & (history.residual_rms < 0.02)).all()
    assert (history.residual_max > history.residual_rms).all()
    outcome = run.hits(ae.Unperturbed()).outcome
    for row, end in enumerate(history.ions):
        since = slice(end - 100, end)
        assert history.missed[row] == np.mean(outcome[since] == ae.detection.Outcome.MISSED)
        assert history.never_left[row] == 0
        assert history.flagged[row] == np.mean(run.flagged[since])
        assert history.field[row] == pytest.approx(run.fields[since].mean(), rel=1e-14)
    assert 0 < history.missed.max() < 1
    run.save(tmp_path / "run.h5")
    for one, two in zip(history, ae.load(tmp_path / "run.h5").history, strict=True):
        assert np.array_equal(one, two)


def test_watching_changes_no_bit_and_depends_on_no_batch_or_thread(small_tip):
    plain = simulate(small_tip, monitor={"interval": 10**6})
    assert len(plain.history.ions) == 0
    watched = simulate(small_tip)
    assert np.array_equal(plain.site, watched.site) and np.array_equal(plain.charges, watched.charges)
    assert np.array_equal(plain.flown[0].directions, watched.flown[0].directions, equal_nan=True)
    for other in (simulate(small_tip, batch_size=7), simulate(small_tip, n_threads=2)):
        assert all(np.array_equal(one, two) for one, two in zip(watched.history, other.history, strict=True))


def test_a_run_after_a_run_has_its_own_history(small_tip):
    monitor = ae.simulation.Monitor(interval=100)
    simulation = ae.Simulation(small_tip, n_threads=1, monitor=monitor, charge_settings=FIXED)
    first, second = (simulation.run(250, responses=False, progress=False) for _ in range(2))
    assert first.history.ions.tolist() == [100, 200]
    assert second.history.ions.tolist() == [400]  # the first relaxation at which 100 ions of this run have left


def test_by_default_every_tenth_relaxation(small_tip):
    run = ae.Simulation(small_tip, n_threads=1, charge_settings=FIXED).run(1100, responses=False, progress=False)
    assert run.history.ions.tolist() == [1000]


# ---- bounds --------------------------------------------------------------------------------------------------------


def warned(tip, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        simulate(tip, **options)
    return [(item.category, str(item.message)) for item in caught]


@pytest.mark.slow
def test_one_warning_past_each_bound(small_tip):
    assert warned(small_tip) == []
    ((kind, text),) = warned(small_tip, monitor={"charge_bound": 1e-6})
    assert kind is ChargesWarning and "after 100 ions" in text and "bound of 1e-06" in text
    flights = ae.simulation.FlightSettings(max_steps=3)
    ((kind, text),) = warned(small_tip, flight_settings=flights)
    assert kind is RunWarning and text.startswith("100.0% of the last ions, up to number 100, never left the specimen")
    kinds = [kind for kind, _ in warned(small_tip, n=150, flight_settings=flights, responses=True)]
    assert kinds == [RunWarning, ResponseWarning]


def test_charges_that_are_let_go_are_noticed(small_tip):
    """A bound that is not too wide: patches too small to carry the change of charge run past it."""
    loose = ae.evaporation.ChargeSettings(patch_radius=1.5, update_radius=1.5, sweep_interval=400, tolerance=0.5)
    ((kind, _),) = warned(small_tip, n=900, charge_settings=loose)
    assert kind is ChargesWarning


def test_the_progress_line_shows_it(small_tip, capsys):
    monitor = ae.simulation.Monitor(interval=100)
    ae.Simulation(small_tip, n_threads=1, monitor=monitor).run(250, responses=False, progress=True)
    line = capsys.readouterr().err.split("\r")[-1]
    assert "charges=" in line and "missed=" in line and "never left=0.0%" in line


@pytest.mark.parametrize("bad", [{"interval": 0}, {"sample": 0}, {"charge_bound": 0.0}, {"fraction_bound": 2.0}])
def test_bad_settings_are_refused(bad):
    with pytest.raises(ValueError, match=f"{next(iter(bad))} must be "):
        ae.simulation.Monitor(**bad)
