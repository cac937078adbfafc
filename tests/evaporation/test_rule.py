"""Charging rules: one written in Python behind the contract of the compiled ones, and the settings in files."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._core.rule import PythonRule


class SlowRobin:
    """Robin's iteration in twenty lines: the twin of the compiled one."""

    def __init__(self, sweeps=200):
        self.sweeps = sweeps
        self._area = None

    def solve(self, positions, normals, charges, field_of, potential, tolerance):
        for _ in range(self.sweeps):
            flux = np.maximum(np.einsum("ij,ij->i", field_of(charges), normals), 0)
            area = 2 * np.pi * charges.sum() / flux.sum()
            new = flux * charges.sum() / flux.sum()
            change = np.abs(new - charges).max() / charges.mean()
            charges = new
            if change < tolerance:
                break
        self._area = area
        distances = np.linalg.norm(positions, axis=1)  # from the centre of the cap, which has the potential
        return charges * potential / (charges / distances).sum(), area

    def solve_patch(self, positions, normals, charges, field):
        step = positions[:, None] - positions
        distance = np.linalg.norm(step, axis=2)
        np.fill_diagonal(distance, np.inf)
        kernel = np.einsum("ijk,ik->ij", step, normals) / distance**3
        outer = np.einsum("ij,ij->i", field, normals) - kernel @ charges
        c = self._area / (2 * np.pi)
        return np.linalg.solve(np.eye(len(charges)) - c * kernel, c * outer)


def by_atom(emitter):
    order = np.argsort(emitter.atoms)
    return emitter.atoms[order], emitter.charges[order]


def test_a_rule_in_python_is_the_twin_of_robin(tip12):
    compiled = ae.Emitter(tip12, settings=ae.ChargeSettings(start_tolerance=1e-6))
    slow = ae.Emitter(tip12, settings=ae.ChargeSettings(start_tolerance=1e-6), rule=SlowRobin())
    assert isinstance(slow._core.rule, PythonRule)
    for events in (0, 12):
        first = np.concatenate([np.empty(0, int), *(batch.site for batch in compiled.advance(events))])
        second = np.concatenate([np.empty(0, int), *(batch.site for batch in slow.advance(events))])
        assert np.array_equal(first, second)
        (atoms, exact), (same, charges) = by_atom(compiled), by_atom(slow)
        assert np.array_equal(atoms, same)
        # both stop at a change of 1e-6 in a sweep; the patches of Robin at 1e-5
        assert charges == pytest.approx(exact, abs=2e-4 * exact.mean())
    assert slow.fields[:50] == pytest.approx(compiled.fields[:50], rel=1e-3)


def test_a_rule_without_residuals_is_not_warned_of(small_tip):
    run = ae.Simulation(small_tip, rule=SlowRobin(), watch_settings=ae.WatchSettings(interval=10)).run(
        30, responses=False, progress=False
    )
    assert run.settings["rule"] == {"name": "SlowRobin", "sweeps": 200}
    assert len(run) == 30


def test_two_emitters_may_share_a_rule(small_tip):
    rule = ae.Robin(tolerance=1e-4)
    first, second = ae.Emitter(small_tip, rule=rule), ae.Emitter(small_tip, 500.0, rule=rule)
    assert first.rule is rule is second.rule
    alone = ae.Emitter(small_tip, rule=ae.Robin(tolerance=1e-4))
    for emitter in (first, second, alone):
        assert len(list(emitter.advance(50))) > 0
    assert np.array_equal(first.charges, alone.charges)


@pytest.mark.parametrize("other", [ae.Robin(tolerance=1e-1), ae.Robin(window=0)])
def test_a_run_is_not_resumed_by_another_rule(small_tip, tmp_path, other):
    checkpoint = ae.Checkpoint(tmp_path / "a.h5", resume=True)
    ae.Simulation(small_tip).run(20, responses=False, progress=False, checkpoint=checkpoint)
    with pytest.raises(ae.FileError, match=r"other settings: rule\."):
        ae.Simulation(small_tip, rule=other).run(40, responses=False, progress=False, checkpoint=checkpoint)


class NoCharges(SlowRobin):
    def solve(self, *arguments):
        return np.full(len(arguments[0]), -1.0), 1.0


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ("Robin", "rule must be a charging rule such as Robin"),
        (NoCharges(), "solve of NoCharges must return .* charges, none negative"),
    ],
)
def test_bad_rules_are_refused(small_tip, rule, message):
    with pytest.raises(ValueError, match=message):
        ae.Emitter(small_tip, rule=rule)


@pytest.mark.parametrize("bad", [{"tolerance": 0.0}, {"tolerance": 2.0}, {"window": -1}, {"window": 100}])
def test_bad_parameters_of_robin_are_refused(bad):
    with pytest.raises(ValueError, match=rf"^{next(iter(bad))} must be .* got"):
        ae.Robin(**bad)
