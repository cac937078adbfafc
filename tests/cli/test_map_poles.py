"""`apt-evap map --poles`."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap import plot
from apt_evap.cli.main import main
from apt_evap.specimen.symmetry import point_group


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """Orientations and projections whose poles were drawn."""
    monkeypatch.chdir(tmp_path)
    crystals = []
    monkeypatch.setattr(plot, "poles", lambda ax, *crystal, **_: crystals.append(crystal))
    return crystals


def test_poles_of_a_run_are_its_own(drawn, small_tip, capsys):
    run = ae.Simulation(small_tip, seed=1).run(60, [ae.Unperturbed()], responses=False, progress=False)
    run.save("small.h5")
    assert main(["map", "small.h5", "--poles", "--scale", "80"]) == 0
    ((orientation, projection),) = drawn
    assert orientation == ae.Orientation.from_settings(run.settings["tip"]) and projection.scale == 80
    for wrong in (["--poles", "Ni"], ["--poles", "--axis", "1,1,1"], ["--scale", "80"]):
        assert main(["map", "small.h5", "-o", "b.png", *wrong]) == 2 and "--poles" in capsys.readouterr().err


@pytest.mark.slow
def test_poles_of_a_measured_map_are_searched_or_given(drawn, capsys):
    truth, projection = ae.Orientation("W", (0.05, 0.66, 0.74), 30.0), ae.detection.Projection(60.0)
    pattern = ae.maps.master_patterns("bcc")[0]
    simulated = pattern.map(truth, projection, width=70.0, ions=30_000, rolled=0.5, seed=1)
    np.savez("w.npz", values=simulated.values, x_edges=simulated.x_edges, y_edges=simulated.y_edges)
    command = ["map", "w.npz", "--arrays", "values,x_edges,y_edges", "--unit", "mm", "-o", "w.png"]
    given = ["--axis", "0.05,0.66,0.74", "--rotation", "30", "--scale", "60"]
    assert main([*command, "--poles", "W", *given]) == 0 and "indexed" not in capsys.readouterr().out
    assert main([*command, "--poles", "W", "--axis", "0,1,1", "--scale", "60"]) == 0
    assert "indexed: " in capsys.readouterr().out
    (orientation, there), (searched, where) = drawn
    assert orientation == truth and there.scale == 60.0
    # an axis and its mirror image look alike; 0.5 degrees: a bin of the map is 0.52 degrees wide
    axes = point_group("bcc") @ truth.matrix[2]
    assert np.degrees(np.arccos((axes @ searched.matrix[2]).max())) < 0.5
    assert where.scale == pytest.approx(60.0, rel=0.02)
    for wrong, name in (
        (["--poles"], "--poles"),
        (["--axis", "0,1,1"], "--axis"),
        (["--poles", "W", "--rotation", "3"], "--rotation"),
        (["--poles", "W", "--axis", "0.1,1,1"], "--axis"),
    ):
        assert main([*command, *wrong]) == 2 and name in capsys.readouterr().err
