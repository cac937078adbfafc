"""Maps in .npz files."""

import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.io.formats import read

X, Y = np.linspace(-2.0, 2.0, 21), np.linspace(-1.0, 1.0, 11)
COUNTS = np.random.default_rng(1).poisson(5.0, (10, 20)).astype(np.int16)
INSIDE = np.ones((10, 20), bool)
INSIDE[0, :3] = False
DATA = Path(__file__).parents[3] / "shared" / "data"


def test_counts_with_a_mask(tmp_path):
    np.savez(tmp_path / "map.npz", counts=COUNTS, x_edges_cm=X, y_edges_cm=Y, inside=INSIDE)
    map = ae.io.read_map(tmp_path / "map.npz")
    assert map.is_counts and np.array_equal(map.counts, COUNTS) and np.array_equal(map.mask, INSIDE)
    assert map.ions == COUNTS[INSIDE].sum()
    assert map.x_edges == pytest.approx(10 * X) and map.y_edges == pytest.approx(10 * Y)
    assert map.source.endswith("map.npz")
    assert np.array_equal(ae.read(tmp_path / "map.npz").counts, COUNTS)
    suffixes = (
        r"must be one of \.h5, \.nxs, \.epos, \.pos, \.apt, \.raw, \.ato, \.npz, \.csv, \.txt, \.tapsim, "
        r"got suffix '\.py'$"
    )
    with pytest.raises(ae.FileError, match=suffixes):
        ae.read(Path(__file__))


def test_densities_are_nan_outside(tmp_path):
    values = np.where(INSIDE, COUNTS / 7, np.nan)
    np.savez_compressed(tmp_path / "map.npz", relative_density=values, x_edges_mm=X, y_edges_mm=Y)
    map = ae.io.read_map(tmp_path / "map.npz")
    assert not map.is_counts and np.array_equal(map.mask, INSIDE)
    assert np.array_equal(map.values[INSIDE], values[INSIDE]) and np.array_equal(map.x_edges, X)


def test_names_and_unit_can_be_given(tmp_path):
    arrays = {"n": COUNTS, "other": COUNTS * 2, "u": X, "v": Y, "use": INSIDE, "ignore": ~INSIDE}
    np.savez(tmp_path / "map.npz", **arrays)
    names = {"values": "other", "x_edges": "u", "y_edges": "v", "mask": "use"}
    map = ae.io.read_map(tmp_path / "map.npz", unit="um", **names)
    assert np.array_equal(map.values[INSIDE], 2.0 * COUNTS[INSIDE])
    assert map.x_edges == pytest.approx(1e-3 * X)
    with pytest.raises(ae.FileError, match=r"map\.npz.*the unit of u must be one of mm, cm, m, um, name it u_mm"):
        ae.io.read_map(tmp_path / "map.npz", **names)
    with pytest.raises(ae.FileError, match=r"the unit of u must be one of mm, cm, m, um, got 'inch'"):
        ae.io.read_map(tmp_path / "map.npz", unit="inch", **names)
    with pytest.raises(ae.FileError, match=r"must contain an array 'w', it contains n int16\[10, 20\]"):
        ae.io.read_map(tmp_path / "map.npz", unit="mm", **names | {"x_edges": "w"})


@pytest.mark.parametrize(
    "arrays, words",
    [
        ({}, "exactly one array for the values, it contains no array"),
        (
            {"a": COUNTS, "b": COUNTS, "x_edges_mm": X, "y_edges_mm": Y},
            "exactly one array for the values, it contains a int16",
        ),
        ({"counts": COUNTS, "y_edges_mm": Y}, r"exactly one array for the edges in x \(x_edges_mm\)"),
        ({"counts": COUNTS, "x_edges_mm": X[:-1], "y_edges_mm": Y}, r"x_edges must have shape \(21,\), got \(20,\)"),
        ({"counts": -COUNTS, "x_edges_mm": X, "y_edges_mm": Y}, "must be >= 0, got -"),
        ({"counts": np.array([None]), "x_edges_mm": X}, "as an .npz file: Object arrays"),
        ({"counts": COUNTS, "x_edges_mm": X.astype("U9"), "y_edges_mm": Y}, "x_edges_mm must contain numbers, got <U9"),
        ({"counts": COUNTS, "x_edges_mm": X, "y_edges_mm": Y > 0}, "y_edges_mm must contain numbers, got bool"),
        (
            {"counts": COUNTS + np.int64(2**62), "x_edges_mm": X, "y_edges_mm": Y},
            "add up to at most 9007199254740992, got 9.2",
        ),
    ],
)
def test_arrays_that_are_no_map(tmp_path, arrays, words):
    np.savez(tmp_path / "map.npz", **arrays)
    with pytest.raises(ae.FileError, match=rf"map\.npz.*{words}"):
        ae.io.read_map(tmp_path / "map.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED])
def test_damage_in_every_kind_of_compression(tmp_path, method):
    path = tmp_path / "map.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, values in {"counts": COUNTS, "x_edges_mm": X, "y_edges_mm": Y}.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.save(member, values)
    assert np.array_equal(ae.io.read_map(path).counts, COUNTS)
    whole, refused = path.read_bytes(), 0
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            ae.io.read_map(path)
        except ae.FileError:
            refused += 1
    assert refused > len(whole) // 7 // 2


def test_files_that_are_none(tmp_path):
    (tmp_path / "empty.npz").touch()
    np.save(tmp_path / "one.npy", COUNTS)
    for name in ("empty.npz", "one.npy"):
        with pytest.raises(ae.FileError, match=f"{name}.*does not begin like an .npz file"):
            ae.io.read_map(tmp_path / name)
    with pytest.raises(ae.FileError, match="No such file"):
        ae.io.read_map(tmp_path / "none.npz")


@given(place=st.integers(0, 10_000), byte=st.integers(0, 255), length=st.integers(0, 10_000), cut=st.booleans())
def test_damaged_files_are_refused_or_hold_a_map(tmp_path, place, byte, length, cut):
    path = tmp_path / "damaged.npz"
    np.savez_compressed(path, counts=COUNTS, x_edges_mm=X, y_edges_mm=Y, inside=INSIDE)
    whole = bytearray(path.read_bytes())
    whole[place % len(whole)] = byte
    path.write_bytes(whole[: length % len(whole)] if cut else whole)
    try:
        map = ae.io.read_map(path)
    except ae.FileError as error:
        assert "damaged.npz" in str(error)
    else:
        assert map.values.shape == map.mask.shape


@pytest.mark.skipif(not DATA.exists(), reason="no measured data beside the project")
def test_measured_maps():
    nickel = ae.io.read_map(DATA / "ni111_map.npz")
    assert not nickel.is_counts and nickel.values.shape == (113, 105)
    assert nickel.bin_size == pytest.approx((0.348, 0.325), abs=5e-4)
    aluminium = ae.io.read_map(DATA / "al_oxcart_map.npz")
    assert aluminium.is_counts and aluminium.ions == pytest.approx(715_000, rel=1e-3)
    assert aluminium.x_edges[0] == pytest.approx(-26.46, abs=0.01)  # cm in the file


def test_a_shape_larger_than_its_data_takes_no_memory(tmp_path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (40000, 40000), }"
    header += b" " * (53 - len(header) % 64) + b"\n"
    with zipfile.ZipFile(tmp_path / "map.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "counts.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(1 << 20)
        )
    tracemalloc.start()
    try:
        with pytest.raises(ae.FileError, match=r"map\.npz.*\(40000, 40000\)"):
            ae.io.read_map(tmp_path / "map.npz")
        assert tracemalloc.get_traced_memory()[1] < 1 << 24  # a hundredth of the 12 GB of the shape would be too much
    finally:
        tracemalloc.stop()


def test_another_zip_is_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("ions.epos", bytes(440))
    with pytest.raises(FileError, match=r"a\.zip' .*: it is a \.zip archive with 'ions\.epos': unpack it"):
        read(tmp_path / "a.zip")
