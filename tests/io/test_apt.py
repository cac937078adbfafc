import struct
import warnings

import numpy as np
import pytest
from ion_files import apt, apt_header, apt_section, position_section, usual_apt

from apt_evap._common.files import FileError, TruncatedFile
from apt_evap.io.formats import read

THREE = np.array([1.5, 2.5, 3.5], "f4")


@pytest.fixture
def save(tmp_path):
    def save(*sections, ions=3, name="a.apt"):
        (tmp_path / name).write_bytes(apt(sections, ions))
        return tmp_path / name

    return save


def strict(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read(path, **options)


def test_every_section_lands_where_it_belongs(tmp_path):
    data, columns = usual_apt()
    (tmp_path / "a.pos").write_bytes(data)  # the signature tells, not the name
    hits = strict(tmp_path / "a.pos")
    for name, values in columns.items():
        np.testing.assert_array_equal(getattr(hits, name), values)
        assert getattr(hits, name).dtype == np.float32
    assert hits.pulse_id.tolist() == [0, 1, 1, 1, 2, 2] and hits.multiplicity.tolist() == [1, 3, 3, 3, 2, 2]
    assert hits.extra == {} and hits.voltage is None and hits.source.endswith("a.pos")


def test_any_order_padding_and_header_size(tmp_path):
    sections = [
        position_section(np.arange(9.0).reshape(3, 3), padding=7) + bytes(5000),  # inside its length, and behind it
        apt_section("Mass", THREE, "Da", extra_header=b"\xff" * 12, padding=3) + b"\0",
        apt_section("tofc", THREE * 100, "ns"),
    ]
    path = tmp_path / "a.apt"
    path.write_bytes(apt_header(3, size=600) + b"".join(sections) + bytes(20))
    hits = strict(path)
    assert hits.positions.tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    assert hits.mass_to_charge.tolist() == [1.5, 2.5, 3.5] and hits.time_of_flight.tolist() == [150, 250, 350]


def test_zeros_without_end_are_not_read_to_their_end(tmp_path):
    path = tmp_path / "a.apt"
    path.write_bytes(apt_header(3) + apt_section("Mass", THREE, "Da"))
    with open(path, "r+b") as file:
        file.truncate(300 << 30)
    with pytest.raises(FileError, match=r"a\.apt'.*expected a section .* got only zeros"):
        read(path)


def test_detector_coordinates_have_a_stride_of_two(save):
    pairs = np.arange(6.0, dtype="f4").reshape(3, 2)
    hits = strict(save(apt_section("Detector Coordinates", pairs, "mm")))
    assert hits.x.tolist() == [0, 2, 4] and hits.y.tolist() == [1, 3, 5]
    hits = strict(save(apt_section("Detector Coordinates", pairs, "cm"), apt_section("XDet_mm", THREE, "mm")))
    assert hits.x.tolist() == [1.5, 2.5, 3.5] and hits.y is None
    np.testing.assert_array_equal(hits.extra["Detector Coordinates"], pairs)
    assert hits.units == {"Detector Coordinates": "cm"}


@pytest.mark.parametrize(
    "name, column, unit, factor",
    [
        ("XDet_mm", "x", "cm", 10),
        ("XDet_mm", "x", "m", 1000),
        ("YDet_mm", "y", "um", 1e-3),
        ("tofc", "time_of_flight", "ps", 1e-3),
        ("tofc", "time_of_flight", "us", 1000),
        ("Mass", "mass_to_charge", "amu", 1),
        ("Mass", "mass_to_charge", "kDa", 1000),
        ("TOFC", "time_of_flight", "ns", 1),
    ],
)
def test_units_are_converted(save, name, column, unit, factor):
    hits = strict(save(apt_section(name, THREE, unit)))
    # factor and product in single precision: half a unit in the last place each, 2 x 6e-8
    np.testing.assert_allclose(getattr(hits, column), THREE.astype(float) * factor, rtol=1.2e-7)
    assert strict(save(position_section(np.ones((3, 3)))), columns="positions").positions.max() == 1


@pytest.mark.parametrize("unit", ["furlong", "ns", "V", "Mm mm"])
def test_a_section_of_unknown_unit_is_kept_as_it_is(save, unit):
    path = save(apt_section("XDet_mm", THREE, unit), apt_section("YDet_mm", THREE, "mm"))
    with pytest.warns(UserWarning, match=rf"a\.apt.*'XDet_mm' has the unknown unit '{unit}'.* not x"):
        hits = read(path)
    assert hits.x is None and hits.extra["XDet_mm"].tolist() == THREE.tolist() and hits.units == {"XDet_mm": unit}


def test_any_other_section_is_read_and_selected_with_the_ions(save):
    rows = np.arange(6, dtype="u2").reshape(3, 2)
    path = save(
        apt_section("Laser Power", THREE.astype("f8"), "nJ"),
        apt_section("pulse", np.array([2**40, 5, 6])),
        apt_section("pair", rows, "V"),
        apt_section("flag", np.array([-1, 0, 1], "i1")),
        apt_section("half", THREE.astype("f2")),
        apt_section("letters", np.array([b"ab", b"cd", b"ef"])),
    )
    hits = strict(path)
    assert hits.extra["Laser Power"].dtype == np.float64 and hits.units["Laser Power"] == "nJ"
    assert hits.extra["pulse"].tolist() == [2**40, 5, 6] and hits.extra["flag"].tolist() == [-1, 0, 1]
    np.testing.assert_array_equal(hits.extra["pair"], rows)
    assert hits.extra["half"].tolist() == THREE.tolist() and hits.extra["letters"].tolist() == [b"ab", b"cd", b"ef"]
    assert len(hits) == 3 and "Laser Power" in repr(hits)
    chosen = hits[[False, True, True]]
    assert chosen.extra["pair"].tolist() == [[2, 3], [4, 5]] and chosen.units == hits.units
    assert hits.window(**{"Laser Power": (2, None)}).extra["pulse"].tolist() == [5, 6]


@pytest.mark.parametrize(
    "options, problem",
    [
        ({"relationship": 2}, "relationship 2"),
        ({"record_type": 2}, "record type 2"),
        ({"kind": 7}, "data type 7 of 32 bits"),
        ({"bits": 24}, "data type 3 of 24 bits"),
        ({"record_size": 3}, "records of 3 bytes"),
        ({"record_size": 0}, "records of 0 bytes"),
    ],
)
def test_sections_that_cannot_be_read_are_left_out_and_named(save, options, problem):
    path = save(apt_section("odd", THREE, "mm", **options), apt_section("Mass", THREE, "Da"))
    with pytest.warns(UserWarning, match=rf"a\.apt.*section 'odd'.*skipped.*{problem}"):
        hits = read(path)
    assert hits.columns == ("mass_to_charge",) and hits.extra == {}


def test_a_name_that_comes_twice(save):
    path = save(*(apt_section("Mass", THREE + i, "Da") for i in range(3)))
    with pytest.warns(UserWarning, match=r"another section 'Mass' is called 'Mass \([23]\)'"):
        hits = read(path)
    assert hits.mass_to_charge.tolist() == THREE.tolist()
    assert {name: values[0] for name, values in hits.extra.items()} == {"Mass (2)": 2.5, "Mass (3)": 3.5}


@pytest.mark.parametrize(
    "numbers, pulse_id",
    [
        ([1, 1, 1], [0, 1, 2]),
        ([2, 0, 1], [0, 0, 1]),
        ([2, 2, 1], [0, 0, 1]),
        ([1, 2, 2], [0, 1, 1]),
        ([3, 3, 3], [0, 0, 0]),
    ],
)
def test_multiplicity_on_the_first_or_on_every_ion(save, numbers, pulse_id):
    hits = strict(save(apt_section("Multiplicity", np.array(numbers, "i4"))))
    assert hits.pulse_id.tolist() == pulse_id
    assert hits.multiplicity.tolist() == np.bincount(pulse_id)[pulse_id].tolist()


@pytest.mark.parametrize("numbers", [[1, 2, 1], [0, 0, 0], [-1, 0, 2], [1, 2, 3], [0, 3, 0]])
def test_multiplicity_that_fits_nothing_is_extra(save, numbers):
    with pytest.warns(UserWarning, match=r"a\.apt.*pulses unknown"):
        hits = read(save(apt_section("Multiplicity", np.array(numbers, "i4"))))
    assert hits.pulse_id is None and hits.multiplicity is None and hits.extra["Multiplicity"].tolist() == numbers


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_multiplicities_beyond_all_bounds(save):
    for numbers in ([2**64 - 1, 0, 0], [2**63, 2**63, 2**63], [2**62, 2**62, 0]):
        with pytest.warns(UserWarning, match="pulses unknown"):
            hits = read(save(apt_section("Multiplicity", np.array(numbers, "u8"))))
        assert hits.extra["Multiplicity"].tolist() == numbers


def test_wrong_shape_or_type_of_a_known_name_is_extra(save):
    path = save(
        apt_section("Mass", np.ones((3, 2), "f4"), "Da"), apt_section("tofc", np.array([b"a", b"b", b"c"]), "ns")
    )
    with pytest.warns(UserWarning, match=r"'Mass' has 2 values per ion|'tofc' has values of type"):
        hits = read(path)
    assert hits.columns == () and set(hits.extra) == {"Mass", "tofc"}


def test_counts_that_contradict_the_header(save):
    with pytest.raises(FileError, match=r"a\.apt.*'Mass'.*has 3 records, expected .* 4 ions"):
        read(save(apt_section("Mass", THREE, "Da"), ions=4))
    with pytest.raises(FileError, match=r"has 12 bytes, expected 3 records of 8 bytes"):
        read(save(apt_section("Mass", THREE, "Da", record_size=8)))
    with pytest.raises(FileError, match="0 ions"):
        read(save(apt_section("Mass", THREE[:0], "Da"), ions=0))
    with pytest.raises(FileError, match="byte count must be >= 0, got -1"):
        read(save(apt_section("Mass", THREE, "Da", length=-1)))


@pytest.mark.slow
def test_a_file_cut_anywhere_says_so_and_partial_reads_the_whole_sections(tmp_path):
    data, columns = usual_apt()
    names = ["time_of_flight", "mass_to_charge", "x", "y", "multiplicity", "positions"]
    lengths = [148 + 24] * 5 + [172 + 72]
    ends = 540 + np.cumsum(lengths)
    assert ends[-1] == len(data)
    for cut in range(4, len(data)):
        path = tmp_path / "cut.apt"
        path.write_bytes(data[:cut])
        whole = np.count_nonzero(ends <= cut)
        if cut in ends:
            assert len(strict(path)) == 6  # nothing tells that a section is missing
            continue
        with pytest.raises(TruncatedFile, match=r"cut\.apt"):
            read(path)
        if whole == 0:
            with pytest.raises(TruncatedFile), warnings.catch_warnings(action="ignore"):
                read(path, partial=True)
            continue
        with pytest.warns(UserWarning, match=f"only the {whole} sections"):
            hits = read(path, partial=True)
        wanted = {*names[:whole], *(["pulse_id"] if whole > 4 else [])}
        assert set(hits.columns) == wanted
        np.testing.assert_array_equal(hits.time_of_flight, columns["time_of_flight"])


def test_what_is_no_apt(save, tmp_path):
    path = tmp_path / "a.apt"
    path.write_bytes(b"")
    with pytest.raises(FileError, match=r"a\.apt.*empty"):
        read(path)
    path.write_bytes(b"anything else")
    with pytest.raises(FileError, match="does not begin like"):
        read(path)
    with pytest.raises(FileError, match="does not begin like"):
        read(path, format=".apt")
    path.write_bytes(struct.pack("<4si", b"APT\0", 12).ljust(540, b"\1"))
    with pytest.raises(FileError, match="header size of 12"):
        read(path)
    with pytest.raises(FileError, match=r"expected a section .* at byte 540, got b'XYZ"):
        read(save(apt_section("Mass", THREE, "Da", signature=b"XYZ\0")))
    with pytest.raises(FileError, match="no complete section"):
        read(save())


def test_some_columns_only(tmp_path):
    data, columns = usual_apt()
    path = tmp_path / "a.apt"
    path.write_bytes(data)
    hits = strict(path, columns=("y", "pulse_id"))
    assert hits.columns == ("y", "pulse_id") and hits.y.tolist() == columns["y"].tolist()
    with pytest.raises(FileError, match=r"a\.apt.*no column 'voltage', available are time_of_flight, .*pulse_id"):
        read(path, columns=("x", "voltage"))


def test_sections_of_ap_suite(save):
    """Names of IVAS and AP Suite; the preferred one is the column, the others stay as they are."""
    sections = {
        "Mass": ("da", "mass_to_charge", 1.0),
        "Voltage": ("V", "voltage", 1.0),
        "Pulse Voltage": ("kV", "pulse_voltage", 1e3),
        "Epos ToF": ("NS", "time_of_flight", 1.0),
        "XDet_mm": ("", "x", 1.0),
        "YDet_mm": ("Mm", "y", 1.0),
    }
    lower = {name.lower(): of for name, of in sections.items()} | {"mass": ("DA", "mass_to_charge", 1.0)}
    for names in (sections, lower):
        counts = [apt_section(name, np.array([1, 40, 0], "i2"), "") for name in ("pulseDelta", "pulse")]
        parts = [apt_section(name, THREE, unit) for name, (unit, _, _) in names.items()]
        hits = strict(save(*parts, *counts, apt_section("tof", 2 * THREE, "ns"), apt_section("Vap", THREE, "V")))
        for _, column, factor in names.values():
            np.testing.assert_allclose(getattr(hits, column), THREE * factor, rtol=1.2e-7)
        assert hits.pulses.tolist() == [1, 40, 0] and set(hits.extra) == {"tof", "pulse", "Vap"}
        assert strict(hits.source, columns=("voltage", "pulses")).columns == ("voltage", "pulses")
    for names in (("Delta Pulse", "v", "tof"), ("pulsedelta", "VOLTAGE", "Time of Flight")):
        counts = apt_section(names[0], np.array([1, 2, 3], "u4"))
        hits = strict(save(counts, apt_section(names[1], THREE, "v"), apt_section(names[2], THREE, "s")))
        assert hits.columns == ("time_of_flight", "voltage", "pulses") and hits.extra == {}
        np.testing.assert_allclose(hits.time_of_flight, THREE * 1e9, rtol=1.2e-7)


def test_a_preferred_section_that_does_not_fit_leaves_its_place_to_the_next(save):
    path = save(apt_section("tofc", THREE, "furlong"), apt_section("tof", THREE, "ns"))
    with pytest.warns(UserWarning, match="'tofc' has the unknown unit"):
        hits = read(path)
    assert hits.time_of_flight.tolist() == THREE.tolist() and set(hits.extra) == {"tofc"}
    with pytest.raises(FileError, match=r"a\.apt': section 'pulseDelta' must be the number of pulses .* got -3"):
        read(save(apt_section("pulseDelta", np.array([1, -3, 2], "i2"))))
