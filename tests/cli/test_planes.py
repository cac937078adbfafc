"""The command `planes`: planes whose spacing and normal are known."""

import json

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main

SPACING, TILT = 0.2, 6.0  # nm, degrees


@pytest.fixture
def planes(tmp_path, monkeypatch):
    """Ions on 20 planes, whose normal is tilted towards x, with a scatter of 0.02 nm, in a file."""
    rng = np.random.default_rng(3)
    flat = rng.random((1500, 3)) * (4, 4, 0) - (2, 2, 0)
    flat[:, 2] = SPACING * rng.integers(0, 20, 1500) + 0.02 * rng.standard_normal(1500)
    angle = np.radians(TILT)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    monkeypatch.chdir(tmp_path)
    ae.write("planes.pos", ae.Hits(positions=flat @ turn.T, mass_to_charge=np.full(1500, 27.0)))
    return "planes.pos"


@pytest.mark.slow  # 2 s: a search over normals
def test_spacing_and_normal_are_found(planes, capsys):
    assert main(["planes", planes, "--radius", "1.2", "--spacing", "0.21", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["spacing"] == pytest.approx(SPACING, rel=0.01)
    assert found["tilt"] == pytest.approx(TILT, abs=0.5)  # 0.02 nm over 2.4 nm
    np.testing.assert_allclose(found["normal"], [np.sin(np.radians(6)), 0, np.cos(np.radians(6))], atol=0.01)
    assert found["depth_resolution"] == pytest.approx(0.02, abs=0.006)
    assert found["efficiency_ratio"] == pytest.approx(SPACING / 0.21, rel=0.01)
    assert found["field_factor_ratio"] == pytest.approx((0.21 / SPACING) ** 0.5, rel=0.01)
    relative = found["spacing_error"] / found["spacing"]
    assert found["efficiency_ratio_error"] == pytest.approx(relative * found["efficiency_ratio"])
    assert found["field_factor_ratio_error"] == pytest.approx(relative * found["field_factor_ratio"] / 2)


def test_wrong_input_is_one_sentence(planes, capsys):
    for options, sentence in (
        (["--at", "4"], "--at must be two numbers X,Y [nm], got '4'"),
        (["--radius", "0.1"], "the cylinder must hold at least 50 ions"),
        (["--tilt", "80"], "widest must be"),
    ):
        assert main(["planes", planes, *options]) == 2
        assert sentence in capsys.readouterr().err
