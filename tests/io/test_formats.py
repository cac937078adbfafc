import os
import struct
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ion_files import apt, apt_section, epos, ions_of, pyccapt_instrument, raw

from apt_evap._common.files import FileError, TruncatedFile
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.io.formats import FORMATS, chunks, left_out, read, write
from apt_evap.simulation import read_file
from apt_evap.simulation.run import Run
from apt_evap.simulation.simulation import Simulation
from apt_evap.warnings import DataWarning

SILICON = Path(__file__).parents[3] / "shared" / "data" / "Si.epos"


def epos_row(x=1.0, y=2.0, z=-3.0, mass=14.0, time=500.0, v=5000.0, pulse=1000.0, dx=4.0, dy=5.0, pulses=3, ions=1):
    return struct.pack(">9f2I", x, y, z, mass, time, v, pulse, dx, dy, pulses, ions)


def save(path, *rows):
    path.write_bytes(b"".join(rows))
    return path


def test_every_column_of_an_epos_lands_where_it_belongs(tmp_path):
    hits = read(save(tmp_path / "a.epos", epos_row(), epos_row(x=9.0, pulses=0, dy=-5.5)))
    assert hits.positions.tolist() == [[1, 2, -3], [9, 2, -3]]
    assert (hits.x.tolist(), hits.y.tolist()) == ([4, 4], [5, -5.5])
    assert hits.mass_to_charge[0] == 14 and hits.time_of_flight[0] == 500
    assert hits.voltage[0] == 5000 and hits.pulse_voltage[0] == 1000
    assert hits.pulses.tolist() == [3, 0] and hits.multiplicity.tolist() == [1, 1]
    assert hits.source.endswith("a.epos")
    assert all(getattr(hits, name).dtype.isnative for name in hits.columns)


def test_pos(tmp_path):
    hits = read(save(tmp_path / "A.POS", struct.pack(">8f", 1, 2, 3, 58, 4, 5, 6, 29)))
    assert hits.positions.tolist() == [[1, 2, 3], [4, 5, 6]] and hits.mass_to_charge.tolist() == [58, 29]
    assert hits.x is None
    with pytest.raises(ValueError, match=r"A\.POS has no column 'x'"):
        hits.map()


def test_kilovolts_become_volts(tmp_path):
    path = save(tmp_path / "a.epos", epos_row(v=5.5, pulse=1.25))
    with pytest.warns(DataWarning, match=r"a\.epos': voltages of at most 5\.5 are taken for kV"):
        hits = read(path)
    assert hits.voltage.tolist() == [5500] and hits.pulse_voltage.tolist() == [1250]


def test_the_unit_of_voltages_can_be_given(tmp_path):
    low = Hits(voltage=[20.0, 37.0], pulse_voltage=[5.0, 7.0], ion=[0, 1])
    high = Hits(voltage=[20.0, 5000.0], ion=[0, 1])
    with pytest.warns(DataWarning, match=r"low\.epos': voltages of at most 37 V"):
        write(tmp_path / "low.epos", low)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write(tmp_path / "high.epos", high)
        assert np.array_equal(read(tmp_path / "high.epos").voltage, high.voltage)
        for unit, factor in (("V", 1), ("kV", 1000)):
            hits = read(tmp_path / "low.epos", voltage_unit=unit)
            assert np.array_equal(hits.voltage, factor * low.voltage)
            assert np.array_equal(hits.pulse_voltage, factor * low.pulse_voltage)
            (part,) = chunks(tmp_path / "low.epos", 9, voltage_unit=unit)
            assert np.array_equal(part.voltage, hits.voltage)
    with pytest.raises(ValueError, match="voltage_unit"):
        read(tmp_path / "low.epos", voltage_unit="mV")


def test_zero_columns_are_absent_but_a_laser_has_no_pulse_voltage(tmp_path):
    hits = read(save(tmp_path / "a.epos", epos_row(time=0, v=0, pulse=0, pulses=0)))
    assert hits.time_of_flight is None and hits.voltage is None and hits.pulse_voltage is None
    assert hits.pulses.tolist() == [0]
    assert read(save(tmp_path / "b.epos", epos_row(pulse=0))).pulse_voltage.tolist() == [0]


def test_pulses_come_from_the_last_column_alone(tmp_path):
    ions = [1, 3, 0, 0, 2, 0, 1]
    hits = read(save(tmp_path / "a.epos", *(epos_row(ions=n, pulses=0) for n in ions)))
    assert hits.pulse_id.tolist() == [0, 1, 1, 1, 2, 2, 3]
    assert hits.multiplicity.tolist() == [1, 3, 3, 3, 2, 2, 1]


@pytest.mark.parametrize(
    "ions, problem",
    [
        ([0, 0], "zero for all ions"),
        ([0, 1], "first 1 rows"),
        ([2, 1, 3], "row 0 gives 2 ions .* begins 1 rows later .2 such"),
        ([1, 0], "row 0"),
    ],
)
def test_inconsistent_pulses_are_told_and_dropped(tmp_path, ions, problem):
    path = save(tmp_path / "a.epos", *(epos_row(ions=n) for n in ions))
    with pytest.warns(UserWarning, match=problem):
        hits = read(path)
    assert hits.pulse_id is None and hits.multiplicity is None and len(hits) == len(ions)


def test_truncated_file_raises_and_partial_reads_the_whole_ions(tmp_path):
    path = save(tmp_path / "cut.epos", epos_row(), epos_row(ions=3), epos_row(ions=0), epos_row(ions=0)[:-5])
    with pytest.raises(TruncatedFile, match=r"cut\.epos.* 3 complete ions .* 39 further bytes; partial=True"):
        read(path)
    hits = read(path, partial=True)
    assert len(hits) == 3 and hits.pulse_id.tolist() == [0, 1, 1] and hits.multiplicity.tolist() == [1, 3, 3]
    with pytest.raises(TruncatedFile, match="fewer than one ion"):
        read(save(tmp_path / "tiny.pos", b"1234567"), partial=True)


def test_pos_named_epos_and_the_other_way_round(tmp_path):
    with pytest.raises(TruncatedFile, match=r"partial=True .* fits the 16 bytes per ion of a \.pos"):
        read(save(tmp_path / "a.epos", struct.pack(">4f", 1, 2, 3, 4)))
    assert len(read(tmp_path / "a.epos", format=".pos")) == 1
    with pytest.raises(FileError, match=r"fits the 44 bytes per ion of an \.epos"):
        read(save(tmp_path / "a.pos", epos_row()))


def test_little_endian_raises_unless_asked_for(tmp_path):
    values = np.random.default_rng(1).uniform(-40, 40, (50, 4)).astype("f4")
    path = save(tmp_path / "a.pos", values.astype("<f4").tobytes())
    with pytest.raises(FileError, match=r"a\.pos.*little-endian.*byte_order='little'"):
        read(path)
    np.testing.assert_array_equal(read(path, byte_order="little").positions, values[:, :3])
    with pytest.raises(ValueError, match="byte_order"):
        read(path, byte_order="middle")


def test_rows_that_are_not_finite_are_read_but_not_detected(tmp_path):
    nan = float("nan")
    hits = read(save(tmp_path / "a.epos", epos_row(), epos_row(x=nan, y=nan, z=nan, dx=nan, v=nan)))
    assert len(hits) == 2 and hits.detected.tolist() == [True, False] and hits.voltage[0] == 5000


@pytest.mark.parametrize("suffix", [".pos", ".epos"])
def test_files_that_cannot_be_read(tmp_path, suffix):
    with pytest.raises(FileError, match=rf"empty{suffix}.* is empty"):
        read(save(tmp_path / f"empty{suffix}"))
    with pytest.raises(FileError, match=rf"none{suffix}.*No such file"):
        read(tmp_path / f"none{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(FileError, match="directory"):
        read(tmp_path / f"folder{suffix}")


def test_unknown_formats_options_and_paths(tmp_path):
    path = save(tmp_path / "a.xyz", b"anything")
    with pytest.raises(FileError, match=r"suffix '\.xyz' can only be written, expected one of .*\.epos"):
        read(path)
    with pytest.raises(FileError, match="format='doc'"):
        read(path, format="doc")
    with pytest.raises(FileError, match="takes partial, byte_order, got 'parts'"):
        read(save(tmp_path / "a.pos", struct.pack(">4f", 1, 2, 3, 4)), parts=True)
    with pytest.raises(FileError, match="file name"):
        read(3)
    with pytest.raises(FileError, match="does not begin like"):
        read(save(tmp_path / "a.h5", b"not HDF5"))
    with pytest.raises(ValueError, match=r"hits must have detector coordinates x and y for .*b\.h5"):
        write(tmp_path / "b.h5", Hits(x=[1.0]))


def test_hdf5_is_recognised_whatever_its_name(tmp_path, small_tip):
    run = Simulation(small_tip, seed=1).run(20, responses=False, progress=False)
    run.save(tmp_path / "run.h5")
    (tmp_path / "run.h5").rename(tmp_path / "a.pos")
    for format in (None, ".h5", "h5"):
        assert isinstance(read_file.read(tmp_path / "a.pos", format=format), Run)
    with pytest.raises(FileError, match=r"a\.pos.*a run takes no columns, got \('x',\)"):
        read_file.read(tmp_path / "a.pos", columns=("x",))
    with pytest.raises(FileError, match=r"a\.pos.*takes no options, got 'partial'"):
        read_file.read(tmp_path / "a.pos", partial=True)
    with pytest.raises(FileError, match=r"a\.pos' is an HDF5 file of the kind 'run'"):
        read(tmp_path / "a.pos")
    write(tmp_path / "b.nxs", run.hits(run.first_perturbation), elements=["Ni"])
    (tmp_path / "b.nxs").rename(tmp_path / "b.epos")
    assert isinstance(read(tmp_path / "b.epos"), Hits)
    assert len(read_file.read(tmp_path / "b.epos", columns=("x", "y"))) == 20
    with pytest.raises(FileError, match=r"b\.epos.*partial"):
        read(tmp_path / "b.epos", partial=True)
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["some/data"] = np.arange(5)
    with pytest.raises(FileError, match=r"c\.h5' is an HDF5 file of unknown kind, expected a run, ions in NXapm"):
        read(tmp_path / "c.h5")


def hits_of(values, **columns):
    return Hits(
        positions=values[:, :3],
        mass_to_charge=values[:, 3],
        time_of_flight=values[:, 4],
        x=values[:, 5],
        y=values[:, 6],
        **columns,
    )


finite = st.floats(-1000, 1000, width=32).filter(lambda value: value == 0 or abs(value) > 1e-6)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
@given(values=arrays("f4", st.tuples(st.integers(1, 12), st.just(7)), elements=finite), data=st.data())
def test_epos_round_trip(tmp_path, values, data):
    values[:, 4:6] += 2000  # no column of zeros, which would come back as None
    values[:, :4] += np.float32(0.125)
    n = len(values)
    pulse_id = np.sort(data.draw(arrays("i8", n, elements=st.integers(0, n))))
    before = hits_of(values, pulse_id=pulse_id, pulses=np.arange(n), voltage=np.full(n, 5e3))
    write(tmp_path / "a.epos", before)
    after = read(tmp_path / "a.epos", byte_order="big")
    for name in ("x", "y", "time_of_flight", "voltage", "pulses"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_array_equal(after.positions, values[:, :3])
    _, which, size = np.unique(pulse_id, return_inverse=True, return_counts=True)
    np.testing.assert_array_equal(after.pulse_id, which)
    np.testing.assert_array_equal(after.multiplicity, size[which])
    first = (tmp_path / "a.epos").read_bytes()
    write(tmp_path / "a.epos", after)
    assert (tmp_path / "a.epos").read_bytes() == first


def test_selection_recounts_the_ions_per_pulse(tmp_path):
    rows = [epos_row(ions=n, dx=float(i)) for i, n in enumerate([1, 3, 0, 0, 2, 0])]
    hits = read(save(tmp_path / "a.epos", *rows))
    write(tmp_path / "b.epos", hits[[0, 2, 3, 5]])
    again = read(tmp_path / "b.epos")
    assert again.multiplicity.tolist() == [1, 2, 2, 1] and again.x.tolist() == [0, 2, 3, 5]


@pytest.mark.parametrize(("scale", "ions", "warned"), [(1e-9, 200, True), (1.0, 200, False), (1e-9, 50, False)])
def test_positions_in_metres_are_noticed(tmp_path, recwarn, rng, scale, ions, warned):
    positions = scale * rng.uniform(0, 30, (ions, 3))  # nm, as metres
    write(tmp_path / "a.pos", Hits(positions=positions, mass_to_charge=np.full(ions, 27.0)))
    read(tmp_path / "a.pos")
    assert any("are they in nm?" in str(warning.message) for warning in recwarn) == warned


@pytest.mark.parametrize("suffix", [".pos", ".epos"])
def test_missed_and_broken_ions_are_left_out_and_counted(tmp_path, suffix):
    hits = Hits(
        x=[1.0, np.nan, 2.0, np.nan, 1e39],
        y=[1.0, np.nan, 2.0, np.nan, 0.0],
        positions=np.where(np.arange(5)[:, None] >= 3, [np.nan, 0, 0], [1.0, 2.0, 3.0]),
        outcome=[Outcome.HIT, Outcome.MISSED, Outcome.HIT, Outcome.NEVER_LEFT, Outcome.HIT],
    )
    path = tmp_path / f"a{suffix}"
    with pytest.warns(UserWarning, match=r"3 of 5 ions left out of .*: 2 did not hit .* 1 have values"):
        write(path, hits)
    words = np.fromfile(path, ">f4")
    assert np.isfinite(words).all() and len(words) == 2 * (4 if suffix == ".pos" else 11)
    with pytest.raises(ValueError, match=r"no ion to write to .*: the hits are empty$"):
        write(tmp_path / "a.pos", hits[:0])
    with pytest.raises(ValueError, match=r"no ion to write .* of 1 ions 1 did not hit the detector$"):
        write(path, hits[1:2])
    with pytest.warns(UserWarning, match=r"2 of 3 ions left out of .*: 2 did not hit the detector$"):
        write(tmp_path / f"b{suffix}", hits[[0, 1, 3]])
    assert read(path).positions.tolist() == [[1, 2, 3], [1, 2, 3]]


def test_simulated_ions_are_single_hits_and_missing_columns_zeros(tmp_path):
    write(tmp_path / "a.epos", Hits(x=[1.0, 2.0], y=[3.0, 4.0], ion=[0, 1]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hits = read(tmp_path / "a.epos")
    assert hits.multiplicity.tolist() == [1, 1] and hits.positions is None and hits.mass_to_charge is None
    with pytest.raises(ValueError, match="no column 'positions'"):
        write(tmp_path / "a.pos", hits)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.pos"
    write(path, Hits(positions=[[1.0, 2.0, 3.0]]))
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(FileError, match=r"cannot write .*a\.pos.*No space left"):
        write(path, Hits(positions=[[4.0, 5.0, 6.0]]))
    assert os.listdir(tmp_path) == ["a.pos"] and path.read_bytes() == before


def test_unwritable_places(tmp_path):
    hits = Hits(positions=[[1.0, 2.0, 3.0]])
    with pytest.raises(FileError, match="No such file"):
        write(tmp_path / "nowhere" / "a.pos", hits)
    (tmp_path / "b.pos").mkdir()
    with pytest.raises(FileError, match="directory"):
        write(tmp_path / "b.pos", hits)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
@pytest.mark.parametrize(
    "suffix",
    [
        pytest.param(entry.suffix, marks=[pytest.mark.slow] if entry.suffix == ".tapsim" else [])  # a text
        for entry in FORMATS
        if entry.write and entry.read
    ],
)
def test_every_format_that_writes_reads_back_more_ions_than_a_chunk(tmp_path, suffix):
    values = np.random.default_rng(2).uniform(1, 50, (40_000, 7)).astype("f4")
    options = {"elements": ["Si"]} if suffix == ".nxs" else {}
    write(tmp_path / f"a{suffix}", hits_of(values, pulse_id=np.arange(40_000) // 2), **options)
    positions = read(tmp_path / f"a{suffix}").positions
    # a .tapsim has metres in float32: two roundings
    np.testing.assert_allclose(positions, values[:, :3], rtol=2e-7 if suffix == ".tapsim" else 0, atol=0)


@pytest.mark.skipif(not SILICON.exists(), reason="the measured Si.epos is not there")
def test_measured_file_comes_back_to_the_byte(tmp_path):
    hits = read(SILICON)
    # facts of the file: 4.1 % of the ions in multi-hits of up to 12
    assert len(hits) == 945_211 and hits.multiplicity.max() == 12
    assert np.count_nonzero(hits.multiplicity > 1) / len(hits) == pytest.approx(0.041, abs=5e-4)
    write(tmp_path / "a.epos", hits)
    assert (tmp_path / "a.epos").read_bytes() == SILICON.read_bytes()


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
@pytest.mark.parametrize("suffix", [".epos", ".raw"])
def test_the_unit_of_detector_coordinates_can_be_given(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(epos(ions_of([1, 2])) if suffix == ".epos" else raw([1, 2, 2])[0])
    hits = read(path)
    for unit, factor in (("mm", 1), ("cm", 10), ("m", 1000), ("um", 1e-3)):
        part = read(path, detector_unit=unit, columns=("x", "voltage"))
        np.testing.assert_allclose(part.x, factor * hits.x, rtol=1.2e-7)
        np.testing.assert_array_equal(part.voltage, hits.voltage)
        parts = list(chunks(path, 2, detector_unit=unit))
        np.testing.assert_allclose(np.concatenate([part.y for part in parts]), factor * hits.y, rtol=1.2e-7)
    for function in (read, lambda path, **options: list(chunks(path, 2, **options))):
        with pytest.raises(ValueError, match=r"detector_unit \(--unit\) must be one of mm, cm, m, um, got 'inch'"):
            function(path, detector_unit="inch")


def test_a_detector_of_many_metres_is_warned_of_in_every_format(tmp_path):
    ions = {"time_of_flight": [5.0, 6.0], "mass_to_charge": [20.0, 20.0], "positions": np.ones((2, 3))}
    ions |= {"pulse_id": [0, 1], "voltage": [5e3, 5e3]}
    wide, usual = (Hits(x=[0.0, width], y=[0.0, 1.0], **ions) for width in (501.0, 499.0))
    (tmp_path / "a.apt").write_bytes(
        apt(
            [apt_section("XDet_mm", np.array([0, 501], "f4"), "mm"), apt_section("YDet_mm", np.zeros(2, "f4"), "mm")], 2
        )
    )
    pyccapt_instrument(tmp_path / "a.h5", 2, x=np.array([0.0, 50.1]))
    edges = np.linspace(0, 501, 9)
    np.savez(tmp_path / "a.npz", counts=np.ones((8, 8), int), x_edges_mm=edges, y_edges_mm=edges)
    for suffix, options in ((".epos", {}), (".nxs", {"elements": ["Al"]}), (".tapsim", {})):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # a .tapsim has fewer columns
            write(tmp_path / f"a{suffix}", wide, **options)
            write(tmp_path / f"usual{suffix}", usual, **options)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read(tmp_path / f"usual{suffix}")
    rows = raw([1, 2])[1]
    rows["x"] = [0, 501]
    (tmp_path / "a.raw").write_bytes(rows.tobytes())
    for suffix in (".epos", ".nxs", ".tapsim", ".apt", ".h5", ".npz", ".raw"):
        with pytest.warns(DataWarning, match=rf"a\{suffix}' has detector coordinates in 501 x .* are they in mm\?"):
            read(tmp_path / f"a{suffix}")
    for suffix in (".epos", ".apt", ".raw"):
        with pytest.warns(DataWarning, match="are they in mm") as caught:
            list(chunks(tmp_path / f"a{suffix}", 2))
        assert len(caught) == 1


LEFT_OUT = {
    ".epos": {"Temp", "flag", "name"},
    ".pos": {"x", "y", "voltage", "pulse_id", "multiplicity", "Temp", "flag", "name"},
    ".tapsim": {"mass_to_charge", "pulse_id", "multiplicity", "Temp", "flag", "name"},
    ".nxs": {"name"},
    ".xyz": {"flag"},
    ".vtp": {"flag"},
    ".csv": set(),
    ".h5": {"Temp", "flag", "name"},
}


@pytest.mark.parametrize("suffix", LEFT_OUT)
def test_columns_without_a_place_are_named(tmp_path, suffix):
    extra = {"Temp": [50.0, 51.0], "flag": [True, False], "name": ["a", "b"]}
    columns = {"x": [1.0, 2.0], "y": [0.0, 1.0], "positions": np.ones((2, 3)), "mass_to_charge": [20.0, 20.0]}
    measured = Hits(**columns, voltage=[5e3, 5e3], pulse_id=[0, 1], multiplicity=[1, 1], extra=extra)
    options = {"elements": ["Al"]} if suffix == ".nxs" else {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DataWarning)
        write(tmp_path / f"a{suffix}", measured, **options)
    names = ", ".join(name for name in (*measured.columns, *extra) if name in LEFT_OUT[suffix])
    expected = [f"is without the columns {names}, for which a {suffix} file has no place"] if names else []
    assert [str(entry.message).partition("' ")[2] for entry in caught] == expected
    assert left_out(tmp_path / f"a{suffix}", measured)[0] == tuple(names.split(", ") if names else ())
    zeros = dict.fromkeys((".epos", ".h5"), ("time_of_flight", "pulse_voltage", "pulses"))
    assert left_out("a" + suffix, measured)[1] == zeros.get(suffix, ())
    assert all(entry.suffix in LEFT_OUT for entry in FORMATS if entry.write)
