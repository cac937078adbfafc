"""Reading some columns, and reading in chunks: the same as reading the whole."""

import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from ion_files import apt, apt_section, epos, ions_of, pos, raw, usual_apt

import apt_evap.io._pulses as pulses_module
import apt_evap.io._records as records_module
from apt_evap._common.files import FileError, TruncatedFile
from apt_evap.io.formats import chunks, read


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Borders of the blocks in which whole files are looked through fall everywhere."""
    monkeypatch.setattr(records_module, "_SURVEY", 5)
    monkeypatch.setattr(pulses_module, "_BLOCK", 3)


def content(suffix, sizes):
    """A file with pulses of these sizes."""
    ions = ions_of(sizes)
    n = len(ions)
    if suffix == ".epos":
        return epos(ions)
    if suffix == ".raw":
        return raw(np.repeat(np.arange(len(sizes)) * 3 + 1, sizes))[0]
    if suffix == ".apt":
        extra = apt_section("pulse", np.arange(n), "")
        return apt([usual_apt(n, ions)[0][540:], extra], n)
    return pos(n)


def assert_joined(parts, whole):
    parts = list(parts)
    assert all(part.columns == whole.columns and part.units == whole.units for part in parts)
    for name in whole.columns:
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))
    for name in whole.extra:
        np.testing.assert_array_equal(np.concatenate([part.extra[name] for part in parts]), whole.extra[name])


@given(
    suffix=st.sampled_from([".epos", ".raw", ".apt", ".pos"]),
    sizes=st.lists(st.integers(1, 4), min_size=1, max_size=15),
    more=st.integers(0, 8),
)
def test_chunks_joined_are_the_whole(tmp_path, suffix, sizes, more):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content(suffix, sizes))
    rows = max(sizes) + more
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = read(path)
        parts = list(chunks(path, rows))
    assert max(len(part) for part in parts) <= rows
    assert_joined(parts, whole)
    if suffix != ".pos":
        assert whole.multiplicity.tolist() == np.repeat(sizes, sizes).tolist()
        assert whole.pulse_id.tolist() == np.repeat(np.arange(len(sizes)), sizes).tolist()
        for part in parts:  # whole pulses, and right within each chunk
            _, inverse, count = np.unique(part.pulse_id, return_inverse=True, return_counts=True)
            assert part.multiplicity.tolist() == count[inverse].tolist()


@given(suffix=st.sampled_from([".epos", ".raw", ".apt", ".pos"]), data=st.data())
def test_some_columns_are_those_of_the_whole(tmp_path, suffix, data):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content(suffix, [1, 3, 2, 1, 2]))
    whole = read(path)
    names = data.draw(st.sets(st.sampled_from([*whole.columns, *whole.extra]), min_size=1))
    some = read(path, columns=names)
    assert {*some.columns, *some.extra} == names
    for name in names:
        pair = [hits.extra[name] if name in hits.extra else getattr(hits, name) for hits in (some, whole)]
        np.testing.assert_array_equal(*pair)
    assert_joined(chunks(path, 3, columns=names), some)


@example(ions=[0, 0, 0, 1])  # a block without a first ion
@given(ions=st.lists(st.integers(0, 3), min_size=1, max_size=12))
def test_the_last_column_is_consistent_where_a_plain_reading_says_so(tmp_path, ions):
    path = tmp_path / "a.epos"
    path.write_bytes(epos(ions))
    expected, at = [], 0
    while at < len(ions) and ions[at] > 0 and ions[at + 1 : at + ions[at]] == [0] * (ions[at] - 1):
        expected += [ions[at]] * ions[at]
        at += ions[at]
    if len(expected) != len(ions):  # or the number for each ion of a pulse
        at = 0
        while at < len(ions) and ions[at] > 0 and ions[at : at + ions[at]] == [ions[at]] * ions[at]:
            at += ions[at]
        expected = ions if at == len(ions) else []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        hits = read(path)
        parts = list(chunks(path, 5))
    if expected and len(expected) == len(ions):
        assert hits.multiplicity.tolist() == expected and not caught
    else:
        assert hits.multiplicity is None and len(caught) == 2
    assert_joined(parts, hits)


@given(sizes=st.lists(st.integers(1, 4), min_size=1, max_size=15), more=st.integers(0, 8), cut=st.integers(0, 1))
def test_numbers_for_every_ion_of_a_pulse(tmp_path, sizes, more, cut):
    path = tmp_path / "a.epos"
    numbers = np.repeat(sizes, sizes).tolist()
    rows = epos(numbers)
    path.write_bytes(rows[:-10] if cut and len(numbers) > 1 else rows)
    whole = read(path, partial=bool(cut))
    kept = len(whole)
    assert whole.multiplicity.tolist() == numbers[:kept]
    assert whole.pulse_id.tolist() == np.repeat(np.arange(len(sizes)), sizes).tolist()[:kept]
    parts = list(chunks(path, max(sizes) + more, partial=bool(cut)))
    assert_joined(parts, whole)
    assert max(map(len, parts)) <= max(sizes) + more


def test_what_is_absent_and_in_kilovolts_is_told_by_the_whole_file(tmp_path):
    rows = np.frombuffer(epos([1] * 6), ">f4").reshape(6, 11).copy()
    rows[:4, 7:9] = 0  # nothing on the detector at first
    rows[:, 4] = 0
    rows[:, 5] = [5, 5, 5, 5, 5, 5000]  # volts, as the last row tells
    path = tmp_path / "a.epos"
    path.write_bytes(rows.tobytes())
    parts = list(chunks(path, 2))
    assert [part.x.any() for part in parts] == [False, False, True] and parts[0].time_of_flight is None
    assert parts[0].voltage.tolist() == [5, 5]
    assert_joined(parts, read(path))
    assert read(path, columns=["pulse_voltage"]).pulse_voltage.max() < 100
    with pytest.raises(FileError, match=r"a\.epos.*no data in time_of_flight"):
        read(path, columns="time_of_flight")
    rows[:, 7] = 0  # all on a line: x is zero and not absent
    path.write_bytes(rows.tobytes())
    assert not read(path, columns="x").x.any()
    assert_joined(chunks(path, 2), read(path))


def test_a_truncated_file_in_chunks(tmp_path):
    path = tmp_path / "a.epos"
    path.write_bytes(epos([1, 3, 0, 0, 2, 0])[:-44])
    with pytest.warns(UserWarning, match="row 4 gives 2 ions"):
        assert read(path).pulse_id is None  # nothing says that the file was cut
    path.write_bytes(epos([1, 3, 0, 0, 2, 0])[:-20])
    with pytest.raises(TruncatedFile):
        list(chunks(path, 3))
    parts = list(chunks(path, 3, partial=True))
    assert [part.multiplicity.tolist() for part in parts] == [[1], [3, 3, 3], [2]]
    assert_joined(parts, read(path, partial=True))


def test_a_pulse_that_claims_to_go_on_for_ever(tmp_path):
    path = tmp_path / "a.epos"
    path.write_bytes(epos([1, 2**32 - 1, 0, 0])[:-4])
    hits = read(path, partial=True)
    assert hits.multiplicity.tolist() == [1, 2**32 - 1, 2**32 - 1] and hits.pulse_id.tolist() == [0, 1, 1]


@pytest.mark.parametrize("suffix", [".epos", ".raw", ".apt"])
def test_chunks_smaller_than_a_pulse(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content(suffix, [1, 4, 1]))
    with pytest.raises(ValueError, match=rf"rows must be >= .*a\{suffix}.*got 3"):
        list(chunks(path, 3))


def test_the_last_pulse_of_a_cut_file_may_be_smaller_than_it_says(tmp_path):
    path = tmp_path / "a.epos"
    path.write_bytes(epos([2, 0, 9, 0]) + bytes(10))
    whole = read(path, partial=True)
    parts = list(chunks(path, 3, partial=True))
    assert [len(part) for part in parts] == [2, 2] and whole.multiplicity.tolist() == [2, 2, 9, 9]
    assert np.concatenate([part.pulse_id for part in parts]).tolist() == whole.pulse_id.tolist() == [0, 0, 1, 1]
    path.write_bytes(epos([2, 0, 9, 0, 0, 0]) + bytes(10))
    with pytest.raises(ValueError, match="rows"):
        list(chunks(path, 3, partial=True))


def test_arguments(tmp_path):
    path = tmp_path / "a.pos"
    path.write_bytes(pos(3))
    for rows in (0, -1, 1.5, True, None):
        with pytest.raises(ValueError, match="rows"):
            chunks(path, rows)
    with pytest.raises(FileError, match="takes partial, byte_order, got 'rows'"):
        read(path, rows=3)
    with pytest.raises(FileError, match=r"a\.pos.*no column 'x', available are positions, mass_to_charge"):
        read(path, columns=("x",))
    for columns in ((), 3, [3]):
        with pytest.raises(FileError, match="no column"):
            read(path, columns=columns)
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(FileError, match=r"a\.h5.*chunks"):
        chunks(tmp_path / "a.h5", 3)
    np.savez(tmp_path / "a.npz", counts=np.ones((3, 3)))
    with pytest.raises(FileError, match=r"\.npz files takes no columns"):
        read(tmp_path / "a.npz", columns=["x"])


def test_memory(tmp_path, monkeypatch):
    monkeypatch.undo()
    n = 200_000
    path = tmp_path / "a.epos"
    path.write_bytes(epos([1] * n))

    def peak(task):
        tracemalloc.start()
        task()
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    # two columns of 4 bytes, and buffers of 2**14 rows of 44 bytes
    assert peak(lambda: read(path, columns=("x", "y"))) < 8 * n + 3 * 44 * 2**14
    assert (
        peak(lambda: [len(part) for part in chunks(path, 1000)]) < 2 * 44 * 2**16
    )  # the rows looked through at once, twice
