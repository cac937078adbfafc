"""Text tables of ions and of calibration grids, as spreadsheets and other programs write them."""

import warnings

import h5py
import numpy as np
import pytest

from apt_evap._common.files import FileError
from apt_evap.detection.hits import Hits
from apt_evap.io.distortion_grid import read_grid
from apt_evap.io.formats import read, write
from apt_evap.warnings import DataWarning

IONS = [(1.204, -3.377, 0.052, 30.9688), (-2.518, 0.914, 0.061, 46.453), (0.033, 4.106, 0.087, 59.9511)]


def table(header, divider, comma=False, end="\n", rows=IONS):
    lines = [divider.join(str(cell).replace(".", ",") if comma else str(cell) for cell in row) for row in rows]
    return end.join([*header, *lines, ""])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", table(['"x (nm)","y (nm)","z (nm)","m/n (Da)"'], ",")),
        ("a.csv", table(["X [nm];Y [nm];Z [nm];m/n [Da]"], ";", comma=True, end="\r\n")),
        ("a.txt", table(["# x y z m_n, of a script"], "\t")),
        ("a.txt", table(["# made yesterday by someone"], "\t", comma=True)),
        ("a.txt", table([], " ", comma=True, end="\r")),
        ("a.csv", table(["x,y,z,m"], ",", end="\r\n")),
        ("a.txt", table(["X_nm\tY_nm\tZ_nm\tMass-to-charge-state ratio (Da)"], "\t")),
        ("a.csv", table(["x (A),y (A),z (A),mc"], ",", rows=[(*np.multiply(row[:3], 10), row[3]) for row in IONS])),
    ],
)
def test_ions_of_other_programs(tmp_path, name, text):
    (tmp_path / name).write_bytes(text.encode())
    hits = read(tmp_path / name)
    assert hits.mass_to_charge.tolist() == [row[3] for row in IONS]
    # units are factors of ten: one rounding
    np.testing.assert_allclose(hits.positions, [row[:3] for row in IONS], rtol=1e-14)


def test_units_in_the_names_of_columns(tmp_path):
    (tmp_path / "a.csv").write_text("XDet_mm,YDet_cm,Time of flight_us,Dose_nm\n1,2,0.5,7\n")
    hits = read(tmp_path / "a.csv")
    assert (hits.x.item(), hits.y.item(), hits.time_of_flight.item()) == (1.0, 20.0, 500.0)
    assert list(hits.extra) == ["Dose_nm"]  # a name that is not known stays whole


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_a_csv_is_read_back(tmp_path, dtype):
    random = np.random.default_rng(3)
    values = random.normal(size=(5, 60)).astype(dtype) * [[30], [30], [600], [5000], [28]]
    hits = Hits(
        x=values[0].astype(dtype), y=values[1].astype(dtype), time_of_flight=values[2].astype(dtype),
        voltage=values[3].astype(dtype), mass_to_charge=values[4].astype(dtype),
        positions=random.normal(size=(60, 3)).astype(dtype), pulse_id=np.arange(60) // 2,
        multiplicity=np.full(60, 2),
        extra={"element": np.array(["Al", 'C"u'] * 30), "pair": random.normal(size=(60, 2))},
        units={"pair": "nm"},
    )  # fmt: skip
    write(tmp_path / "a.csv", hits)
    again = read(tmp_path / "a.csv")
    assert again.columns == hits.columns and again.extra.keys() == hits.extra.keys() and again.units == hits.units
    for name in hits.columns:
        assert getattr(again, name).dtype == getattr(hits, name).dtype, name
        np.testing.assert_array_equal(getattr(again, name), getattr(hits, name))
    for name, column in hits.extra.items():
        np.testing.assert_array_equal(again.extra[name], column)


@pytest.mark.parametrize(("separator", "divider"), [("comma", ","), ("semicolon", ";"), ("tab", "\t")])
def test_decimals_and_separators_of_a_csv(tmp_path, separator, divider):
    x = np.array([1.23456, -0.0004, 217.891])
    label = np.array(["a;b", "a,b", "a\tb"])
    hits = Hits(x=x, y=-x, pulse_id=[0, 1, 1], multiplicity=[1, 2, 2], extra={"label": label})
    write(tmp_path / "a.csv", hits, decimals=3, separator=separator)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0].split(divider)[:2] == ["x [mm]", "y [mm]"]
    assert lines[3].split(divider)[:2] == ["217.891", "-217.891"]
    again = read(tmp_path / "a.csv")
    assert again.x.tolist() == [1.235, 0, 217.891] and again.pulse_id.tolist() == [0, 1, 1]
    assert again.extra["label"].tolist() == label.tolist()
    write(tmp_path / "a.csv", hits, separator=separator)
    assert read(tmp_path / "a.csv").x.tolist() == x.tolist()


@pytest.mark.parametrize("options", [{"decimals": -1}, {"decimals": 18}, {"separator": ";"}, {"decimals": 1.5}])
def test_forms_of_a_csv_that_are_wrong(tmp_path, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        write(tmp_path / "a.csv", Hits(x=[1.0], y=[2.0]), **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x [mm],y [mm]\n1,2\n1,2,3\n", "line 3: expected 2 cells, got 3"),
        ("x [mm],y [mm]\n1,2\n1,two\n", "line 3: expected a number, got 'two'"),
        ("x [miles],y [mm]\n1,2\n", "the unit of x must be one of m, .*, got 'miles'"),
        ("a,b\n1,2\n", "has no column of ions such as x, y or m/n, only a, b"),
        ("1,2,3\n", "must name its columns in the first line.* got 3 columns"),
        ("x,y\n", "has no numbers"),
        ("x,y\n1,\0\n", "is not a text: it has zero bytes"),
        ("x,X\n1,2\n", "different columns"),
    ],
)
def test_tables_that_are_wrong(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(FileError, match=rf"a\.csv'.*{message}"):
        read(tmp_path / "a.csv")


def seen(x, y):
    """Place on the detector [mm] of a crossing."""
    return x * (1.04 - 2e-4 * x * x) + 0.35, 0.95 * y * (1 + 1e-4 * y * y) - 0.2


ROWS = [(*seen(x, y), x, y) for y in range(-24, 25, 6) for x in range(-18, 19, 6)]
NAMES = ["detectorX", "detectorY", "gridX", "gridY"]


@pytest.mark.parametrize(
    ("divider", "comma", "end"), [(",", 0, "\r"), (";", 1, "\r\n"), ("\t", 0, "\n"), ("\t", 1, "\n")]
)
def test_grids_of_other_programs(tmp_path, divider, comma, end):
    (tmp_path / "a.csv").write_text(table([",".join(NAMES)], ",", rows=ROWS))
    (tmp_path / "b.csv").write_bytes(table([divider.join(NAMES)], divider, comma, end, ROWS).encode())
    np.testing.assert_array_equal(read_grid(tmp_path / "b.csv").detector, read_grid(tmp_path / "a.csv").detector)


def test_a_grid_with_exchanged_axes(tmp_path):
    (tmp_path / "a.csv").write_text(table([",".join(NAMES)], ",", rows=ROWS))
    (tmp_path / "b.csv").write_text(table([",".join(NAMES)], ",", rows=[(b, a, c, d) for a, b, c, d in ROWS]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        good = read_grid(tmp_path / "a.csv")
        exchanged = read_grid(tmp_path / "b.csv", exchange=True)
    np.testing.assert_array_equal(exchanged.detector, good.detector)
    # the places of the grid belong to these hits: from the equations, to the width of a square
    assert np.round(np.ravel(good.undistorted([15.0, 0.0], [0.0, 15.0])), 2).tolist() == [14.99, 0.01, 0.01, 15.23]
    with pytest.warns(DataWarning, match=r"b\.csv' fits the detector only mirrored: are detectorX and detectorY"):
        assert read_grid(tmp_path / "b.csv").mirrored


def nxapm(path, mass, **options):
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry1/atom_probe")
        entry.create_dataset("mass_to_charge_conversion/mass_to_charge", data=mass, **options).attrs["units"] = "Da"
    return path


def test_nxapm_with_lzf_and_masses_in_a_column(tmp_path):
    mass = np.linspace(10, 60, 300, dtype="f4")
    chunks = {"chunks": (75,)}
    for name, values, options in (
        ("gzip", mass, {"compression": "gzip", **chunks}),
        ("lzf", mass, {"compression": "lzf", **chunks}),
        ("shuffled", mass, {"compression": "lzf", "shuffle": True, **chunks}),
        ("column", mass[:, None], {"compression": "gzip", "chunks": (75, 1)}),
    ):
        np.testing.assert_array_equal(read(nxapm(tmp_path / f"{name}.nxs", values, **options)).mass_to_charge, mass)
    with pytest.raises(FileError, match=r"must have shape \(any\), got \(150, 2\)"):
        read(nxapm(tmp_path / "two.nxs", mass.reshape(150, 2)))


@pytest.mark.parametrize("name", ["Blosc", "Zstd"])
def test_nxapm_compressed_by_a_plugin(tmp_path, name):
    plugin = pytest.importorskip("hdf5plugin")
    mass = np.linspace(10, 60, 300, dtype="f4")
    path = nxapm(tmp_path / "a.nxs", mass, chunks=(75,), **getattr(plugin, name)())
    np.testing.assert_array_equal(read(path).mass_to_charge, mass)


def test_a_tilde_is_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "a.csv").write_text("x [mm],y [mm]\n1,2\n")
    assert read("~/a.csv").x.tolist() == [1.0]


ROWS_OF_IONS = [tuple(row) for row in np.random.default_rng(2).uniform(1, 30, (6, 4)).round(3).tolist()]
ODD = {
    "a word": lambda cells: ["x"],
    "a cell less": lambda cells: cells[1:],
    "a cell more": lambda cells: [*cells, cells[-1]],
    "a word in it": lambda cells: [cells[0], "odd", *cells[1:]],
    "glued": lambda cells: [cells[0] + cells[1], *cells[2:]],
    "stars": lambda cells: ["**", *cells[1:]],
    "a letter": lambda cells: [cells[0].replace(cells[0][-1], "O"), *cells[1:]],
    "a quote": lambda cells: ['"' + cells[0], *cells[1:]],
}


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize(("divider", "comma"), [(",", False), (";", True), ("\t", False), (" ", False)])
def test_one_odd_row_is_named(tmp_path, odd, divider, comma):
    """Also the first or the last one: what most rows have decides on the divider and the number of columns."""
    header = [divider.join(["x[nm]", "y[nm]", "z[nm]", "m/n"])]
    lines = table(header, divider, comma, rows=ROWS_OF_IONS).splitlines()
    for at in range(2, len(lines) + 1):
        changed = divider.join(ODD[odd](lines[at - 1].split(divider)))
        (tmp_path / "a.csv").write_text("\n".join([*lines[: at - 1], changed, *lines[at:]]))
        with pytest.raises(FileError, match=rf"a\.csv', line {at}: expected"):
            read(tmp_path / "a.csv")


def test_an_odd_header_is_named(tmp_path):
    lines = table(["x [nm],y [nm],z [nm]"], ",", rows=ROWS_OF_IONS)
    (tmp_path / "a.csv").write_text(lines)
    with pytest.raises(FileError, match=r"a\.csv', line 1: expected 4 cells, got 3"):
        read(tmp_path / "a.csv")
