"""Charging rules: one written in Python behind the contract of the compiled ones, and the settings in files."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

import apt_evap as ae
from apt_evap._core.interactions import direct_field
from apt_evap._core.rule import PythonRule
from apt_evap.units import COULOMB


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
    compiled = ae.evaporation.Emitter(tip12, settings=ae.evaporation.ChargeSettings(start_tolerance=1e-6))
    slow = ae.evaporation.Emitter(tip12, settings=ae.evaporation.ChargeSettings(start_tolerance=1e-6), rule=SlowRobin())
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
    run = ae.Simulation(small_tip, rule=SlowRobin(), monitor=ae.simulation.Monitor(interval=10)).run(
        30, responses=False, progress=False
    )
    assert run.settings["rule"] == {"name": "SlowRobin", "sweeps": 200}
    assert len(run) == 30


def test_two_emitters_may_share_a_rule(small_tip):
    rule = ae.Robin(tolerance=1e-4)
    first, second = ae.evaporation.Emitter(small_tip, rule=rule), ae.evaporation.Emitter(small_tip, 500.0, rule=rule)
    assert first.rule is rule is second.rule
    alone = ae.evaporation.Emitter(small_tip, rule=ae.Robin(tolerance=1e-4))
    for emitter in (first, second, alone):
        assert len(list(emitter.advance(50))) > 0
    assert np.array_equal(first.charges, alone.charges)


@pytest.mark.parametrize("other", [ae.Robin(tolerance=1e-1), ae.Robin(window=0)])
def test_a_run_is_not_resumed_by_another_rule(small_tip, tmp_path, other):
    checkpoint = ae.simulation.Checkpoint(tmp_path / "a.h5", resume=True)
    ae.Simulation(small_tip).run(20, responses=False, progress=False, checkpoint=checkpoint)
    with pytest.raises(ae.FileError, match=r"other settings \(rule\."):
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
        ae.evaporation.Emitter(small_tip, rule=rule)


@pytest.mark.parametrize("bad", [{"tolerance": 0.0}, {"tolerance": 2.0}, {"window": -1}, {"window": 100}])
def test_bad_parameters_of_robin_are_refused(bad):
    with pytest.raises(ValueError, match=rf"^{next(iter(bad))} must be .* got"):
        ae.Robin(**bad)


# ---- constant potential --------------------------------------------------------------------------------------------


CONSTANT = [
    ae.ConstantPotential(law_field="charge"),
    ae.ConstantPotential(),
    ae.ConstantPotential(charges="gaussian", self_term=10.0),
    ae.ConstantPotential(self_term=4.0 / 0.352),  # some charges are negative
]
NAMES = ["points", "others", "gaussian", "negative"]


def potentials_of(emitter):
    """Potential of each atom with that of its own charge [V], by direct sums."""
    positions, charges, rule = emitter.positions, emitter.charges, emitter.rule
    self_term = emitter._core.rule.self_term
    distance = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(distance, 1.0)
    eta = self_term * np.sqrt(np.pi / 2)
    matrix = (erf(eta * distance / np.sqrt(2)) if rule.charges == "gaussian" else 1.0) / distance
    np.fill_diagonal(matrix, self_term)
    return COULOMB * (matrix @ charges)


@pytest.mark.slow
@pytest.mark.parametrize(("tolerance", "bound"), [(1e-5, 5e-5), (1e-4, 2e-4)])
@pytest.mark.parametrize("rule", CONSTANT, ids=NAMES)
def test_potentials_are_kept_during_the_events(small_tip, rule, tolerance, bound):
    rule = replace(rule, tolerance=tolerance)
    settings = ae.evaporation.ChargeSettings(opening_angle=0.2, relaxation_angle=0.2, update_radius=40.0)  # all atoms
    emitter = ae.evaporation.Emitter(small_tip, 1000.0, rule=rule, settings=settings)
    for number, batch in enumerate(emitter.advance(60, batch_size=20)):
        top = emitter.tip.positions[batch.site[-1]]
        near = np.linalg.norm(emitter.positions - top, axis=1) < 8 * 0.249
        stored = COULOMB * emitter._core.rule.potentials[emitter._core.slots]
        exact = potentials_of(emitter)
        # the patch is at the voltage, as it is stored: solved to `tolerance` of self term and mean charge
        unit = COULOMB * emitter._core.rule.self_term * emitter.charges.mean()
        assert stored[near] == pytest.approx(1000.0, abs=bound * unit)
        # what is stored is the sum over all charges: up to the cells, 2e-4, and the single precision of the changes
        assert stored == pytest.approx(exact, abs=2e-3 * unit), number
    # the full solution differs by the smooth remainder that a relaxation removes
    (_, before), mean = by_atom(emitter), emitter.charges.mean()
    emitter.relax(1e-7)
    change = by_atom(emitter)[1] - before
    # of the order of the largest change beyond the patch, 2e-3 per event (see ChargeSettings), which partly cancel
    assert np.abs(change).max() < 0.02 * mean
    assert np.sqrt(np.mean(change**2)) < 3e-3 * mean
    assert potentials_of(emitter) == pytest.approx(1000.0, abs=1e-3 * unit)
    assert np.abs(emitter.charge_residuals(np.arange(50))).max() < 1e-3
    assert emitter.counts["clipped"] == emitter.counts["unsettled"] == 0


def test_negative_charges_are_counted_and_do_not_leave(small_tip):
    emitter = ae.evaporation.Emitter(small_tip, rule=CONSTANT[3])
    assert emitter.counts["negative"] == np.count_nonzero(emitter.charges < 0) > 5
    assert ae.evaporation.Emitter(small_tip, rule=ae.ConstantPotential()).counts["negative"] <= 5
    assert all((batch.charges > 0).all() for batch in emitter.advance(40))
    points = 5.0 * np.eye(3) + [0.0, 0.0, 2.0]
    assert emitter.field_at(points, 0.3) == pytest.approx(emitter.field_at(points, 0.0), rel=1e-3, abs=0.1)


def test_a_law_can_see_the_field_of_the_others(small_tip):
    emitter = ae.evaporation.Emitter(
        small_tip, rule=CONSTANT[1], settings=ae.evaporation.ChargeSettings(opening_angle=0.2)
    )
    list(emitter.advance(20))
    chosen = np.argsort(emitter.fields)[-30:]
    direct = COULOMB * direct_field(emitter.positions[chosen], emitter.positions, emitter.charges)
    exact = 2 * np.einsum("ij,ij->i", direct, emitter.normals[chosen])
    assert emitter.fields[chosen] == pytest.approx(exact, rel=2e-3)  # cells, and patches of single precision
    of_charge = ae.evaporation.Emitter(small_tip, rule=CONSTANT[0])
    of_others = ae.evaporation.Emitter(small_tip, rule=CONSTANT[1])
    assert np.allclose(of_charge.charges, of_others.charges, rtol=0, atol=1e-12)
    # the same weighted mean, another contrast
    weights = of_charge.charges / of_charge.charges.sum()
    assert (weights * of_others.fields).sum() == pytest.approx((weights * of_charge.fields).sum(), rel=1e-3)
    assert of_others.fields.std() < 0.95 * of_charge.fields.std()


@pytest.mark.slow
@pytest.mark.parametrize("rule", CONSTANT, ids=NAMES)
def test_bits_do_not_depend_on_threads_batches_and_resumes(small_tip, made_once, tmp_path, rule):
    settings = ae.evaporation.ChargeSettings(sweep_interval=15)
    options = {"rule": rule, "charge_settings": settings, "seed": 1}

    def simulation(**threads):
        return ae.Simulation(small_tip, **options, **threads)

    whole = made_once(small_tip, 50, n_threads=1, **options)
    assert whole.fingerprint() == simulation(n_threads=2).run(50, progress=False).fingerprint()
    checkpoint = ae.simulation.Checkpoint(tmp_path / "a.h5", resume=True)
    simulation().run(20, progress=False, checkpoint=checkpoint)
    again = simulation().run(50, progress=False, checkpoint=checkpoint)
    assert again.fingerprint() == whole.fingerprint()
    assert whole.settings["rule"]["name"] == "ConstantPotential"
    # the polynomials of the responses give the hits
    hits = whole.hits(ae.RollUp(ae.TruncatedNormal(0.155, 0.155)))
    assert np.isfinite(hits.x[hits.outcome == ae.detection.Outcome.HIT]).all()
    assert hits.counts[ae.detection.Outcome.HIT] > 40
    emitters = [ae.evaporation.Emitter(small_tip, rule=rule, settings=settings) for _ in range(2)]
    for emitter, size in zip(emitters, (1, 40), strict=True):
        list(emitter.advance(40, batch_size=size))
    assert np.array_equal(*(emitter.charges for emitter in emitters))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"self_term": 0}, "^self_term must be .* got"),
        ({"charges": "spheres"}, "^charges must be one of points, gaussian, got"),
        ({"law_field": "all"}, "^law_field must be one of charge, others, got"),
        ({"tolerance": 1e-9}, "^tolerance must be .* got"),
    ],
)
def test_bad_parameters_of_the_constant_potential_are_refused(bad, message):
    with pytest.raises(ValueError, match=message):
        ae.ConstantPotential(**bad)


class Coarse(ae.ConstantPotential):
    RELAXATION_TOLERANCE, RELAXATION_SHARE, WHOLE_INTERVAL = 0.1, 20, 3


def test_relaxations_are_those_of_the_rule(small_tip, tip12):
    robin, constant, coarse = (6e-3, 300, 10), (6e-3, 200, 7), (0.1, 20, 3)
    rules = {None: robin, ae.Robin(): robin, ae.ConstantPotential(): constant, Coarse(): coarse}
    for rule, expected in rules.items():
        emitter = ae.evaporation.Emitter(tip12 if expected is coarse else small_tip, rule=rule)
        assert (emitter.settings.tolerance, emitter.settings.whole_interval) == expected[::2]
        assert emitter.sweep_interval == max(100, len(emitter) // expected[1])
        assert expected is not coarse or emitter.sweep_interval > 200
    given = ae.evaporation.ChargeSettings(tolerance=1e-3, sweep_interval=150, whole_interval=2)
    emitter = ae.evaporation.Emitter(small_tip, rule=ae.ConstantPotential(), settings=given)
    assert emitter.settings == given and emitter.sweep_interval == 150
