"""Extended XYZ and .vtp, read back by what their descriptions say."""

import csv
import re
import warnings
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.io.formats import read, write
from apt_evap.spectra.mass_ranges import Ranges


def full():
    """Three ions with all kinds of columns, one of which missed."""
    return Hits(
        positions=np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9.125]], "f4"),
        x=[0.1, np.nan, 3.0],
        y=np.array([0.1, np.nan, 3.0], "f4"),
        mass_to_charge=[28.0, 16.0, 55.5],
        pulses=[0, 2**32 - 1, 2],
        pulse_id=[0, 1, 1],
        site=[5, 2**40, 7],
        outcome=[Outcome.HIT, Outcome.MISSED, Outcome.HIT],
        extra={"pair": np.arange(6.0).reshape(3, 2), "a-b": [1, 2, 3], "a b": [4, 5, 6], "text": ["a", "b", "c"]},
    )


EXPECTED = {
    "detector_x": "x",
    "detector_y": "y",
    "mass_to_charge": "mass_to_charge",
    "pulses": "pulses",
    "pulse_id": "pulse_id",
    "site": "site",
    "outcome": "outcome",
}


def parse_xyz(path):
    """Columns of an extended XYZ, as its Properties say."""
    count, comment, *lines = path.read_text().splitlines()
    rows = [line.split() for line in lines]
    assert len(rows) == int(count)
    words = re.search(r"Properties=(\S+)", comment)[1].split(":")
    assert 'pbc="F F F"' in comment
    columns, at = {}, 0
    for name, kind, width in zip(words[::3], words[1::3], map(int, words[2::3]), strict=True):
        assert name not in columns
        part = [row[at : at + width] for row in rows]
        columns[name] = np.array(part, {"S": str, "R": float, "I": np.int32}[kind])
        columns[name] = columns[name][:, 0] if width == 1 else columns[name]
        at += width
    assert all(len(row) == at for row in rows)
    return columns


def parse_vtp(path):
    """Points, point data and cells of a .vtp with appended raw data."""
    data = path.read_bytes()
    start = data.index(b'<AppendedData encoding="raw">\n_') + len(b'<AppendedData encoding="raw">\n_')
    end = data.rindex(b"\n</AppendedData>")
    root = ElementTree.fromstring(data[:start] + data[end:])
    assert root.attrib == {
        "type": "PolyData",
        "version": "1.0",
        "byte_order": "LittleEndian",
        "header_type": "UInt64",
    }
    piece = root.find("PolyData/Piece")
    n = int(piece.get("NumberOfPoints"))
    assert int(piece.get("NumberOfVerts")) == n
    parts, read_to = {}, 0
    for folder in ("PointData", "Points", "Verts"):
        for array in piece.find(folder):
            at = start + int(array.get("offset"))
            size = int.from_bytes(data[at : at + 8], "little")
            if array.get("type") == "String":
                texts = data[at + 8 : at + 8 + size].decode().split("\0")
                assert int(array.get("NumberOfTuples")) == n == len(texts) - 1 and texts.pop() == ""
                parts[folder, array.get("Name")] = np.array(texts)
                read_to = max(read_to, at + 8 + size)
                continue
            kind = re.fullmatch(r"(Float|Int|UInt)(\d+)", array.get("type"))
            dtype = f"<{kind[1][0].lower()}{int(kind[2]) // 8}"
            values = np.frombuffer(data[at + 8 : at + 8 + size], dtype)
            width = int(array.get("NumberOfComponents"))
            parts[folder, array.get("Name")] = values if width == 1 else values.reshape(-1, width)
            assert len(parts[folder, array.get("Name")]) == n
            read_to = max(read_to, at + 8 + size)
    assert read_to == end
    return parts


def test_xyz_holds_every_column(tmp_path):
    hits = full()
    hits.extra["text"] = np.array(["a", "b c", ""])
    write(tmp_path / "a.xyz", hits, species=["Si", "O", "Cr"])
    columns = parse_xyz(tmp_path / "a.xyz")
    assert columns.pop("species").tolist() == ["Si", "O", "Cr"]
    np.testing.assert_array_equal(columns.pop("pos"), 10 * hits.positions.astype(float))  # Angstrom
    for name, of in EXPECTED.items():
        values = columns.pop(name)
        np.testing.assert_array_equal(values.astype(getattr(hits, of).dtype), getattr(hits, of))
        # whole numbers beyond 32 bits are real ones
        assert (values.dtype.kind == "i") == (of in ("pulse_id", "outcome"))
    np.testing.assert_array_equal(columns.pop("pair"), hits.extra["pair"])
    assert columns.pop("a_b").tolist() == [1, 2, 3] and columns.pop("a_b_2").tolist() == [4, 5, 6]
    assert columns.pop("text").tolist() == ["a", "b_c", "_"]
    assert columns == {}


def test_vtp_holds_every_column(tmp_path):
    hits = full()
    write(tmp_path / "a.vtp", hits)
    parts = parse_vtp(tmp_path / "a.vtp")
    np.testing.assert_array_equal(parts.pop(("Points", "positions")), hits.positions)  # nm
    assert parts.pop(("Verts", "connectivity")).tolist() == [0, 1, 2]
    assert parts.pop(("Verts", "offsets")).tolist() == [1, 2, 3]
    for name, of in EXPECTED.items():
        values = parts.pop(("PointData", name))
        np.testing.assert_array_equal(values, getattr(hits, of))
        assert values.dtype == getattr(hits, of).dtype
    np.testing.assert_array_equal(parts.pop(("PointData", "pair")), hits.extra["pair"])
    assert parts.pop(("PointData", "text")).tolist() == ["a", "b", "c"]
    assert parts.pop(("PointData", "text_number")).tolist() == [0, 1, 2]
    assert {name for _, name in parts} == {"a_b", "a_b_2"}


def test_csv_holds_every_column(tmp_path):
    hits = full()
    hits.units["a b"] = "V"
    hits.extra["a,b"], hits.extra["text"] = np.array([True, False, True]), np.array(["a,b", 'c"d', "e"])
    write(tmp_path / "a.csv", hits)
    with open(tmp_path / "a.csv", newline="", encoding="utf-8") as file:
        titles, *rows = csv.reader(file)
    columns = dict(zip(titles, zip(*rows, strict=True), strict=True))
    assert len(columns) == len(titles)
    for k, axis in enumerate("xyz"):
        np.testing.assert_array_equal(np.array(columns.pop(f"position_{axis} [nm]"), "f4"), hits.positions[:, k])
    for title, of in (("x [mm]", "x"), ("y [mm]", "y"), ("mass_to_charge [Da]", "mass_to_charge")):
        values = getattr(hits, of)
        np.testing.assert_array_equal(np.array(columns.pop(title), float).astype(values.dtype), values)
    for name in ("pulses", "pulse_id", "site", "outcome"):
        assert [int(cell) for cell in columns.pop(name)] == getattr(hits, name).tolist()
    assert [float(cell) for cell in columns.pop("pair_0")] == [0, 2, 4] and columns.pop("pair_1") == ("1", "3", "5")
    assert columns.pop("a b [V]") == ("4", "5", "6") and columns.pop("a-b") == ("1", "2", "3")
    assert columns.pop("a,b") == ("1", "0", "1") and columns.pop("text") == ("a,b", 'c"d', "e")
    assert columns == {}
    again = read(tmp_path / "a.csv")
    for name in ("x", "y", "mass_to_charge", "pulse_id", "positions"):
        values = getattr(hits, name)  # of float32 nine digits are written, which are all of it
        np.testing.assert_array_equal(getattr(again, name).astype(values.dtype), values)


@given(values=arrays("f8", 5, elements=st.floats(allow_nan=True, allow_infinity=True)), single=st.booleans())
def test_numbers_of_a_csv_come_back(tmp_path, values, single):
    with np.errstate(over="ignore"):
        values = values.astype("f4") if single else values
    write(tmp_path / "a.csv", Hits(x=values))
    lines = (tmp_path / "a.csv").read_bytes().split(b"\r\n")
    assert lines[0] == b"x [mm]" and lines[-1] == b""
    np.testing.assert_array_equal(np.array(lines[1:-1], float).astype(values.dtype), values)


@given(positions=arrays("f4", st.tuples(st.integers(1, 9), st.just(3)), elements=st.floats(-1e4, 1e4, width=32)))
def test_positions_come_back(tmp_path, positions):
    hits = Hits(positions=positions, x=positions[:, 0], y=positions[:, 1].astype(float))
    write(tmp_path / "a.vtp", hits)
    np.testing.assert_array_equal(parse_vtp(tmp_path / "a.vtp")["Points", "positions"], positions)
    write(tmp_path / "a.xyz", hits)
    columns = parse_xyz(tmp_path / "a.xyz")
    # half of the last of five decimals of an Angstrom, and the rounding of numbers up to 1e5
    np.testing.assert_allclose(columns["pos"], 10 * positions.astype(float), rtol=0, atol=0.51e-5)
    np.testing.assert_array_equal(columns["detector_x"].astype("f4"), hits.x)
    np.testing.assert_array_equal(columns["detector_y"], hits.y)
    assert set(columns["species"]) == {"X"}


@pytest.mark.parametrize("suffix", [".xyz", ".vtp"])
def test_more_ions_than_a_chunk_and_their_order(tmp_path, suffix, monkeypatch):
    monkeypatch.setattr(f"apt_evap.io.{suffix[1:]}._CHUNK", 7)
    positions = np.random.default_rng(1).normal(size=(50, 3)).round(3)
    path = tmp_path / f"a{suffix}"
    write(path, Hits(positions=positions, ion=np.arange(50)))
    if suffix == ".xyz":
        columns = parse_xyz(path)
        points, ion = columns["pos"] / 10, columns["ion"]
    else:
        parts = parse_vtp(path)
        points, ion = parts["Points", "positions"], parts["PointData", "ion"]
    # 10 x and / 10 round once each
    np.testing.assert_allclose(points, positions, rtol=1e-15, atol=0)
    assert ion.tolist() == list(range(50))


@pytest.mark.parametrize("suffix", [".xyz", ".vtp"])
def test_ions_without_a_place_are_left_out_and_counted(tmp_path, suffix):
    hits = Hits(positions=[[1.0, 2, 3], [np.nan, 0, 0], [4, 5, np.inf]], ion=[0, 1, 2])
    path = tmp_path / f"a{suffix}"
    with pytest.warns(UserWarning, match=rf"a\{suffix}.*2 of 3 ions have positions that are not finite"):
        write(path, hits, **({"species": ["Si", "O", "C"]} if suffix == ".xyz" else {}))
    if suffix == ".xyz":
        assert parse_xyz(path)["species"].tolist() == ["Si"] and parse_xyz(path)["ion"].tolist() == [0]
    else:
        assert parse_vtp(path)["PointData", "ion"].tolist() == [0]
    with pytest.raises(ValueError, match="no ion to write"):
        write(path, hits[1:])
    with pytest.raises(ValueError, match="no column 'positions'"):
        write(path, Hits(x=[1.0]))
    with pytest.raises(ValueError, match=r"no ion to write to .*: the hits are empty$"):
        write(path, hits[:0])
    with pytest.raises(FileError, match=rf"a\{suffix}.* cannot be read"):
        read(path)


def test_species_from_ranges(tmp_path):
    ranges = Ranges(["Si", "O"], [27.0, 15.0], [30.0, 17.0])
    write(tmp_path / "a.xyz", full(), species=ranges.labels(full()))
    assert parse_xyz(tmp_path / "a.xyz")["species"].tolist() == ["Si", "O", "X"]
    for species in (["Si"], 3, ["a b", "c", "d"], "", [""] * 3):
        with pytest.raises(ValueError, match="species"):
            write(tmp_path / "a.xyz", full(), species=species)
    with pytest.raises(FileError, match=r"writing \.vtp files takes no options, got 'species'"):
        write(tmp_path / "a.vtp", full(), species="Si")


def test_what_cannot_be_written(tmp_path):
    for suffix in (".apt", ".raw"):
        with pytest.raises(FileError, match=rf"a {suffix} file is a format that can only be read"):
            write(tmp_path / f"a{suffix}", full())
    with pytest.raises(ValueError, match="hits"):
        write(tmp_path / "a.xyz", 5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write(tmp_path / "a.XYZ", full())
    assert len(parse_xyz(tmp_path / "a.XYZ")["pos"]) == 3


@pytest.fixture(scope="session")
def two_phases():
    """Hits of a specimen of nickel with a particle below its apex, and their elements and phases."""
    sphere = ae.specimen.Sphere((0, 0, 2.0), 0.9)
    particle = ae.specimen.Phase("rich in copper", "Ni", region=sphere, solutes={"Cu": 0.5})
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", "Ni"), particle], apex_radius=2.0, seed=1)
    run = ae.Simulation(tip, seed=1).run(150, responses=False, progress=False)
    elements = [run.elements[k] for k in run.species]
    names = [run.phase_names[k] for k in run.phase]
    assert {"Ni", "Cu"} == set(elements) and len(set(names)) == 2
    return run.hits(ae.Unperturbed()), elements, names


def test_elements_and_phases_of_a_run(tmp_path, two_phases):
    hits, elements, names = two_phases
    for suffix in ("xyz", "vtp", "csv"):
        write(tmp_path / f"a.{suffix}", hits)
    columns = parse_xyz(tmp_path / "a.xyz")
    assert columns["species"].tolist() == elements and "element" not in columns
    assert columns["phase_name"].tolist() == [name.replace(" ", "_") for name in names]
    parts = parse_vtp(tmp_path / "a.vtp")
    for name, texts in (("element", elements), ("phase_name", names)):
        assert parts["PointData", name].tolist() == texts
        kinds = sorted(set(texts))
        assert [kinds[k] for k in parts["PointData", f"{name}_number"]] == texts
    with open(tmp_path / "a.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["element"] for row in rows] == elements and [row["phase_name"] for row in rows] == names


def test_ase_reads_the_ions_of_a_run(tmp_path, two_phases):
    ase_io = pytest.importorskip("ase.io")
    hits, elements, names = two_phases
    write(tmp_path / "a.xyz", hits)
    atoms = ase_io.read(tmp_path / "a.xyz")
    assert atoms.get_chemical_symbols() == elements
    assert atoms.arrays["phase_name"].tolist() == [name.replace(" ", "_") for name in names]
    np.testing.assert_allclose(atoms.positions, 10 * hits.positions, rtol=0, atol=0.51e-5)  # five decimals
    np.testing.assert_array_equal(atoms.arrays["ion"], hits.ion)
    np.testing.assert_array_equal(atoms.arrays["detector_x"], hits.x)


def test_vtk_reads_the_ions_of_a_run(tmp_path, two_phases):
    vtk = pytest.importorskip("vtk")
    hits, elements, names = two_phases
    write(tmp_path / "a.vtp", hits)
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(tmp_path / "a.vtp"))
    reader.Update()
    data = reader.GetOutput().GetPointData()
    for name, texts in (("element", elements), ("phase_name", names)):
        array = data.GetAbstractArray(name)
        assert [array.GetValue(k) for k in range(array.GetNumberOfValues())] == texts
    assert data.GetArray("ion").GetTuple1(7) == hits.ion[7]


def test_ions_of_a_run(tmp_path, small_tip):
    run = ae.Simulation(small_tip, seed=1).run(40, responses=False, progress=False)
    hits = run.hits(run.perturbations[0])
    write(tmp_path / "a.xyz", hits, species="Ni")
    write(tmp_path / "a.vtp", hits)
    columns, parts = parse_xyz(tmp_path / "a.xyz"), parse_vtp(tmp_path / "a.vtp")
    np.testing.assert_array_equal(parts["Points", "positions"], hits.positions)
    np.testing.assert_allclose(columns["pos"], 10 * hits.positions, rtol=0, atol=0.51e-5)  # five decimals
    assert columns["site"].tolist() == hits.site.tolist() == parts["PointData", "site"].tolist()
