import numpy as np
import pytest
from ion_files import raw

from apt_evap._common.files import FileError, TruncatedFile
from apt_evap.io.formats import chunks, read


@pytest.fixture
def save(tmp_path):
    def save(data, name="a.raw"):
        (tmp_path / name).write_bytes(data)
        return tmp_path / name

    return save


def test_every_column_lands_where_it_belongs(save):
    data, rows = raw([10, 11, 11, 15, 15, 15])
    assert len(data) == 6 * 32
    hits = read(save(data))
    for name in ("voltage", "pulse_voltage", "x", "y", "time_of_flight"):
        np.testing.assert_array_equal(getattr(hits, name), rows[name])
    for name in ("reflectron_voltage", "epoch", "pulse_number"):
        np.testing.assert_array_equal(hits.extra[name], rows[name])
    assert hits.units == {"reflectron_voltage": "V"} and hits.extra["epoch"].tolist() == [-2, -1, 0, 1, 2, 3]
    assert hits.pulse_id.tolist() == [0, 1, 1, 2, 2, 2] and hits.multiplicity.tolist() == [1, 2, 2, 3, 3, 3]
    assert hits[[0, 4]].extra["pulse_number"].tolist() == [10, 15]


def test_the_pulse_number_may_wrap_around(save, recwarn):
    hits = read(save(raw([2**32 - 2, 2**32 - 1, 2**32 - 1, 0, 0, 1])[0]))
    assert hits.pulse_id.tolist() == [0, 1, 1, 2, 2, 3] and not recwarn


def test_pulse_numbers_that_tell_nothing(save):
    with pytest.warns(UserWarning, match=r"a\.raw.*zero for all ions"):
        hits = read(save(raw([0, 0, 0])[0]))
    assert hits.pulse_id is None and hits.multiplicity is None
    with pytest.warns(UserWarning, match=r"a\.raw.*only consecutive ions.*decreases at 1 rows"):
        assert read(save(raw([5, 6, 6, 5])[0])).pulse_id.tolist() == [0, 1, 1, 2]


def test_wrong_files(save):
    data, rows = raw([1, 2, 3])
    with pytest.raises(FileError, match=r"a\.raw.*empty"):
        read(save(b""))
    with pytest.raises(TruncatedFile, match=r"a\.raw.* 2 complete ions of 32 bytes as in a \.raw and 31 further bytes"):
        read(save(data[:-1]))
    assert len(read(save(data[:-1]), partial=True)) == 2
    swapped = rows.byteswap().tobytes()
    with pytest.raises(FileError, match=r"appears to be big-endian .* expected little-endian; byte_order='big'"):
        read(save(swapped))
    np.testing.assert_array_equal(read(save(swapped), byte_order="big").x, rows["x"])


def test_some_columns_only(save):
    data, rows = raw([1, 2, 2])
    hits = read(save(data), columns=("x", "multiplicity", "epoch"))
    assert hits.columns == ("x", "multiplicity") and list(hits.extra) == ["epoch"] and hits.units == {}
    assert hits.multiplicity.tolist() == [1, 2, 2] and hits.x.tolist() == rows["x"].tolist()
    with pytest.raises(FileError, match="no column 'positions'"):
        read(save(data), columns=["positions"])


def test_a_pulse_larger_than_a_chunk(save):
    path = save(raw([1, 2, 2, 2, 3])[0])
    with pytest.raises(ValueError, match="rows"):
        list(chunks(path, 2))
    assert [len(part) for part in chunks(path, 3)] == [1, 3, 1]
