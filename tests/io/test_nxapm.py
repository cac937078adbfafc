"""NXapm: what the validator of pynxtools 0.16 requires, ions that come back as they were, and files of others."""

import datetime

import h5py
import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.files import FileError

DATA = "entry1/atom_probe"
# classes of the groups, which the validator compares with NXapm
CLASSES = {
    "/": "NXroot",
    "entry1": "NXentry",
    "entry1/specimen": "NXsample",
    "entry1/laboratory_reference_frame": "NXcoordinate_system",
    DATA: "NXroi_process",
    f"{DATA}/voltage_and_bowl/config": "NXparameters",
}
for step in ("hit_finding", "hit_spatial_filtering", "voltage_and_bowl", "mass_to_charge_conversion"):
    CLASSES |= {f"{DATA}/{step}": "NXprocess", f"{DATA}/{step}/program1": "NXprogram"}
# groups at the paths of other programs, which are not validated
LINKS = {
    f"{DATA}/reconstruction",
    "entry1/measurement",
    "entry1/measurement/event1",
    "entry1/measurement/event1/instrument",
    "entry1/measurement/event1/instrument/pulser",
}
CLASSES |= dict.fromkeys(LINKS, "NXcollection")
# paths that NXapm names, beside the programs; anything else outside of NXcollection is a warning
FIELDS = {
    "entry1/definition",
    "entry1/start_time",
    "entry1/operation_mode",
    "entry1/specimen/is_simulation",
    "entry1/specimen/atom_types",
    "entry1/specimen/initial_radius",
    "entry1/specimen/shank_angle",
    *(f"entry1/laboratory_reference_frame/{name}" for name in ("type", "x", "y", "z")),
    f"{DATA}/hit_finding/hit_positions",
    f"{DATA}/hit_finding/hit_multiplicity",
    f"{DATA}/hit_spatial_filtering/evaporation_id",
    f"{DATA}/hit_spatial_filtering/evaporation_id_offset",
    f"{DATA}/voltage_and_bowl/raw_tof",
    f"{DATA}/mass_to_charge_conversion/mass_to_charge",
    *(f"{name}/program" for name in CLASSES if name.endswith("program1")),
}
ATTRIBUTES = {
    "entry1/definition": {"version"},
    f"{DATA}/hit_finding/hit_positions": {"units", "depends_on"},
    f"{DATA}/mass_to_charge_conversion/mass_to_charge": {"units"},
    "entry1/specimen/initial_radius": {"units"},
    "entry1/specimen/shank_angle": {"units"},
    **{f"entry1/laboratory_reference_frame/{axis}": {"units"} for axis in "xyz"},
    **{name: {"version"} for name in FIELDS if name.endswith("/program")},
}

# of columns for which the format has no place
pytestmark = pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")


def check_structure(path, own, is_simulation, elements):
    """Fail if a file is not as the validator wants it; `own` is the group that is not validated."""
    with h5py.File(path) as file:
        names = []
        file.visit(names.append)
        outside = [name for name in names if name != own and not name.startswith(f"{own}/")]
        for name in ["/", *outside]:
            item = file[name]
            if isinstance(item, h5py.Group):
                # the validator takes bytes for another class
                assert item.attrs["NX_class"] == CLASSES[name] and isinstance(item.attrs["NX_class"], str)
            elif name.rpartition("/")[0] in LINKS:
                assert any(item == column for column in file[own].values()), name  # a link, no copy
            else:
                assert name in FIELDS and set(item.attrs) == ATTRIBUTES.get(name, set()), name
        groups = [name for name in names if name.startswith(own) and isinstance(file[name], h5py.Group)]
        assert own in groups and all(file[name].attrs["NX_class"] == "NXcollection" for name in groups)
        texts = {name: file[name].asstr()[()] for name in ("entry1/definition", "entry1/operation_mode")}
        assert texts == {"entry1/definition": "NXapm", "entry1/operation_mode": "apt"}
        time = file["entry1/start_time"]
        assert h5py.check_string_dtype(time.dtype).length is None  # the validator wants no bytes
        assert datetime.datetime.fromisoformat(time.asstr()[()]).tzinfo is not None
        assert file["entry1/specimen/is_simulation"][()] == is_simulation
        assert file["entry1/specimen/is_simulation"].dtype == bool
        assert file["entry1/specimen/atom_types"].asstr()[()] == elements
        ions = file[f"{DATA}/hit_spatial_filtering/evaporation_id"]
        assert ions.dtype == np.int64 and file[ions.name + "_offset"].shape == ()
        if f"{DATA}/hit_finding/hit_positions" in file:
            positions = file[f"{DATA}/hit_finding/hit_positions"]
            assert positions.shape == (len(ions), 2) and positions.attrs["units"] == "mm"
            assert file[positions.attrs["depends_on"]].attrs["NX_class"] == "NXcoordinate_system"
        assert dict(file.attrs).keys() <= {
            "NX_class", "format", "rows", "note", "nearest_neighbour_distance",
        }  # fmt: skip


@pytest.fixture(scope="session")
def run():
    tip = ae.Tip("Ni", apex_radius=1.8, axis=(1, 1, 1), shank_length=1.8, solutes={"Al": 0.1}, seed=1)
    simulation = ae.Simulation(tip, seed=1, n_threads=1, law=ae.Arrhenius(temperature=50.0))
    return simulation.run(30, [ae.RollUp(0.2)], progress=False).at_evaporation_field()


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")  # 0.2 eV are above the limit in true eV
def test_a_run_is_as_nxapm_wants_it(run, tmp_path):
    run.save(tmp_path / "a.h5")
    check_structure(tmp_path / "a.h5", "entry1/simulation", True, "Ni, Al")
    with h5py.File(tmp_path / "a.h5") as file:
        radius, angle = file["entry1/specimen/initial_radius"], file["entry1/specimen/shank_angle"]
        assert (radius[()], radius.attrs["units"]) == (1.8, "nm") and (angle[()], angle.attrs["units"]) == (1.5, "deg")
        assert {"clock", "real", "state", "flown", "responses"} <= set(file["entry1/simulation"])


def measured(n=5000):
    rng = np.random.default_rng(3)
    return ae.Hits(
        x=rng.uniform(-30, 30, n).astype("f4"),
        y=rng.uniform(-30, 30, n).astype("f4"),
        mass_to_charge=rng.uniform(1, 90, n).astype("f4"),
        time_of_flight=rng.uniform(1, 90, n).astype("f4"),
        voltage=rng.uniform(1, 90, n),
        positions=rng.normal(size=(n, 3)).astype("f4"),
        pulse_id=np.arange(n) // 2,
        multiplicity=np.full(n, 2),
        pulses=np.arange(n),
        extra={"a/b": np.arange(n), "pair": rng.normal(size=(n, 2)), "text": np.full(n, "a")},
        units={"a/b": "V"},
        source="some.epos",
    )


def same(one, two):
    assert one.columns == two.columns
    for name in one.columns:
        assert getattr(one, name).dtype == getattr(two, name).dtype, name
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_measured_ions_are_as_nxapm_wants_them_and_come_back(tmp_path):
    hits = measured()
    ae.write(tmp_path / "a.nxs", hits, elements=["Si", "O"], start_time="2026-05-04T09:30:00+02:00")
    check_structure(tmp_path / "a.nxs", "entry1/ions", False, "Si, O")
    back = ae.read(tmp_path / "a.nxs")
    same(hits, back)
    assert set(back.extra) == {"a/b", "pair"} and back.units == {"a/b": "V"} and back.source == "some.epos"
    for name in back.extra:
        np.testing.assert_array_equal(back.extra[name], hits.extra[name])
    part = ae.read(tmp_path / "a.nxs", columns=("y", "pair"))
    assert part.columns == ("y",) and set(part.extra) == {"pair"}
    with pytest.raises(FileError, match=r"a\.nxs' has no column 'z'"):
        ae.read(tmp_path / "a.nxs", columns=("z",))
    with h5py.File(tmp_path / "a.nxs") as file:
        assert file["entry1/start_time"].asstr()[()] == "2026-05-04T09:30:00+02:00"


def test_ions_of_a_run(run, tmp_path):
    hits = run.hits(ae.Unperturbed())
    ae.write(tmp_path / "a.nxs", hits, elements=run.elements)
    check_structure(tmp_path / "a.nxs", "entry1/ions", True, "Ni, Al")
    back = ae.read(tmp_path / "a.nxs")
    same(hits, back)
    assert back.extent == hits.extent and back.map(bins=20).extent == hits.map(bins=20).extent


def test_few_columns(tmp_path):
    for hits in (ae.Hits(positions=np.zeros((3, 3))), ae.Hits(x=[1.0, 2.0]), ae.Hits(ion=[3, 5])):
        ae.write(tmp_path / "a.nxs", hits, elements=["Si"])
        check_structure(tmp_path / "a.nxs", "entry1/ions", False, "Si")
        same(hits, ae.read(tmp_path / "a.nxs"))


def test_refusals(tmp_path):
    hits = measured(4)
    for elements in ((), "Si", ["si"], ["Si", 5]):
        with pytest.raises(ValueError, match="elements"):
            ae.write(tmp_path / "a.nxs", hits, elements=elements)
    for time in ("yesterday", "2026-05-04T09:30:00", 5):
        with pytest.raises(ValueError, match="start_time"):
            ae.write(tmp_path / "a.nxs", hits, elements=["Si"], start_time=time)
    assert not (tmp_path / "a.nxs").exists()
    with h5py.File(tmp_path / "b.nxs", "w") as file:
        file["entry/data"] = [1]
    with pytest.raises(FileError, match=r"b\.nxs' is an HDF5 file of unknown kind, expected a run, ions in NXapm"):
        ae.read(tmp_path / "b.nxs", format=".nxs")


# ---- other programs --------------------------------------------------------------------------------------------------

PULSER = "entry1/measurement/event1/instrument/pulser"
OTHERS = {  # values and units as pynxtools-apm 0.5.3 writes them, with the long names of pint
    f"{DATA}/reconstruction/reconstructed_positions": (np.arange(12, dtype="f4").reshape(4, 3), "nanometer"),
    f"{DATA}/mass_to_charge_conversion/mass_to_charge": (np.arange(4, dtype="f4") + 20, "dalton"),
    f"{DATA}/voltage_and_bowl/raw_tof": (np.arange(4, dtype="f4") + 500, "nanosecond"),
    f"{DATA}/hit_finding/hit_positions": (np.arange(8, dtype="f4").reshape(4, 2), "millimeter"),
    f"{DATA}/hit_finding/epos_number_of_pulses": (np.array([7, 3, 0, 2], "u4"), None),
    f"{DATA}/hit_finding/epos_ions_per_pulse": (np.array([1, 2, 0, 1], "u4"), None),
    f"{PULSER}/standing_voltage": (np.full(4, 4000, "f4"), "volt"),
    f"{PULSER}/pulse_voltage": (np.full(4, 800, "f4"), "volt"),
}


def others(path, changes=()):
    with h5py.File(path, "w") as file:
        for name, content in (OTHERS | dict(changes)).items():
            if content is not None:
                values, units = content
                file.create_dataset(name, data=values, chunks=values.shape, compression="gzip", compression_opts=9)
                if units is not None:
                    file[name].attrs["units"] = units
    return path


def test_every_column_of_others(tmp_path):
    path = others(tmp_path / "a.nxs")
    hits = ae.read(path)
    assert hits.x.tolist() == [0, 2, 4, 6] and hits.y.tolist() == [1, 3, 5, 7] and hits.x.dtype == np.float32
    assert hits.positions.tolist() == np.arange(12).reshape(4, 3).tolist()
    assert hits.mass_to_charge.tolist() == [20, 21, 22, 23] and hits.time_of_flight.tolist() == [500, 501, 502, 503]
    assert (hits.voltage == 4000).all() and (hits.pulse_voltage == 800).all() and hits.pulses.tolist() == [7, 3, 0, 2]
    assert hits.pulse_id.tolist() == [0, 1, 1, 2] and hits.multiplicity.tolist() == [1, 2, 2, 1]
    part = ae.read(path, columns=("y", "multiplicity"))
    assert part.columns == ("y", "multiplicity") and part.multiplicity.tolist() == [1, 2, 2, 1]


@pytest.mark.parametrize(
    ("place", "column", "units", "factor"),
    [
        (f"{DATA}/hit_finding/hit_positions", "x", "cm", 10),
        (f"{DATA}/hit_finding/hit_positions", "x", "meter", 1000),
        (f"{DATA}/reconstruction/reconstructed_positions", "positions", "angstrom", 0.1),
        (f"{DATA}/voltage_and_bowl/raw_tof", "time_of_flight", "µs", 1000),
        (f"{PULSER}/standing_voltage", "voltage", b"kilovolt", 1000),
        (f"{PULSER}/pulse_voltage", "pulse_voltage", "kV", 1000),
        (f"{DATA}/mass_to_charge_conversion/mass_to_charge", "mass_to_charge", "u", 1),
    ],
)
def test_units_of_others_are_converted(tmp_path, place, column, units, factor):
    values = OTHERS[place][0]
    hits = ae.read(others(tmp_path / "a.nxs", {place: (values, units)}))
    expected = factor * (values[:, 0] if column == "x" else values)
    np.testing.assert_allclose(getattr(hits, column), expected, rtol=1e-6)  # of float32


def test_what_others_leave_out(tmp_path):
    epos = {name: None for name in OTHERS if "epos_" in name}
    zero = {f"{DATA}/hit_finding/hit_positions": (np.zeros((4, 2), "f4"), "mm")}
    hits = ae.read(others(tmp_path / "a.nxs", epos | zero))
    assert hits.x is None and hits.pulse_id is None and hits.multiplicity is None and hits.pulses is None
    numbers = {f"{PULSER}/pulse_number": (np.array([10, 12, 12, 15], "u8"), None)}
    hits = ae.read(others(tmp_path / "a.nxs", epos | numbers))
    assert hits.pulse_id.tolist() == [10, 12, 12, 15] and hits.multiplicity.tolist() == [1, 2, 2, 1]
    wrong = {f"{DATA}/hit_finding/epos_ions_per_pulse": (np.array([1, 3, 0, 1], "u4"), None)}
    with pytest.warns(ae.warnings.DataWarning, match=r"a\.nxs': ions are not grouped in pulses"):
        assert ae.read(others(tmp_path / "a.nxs", wrong)).pulse_id is None


@pytest.mark.parametrize(
    ("place", "content", "message"),
    [
        (
            f"{PULSER}/standing_voltage",
            (np.ones(4), "ns"),
            r"units of entry1/.*/standing_voltage must be one of V, .*'ns'",
        ),
        (f"{PULSER}/standing_voltage", (np.ones(4), None), r"standing_voltage must be one of V, .*, got none"),
        (f"{PULSER}/standing_voltage", (np.ones(4), np.ones(2)), r"standing_voltage must be one of V, "),
        (f"{PULSER}/standing_voltage", (np.ones(5), "V"), "columns of NXapm must have equal lengths"),
        (f"{DATA}/hit_finding/hit_positions", (np.ones((4, 3)), "mm"), r"hit_positions must have shape \(any, 2\)"),
        (f"{DATA}/hit_finding/epos_ions_per_pulse", (np.ones(4), None), "must contain integers, got float64"),
        (f"{DATA}/voltage_and_bowl/raw_tof", (np.full(4, b"a"), "ns"), r"must contain numbers, got \|S1"),
        ("entry2/atom_probe/hit_finding/hit_positions", (np.ones((4, 2)), "mm"), "must have one entry with ions"),
        ("entry1/measurement/event2/x", (np.ones(4), "mm"), "must have one event of the measurement"),
    ],
)
def test_refusals_of_others(tmp_path, place, content, message):
    with pytest.raises(FileError, match=rf"a\.nxs'.*{message}"):
        ae.read(others(tmp_path / "a.nxs", {place: content}))


def test_a_small_file_that_promises_much_and_damage_are_refused(tmp_path):
    path = others(tmp_path / "a.nxs", {f"{DATA}/hit_finding/epos_number_of_pulses": None})
    with h5py.File(path, "a") as file:
        file.create_dataset(
            f"{DATA}/hit_finding/epos_number_of_pulses", (10**12,), "u4", chunks=(4,), compression="gzip"
        )
    with pytest.raises(FileError, match=r"epos_number_of_pulses has shape \(1000000000000,\), more than"):
        ae.read(path)
    path = others(tmp_path / "a.nxs")
    with h5py.File(path) as file:
        chunk = file[f"{PULSER}/standing_voltage"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileError, match="damaged"):
        ae.read(path)


def test_paths_of_other_programs_are_written(tmp_path):
    """Without the group of this package the same ions are read as those of another program."""
    hits = measured()
    hits = ae.Hits(**{name: getattr(hits, name) for name in hits.columns if name != "pulses"})
    ae.write(tmp_path / "a.nxs", hits, elements=["Si"])
    with h5py.File(tmp_path / "a.nxs", "a") as file:
        del file["entry1/ions"], file.attrs["format"]
        file[f"{DATA}/voltage_and_bowl/raw_tof"].attrs["units"] = "ns"  # for which NXapm has none
    back = ae.read(tmp_path / "a.nxs")
    assert set(back.columns) == {*hits.columns, "ion"}
    for name in hits.columns:
        np.testing.assert_array_equal(getattr(back, name), getattr(hits, name))
