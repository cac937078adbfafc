"""`apt-evap clusters` and `apt-evap proxigram`: of ions with ranges, of a run, and what they refuse."""

import json

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Copper in a ball among aluminium, as a .pos file with ranges."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    positions = 6 * rng.random((8_400, 3))
    copper = rng.random(8_400) < np.where(np.linalg.norm(positions - 3, axis=1) < 1.2, 0.8, 0.01)
    ae.write("R1.pos", ae.Hits(positions=positions, mass_to_charge=np.where(copper, 63.0, 27.0)))
    ranges = ae.spectra.Ranges(["Al", "Cu"], [26, 62], [28, 64], composition=[{"Al": 1}, {"Cu": 1}])
    ae.io.write_rrng("R1.rrng", ranges)
    return tmp_path


@pytest.mark.usefixtures("rough_layout")
def test_clusters_of_a_file(folder, capsys):
    assert main(["clusters", "R1.pos", "--ranges", "R1.rrng", "--solute", "Cu", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["clusters"] == 1 and result["p_value"] == 0.05 and result["at_edge"] == [False]
    assert result["radii"][0] == pytest.approx(1.2, abs=0.1) and (folder / "R1_clusters.png").stat().st_size > 10_000
    assert main(["clusters", "R1.pos", "--ranges", "R1.rrng", "--solute", "Cu", "--d-max", "0.5", "--n-min", "20"]) == 0
    out = capsys.readouterr().out
    said = ae.measures.PointCloud.of(ae.read("R1.pos"), ae.io.read_ranges("R1.rrng")).clusters("Cu", 0.5, 20)
    value, error = said.fractions()["Cu"]
    every = said.atoms.sum(axis=0)[said.cloud.elements.index("Cu")] / said.atoms.sum()
    assert "1 cluster with " in out and f"Cu {100 * value:.2f} ± {100 * error:.2f} %" in out
    assert f"near solutes by choice: Al {100 - 100 * every:.2f} %, Cu {100 * every:.2f} %\n" in out
    assert main([*"clusters R1.pos --ranges R1.rrng --solute Cu --d-max 0.5 --envelope 0".split()]) == 0
    assert "clusters: no composition, as no other ion is between their solutes" in capsys.readouterr().out


def test_proxigram_of_a_file(folder, capsys):
    command = ["proxigram", "R1.pos", "--ranges", "R1.rrng", "--solute", "Cu", "--isovalue", "0.3", "--largest"]
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    copper = np.array(result["fractions"], float)[:, result["elements"].index("Cu")]
    edges = np.array(result["edges"])
    assert copper[edges[1:] > 1.0].max() < 0.1 and np.nanmax(copper[edges[:-1] < -0.3]) > 0.6
    assert (folder / "R1_proxigram.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["clusters", "R1.pos", "--solute", "Cu"], "--ranges is missing"),
        (["clusters", "R1.pos", "--ranges", "R1.rrng", "--solute", "Ag"], "solute must be one of Al, Cu, got 'Ag'"),
        (
            ["clusters", "R1.pos", "--ranges", "R1.rrng", "--solute", "Cu", "--d-max", "-1"],
            "d_max must be a finite number [nm] > 0",
        ),
        (["proxigram", "R1.pos", "--ranges", "R1.rrng", "--solute", "Cu", "--isovalue", "0.999"], "isovalue must be"),
    ],
)
def test_what_is_refused_is_one_sentence(folder, capsys, arguments, message):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(folder.glob("*.png"))
