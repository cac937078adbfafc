"""HDF5 files: no damage goes unnoticed, and nothing outside of them is read."""

import json
import os
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
from systems import PIPES

import apt_evap as ae
from apt_evap._common.checked_hdf5 import label_of, open_hdf5, put_field, put_text, write_hdf5
from apt_evap.simulation.run_hdf5 import count_ions, is_run

SIMULATION = "entry1/simulation"


@pytest.fixture(scope="session")
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


def refused(path, match=r"\.h5' is damaged", reader=ae.load):
    with pytest.raises(ae.FileError, match=match):
        reader(path)


# ---- any damage ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flips", [20, pytest.param(600, marks=pytest.mark.slow)])
def test_every_changed_bit_is_noticed(path, run, flips):
    """Or it is in a gap of the file, in what only NeXus needs, or one of the five bits that pad a block of deflate."""
    whole, is_read = path.read_bytes(), np.zeros(path.stat().st_size, bool)
    n_same = 0

    def mark(name, item):
        needed = (SIMULATION in name and name != f"{SIMULATION}/perturbation") or name.endswith("evaporation_id")
        if isinstance(item, h5py.Dataset) and item.chunks and needed:
            for chunk in map(item.id.get_chunk_info, range(item.id.get_num_chunks())):
                is_read[chunk.byte_offset : chunk.byte_offset + chunk.size] = True

    with h5py.File(path) as file:
        file.visititems(mark)
    assert is_read.mean() > 0.4
    whole_path = path.with_name("whole.h5")
    whole_path.write_bytes(whole)
    random = np.random.default_rng(1)
    for place in random.integers(len(whole), size=flips):
        content = bytearray(whole)
        content[place] ^= 1 << random.integers(8)
        path.write_bytes(content)
        try:
            other = ae.load(path)
        except ae.FileError as error:
            assert "run.h5' is damaged" in str(error) or "it is not an HDF5 file" in str(error)
        else:
            n_same += is_read[place]
            assert other.fingerprint() == run.fingerprint() and other.settings == run.settings
            assert other.perturbations == ae.load(whole_path).perturbations
            assert other.state.charges.tobytes() == run.state.charges.tobytes() and other.ended == run.ended
    assert n_same <= 1 + flips // 150  # measured: 1 of 600


@pytest.mark.slow
def test_zeros_cuts_and_insertions_are_noticed(path, run):
    """Zeros from the beginning of a chunk to its end as well: their checksum is not zero."""
    whole = path.read_bytes()
    with h5py.File(path) as file:
        chunk = file[f"{SIMULATION}/history/field"].id.get_chunk_info(0)
    random = np.random.default_rng(1)
    places = [(chunk.byte_offset, chunk.size), *random.integers([0, 1], [len(whole), 9000], (100, 2)).tolist()]
    for place, length in places:
        after = whole[place + length :]
        zeros = whole[:place] + bytes(len(whole) - place - len(after)) + after
        inserted = whole[:place] + random.bytes(length) + whole[place:]
        for mutant in (zeros, whole[:place], inserted, whole[:place] + after):
            path.write_bytes(mutant)
            try:
                other = ae.load(path)
            except ae.FileError:
                continue
            assert mutant is not whole and other.fingerprint() == run.fingerprint()
            assert np.array_equal(other.history.field, run.history.field)


def test_rows_of_a_damaged_column_are_refused(tmp_path):
    """When they are read; the rest of the file is."""
    path = tmp_path / "a.h5"
    with write_hdf5(path, "test", 400_000) as file:
        put_field(file, "values", np.arange(400_000.0))
        place = file["values"].id
        put_text(file, "text", "Ü" * 70_000)
    with h5py.File(path) as file:
        place = file["values"].id.get_chunk_info(2).byte_offset
    content = bytearray(path.read_bytes())
    content[place + 100] ^= 1
    path.write_bytes(content)
    with open_hdf5(path) as file:
        assert file.label == ("test", 400_000, "") and file.text("text") == "Ü" * 70_000
        assert np.array_equal(file.read("values", float, (None,), slice(10, 20)), np.arange(10.0, 20.0))
        with pytest.raises(ae.FileError, match=r"a\.h5' is damaged"):
            file.read("values", float, (None,), slice(200_000, 300_000))


def test_other_programs_read_it(path, run):
    with h5py.File(path) as file:
        assert file.attrs["format"] == b"apt_evap run 2"
        assert json.loads(file[f"{SIMULATION}/settings"].asstr()[0]) == json.loads(json.dumps(run.settings))
        assert np.array_equal(file[f"{SIMULATION}/fields"], run.fields)
        assert np.array_equal(file[f"{SIMULATION}/history/flagged"], run.history.flagged)
    assert path.read_bytes()[:8] == b"\x89HDF\r\n\x1a\n"


def test_everything_that_is_read_has_a_checksum(path):
    """Attributes and layouts are in headers, which have one; texts of variable length are for NeXus alone."""

    def check(name, item):
        assert all(isinstance(item.attrs[each], str) for each in item.attrs if each in ("NX_class", "units"))
        if isinstance(item, h5py.Dataset) and item.shape and item.size:
            assert item.compression == "gzip" and not item.dtype.hasobject, name

    with h5py.File(path, libver=("v110", "v110")) as file:
        file.visititems(check)
        assert path.read_bytes()[8] == 3  # version of the superblock: the first with a checksum is 2


def test_the_number_of_ions_is_known_without_reading_them(path):
    assert count_ions(path) == 60 and label_of(path) == ("run", 60, "")


# ---- what is a run -------------------------------------------------------------------------------------------------


def test_a_run_with_a_damaged_column_is_a_run(path):
    content = path.read_bytes()
    with h5py.File(path) as file:
        place = file[f"{SIMULATION}/charges"].id.get_chunk_info(0).byte_offset
    path.write_bytes(content[:place] + bytes(8) + content[place + 8 :])
    assert is_run(path)
    refused(path)


def test_other_files_are_none(path, tmp_path):
    assert is_run(path)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = "apt_evap run 1"
    (tmp_path / "text.h5").write_text("apt_evap run 1")
    for name in ("other.h5", "text.h5", "missing.h5", "."):
        assert not is_run(tmp_path / name)
    refused(tmp_path / "other.h5", "is not a run")


@PIPES
def test_a_pipe_is_none(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    assert not is_run(tmp_path / "pipe.h5")


def test_a_run_of_another_format(path):
    with h5py.File(path, "a") as file:
        file.attrs.create("format", b"apt_evap run 9", dtype=h5py.string_dtype("utf-8", 14))
    refused(path, "is a run of format 9, which this version cannot read: repeat the run")


# ---- what does not fit ---------------------------------------------------------------------------------------------


def with_dataset(path, name, values):
    with h5py.File(path, "a") as file:
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
        ("responses/site", lambda values: values[:, :, :5], r"site must have shape \(60, 3, 46\), got \(60, 3, 5\)"),
        ("site", lambda values: values[:-5], r"site must have shape \(60\), got \(55,\)"),
        ("flown/0/times", lambda values: values[:-5], r"times must have shape \(60\), got \(55,\)"),
        ("history/field", lambda values: values[:-1], "field must have shape"),
        ("state/isolated_normals", lambda values: np.zeros((0, 2)), r"isolated_normals must have shape \(any, 3\)"),
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
    with h5py.File(path, "a") as file:
        del file[f"{SIMULATION}/charges"]
        place = [(str(tmp_path / "secret"), 0, 8 * 60)]
        file.create_dataset(f"{SIMULATION}/charges", (60,), "f8", external=place)
    refused(path, "charges is in another file: data outside the file are not read")


def test_virtual_datasets_are_refused(path, tmp_path):
    other = tmp_path / "other.h5"
    shutil.copy(path, other)
    layout = h5py.VirtualLayout((60,), "f8")
    layout[:] = h5py.VirtualSource(str(other), f"{SIMULATION}/charges", (60,))
    with h5py.File(path, "a") as file:
        del file[f"{SIMULATION}/charges"]
        file.create_virtual_dataset(f"{SIMULATION}/charges", layout)
    refused(path, "charges is in another file")


@pytest.mark.parametrize("name", [f"{SIMULATION}/charges", SIMULATION, f"{SIMULATION}/state"])
def test_links_are_refused(path, tmp_path, name):
    other = tmp_path / "other.h5"
    shutil.copy(path, other)
    for link in (h5py.ExternalLink(str(other), name), h5py.SoftLink("/elsewhere")):
        with h5py.File(path, "a") as file:
            if "elsewhere" in file:
                del file[name]
            else:
                file.move(name, "elsewhere")
            file[name] = link
        refused(path, "is a link: data outside the file are not read")


def test_the_size_is_asked_first(path):
    with h5py.File(path, "a") as file:
        for name in ("charges", "fields"):
            del file[f"{SIMULATION}/{name}"]
            file.create_dataset(f"{SIMULATION}/{name}", (2**40,), "f8", chunks=(1000,))
        place = "entry1/atom_probe/hit_spatial_filtering/evaporation_id"
        del file[place]
        file.create_dataset(place, (2**40,), "i8", chunks=(1000,))
    refused(path, "1099511627776")


@pytest.mark.parametrize("name", ["settings", "elements", "ended", "provenance", "state/numbers"])
@pytest.mark.parametrize("values", [np.arange(1), np.arange(3), [b"\xff"], [b"[[["], [b"5"]])
def test_texts_that_are_none(path, name, values):
    with_dataset(path, name, values)
    if name != "ended" or not isinstance(values, list) or values == [b"\xff"]:
        refused(path, r"run\.h5'")


def test_datasets_without_values_are_refused(path):
    """HDF5 would return zeros."""
    with h5py.File(path, "a") as file:
        del file[f"{SIMULATION}/charges"]
        file.create_dataset(f"{SIMULATION}/charges", (60,), "f8", chunks=(30,))[:30] = 1.0
    refused(path, "charges is incomplete")


def test_states_that_do_not_fit_are_refused(run, path):
    for change in ({"tolerance": -1.0}, {"clipped": -5}, {"charges": np.zeros((2, 2))}, {"sites": np.zeros(3)}):
        replace(run, state=replace(run.state, **change)).save(path)
        refused(path, r"cannot read .*run\.h5' as a run")


# ---- writing -------------------------------------------------------------------------------------------------------


def test_the_state_comes_back(run, path):
    other = ae.load(path)
    state = other.state
    assert other.first_event == 0 and state.extensions == run.state.extensions
    for name in ("sites", "charges", "isolated", "isolated_normals"):
        assert np.array_equal(getattr(state, name), getattr(run.state, name))
    assert np.array_equal(state.rule_state["potential_point"], run.state.rule_state["potential_point"])


@pytest.mark.parametrize("locking", [None, True, False, "best-effort"])
def test_a_file_that_this_process_has_open_is_read(path, run, locking):
    with h5py.File(path, "r", locking=locking):
        assert ae.load(path).fingerprint() == ae.read(path).fingerprint() == run.fingerprint()
