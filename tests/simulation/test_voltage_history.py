"""The voltage at which ions evaporate follows from the fields at which they left and from their materials."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.simulation.voltage_history import evaporation_fields, evaporation_voltages, smoothed_history


@pytest.fixture(scope="session")
def alloy(nickel):
    """A run of nickel and of a material of one's own, of another evaporation field but of the same name."""
    own = replace(nickel, evaporation_field=44.0)
    tip = ae.Tip(nickel, apex_radius=4 * nickel.a, shank_length=4 * nickel.a, solutes={own: 0.5}, seed=1)
    return ae.Simulation(tip, voltage=500.0).run(40, responses=False, progress=False)


def test_every_ion_has_the_evaporation_field_of_its_material(alloy):
    assert alloy.elements == ("Ni", "Ni") and set(alloy.species) == {0, 1}
    fields = np.where(alloy.species == 0, 35.0, 44.0)
    assert np.array_equal(evaporation_fields(alloy), fields)
    assert np.array_equal(evaporation_voltages(alloy), 500.0 * fields / alloy.fields)


def test_a_tip_of_given_positions(small_tip, nickel):
    own = replace(nickel, evaporation_field=44.0)
    species = np.arange(len(small_tip)) % 2
    tip = ae.Tip.from_positions(small_tip.positions, species, (own, "Ni"))
    run = ae.Simulation(tip).run(20, responses=False, progress=False)
    assert np.array_equal(evaporation_fields(run), np.where(species[run.site] == 0, 44.0, 35.0))


def test_fields_at_the_evaporation_voltage_are_those_of_evaporation(small_tip):
    """Simulated at the voltage at which its third ion evaporates, that ion leaves at its evaporation field."""
    run = ae.Simulation(small_tip, voltage=1000.0).run(3, responses=False, progress=False)
    voltage = evaporation_voltages(run)[2]
    again = ae.Simulation(small_tip, voltage=voltage).run(3, responses=False, progress=False)
    assert again.site.tolist() == run.site.tolist()
    # both are relaxed to 1e-4 of a charge
    assert again.fields[2] == pytest.approx(evaporation_fields(run)[2], rel=1e-4)


def test_runs_in_files_have_their_materials(alloy, tmp_path):
    alloy.save(tmp_path / "a.h5")
    assert np.array_equal(evaporation_voltages(ae.load(tmp_path / "a.h5")), evaporation_voltages(alloy))


def test_the_course_of_a_quantity():
    values = np.random.default_rng(1).normal(size=100)
    ions, low, median, high = smoothed_history(values, 10)
    np.testing.assert_allclose(ions, 5 + 10 * np.arange(10))
    parts = values.reshape(10, 10)
    for line, percent in ((low, 5), (median, 50), (high, 95)):
        np.testing.assert_allclose(line, np.percentile(parts, percent, axis=1))
    assert smoothed_history(values[:7], 10).median.tolist() == values[:7].tolist()
    with pytest.raises(ValueError, match="points"):
        smoothed_history(values, 0)
    with pytest.raises(ValueError, match="at least one, got none"):
        smoothed_history([])
    with pytest.raises(ValueError, match="run must be a Run"):
        evaporation_voltages(ae.Hits(voltage=values))
