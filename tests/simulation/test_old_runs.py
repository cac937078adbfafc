"""Runs of earlier versions load, compare and are resumed."""

import multiprocessing
import warnings
from dataclasses import asdict

import h5py
import numpy as np
import pytest
from old_files import make_old, old_settings

import apt_evap as ae
from apt_evap.simulation.old_settings import upgraded
from apt_evap.simulation.run_hdf5 import is_run, plain, read_state, write_state


def simulation():
    tip = ae.Tip("Ni", apex_radius=1.5, axis=(1, 1, 1), shank_length=1.5)
    return ae.Simulation(tip, seed=5, n_threads=1)


def run(path, n_ions, **options):
    return simulation().run(n_ions, progress=False, batch_size=30, checkpoint=ae.Checkpoint(path, minutes=0, **options))


@pytest.fixture
def saved(tmp_path):
    """A run of 60 ions, and its file as an earlier version would have written it."""
    new = run(tmp_path / "run.h5", 60)
    make_old(tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5") as file:
        assert file["entry1/simulation/fields"].fletcher32 and b"most_steps" in file.attrs["settings"]
    return new


def test_settings_are_those_of_today():
    today = plain(simulation().settings)
    assert upgraded(old_settings(today)) == today
    assert upgraded(today) == today


def test_settings_of_ones_own_stay():
    law = {"name": "Mine", "repr": "Mine()"}
    own = {"law": law, "rule": "Mine", "seed": 1}
    assert upgraded(own) == own | {"control": None, "pulse_length": None}


def test_an_old_run_is_loaded(saved, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        old = ae.load(tmp_path / "run.h5")
    assert plain(saved.settings) == old.settings and is_run(tmp_path / "run.h5")
    assert old.perturbations == saved.perturbations and old.elements == saved.elements
    for name in ("site", "species", "charges", "fields"):
        assert np.array_equal(getattr(old, name), getattr(saved, name))
    for one, two in zip(
        (*old.responses.columns.values(), *old.history),
        (*saved.responses.columns.values(), *saved.history),
        strict=True,
    ):
        assert np.array_equal(one, two, equal_nan=True)
    for name, value in asdict(saved.state).items():
        if name == "rule_state":
            value, there = value["potential_point"], old.state.rule_state["potential_point"]
        else:
            there = getattr(old.state, name)
        assert np.array_equal(value, there), name


def test_an_old_run_is_resumed(saved, tmp_path):
    run(tmp_path / "run.h5", 90, resume=True)
    whole = run(tmp_path / "whole.h5", 90)
    resumed = ae.load(tmp_path / "run.h5")
    assert np.array_equal(resumed.charges, whole.charges) and np.array_equal(resumed.fields, whole.fields)
    assert resumed.settings == plain(whole.settings)
    columns = resumed.responses.columns, whole.responses.columns
    assert all(map(np.array_equal, *(each.values() for each in columns)))


def test_an_old_unfinished_run_is_resumed(tmp_path, monkeypatch):
    class Breaking(ae.Unperturbed):
        breaks = True

        def launch(self, emissions, random):
            if self.breaks and emissions.ions[-1] > 60:
                raise RuntimeError("broken on purpose")
            return super().launch(emissions, random)

        def __repr__(self):
            return "Breaking()"

    options = {"responses": False, "progress": False, "batch_size": 30}
    checkpoint = ae.Checkpoint(tmp_path / "run.h5", minutes=0, resume=True)
    with pytest.raises(ae.RunInterrupted):
        simulation().run(90, [Breaking()], checkpoint=checkpoint, **options)
    files = sorted((tmp_path / "run.h5.unfinished").glob("*.h5"))
    assert {path.name for path in files} > {"state.h5"}
    for path in files:
        make_old(path)
    assert len(ae.load(tmp_path / "run.h5.unfinished")) == checkpoint.ions_there() == 60
    monkeypatch.setattr(Breaking, "breaks", False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        resumed = simulation().run(90, [Breaking()], checkpoint=checkpoint, **options)
    whole = simulation().run(90, [Breaking()], **options)
    assert np.array_equal(resumed.charges, whole.charges)
    assert np.array_equal(resumed.flown[0].directions, whole.flown[0].directions, equal_nan=True)


def test_a_damaged_old_run_costs_its_chunks_only(tmp_path):
    whole = run(tmp_path / "run.h5", 60)
    make_old(tmp_path / "run.h5", rows=60)
    with h5py.File(tmp_path / "run.h5") as file:
        place = file["entry1/simulation/fields"].id.get_chunk_info(0).byte_offset
    content = bytearray((tmp_path / "run.h5").read_bytes())
    content[place] ^= 1
    (tmp_path / "run.h5").write_bytes(content)
    with pytest.raises(ae.FileError, match="partial=True reads the undamaged ions"):
        ae.load(tmp_path / "run.h5")
    with pytest.warns(ae.DataWarning, match="60 of 60 ions are lost"):
        assert len(ae.load(tmp_path / "run.h5", partial=True)) == 0
    assert len(whole) == 60


def test_an_old_index_that_lost_a_chunk_is_noticed(saved, tmp_path):
    """HDF5 reads zeros where its index does not know of a chunk."""
    with h5py.File(tmp_path / "run.h5", "a") as file:
        values, place = file["entry1/simulation/neighbours"], "entry1/simulation/neighbours"
        shape, dtype = values.shape, values.dtype
        del file[place]
        file.create_dataset(place, shape, dtype, chunks=shape, fletcher32=True)
    with pytest.raises(ae.FileError, match=r"run\.h5' as a run: entry1/simulation/neighbours is incomplete"):
        ae.load(tmp_path / "run.h5")


def read_all_with_zeros(path, step):
    whole = path.read_bytes()
    expected = read_state(path)[0]
    for place in range(0, len(whole), step):
        path.write_bytes(whole[:place] + bytes(47) + whole[place + 47 :])
        try:
            state, _ = read_state(path)
        except ae.FileError:
            continue
        assert len(state.lonely) == len(expected.lonely) and state.charges.shape == expected.charges.shape


def test_damaged_indices_of_old_states_crash_nothing(tmp_path):
    """HDF5 reads beyond its memory at some of these places, were it asked for the values at once."""
    state = simulation().run(60, responses=False, progress=False).state
    write_state(tmp_path / "state.h5", state, 0)
    make_old(tmp_path / "state.h5")
    child = multiprocessing.get_context("fork").Process(target=read_all_with_zeros, args=(tmp_path / "state.h5", 8))
    child.start()
    child.join()
    assert child.exitcode == 0
