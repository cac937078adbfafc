"""A column of the events is stored by one line: rows, joining, fingerprint and file follow from the list of columns."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.simulation import columns, run_hdf5


@pytest.fixture
def run_with_rises(small_tip, monkeypatch):
    """A run that stores "rises", which the events of a control contain and a run does not keep."""
    with_rises = (*columns.OPTIONAL, columns._of_events("events/rises"))
    for module in (columns, run_hdf5):
        monkeypatch.setattr(module, "OPTIONAL", with_rises)
    return ae.Simulation(small_tip, seed=1, law=ae.Arrhenius(60.0)).run(
        300, [ae.Unperturbed()], responses=False, progress=False
    )


def test_a_column_of_the_events_is_stored_by_one_line(run_with_rises, tmp_path):
    run, rises = run_with_rises, run_with_rises.events["rises"]
    # the factor of all rates leads the voltage between relaxations
    assert rises.shape == (300,) and rises.dtype == np.float64 and len(np.unique(rises)) > 100
    assert np.array_equal(run[10:60:5].events["rises"], rises[10:60:5])
    assert np.array_equal(ae.Run.join([run[:120], run[120:]]).events["rises"], rises)
    run.save(tmp_path / "run.h5")
    loaded = ae.load(tmp_path / "run.h5")
    assert np.array_equal(loaded.events["rises"], rises) and loaded.fingerprint() == run.fingerprint()
    rises[7] += 1.0
    assert loaded.fingerprint() != run.fingerprint()


def test_files_without_a_new_column_stay_readable(run_with_rises, small_tip, monkeypatch, tmp_path):
    kept = columns.OPTIONAL
    with monkeypatch.context() as earlier:
        for module in (columns, run_hdf5):
            earlier.setattr(module, "OPTIONAL", kept[:-1])
        run = ae.Simulation(small_tip, seed=1).run(20, progress=False)
        run.save(tmp_path / "earlier.h5")
    loaded = ae.load(tmp_path / "earlier.h5")
    assert loaded.events == loaded[3:9].events == {} and loaded.fingerprint() == run.fingerprint()


def test_other_columns_of_the_events_are_not_kept(small_tip):
    assert "rises" not in ae.Simulation(small_tip, seed=1).run(20, progress=False).events
