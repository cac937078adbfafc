import csv
import json

import h5py
import numpy as np
import pytest
from sweeps import do, planned

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.plot.report.html_page import read_report
from apt_evap.studies.sweep import collection as collection_module
from apt_evap.studies.sweep.collection import collect_sweep
from apt_evap.studies.sweep.planning import open_sweep, sweep_status

BASE = """
[tip]
material = "Ni"
apex_radius = "6 a"
shank_length = "6 a"

[simulation]
ions = 60

[maps]
bins = 24

[[maps.panels]]
title = "at rest"
perturbation = "Unperturbed"

[[maps.panels]]
title = "rolled"
perturbation = "RollUp:0.3"
"""
STUDY = """
base = "base.toml"
[sweep]
"tip.axis" = [[0, 0, 1], [1, 1, 1]]
"tip.offset_seed" = [1, 2]
[[points]]
"detector.width" = 200.0
"""
ROLLUP = ae.RollUp(ae.TruncatedNormal(0.155, 0.155))


@pytest.fixture(scope="session")
def sweep(tmp_path_factory):
    """A sweep of five points; all but the second are done."""
    sweep = planned(tmp_path_factory.mktemp("sweep"), STUDY, BASE)
    for key in (*sweep.keys[:1], *sweep.keys[2:]):
        do(sweep, key)
    return sweep


@pytest.fixture(scope="session")
def collected(sweep):
    return collect_sweep(sweep)


@pytest.mark.slow
def test_the_maps_are_those_of_the_runs(sweep, collected):
    assert collected["points"] == 5 and collected["done"] == 4 and collected["fit"] is None
    done = [key for key in sweep.keys if key != sweep.keys[1]]
    with h5py.File(sweep.folder / "maps.h5") as file:
        assert file["key"].asstr()[:].tolist() == done
        assert file["maps"].shape == (4, 2, 24, 24)
        edges = file["x_edges"][:]
        assert edges[0] == -150 and edges[-1] == 150  # of the largest detector
        frame = ae.DetectorMap.from_array(np.ones((24, 24)), edges, file["y_edges"][:])
        for row, key in enumerate(done):
            run = ae.load(sweep.folder_of(key) / "run.h5")
            for column, perturbation in enumerate((ae.Unperturbed(), ae.RollUp(0.3))):
                expected = ae.DetectorMap.from_hits(run.hits(perturbation), like=frame, position_step=None)
                assert (file["maps"][row, column] == expected.values).all() and expected.values.sum() > 0
        assert file["tip_offset_seed"].asstr()[:].tolist() == ["1", "1", "2", ""]  # the last point has none
        assert file["tip_axis"].asstr()[0] == "[0, 0, 1]"
        assert file["title"].asstr()[:].tolist() == ["at rest", "rolled"]
        assert [file["maps"].dims[axis].keys() for axis in range(4)] == [["point"], ["perturbation"], ["y"], ["x"]]


def test_the_report_has_all_points(sweep, collected):
    assert collected["files"][-1] == str(sweep.folder / "report.html")
    rows = {row["name"]: row for row in read_report(sweep.folder / "report.html")["points"]}
    assert set(rows) == set(sweep.keys)
    states = {point.key: state for point, state in sweep.states()}
    for key, row in rows.items():
        done = states[key].name == "done"
        assert (row["message"] == "") is done and ("ions" in row["results"]) is done


def test_the_index_has_all_points(sweep, collected):
    with open(sweep.folder / "index.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["key"] for row in rows] == list(sweep.keys)
    assert [row["state"] for row in rows] == ["done", "waiting", "done", "done", "done"]
    run = ae.load(sweep.folder_of(rows[2]["key"]) / "run.h5")
    assert rows[2]["fingerprint"] == run.fingerprint() and rows[2]["ions"] == "60"
    assert rows[2]["tip.axis"] == "[1, 1, 1]" and rows[1]["fingerprint"] == ""
    assert rows[4]["detector.width"] == "200.0" and rows[0]["detector.width"] == ""


def test_xarray_opens_the_maps(sweep, collected):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with xarray.open_dataset(sweep.folder / "maps.h5", engine="h5netcdf") as maps:
        assert maps.maps.dims == ("point", "perturbation", "y", "x")
        assert dict(maps.sizes) == {"point": 4, "perturbation": 2, "y": 24, "x": 24, "x_edges": 25, "y_edges": 25}
        assert maps.key.dims == maps.ions.dims == maps.tip_axis.dims == ("point",)
        assert maps.maps[maps.tip_axis == "[1, 1, 1]"].sizes["point"] == 2
        assert json.loads(str(maps.perturbation.values[0])) == {"name": "Unperturbed"}
        np.testing.assert_allclose(np.diff(maps.x), 12.5)
        assert maps.x.attrs["units"] == "mm"


def test_status_corrects_the_hours_by_those_of_finished_points(sweep):
    for key in sweep.keys:
        (sweep.folder_of(key) / "work.json").write_text('{"seconds": 36.0, "error": ""}')
    content = sweep_status(sweep)
    assert content["counts"] == {"done": 4, "running": 0, "waiting": 1, "failed": 0, "wrong": 0}
    estimated = [point.estimate.hours for point in sweep.points]
    speed = np.median([0.01 / hours for number, hours in enumerate(estimated) if number != 1])
    assert content["hours_left"] == pytest.approx(estimated[1] * speed)
    json.dumps(content)


@pytest.mark.slow
def test_a_sweep_finds_the_tip_of_a_measured_map(tmp_path, capsys, monkeypatch):
    """From the study file to the table. The search for the registration is that of `fit_energies`, tested there."""
    planned(tmp_path, STUDY, BASE.replace("60", "400"))
    sweep = open_sweep(tmp_path / "study.toml")
    measured = do(sweep, sweep.keys[2])  # of another origin than that of the point
    hits = measured.hits(ROLLUP)
    ae.write(tmp_path / "measured.epos", hits[hits.detected])
    compare = (
        'compare = {measured = "measured.epos", means = [0.05, 0.155], relative_spreads = [1.0], bins = 24, '
        "resamples = 10, replicas = 4, select = {mass_to_charge = [0.0, 100.0]}}\n"
    )
    study = compare + '"base" = "base.toml"\n[sweep]\n"tip.axis" = [[0, 0, 1], [1, 1, 1]]\n"tip.offset_seed" = [1]\n'
    sweep = planned(tmp_path, study, BASE.replace("60", "400"))
    do(sweep, sweep.keys[0])
    known = ae.Registration(0.0, 1.0, (0.0, 0.0))
    fit_tips = collection_module.fit_tips
    monkeypatch.setattr(
        collection_module, "fit_tips", lambda *args, **options: fit_tips(*args, registration=known, **options)
    )
    assert main(["sweep", "collect", str(tmp_path / "study.toml")]) == 0
    out = capsys.readouterr().out
    assert f"best '{sweep.keys[1]}'" in out and f"wrote {sweep.folder / 'index.csv'}, " in out
    with open(sweep.folder / "fit.csv", newline="") as file:
        best = next(csv.DictReader(file))
    assert best["key"] == sweep.keys[1] and best["tip.axis"] == "[1, 1, 1]"
    content = json.loads((sweep.folder / "fit.json").read_text())
    assert content["settings_of_best"] == {"tip.axis": [1, 1, 1], "tip.offset_seed": 1}
    assert len(content["compare"]["sha256"]) == 64
    assert float(best["similarity"]) == pytest.approx(content["table"][0]["similarity"], rel=1e-5)
    made = read_report(sweep.folder / "report.html")
    assert [row["name"] for row in made["points"]] == [sweep.keys[1], sweep.keys[0]]
    assert made["points"][0]["study"]["optimum"]["score"]["value"] > 0
    assert "sweep collect" in made["origin"]["command"]
    assert [each["name"] for each in made["origin"]["files"]] == ["index.csv", "measured.epos"]
    (sweep.folder / "fit.csv").unlink()
    assert main(["sweep", "collect", str(tmp_path / "study.toml"), "--no-compare", "--json"]) == 0
    assert not (sweep.folder / "fit.csv").exists()
    assert json.loads(capsys.readouterr().out)["done"] == 2
