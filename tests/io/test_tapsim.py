"""Result tables and node files of TAPSim, built from the layouts of its own reader and writer."""

import numpy as np
import pytest
from ion_files import TAPSIM_COLUMNS, tapsim_nodes, tapsim_table

import apt_evap as ae
from apt_evap._common.files import FileError, TruncatedFile
from apt_evap.io.tapsim_nodes import write_nodes, write_types

# two roundings to float32 of numbers in metres
SINGLE = 2.5e-7

pytestmark = pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # places of made ions are in metres


@pytest.mark.parametrize("binary", [False, True])
def test_every_column_of_a_table(tmp_path, binary):
    data, rows = tapsim_table(5, binary)
    (tmp_path / "results").write_bytes(data)  # the signature suffices
    hits = ae.read(tmp_path / "results")
    rows = rows.astype(float)
    assert hits.ion.tolist() == [0, 1, 2, 3, 4] and hits.site.tolist() == [7, 8, 9, 10, 11]
    for name, expected in (
        ("voltage", rows[:, 3]),
        ("positions", 1e9 * rows[:, 4:7]),  # m to nm
        ("x", 1e3 * rows[:, 7]),  # m to mm
        ("y", 1e3 * rows[:, 8]),
        ("time_of_flight", 1e9 * rows[:, 10]),  # s to ns
    ):
        np.testing.assert_allclose(getattr(hits, name), expected, rtol=1e-7, atol=0, err_msg=name)
    for name, expected in (
        ("id", rows[:, 1]),
        ("stop_z", 1e3 * rows[:, 9]),
        ("probability", rows[:, 11]),
        ("potential_before", rows[:, 12]),
        ("field_before", 1e-9 * rows[:, 13:16]),  # V/m to V/nm
        ("potential_after", rows[:, 16]),
        ("field_after", 1e-9 * rows[:, 17:20]),
        ("normal", rows[:, 20:23]),
        ("apex", 1e9 * rows[:, 23:26]),
    ):
        np.testing.assert_allclose(hits.extra[name], expected, rtol=1e-7, atol=0, err_msg=name)
    assert hits.units["field_before"] == "V/nm" and hits.units["apex"] == "nm" and "id" not in hits.units


@pytest.mark.parametrize("binary", [False, True])
def test_a_table_comes_back_to_the_byte(tmp_path, binary):
    data, _ = tapsim_table(5, binary)
    (tmp_path / "a.tapsim").write_bytes(data)
    ae.write(tmp_path / "b.tapsim", ae.read(tmp_path / "a.tapsim"), binary=binary)
    again = (tmp_path / "b.tapsim").read_bytes()
    kind = b"BINARY\n" if binary else b"ASCII\n"
    assert again.split(kind, 1)[1] == data.split(kind, 1)[1]
    lines = again.split(kind, 1)[0].decode().splitlines()
    assert lines[:2] == ["TAPSIM RESULTS DATA", "VERSION 1.0"]
    assert [line.split()[1] for line in lines[2:]] == TAPSIM_COLUMNS
    assert lines[5] == "# voltage [V]" + (" (float)" if binary else "") and "startX [m]" in lines[6]


def test_text_has_nine_digits(tmp_path):
    values = np.random.default_rng(1).uniform(1, 9, 200)
    ae.write(tmp_path / "a.tapsim", ae.Hits(x=values, y=-values))
    hits = ae.read(tmp_path / "a.tapsim")
    np.testing.assert_allclose(hits.x, values, rtol=5.1e-9)  # half a unit of the ninth digit
    np.testing.assert_allclose(hits.y, -values, rtol=5.1e-9)


def test_ions_of_a_run_as_a_table(tmp_path, small_tip):
    run = ae.Simulation(small_tip, seed=1).run(30, progress=False)
    hits = run.hits(ae.Unperturbed())
    ae.write(tmp_path / "a.tapsim", hits)
    text = (tmp_path / "a.tapsim").read_text().split("ASCII\n")[1]
    table = np.array([line.split("\t") for line in text.splitlines()], float)
    assert table.shape == (30, 26)
    np.testing.assert_array_equal(table[:, 0], hits.ion)
    np.testing.assert_array_equal(table[:, 2], hits.site)
    for columns, expected in (
        (table[:, 3], hits.voltage),
        (table[:, 4:7] * 1e9, hits.positions),
        (table[:, 7] * 1e3, hits.x),
        (table[:, 10] * 1e9, hits.time_of_flight),
    ):
        np.testing.assert_allclose(columns, expected, rtol=SINGLE, atol=1e-12)
    assert np.isnan(table[:, 11:]).all() and (table[:, 1] == 0).all()


def test_tables_that_are_wrong(tmp_path):
    path = tmp_path / "a.tapsim"
    data, _ = tapsim_table(3)
    for wrong, message in (
        (b"TAPSIM RESULTS DATA\nVERSION 1.0\n", "no line ASCII or BINARY"),
        (data[: data.index(b"ASCII\n") + 6], "has no rows"),
        (data.replace(b"\t10\t", b"\tx\t", 1), "line 30: expected 26 numbers"),
        (data.replace(b"\t10\t", b"\t1.5\t", 1), "line 30: expected 26 numbers"),
        (data.replace(b"\t10\t", b"\t1_0\t", 1), "line 30: expected 26 numbers"),
        (data.replace(b"\t10\t", b"\t", 1), "line 30: expected 26 numbers"),
        (b"TAPSIM", "does not begin like a .tapsim file"),
    ):
        path.write_bytes(wrong)
        with pytest.raises(FileError, match=rf"a\.tapsim'.*{message}"):
            ae.read(path)
    for binary in (False, True):
        data, _ = tapsim_table(3, binary)
        path.write_bytes(data[:-20])
        with pytest.raises(TruncatedFile, match=r"middle of a row after 2 complete rows; partial=True .* reads"):
            ae.read(path)
        assert ae.read(path, partial=True).ion.tolist() == [0, 1]


def test_trajectories_without_an_end_are_not_detected(tmp_path):
    _, rows = tapsim_table(3)
    rows[1, 7:10] = np.nan
    cells = [[*(str(int(value)) for value in row[:3]), *(f"{value:.8e}" for value in row[3:])] for row in rows]
    data = tapsim_table(3)[0].split(b"ASCII\n")[0] + b"ASCII\n"
    (tmp_path / "a.tapsim").write_bytes(data + "".join("\t".join(row) + "\n" for row in cells).encode())
    assert ae.read(tmp_path / "a.tapsim").detected.tolist() == [True, False, True]


# ---- nodes ---------------------------------------------------------------------------------------------------------

PLACES = np.random.default_rng(1).uniform(-2e-9, 2e-9, (40, 3)).astype("f4").astype(float)  # [m]
IDS = np.array([10] * 20 + [20] * 10 + [0, 1, 2, 3] + [10] * 6)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("more", [{}, {"numbers": range(40)}, {"potentials": np.arange(40.0)},
                                  {"numbers": range(40), "potentials": np.arange(40.0)}])  # fmt: skip
def test_every_node(tmp_path, binary, more):
    (tmp_path / "nodes.txt").write_bytes(b"# a comment\n" * (not binary) + tapsim_nodes(PLACES, IDS, binary, **more))
    tip = ae.read_tip(tmp_path / "nodes.txt", {10: "Al", "20": "Cu"})
    atoms = IDS > 3
    np.testing.assert_allclose(tip.positions, 1e9 * PLACES[atoms], rtol=1e-15)  # one rounding
    assert [tip.elements[k].name for k in tip.species] == ["Al"] * 20 + ["Cu"] * 10 + ["Al"] * 6


@pytest.mark.parametrize("binary", [False, True])
def test_a_tip_there_and_back(tmp_path, binary):
    tip = ae.Tip("Al", apex_radius=2.0, shank_length=2.0, solutes={"Cu": 0.1}, seed=1)
    write_nodes(tmp_path / "nodes.txt", tip, binary=binary)
    back = ae.read_tip(tmp_path / "nodes.txt", {10: "Al", 20: "Cu"}, evaporable=tip.evaporable)
    # eight decimals of numbers to 2e-9 m, or float32
    np.testing.assert_allclose(back.positions, tip.positions, rtol=SINGLE if binary else 1e-8, atol=0)
    np.testing.assert_array_equal(back.species, tip.species)
    assert back.evaporation_fields.tolist() == tip.evaporation_fields.tolist()
    with pytest.raises(ValueError, match="tip"):
        write_nodes(tmp_path / "shell", ae.Tip("Al", apex_radius=4.0, depth=1.5))


def test_types_of_the_nodes(tmp_path):
    """The order of the keys and blocks as the reader of TAPSim wants them."""
    tip = ae.Tip("Al", apex_radius=2.0, shank_length=2.0, solutes={"Cu": 0.1}, seed=1)
    energies = {"Cu": 2.2, "Al": 1.8}
    write_types(tmp_path / "a.aly", tip, temperature=80.0, activation_energies=energies, voltage=2000.0)
    first, temperature, *blocks = (tmp_path / "a.aly").read_text().strip().split("\n\n")
    assert (first, temperature) == ("ASCII", "TEMPERATURE = 80")
    types = [dict(line.split(" = ") for line in block.splitlines()) for block in blocks]
    assert [each["NAME"] for each in types] == ["Vacuum", "Top", "Bottom", "Sides", "Al", "Cu"]
    assert [each["ID"] for each in types] == ["0", "1", "2", "3", "10", "20"]
    assert all(list(each) == list(types[0]) and len(each) == 12 for each in types)
    copper = types[5]
    assert float(copper["EVAPORATION_FIELD_STRENGTH"]) == 30e9 and float(copper["MASS"]) == 63.546
    assert float(copper["EVAPORATION_ACTIVATION_ENERGY"]) == pytest.approx(2.2)  # its barrier has a factor 1/2
    assert (copper["REMOVABLE"], copper["DIRICHLET_BOUNDARY"], copper["POTENTIAL"]) == ("1", "1", "2000")
    assert (types[2]["NEUMANN_BOUNDARY"], types[2]["POTENTIAL"], types[1]["DIRICHLET_BOUNDARY"]) == ("1", "2000", "1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"temperature": -1.0}, "temperature must be"),
        ({"temperature": float("nan")}, "temperature must be"),
        ({"activation_energies": "2"}, "activation_energies must be"),
        ({"activation_energies": {"Al": 2.0}}, r"activation_energies must have a value for Cu, got \{'Al': 2.0\}"),
        ({"activation_energies": {"Al": 2.0, "Cu": 2.0, "Ni": 2.0}}, "activation_energies must be of Al, Cu, got 'Ni'"),
        ({"activation_energies": {"Al": 2.0, "Cu": -2.0}}, "activation energy of Cu must be"),
        ({"voltage": 0.0}, "voltage must be"),
    ],
)
def test_types_with_wrong_arguments_are_not_written(tmp_path, arguments, message):
    tip = ae.Tip("Al", apex_radius=2.0, shank_length=2.0, solutes={"Cu": 0.1}, seed=1)
    with pytest.raises(ValueError, match=message):
        write_types(tmp_path / "a.aly", tip, **arguments)
    assert not any(tmp_path.iterdir())


def test_nodes_that_are_wrong(tmp_path):
    path = tmp_path / "nodes.txt"
    data = tapsim_nodes(PLACES, IDS)

    def refused(content, message, kind=FileError, types=None, **options):
        path.write_bytes(content)
        with pytest.raises(kind, match=rf"nodes\.txt'.*{message}"):
            ae.read_tip(path, types if types is not None else {10: "Al", 20: "Cu"}, **options)

    refused(data, r"types without a name, .* such as types=\{10: 'Al'\}, got none for 10, 20", types={})
    refused(data, r"got none for 20$", types={10: "Al"})
    refused(data, "has no atoms of type '30', only of 10, 20", types={10: "Al", 20: "Cu", 30: "W"})
    refused(data, "no material is named 'Xx'", types={10: "Al", 20: "Xx"})
    refused(data, "of format tapsim takes no such options, got 'units'", units="metal")
    refused(data[: data.rindex(b"\n", 0, -5)], "states 40 nodes but ends after 39", TruncatedFile)
    refused(tapsim_nodes(PLACES, IDS, True)[:-3], "states 40 nodes but ends after 39", TruncatedFile)
    refused(tapsim_nodes(PLACES, 0 * IDS), "has no atoms among its 40 nodes")
    refused(tapsim_nodes(PLACES, IDS - 15), "nodes with the invalid id -15")
    refused(data.replace(b"\t10\n", b"\tAl\n", 1), "expected 4 numbers for each node, the fourth one an integer")
    refused(tapsim_nodes(PLACES * np.inf, IDS), "positions are not finite")
    refused(tapsim_nodes(0 * PLACES, IDS), "positions must be distinct")
    refused(b"ASCII 40\n", "does not begin like a node file", format="tapsim")
