"""The surface at the end of a run, rebuilt from its file."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.simulation.surface import surface_after


def test_the_surface_of_a_file_is_that_of_the_simulation(small_tip, tmp_path):
    simulation = ae.Simulation(small_tip, seed=1, charge_settings=ae.evaporation.ChargeSettings(sweep_interval=50))
    run = simulation.run(120, [ae.Unperturbed()], responses=False, progress=False)
    run.save(tmp_path / "ni.h5")
    emitter = surface_after(ae.load(tmp_path / "ni.h5"))
    assert emitter.counts["events"] == 120
    again = ae.Simulation(small_tip, seed=1, charge_settings=ae.evaporation.ChargeSettings(sweep_interval=50))
    again.run(120, [ae.Unperturbed()], responses=False, progress=False)
    emitter.relax(1e-8), again.emitter.relax(1e-8)
    here, there = np.argsort(emitter.atoms), np.argsort(again.emitter.atoms)
    assert np.array_equal(emitter.atoms[here], again.emitter.atoms[there])
    assert emitter.charges[here] == pytest.approx(again.emitter.charges[there], rel=1e-6)


def test_runs_without_a_surface(small_tip):
    run = ae.Simulation(small_tip, seed=1).run(20, [ae.Unperturbed()], responses=False, progress=False)
    with pytest.raises(ValueError, match="does not contain the state of its surface"):
        surface_after(replace(run, state=None))
    own = replace(run, settings=run.settings | {"rule": {"name": "Mine"}})
    with pytest.raises(ValueError, match="charging rule"):
        surface_after(own)
