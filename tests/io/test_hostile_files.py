"""Files that are damaged or odd: one sentence with the file and the line, or what is right with a warning."""

import bz2
import gzip
import lzma
from dataclasses import replace

import h5py
import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common import nexus
from apt_evap.io import chunks, read_map, read_ranges
from apt_evap.warnings import DataWarning


def written(path, numbers):
    with h5py.File(path, "w") as file:
        hits = file.create_dataset(nexus.HITS, data=np.arange(2.0 * len(numbers)).reshape(-1, 2))
        hits.attrs["units"] = "mm"
        file.create_dataset(f"{nexus.PULSER}/pulse_number", data=numbers)
    return path


@pytest.mark.parametrize(
    ("numbers", "pulses", "ions", "warning"),
    [
        (np.array([5, 5, 6, 5, 5], "u4"), [0, 0, 1, 2, 2], [2, 2, 1, 2, 2], "decreases at 1 rows"),
        (np.array([2**63, 2**63 + 1, 3, 4, 5], "u8"), [0, 1, 2, 3, 4], [1] * 5, None),
        (np.array([2**63, 2**63, 2**63 + 7], "u8"), [0, 0, 1], [2, 2, 1], None),
        (np.array([2**32 - 1, 2**32 - 1, 0, 1], "u4"), [0, 0, 1, 2], [2, 2, 1, 1], None),  # wraps around
        (np.array([3, 3, 9], "i4"), [3, 3, 9], [2, 2, 1], None),
        (np.zeros(5, "u4"), None, None, "pulses unknown"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_pulse_numbers_of_others(tmp_path, numbers, pulses, ions, warning):
    path = written(tmp_path / "a.nxs", numbers)
    if warning is None:
        hits = ae.read(path)
    else:
        with pytest.warns(DataWarning, match=warning):
            hits = ae.read(path)
    assert (hits.pulse_id is None) == (pulses is None)
    if pulses is not None:
        assert hits.pulse_id.tolist() == pulses and hits.multiplicity.tolist() == ions


IONS = ae.Hits(
    x=np.linspace(-30, 30, 200), y=np.linspace(20, -20, 200), mass_to_charge=np.full(200, 28.0),
    voltage=np.linspace(4000, 5000, 200), positions=np.random.default_rng(1).random((200, 3)),
)  # fmt: skip


@pytest.mark.parametrize(
    ("wrap", "what"),
    [
        (gzip.compress, "is compressed by gzip: decompress it"),
        (bz2.compress, "is compressed by bzip2: decompress it"),
        (lzma.compress, "is compressed by xz: decompress it"),
        (lambda data: b"<!DOCTYPE html>\n<html>404</html>", "is a page of the web"),
        (lambda data: b"version https://git-lfs.github.com/spec/v1\noid sha256:4d\n", "is a pointer of Git LFS"),
    ],
)
@pytest.mark.parametrize("suffix", [".pos", ".epos", ".raw"])
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_what_is_no_file_of_ions_says_what_it_is(tmp_path, suffix, wrap, what):
    path = tmp_path / f"a{suffix}"
    ae.write(tmp_path / "ions.epos", IONS)
    path.write_bytes(wrap((tmp_path / "ions.epos").read_bytes()))
    with pytest.raises(ae.FileError, match=f"a{suffix}' {what}"):
        ae.read(path, partial=True)


def test_numbers_that_begin_like_a_compression_are_read(tmp_path):
    rows = np.full((3, 8), 5.0, "<f4")
    rows[0, 0] = np.array([0x459C8B1F], "<u4").view("<f4")[0]  # 5,009 V, the bytes 1f 8b 9c 45
    rows.tofile(tmp_path / "a.raw")
    assert ae.read(tmp_path / "a.raw", columns="voltage").voltage[0] == rows[0, 0]


@pytest.mark.filterwarnings("error")
def test_negative_voltages_are_not_those_of_kilovolts(tmp_path):
    pulses = {"pulse_id": np.arange(200), "multiplicity": np.ones(200, int)}
    ae.write(tmp_path / "a.epos", replace(IONS, voltage=-IONS.voltage, **pulses))
    assert ae.read(tmp_path / "a.epos").voltage.max() == -4000


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.filterwarnings("ignore:.*is without the columns")
def test_coordinates_in_other_units_are_doubted(tmp_path, factor):
    ae.write(tmp_path / "a.csv", replace(IONS, x=IONS.x * factor, y=IONS.y * factor))
    with pytest.warns(DataWarning, match="are they in mm?"):
        ae.read(tmp_path / "a.csv")


def test_chunks_name_the_format_that_was_given(tmp_path):
    path = written(tmp_path / "c.nxs", np.arange(3))
    with pytest.raises(ae.FileError, match=r"the format \.nxs does not support it"):
        chunks(path, 10)


@pytest.mark.parametrize("name", ["oxi\0de", "a\x07b"])
def test_a_control_character_in_a_name_is_an_error_of_the_file(tmp_path, name):
    path = tmp_path / "d.rrng"
    path.write_bytes(f"[Ions]\nNumber=1\nIon1=Si\n[Ranges]\nNumber=1\nRange1=13.8 14.2 Name:{name} Si:1\n".encode())
    with pytest.raises(ae.FileError, match=r"d\.rrng', line 6: names of species"):
        read_ranges(path)


def test_a_gap_of_numbered_ranges_is_not_silent(tmp_path):
    path = tmp_path / "e.rrng"
    path.write_text("[Ions]\nIon1=Si\n[Ranges]\nRange1=13.8 14.2 Si:1\nRange4=15.8 16.2 Si:1\n")
    with pytest.warns(DataWarning, match=r"e\.rrng', line 5: .*without Range2"):
        assert len(read_ranges(path)) == 2


def test_a_damaged_map_is_one_short_sentence(tmp_path):
    path = tmp_path / "m.npz"
    np.savez(path, counts=np.ones((4, 4)), x_edges_mm=np.arange(5.0), y_edges_mm=np.arange(5.0))
    content, random, refused = path.read_bytes(), np.random.default_rng(1), 0
    for _ in range(200):
        damaged = bytearray(content)
        for place in random.integers(len(content), size=4):
            damaged[place] = random.integers(256)
        path.write_bytes(damaged)
        try:
            read_map(path)
        except ae.FileError as error:
            text, refused = str(error).replace(str(tmp_path), ""), refused + 1
            assert "m.npz" in text and text.isprintable() and len(text) < 250
    assert refused > 50
