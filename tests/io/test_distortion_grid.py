"""Calibration grids from .csv files."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main

ROWS = [(10.0 * i + 0.3 * j, 10.0 * j, float(i), float(j)) for i in range(4) for j in range(4)]


def write(path, rows, header="detectorX,detectorY,gridX,gridY"):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n", encoding="utf-8")
    return path


def test_columns_are_found_by_name(tmp_path):
    grid = ae.io.read_grid(write(tmp_path / "a.csv", ROWS))
    assert np.array_equal(grid.detector, np.array(ROWS)[:, :2]) and np.array_equal(grid.grid, np.array(ROWS)[:, 2:])
    assert repr(str(tmp_path / "a.csv")) in repr(grid) and "16 crossings" in repr(grid)
    swapped = [(d, b, 7, a, c) for a, b, c, d in ROWS]
    other = ae.io.read_grid(write(tmp_path / "b.csv", swapped, "\ufeffGridY, detectory ,node,DETECTORX,gridx"))
    assert np.array_equal(other.detector, grid.detector) and np.array_equal(other.grid, grid.grid)


@pytest.mark.parametrize(
    "rows, header, words",
    [
        (ROWS, "detectorX,detectorY,gridX,y", "must have the columns detectorX, .*, it has detectorx, .*, y"),
        ([], "", "has no numbers, expected a calibration grid"),
        ([*ROWS[:3], ("a", 1, 2, 3)], None, "line 5: expected a number, got 'a'"),
        ([*ROWS[:3], (1, 2, 3)], None, "line 5: expected 4 cells, got 3"),
        (ROWS[:4], None, "at least 6 crossings, got 4"),
    ],
)
def test_files_that_are_no_grid(tmp_path, rows, header, words):
    path = write(tmp_path / "bad.csv", rows, *([] if header is None else [header]))
    with pytest.raises(ae.FileError, match=words):
        ae.io.read_grid(path)


def test_commands_undistort(tmp_path, capsys, rng):
    """The map and the summary are those of the corrected ions; runs and maps are refused."""
    grid = write(tmp_path / "grid.csv", ROWS)
    places = rng.uniform(2, 40, (500, 2))
    one = np.ones(500)
    ions = ae.Hits(
        x=places[:, 0], y=places[:, 1], mass_to_charge=29 * one, positions=np.zeros((500, 3)), time_of_flight=one,
        voltage=3000 * one, pulse_voltage=600 * one, pulse_id=np.arange(500),
    )  # fmt: skip
    epos = tmp_path / "ions.epos"
    ae.write(epos, ions)
    assert main(["info", str(epos), "--undistort", str(grid), "--json"]) == 0
    output = capsys.readouterr()
    assert "of 500 ions are outside the calibration grid" in output.err
    assert main(["map", str(epos), "--undistort", str(grid), "-o", str(tmp_path / "a.png")]) == 0
    assert (tmp_path / "a.png").exists()
    np.savez(
        tmp_path / "map.npz", counts=np.ones((20, 20), int), x_edges_mm=np.arange(21.0), y_edges_mm=np.arange(21.0)
    )
    assert main(["info", str(tmp_path / "map.npz"), "--undistort", str(grid)]) == 2
    assert "--undistort is only for measured ions" in capsys.readouterr().err
