"""The law of migration: its equation, its limits, and the electrostatics behind it."""

import math
import runpy
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.emission import Migration
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.roll_probability import AT_REST, BY_CHARGE
from apt_evap.specimen.materials import material
from apt_evap.units import BOLTZMANN, ELEMENTARY_CHARGE
from apt_evap.warnings import EmissionWarning

SCRIPT = Path(__file__).parents[2] / "articles" / "three_metals" / "migration.py"


def emissions_with(ratios):
    """Emissions whose strongest neighbours have these charges."""
    n = len(ratios)
    of_targets = np.full((n, 3), np.nan)
    of_targets[:, 0] = ratios
    return Emissions(
        positions=np.zeros((n, 3)),
        normals=np.tile([0.0, 0.0, 1.0], (n, 1)),
        neighbours=np.zeros((n, 3)),
        charge_states=np.ones(n, int),
        masses=np.ones(n),
        ions=np.arange(n),
        nearest_neighbour_distance=0.25,
        targets=np.zeros((n, 3, 3)),
        charge_ratios=of_targets,
    )


def test_the_probability_is_that_of_two_barriers():
    """Written once more with joules and metres, atom by atom."""
    law = Migration(4.44, 35.0, 300.0, bonds_lost=0.4, polarizability=9e-41)
    ratios = np.linspace(0.4, 1.2, 33)
    expected = []
    for ratio in ratios:
        charge = AT_REST + BY_CHARGE * ratio
        field = 35e9  # V/m
        hop = 0.4 * 4.44 * ELEMENTARY_CHARGE - 0.5 * 9e-41 * field**2 * (charge**2 - 1)
        kt = BOLTZMANN * ELEMENTARY_CHARGE * 300.0
        expected.append(1 / (1 + math.exp((hop - 28 * kt) / kt)))
    expected = np.array(expected)
    assert expected.min() < 0.01 and expected.max() > 0.99
    np.testing.assert_allclose(law.probabilities(emissions_with(ratios)), expected, rtol=1e-9)
    at = law.probabilities(emissions_with([law.threshold, law.threshold + 0.1, np.nan]))
    assert at[0] == pytest.approx(0.5) and at[1] > 0.95 and at[2] == 0.0


def test_limits():
    law = Migration(4.44, 35.0, 60.0)
    cold = emissions_with(law.threshold + np.array([-0.02, 0.02]))
    np.testing.assert_allclose(law.probabilities(cold), [0.0, 1.0], atol=1e-3)  # a step, not a coin
    usual = emissions_with(np.linspace(0.3, 1.1, 9))
    assert (replace(law, field=1.0).probabilities(usual) < 1e-100).all()  # no gain
    assert (replace(law, field=150.0).probabilities(usual) > 0.999).all()
    assert (replace(law, cohesive_energy=0.1).probabilities(usual) > 0.999).all()  # costs less than to leave
    assert replace(law, cohesive_energy=0.1).threshold == 0.0
    thresholds = [replace(law, temperature=t).threshold for t in (20.0, 80.0, 150.0)]
    assert thresholds == sorted(thresholds, reverse=True)  # warm atoms hop more easily
    doubled = replace(law, polarizability=2e-40, cohesive_energy=8.88, temperature=1e-3)
    assert doubled.threshold == pytest.approx(replace(law, temperature=1e-3).threshold, rel=1e-5)  # only their ratio


def test_three_metals():
    """Tungsten rolls, aluminium does not: ratios of real surfaces are 0.4 to 1.0."""
    tungsten, nickel, aluminium = (Migration.of(each) for each in ("W", "Ni", "Al"))
    assert tungsten.threshold == pytest.approx(0.66, abs=0.005)  # selected
    assert tungsten.threshold < nickel.threshold < 0.9
    assert aluminium.threshold > 1.2


def test_a_metal_gives_its_numbers():
    nickel = material("Ni")
    assert Migration.of(nickel, 60.0) == Migration(nickel.cohesive_energy, nickel.evaporation_field, 60.0)
    with pytest.raises(ValueError, match="material must have a cohesive_energy"):
        Migration.of(replace(nickel, cohesive_energy=None))


def test_the_rule_of_a_metal():
    tungsten, nickel, aluminium = (ae.RollUp.of_metal(each) for each in ("W", "Ni", "Al"))
    # a quarter of alpha F^2 / 2, with alpha = 1e-40 F m^2 and F in V/m, in eV
    assert tungsten.energy.mean == pytest.approx(0.25 * 0.5 * 1e-40 * (57e9) ** 2 / ELEMENTARY_CHARGE)
    assert tungsten.energy.mean / nickel.energy.mean == pytest.approx((57 / 35) ** 2)
    assert tungsten.others == nickel.others == aluminium.others  # those that do not roll
    assert nickel.probability == Migration.of("Ni") and (nickel.height, nickel.others_height) == (0.2, 0.0)  # nm
    assert nickel.sharpness == 1.0 and nickel.others.mean == 0.4  # eV
    cold, scaled = ae.RollUp.of_metal("Ni", 20.0), ae.RollUp.of_metal("Ni", energy_scale=0.1)
    assert cold == replace(nickel, probability=Migration.of("Ni", 20.0))
    assert scaled.energy.mean == pytest.approx(0.1 * nickel.energy.mean)
    assert scaled.others.mean == pytest.approx(0.1 * nickel.others.mean)
    for wrong in (0.0, -1.0, math.nan, "x"):
        with pytest.raises(ValueError, match="energy_scale"):
            ae.RollUp.of_metal("Ni", energy_scale=wrong)
    with pytest.raises(ValueError, match="material must have a cohesive_energy"):
        ae.RollUp.of_metal(replace(material("Ni"), cohesive_energy=None))


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.EmissionWarning")
def test_the_rule_of_a_metal_on_a_run():
    """In real units and at the simulated voltage: the same ions roll, and hit the same places."""
    tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    settings = ae.ResponseSettings(energy_limit=20.0)  # 1 eV of a real specimen is 6 eV at this voltage
    run = ae.Simulation(tip, seed=1, response_settings=settings).run(60, progress=False)
    real = run.at_evaporation_field()
    scale = float(np.median(real.energy_scales))
    hits = run.hits(ae.RollUp.of_metal("Ni", energy_scale=scale)), real.hits(ae.RollUp.of_metal("Ni"))
    apart = np.hypot(hits[0].x - hits[1].x, hits[0].y - hits[1].y)[hits[0].detected & hits[1].detected]
    # mm; the factors of the ions differ from their median
    assert len(apart) > 30 and np.median(apart) < 0.1 * np.nanmedian(np.hypot(hits[0].x, hits[0].y))


def test_it_needs_the_neighbours():
    isolated = replace(emissions_with([0.5]), targets=None, charge_ratios=None)
    with pytest.raises(ValueError, match="Migration needs the `targets` and `charge_ratios`"):
        Migration(4.44, 35.0).probabilities(isolated)


@pytest.mark.parametrize("metal", [pytest.param("Ni", marks=pytest.mark.slow), "W"])
def test_the_charge_after_a_roll_up(metal):
    """The line over the charge ratio, against solved charges: fcc and bcc at R = 12 a."""
    ratio, charge, field = runpy.run_path(str(SCRIPT))["rolled"](metal, 12, 40, 500).T
    line = AT_REST + BY_CHARGE * ratio
    # measured here: 0.91 and 0.98, 0.06 and 0.07, -0.11 and -0.15; the mean is -0.03 at R = 40 a, -0.01 at 80 a
    assert np.corrcoef(ratio, charge)[0, 1] > 0.8
    assert np.std(charge - line) < 0.1
    assert abs(np.mean(charge - line)) < 0.2
    assert (field > 1.0).all()


def test_migration_of_an_alloy_warns():
    """It has the numbers of one metal: atoms of another one would roll like its own."""
    settings, rule = ae.ResponseSettings(energy_limit=20.0), ae.ConstantPotential()
    copper = ae.material("Cu", evaporation_field=19.0)
    alloy = ae.Tip("Al", apex_radius=2.4, axis=(0, 0, 1), shank_length=2.4, solutes={copper: 0.2}, seed=1)
    run = ae.Simulation(alloy, seed=1, n_threads=1, response_settings=settings, rule=rule).run(60, progress=False)
    assert len(np.unique(run.species)) == 2
    with pytest.warns(EmissionWarning, match="atoms of Al, Cu evaporate") as caught:
        run.hits(ae.RollUp.of_metal("Al"))
    assert len(caught) == 1
    run.hits(ae.RollUp(0.1, ae.emission.ChargeRatio(0.8)))  # no warning, which would be an error


def test_migration_with_robins_charges_warns(small_tip):
    """Its line over the charge ratios is that of a constant potential: nickel rolls 1.5 times too often otherwise."""
    settings, law = ae.ResponseSettings(energy_limit=20.0), ae.RollUp.of_metal("Ni")
    nested = ae.emission.Mixture(
        (ae.RollUp(0.2), ae.emission.Mixture((ae.Combined(0.1, 0.5, Migration.of("Ni")), law)))
    )
    robin, constant = (
        ae.Simulation(small_tip, seed=1, n_threads=1, response_settings=settings, rule=rule).run(60, progress=False)
        for rule in (ae.Robin(), ae.ConstantPotential())
    )
    for perturbation in (law, nested, ae.RollUp(0.1, Migration.of("Ni"))):
        for each in (robin.hits, robin.places, robin.at_evaporation_field().hits):
            with pytest.warns(EmissionWarning, match="rule=ConstantPotential") as caught:
                each(perturbation)
            assert [warning.filename for warning in caught] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        constant.hits(law), constant.hits(nested)
        robin.hits(ae.RollUp(0.1, ae.emission.ChargeRatio(0.8)))
        ae.evaporation.Emitter(small_tip, law=ae.Extremal(hop=Migration.of("Ni")), rule=ae.ConstantPotential())
    with pytest.warns(EmissionWarning):
        ae.evaporation.Emitter(small_tip, law=ae.Extremal(hop=Migration.of("Ni")))
    shares = [law.probability.probabilities(run.emissions).mean() for run in (robin, constant)]
    assert shares[0] > 1.2 * shares[1] > 0
