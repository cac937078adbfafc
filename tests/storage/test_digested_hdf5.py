"""Run and state files: no damage goes unnoticed, nothing outside of them is read, and HDF5 sees no damaged index."""

import json
import os
import shutil
from contextlib import contextmanager
from dataclasses import replace

import h5py
import numpy as np
import pytest

import apt_evap as ae
from apt_evap.simulation.run_hdf5 import count_ions, is_run, read_state, write_state
from apt_evap.storage import digested_hdf5

SIMULATION = "entry1/simulation"


@pytest.fixture(scope="module")
def run():
    tip = ae.Tip("Ni", apex_radius=1.5, axis=(1, 1, 1), shank_length=1.5)
    settings = ae.evaporation.ChargeSettings(sweep_interval=20)
    monitor = ae.simulation.Monitor(interval=20)
    simulation = ae.Simulation(tip, seed=5, n_threads=1, charge_settings=settings, monitor=monitor)
    return simulation.run(60, [ae.RollUp(0.2)], progress=False)


@pytest.fixture
def path(run, tmp_path):
    run.save(tmp_path / "run.h5")
    return tmp_path / "run.h5"


@pytest.fixture
def state_path(run, tmp_path):
    write_state(tmp_path / "state.h5", run.state, 0)
    return tmp_path / "state.h5"


@contextmanager
def edited(path):
    """Edit a file with h5py and give it a digest that matches, as an attacker could."""
    tail = digested_hdf5.tail_of(path)
    with open(path, "r+b") as file:
        file.truncate(path.stat().st_size - digested_hdf5._TAIL.size)
    with h5py.File(path, "a") as file:
        yield file
    with open(path, "r+b") as file:
        size = file.seek(0, os.SEEK_END)
        end = digested_hdf5._end(size, tail)
        file.write(digested_hdf5._digest(file, size, end) + end)


def changed(path, place, bits=0x80):
    content = bytearray(path.read_bytes())
    content[place] ^= bits
    path.write_bytes(content)


def refused(path, match=r"\.h5' is damaged", reader=ae.load):
    with pytest.raises(ae.FileError, match=match):
        reader(path)


# ---- any damage ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["run", "state"])
def test_every_changed_byte_is_noticed(path, state_path, kind):
    target, reader = (path, ae.load) if kind == "run" else (state_path, read_state)
    reader(target)
    whole = target.read_bytes()
    for place in np.unique(np.linspace(0, len(whole) - 1, 400).astype(int)):
        content = bytearray(whole)
        content[place] ^= 1 << (place % 8)
        target.write_bytes(content)
        refused(target, reader=reader)


@pytest.mark.parametrize("kind", ["run", "state"])
def test_zeros_cuts_and_insertions_are_noticed(path, state_path, kind):
    target, reader = (path, ae.load) if kind == "run" else (state_path, read_state)
    whole = target.read_bytes()
    random = np.random.default_rng(1)
    for _ in range(100):
        place, length = int(random.integers(len(whole))), int(random.integers(1, 600))
        after = whole[place + length :]
        zeros = whole[:place] + bytes(len(whole) - place - len(after)) + after
        for mutant in (
            zeros,
            whole[:place],
            whole[:place] + random.bytes(length) + whole[place:],
            whole[:place] + after,
        ):
            if mutant != whole:
                target.write_bytes(mutant)
                with pytest.raises(ae.FileError):
                    reader(target)


def test_a_lost_end_is_noticed(path):
    with open(path, "r+b") as file:
        file.truncate(path.stat().st_size - 1)
    refused(path, "is damaged, or was changed by another program: its digest is missing")


def test_a_file_that_another_program_changed(path):
    with h5py.File(path, "a") as file:
        settings = json.loads(file.attrs["settings"])
        file.attrs["settings"] = json.dumps(settings | {"voltage": 9000.0})
    refused(path, "was changed by another program: its digest is missing")


def test_other_programs_read_it(path, run):
    with h5py.File(path) as file:
        assert file.attrs["format"] == b"apt_evap run 1"
        assert np.array_equal(file[f"{SIMULATION}/fields"], run.fields)
        assert np.array_equal(file[f"{SIMULATION}/history/flagged"], run.history.flagged)
    assert path.read_bytes()[:8] == b"\x89HDF\r\n\x1a\n"


def test_the_number_of_ions_is_known_without_reading_them(path, monkeypatch):
    monkeypatch.setattr(digested_hdf5.h5py, "File", None)
    assert count_ions(path) == 60 and digested_hdf5.tail_of(path) == ("run", 60, "")


def test_a_number_of_ions_that_differs_is_noticed(path):
    changed(path, path.stat().st_size - digested_hdf5._TAIL.size + 40)
    refused(path)


# ---- what is a run -------------------------------------------------------------------------------------------------


def test_a_damaged_run_is_a_run(path):
    changed(path, 100)
    assert is_run(path)


def test_other_files_are_none(path, state_path, tmp_path):
    assert is_run(path) and not is_run(state_path)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = "apt_evap run 1"
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "text.h5").write_text("apt_evap run 1")
    for name in ("other.h5", "pipe.h5", "text.h5", "missing.h5", "."):
        assert not is_run(tmp_path / name)
    refused(tmp_path / "other.h5", "is not a run")
    refused(state_path, "is not a run")


def test_a_run_of_another_format(path):
    with edited(path) as file:
        file.attrs.create("format", b"apt_evap run 9", dtype=h5py.string_dtype("utf-8", 14))
    refused(path, "another format")


# ---- what does not fit, in files with a digest that matches --------------------------------------------------------


def with_dataset(path, name, values):
    with edited(path) as file:
        del file[f"{SIMULATION}/{name}"]
        file[f"{SIMULATION}/{name}"] = values


@pytest.mark.parametrize(
    "name, change, match",
    [
        (
            "charges",
            lambda values: np.stack([values, values], axis=1),
            r"charges must have shape \(60\), got \(60, 2\)",
        ),
        ("fields", lambda values: values.astype("S5"), r"fields must contain float64, got \|S5"),
        ("species", lambda values: values + 9, "species must be 0 to 0"),
        ("species", lambda values: values - 1, "species must be 0 to 0"),
        ("responses/site", lambda values: values[:, :, :5], r"site must have shape \(60, 3, 15\), got \(60, 3, 5\)"),
        ("site", lambda values: values[:-5], r"site must have shape \(60\), got \(55,\)"),
        ("flown/0/times", lambda values: values[:-5], r"times must have shape \(60\), got \(55,\)"),
        ("history/field", lambda values: values[:-1], "field must have shape"),
        ("state/lonely_normals", lambda values: np.zeros((0, 2)), r"lonely_normals must have shape \(any, 3\)"),
        ("masses", lambda values: h5py.Empty("f8"), "masses must have shape"),
    ],
)
def test_shapes_and_types_that_do_not_fit(path, name, change, match):
    with h5py.File(path) as file:
        values = change(file[f"{SIMULATION}/{name}"][()])
    with_dataset(path, name, values)
    refused(path, match)


def test_external_storage_is_refused(path, tmp_path):
    (tmp_path / "secret").write_bytes(bytes(8 * 60))
    with edited(path) as file:
        del file[f"{SIMULATION}/charges"]
        place = [(str(tmp_path / "secret"), 0, 8 * 60)]
        file.create_dataset(f"{SIMULATION}/charges", (60,), "f8", external=place)
    refused(path, "charges is in another file: data outside the file are not read")


def test_virtual_datasets_are_refused(path, tmp_path):
    other = tmp_path / "other.h5"
    shutil.copy(path, other)
    layout = h5py.VirtualLayout((60,), "f8")
    layout[:] = h5py.VirtualSource(str(other), f"{SIMULATION}/charges", (60,))
    with edited(path) as file:
        del file[f"{SIMULATION}/charges"]
        file.create_virtual_dataset(f"{SIMULATION}/charges", layout)
    refused(path, "charges is in another file")


@pytest.mark.parametrize("name", [f"{SIMULATION}/charges", SIMULATION, f"{SIMULATION}/state"])
def test_links_are_refused(path, tmp_path, name):
    other = tmp_path / "other.h5"
    shutil.copy(path, other)
    for link in (h5py.ExternalLink(str(other), name), h5py.SoftLink("/elsewhere")):
        with edited(path) as file:
            if "elsewhere" in file:
                del file[name]
            else:
                file.move(name, "elsewhere")
            file[name] = link
        refused(path, "is a link: data outside the file are not read")


def test_the_size_is_asked_first(path):
    with edited(path) as file:
        for name in ("charges", "fields"):
            del file[f"{SIMULATION}/{name}"]
            file.create_dataset(f"{SIMULATION}/{name}", (2**40,), "f8", chunks=(1000,))
        place = "entry1/atom_probe/hit_spatial_filtering/evaporation_id"
        del file[place]
        file.create_dataset(place, (2**40,), "i8", chunks=(1000,))
    refused(path, "1099511627776")


@pytest.mark.parametrize("name", ["settings", "elements", "ended", "provenance", "format"])
def test_texts_that_are_none(path, name):
    with edited(path) as file:
        del file.attrs[name]
        file.attrs[name] = np.arange(3)
    refused(path, r"run\.h5'")


def test_states_that_do_not_fit_are_refused(run, tmp_path):
    for change in ({"tolerance": -1.0}, {"clipped": -5}, {"charges": np.zeros((2, 2))}, {"sites": np.zeros(3)}):
        write_state(tmp_path / "state.h5", replace(run.state, **change), 0)
        refused(tmp_path / "state.h5", r"state\.h5' as a state", read_state)


# ---- writing -------------------------------------------------------------------------------------------------------


def test_the_state_comes_back(run, state_path):
    state, first_event = read_state(state_path)
    assert first_event == 0 and state.deepened == run.state.deepened
    for name in ("sites", "charges", "lonely", "lonely_normals"):
        assert np.array_equal(getattr(state, name), getattr(run.state, name))
    assert np.array_equal(state.rule_state["potential_point"], run.state.rule_state["potential_point"])


@pytest.mark.parametrize("locking", [None, True, False, "best-effort"])
def test_a_file_that_this_process_has_open_is_read(path, run, locking):
    with h5py.File(path, "r", locking=locking):
        assert ae.load(path).fingerprint() == ae.read(path).fingerprint() == run.fingerprint()
