"""HDF5 files of PyCCAPT, of the instrument and of the calibration."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from ion_files import pyccapt_calibrated, pyccapt_instrument

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.detection.hits import Hits
from apt_evap.io.formats import read, write
from apt_evap.warnings import DataWarning


def test_every_column_of_the_instrument(tmp_path):
    columns = pyccapt_instrument(tmp_path / "a.h5")
    hits = read(tmp_path / "a.h5")
    np.testing.assert_array_equal(hits.x, 10 * columns["x"])  # cm
    np.testing.assert_array_equal(hits.y, 10 * columns["y"])
    for name, of in (("time_of_flight", "t"), ("voltage", "high_voltage"), ("pulse_voltage", "voltage_pulse")):
        np.testing.assert_array_equal(getattr(hits, name), columns[of])
    assert hits.pulse_id.tolist() == [0, 0, 1, 1, 2, 2, 3, 3] and (hits.multiplicity == 2).all()
    assert list(hits.extra) == ["start_counter"] and hits.extra["start_counter"][0] == 100  # no laser
    assert hits.mass_to_charge is None and hits.positions is None and hits.source.endswith("a.h5")
    assert hits.map(bins=8).counts.sum() == 8
    some = read(tmp_path / "a.h5", columns=("x", "multiplicity"))
    assert some.columns == ("x", "multiplicity") and some.extra == {}


def test_names_and_shapes_of_other_versions(tmp_path):
    n = 8
    changes = {"voltage_pulse": None, "pulse": np.full((n, 1), 7.0), "laser_pulse": None}
    changes |= {"laser_intensity": np.full(n, 3.0), "start_counter": np.zeros(n, "u8"), "x": np.ones((n, 1), "f4")}
    pyccapt_instrument(tmp_path / "a.h5", **changes)
    hits = read(tmp_path / "a.h5")
    assert (
        (hits.pulse_voltage == 7).all()
        and (hits.extra["laser_pulse"] == 3).all()
        and hits.units == {"laser_pulse": "pJ"}
    )
    assert hits.pulse_id is None and hits.multiplicity is None
    assert hits.x.dtype == np.float32 and (hits.x == 10).all()


CALIBRATED = {
    "x (nm)": np.arange(4.0),
    "y (nm)": np.arange(4.0) + 1,
    "z (nm)": np.arange(4.0) + 2,
    "mc (Da)": np.arange(4.0) + 20,
    "mc_uc (Da)": np.arange(4.0) + 21,
    "high_voltage (V)": np.full(4, 4e3),
    "pulse_v (V)": np.full(4, 800.0),
    "pulse_l (pJ)": np.zeros(4),
    "t (ns)": np.full(4, 500.0),
    "t_c (ns)": np.zeros(4),
    "x_det (cm)": np.arange(4.0) - 2,
    "y_det (cm)": np.arange(4.0) - 1,
    "multi": np.ones(4, int),
    "start_counter": np.array([5, 6, 6, 8]),
}


def test_every_column_of_a_calibration(tmp_path):
    pyccapt_calibrated(tmp_path / "a.h5", CALIBRATED)
    hits = read(tmp_path / "a.h5")
    assert hits.x.tolist() == [-20, -10, 0, 10] and hits.y.tolist() == [-10, 0, 10, 20]
    assert hits.positions.tolist() == [[k, k + 1, k + 2] for k in range(4)]
    assert hits.mass_to_charge.tolist() == [20, 21, 22, 23]
    assert (hits.voltage == 4000).all() and (hits.pulse_voltage == 800).all() and (hits.time_of_flight == 500).all()
    assert hits.pulse_id.tolist() == [0, 1, 1, 2] and hits.multiplicity.tolist() == [1, 2, 2, 1]
    assert set(hits.extra) == {"uncalibrated_mass_to_charge", "start_counter", "multi"}


def test_columns_of_steps_that_were_not_done_are_absent(tmp_path):
    zero = dict.fromkeys(("x (nm)", "y (nm)", "z (nm)", "mc (Da)", "mc_uc (Da)"), np.zeros(4))
    pyccapt_calibrated(tmp_path / "a.h5", CALIBRATED | zero)
    hits = read(tmp_path / "a.h5")
    assert hits.positions is None and hits.mass_to_charge is None and hits.x is not None
    pyccapt_calibrated(tmp_path / "a.h5", CALIBRATED | {"mc_c (Da)": np.full(4, 27.0)})
    assert (read(tmp_path / "a.h5").mass_to_charge == 27).all()  # earlier versions: mc was not calibrated


def test_refusals(tmp_path):
    path = tmp_path / "a.h5"

    def refused(message):
        with pytest.raises(FileError, match=rf"a\.h5'.*{message}"):
            read(path)

    pyccapt_instrument(path, x=None)
    refused("has no detector coordinates of PyCCAPT")
    pyccapt_instrument(path, y=np.zeros(3))
    refused("columns of PyCCAPT must have equal lengths")
    pyccapt_instrument(path, x=np.zeros((8, 2)))
    refused("dld/x must have one value per ion")
    pyccapt_instrument(path, x=np.full(8, b"text"))
    refused(r"dld/x must contain numbers, got \|S4")
    pyccapt_instrument(path, x=np.empty(0), y=np.empty(0), t=None, high_voltage=None, start_counter=None,
                       voltage_pulse=None, laser_pulse=None)  # fmt: skip
    assert len(read(path)) == 0
    pyccapt_calibrated(path, {"mc_low": np.ones(3), "mc (Da)": np.ones(3)})
    refused("contains the mass ranges of PyCCAPT, expected its ions")
    pyccapt_instrument(path)
    with h5py.File(path, "a") as file:
        del file["dld/x"]
        file.create_dataset("dld/x", data=np.zeros(8), chunks=(8,), scaleoffset=3)
    refused("dld/x is compressed or filtered: h5repack -f NONE writes a copy that is not")
    with h5py.File(path, "a") as file:
        del file["dld/x"]
        file["dld/x"] = h5py.ExternalLink("other.h5", "x")
    refused("dld/x is a link: data outside the file are not read")


@pytest.mark.parametrize("name", ["x", "y", "t"])
def test_raw_counts_are_refused(tmp_path, name):
    pyccapt_instrument(tmp_path / "a.h5", **{name: np.arange(8, dtype="i4") * 300})
    with pytest.raises(FileError, match=r"a\.h5': \w+ are integers, raw counts of the detector, expected cm and ns"):
        read(tmp_path / "a.h5")
    with pytest.raises(FileError, match="raw counts"):
        read(tmp_path / "a.h5", columns="voltage")
    pyccapt_calibrated(tmp_path / "b.h5", CALIBRATED | {"x_det (cm)": np.arange(4)})
    with pytest.raises(FileError, match="raw counts"):
        read(tmp_path / "b.h5")


def test_the_multiplicity_of_a_calibration(tmp_path):
    without = {name: values for name, values in CALIBRATED.items() if name != "start_counter"}
    for numbers in ([1, 2, 0, 1], [1, 2, 2, 1]):  # for the first ion of a pulse, or for all
        pyccapt_calibrated(tmp_path / "a.h5", without | {"multi": np.array(numbers), "delta_p": np.array([5, 2, 0, 1])})
        hits = read(tmp_path / "a.h5")
        assert hits.pulse_id.tolist() == [0, 1, 1, 2] and hits.multiplicity.tolist() == [1, 2, 2, 1]
        assert hits.pulses.tolist() == [5, 2, 0, 1] and "multi" not in hits.extra
    pyccapt_calibrated(tmp_path / "a.h5", without | {"multi": np.array([1, 3, 1, 1])})
    hits = read(tmp_path / "a.h5")
    assert hits.pulse_id is None and hits.extra["multi"].tolist() == [1, 3, 1, 1]


def test_a_table_of_pandas_is_named(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["df/table"] = np.zeros(3, [("index", "i8"), ("values_block_0", "f8", 4)])
    with pytest.raises(FileError, match=r"a\.h5' contains a table of pandas .*, expected format='fixed'"):
        read(tmp_path / "a.h5")


def ions(n=300):
    random = np.random.default_rng(4)
    x, y, volts, pulse, mass, times = (random.uniform(low, high, n).astype("f4") for low, high in BOUNDS)
    return Hits(
        x=x, y=y, voltage=volts, pulse_voltage=pulse, mass_to_charge=mass, time_of_flight=times,
        positions=random.normal(size=(n, 3)).astype("f4"), pulses=random.integers(0, 50, n).astype("u4"),
        pulse_id=np.arange(n) // 2, multiplicity=np.full(n, 2),
    )  # fmt: skip


BOUNDS = ((-30, 30), (-30, 30), (3e3, 5e3), (500, 800), (10, 60), (300, 900))


def test_what_is_written_is_read_back(tmp_path):
    hits = ions()
    write(tmp_path / "a.h5", hits)
    again = read(tmp_path / "a.h5")
    assert set(again.columns) == set(hits.columns)
    for name in hits.columns:  # cm and mm differ by a rounding of float64
        values = getattr(hits, name)
        np.testing.assert_array_equal(getattr(again, name).astype(values.dtype), values, name)
    assert again.extra["start_counter"].tolist() == (hits.pulse_id + 1).tolist()
    kept = replace(hits, extra={"start_counter": np.arange(300) // 2 + 7, "laser_pulse": np.full(300, 2.5)})
    write(tmp_path / "b.h5", kept)
    assert read(tmp_path / "b.h5").extra["start_counter"].tolist() == kept.extra["start_counter"].tolist()
    assert (read(tmp_path / "b.h5").extra["laser_pulse"] == 2.5).all()


def test_pandas_reads_what_is_written(tmp_path):
    """As PyCCAPT does: columns, types and values are those of a table that pandas itself has written."""
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("tables")
    hits = ions()
    write(tmp_path / "a.h5", hits)
    table = pandas.read_hdf(tmp_path / "a.h5", mode="r")
    names = (*[name for name in CALIBRATED if name not in ("multi", "start_counter")], "delta_p", "multi")
    assert list(table.columns) == [*names, "start_counter"]
    assert table.dtypes.astype(str).tolist() == 12 * ["float64"] + 3 * ["int64"]
    np.testing.assert_array_equal(table["mc (Da)"], hits.mass_to_charge)
    np.testing.assert_allclose(table["x_det (cm)"], hits.x / 10, rtol=1e-7)
    np.testing.assert_array_equal(table[["x (nm)", "y (nm)", "z (nm)"]], hits.positions)
    assert (table["multi"] == 2).all() and (table["mc_uc (Da)"] == 0).all()
    table.to_hdf(tmp_path / "b.h5", key="df", mode="w")
    one, two = read(tmp_path / "a.h5"), read(tmp_path / "b.h5")
    assert one.columns == two.columns
    assert all(np.array_equal(getattr(one, name), getattr(two, name)) for name in one.columns)


def test_a_run_is_not_replaced_by_ions(tmp_path, small_tip):
    run = ae.Simulation(small_tip, seed=1, n_threads=1).run(3)
    run.save(tmp_path / "a.h5")
    before = (tmp_path / "a.h5").read_bytes()
    with pytest.raises(FileError, match=r"a\.h5' is a run, which ions do not replace"):
        write(tmp_path / "a.h5", ions())
    assert (tmp_path / "a.h5").read_bytes() == before
    write(tmp_path / "b.h5", ions())
    write(tmp_path / "b.h5", ions(20))
    assert len(read(tmp_path / "b.h5")) == 20
    with pytest.raises(ValueError, match="x"):
        write(tmp_path / "c.h5", Hits(mass_to_charge=[1.0]))


def test_a_start_counter_that_decreases_is_warned_of(tmp_path):
    counter = np.array([5, 5, 6, 6, 2, 2, 7, 7])
    pyccapt_instrument(tmp_path / "a.h5", start_counter=counter)
    with pytest.warns(DataWarning, match="pulses uncertain.*the number decreases at 1 rows"):
        assert read(tmp_path / "a.h5").pulse_id.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
