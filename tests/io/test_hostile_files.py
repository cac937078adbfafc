"""Files that are damaged or odd: one sentence with the file and the line, or what is right with a warning."""

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
