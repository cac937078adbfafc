"""`apt-evap reconstruct`, of measured ions and of a run."""

import json

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main


@pytest.fixture
def measured(tmp_path, monkeypatch, rng):
    monkeypatch.chdir(tmp_path)
    radius, azimuth = 35 * np.sqrt(rng.random(2000)), 2 * np.pi * rng.random(2000)
    hits = ae.Hits(
        x=radius * np.cos(azimuth),
        y=radius * np.sin(azimuth),
        voltage=np.linspace(3000.0, 3100.0, 2000),
        mass_to_charge=np.full(2000, 29.0),
        positions=np.zeros((2000, 3)),
        pulse_id=np.arange(2000),
    )
    ae.write("ni.epos", hits)
    return ae.read("ni.epos")


def test_measured_ions(measured, nickel, capsys):
    command = ["reconstruct", "ni.epos", "--element", "Ni", "--distance", "90", "--efficiency", "0.6"]
    assert main([*command, "--compression", "1.6"]) == 0
    told = capsys.readouterr().out
    assert "<Reconstruction: 2,000 ions, " in told and "wrote 2,000 ions to ni_reconstructed.pos" in told
    known = {"atomic_volume": nickel.a**3 / 4, "distance": 90.0, "efficiency": 0.6, "compression": 1.6}
    expected = ae.reconstruct(measured, **known, evaporation_field=35.0)
    assert ae.read("ni_reconstructed.pos").positions == pytest.approx(expected.positions, rel=1e-6, abs=1e-5)  # float32
    assert main(command) == 2 and "'ni_reconstructed.pos' exists: --force" in capsys.readouterr().err
    # a table without shifts changes nothing but the direction of z
    places = np.random.default_rng(1).random((500, 2)) * 2 - 1
    ae.OriginTable(places, np.zeros((500, 2))).save("table.npz")
    corrected = ["--compression", "1.6", "--origins", "table.npz", "--frame", "specimen", "-o", "corrected.pos"]
    assert main([*command, *corrected]) == 0 and capsys.readouterr()
    assert ae.read("corrected.pos").positions == pytest.approx(expected.specimen_positions, rel=1e-6, abs=1e-5)
    shank = ["--radius", "shank", "--initial-radius", "30", "--shank-angle", "5", "--protocol", "bas", "--json"]
    assert main([*command, *shank, "--projection", "equidistant", "--ions", "0,500", "-o", "shank.epos"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ions"] == 500 and result["settings"]["shank_angle"] == 5.0 and "errors" not in result
    assert len(ae.read("shank.epos")) == 500


def test_a_run_is_compared_with_its_sites(tmp_path, monkeypatch, small_tip, nickel, capsys):
    monkeypatch.chdir(tmp_path)
    ae.Simulation(small_tip, seed=1).run(60, [ae.Unperturbed()], responses=False, progress=False).save("ni.h5")
    command = ["reconstruct", "ni.h5", "--real-units", "--element", "Ni", "--field-factor", "1.3"]
    command += ["--detector-radius", "80", "-o", "ni.pos"]
    assert main([word for word in command if word != "--real-units"]) == 2
    assert "'ni.h5' has the voltages of a simulation: add --real-units" in capsys.readouterr().err
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["settings"]["distance"] == 100.0
    assert result["settings"]["atomic_volume"] == pytest.approx(nickel.a**3 / 4)
    assert 0 < result["errors"]["lateral_rms"] < 2.1  # the radius of the tip
    assert main([*command, "--force"]) == 0 and "RMS errors: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--element Ni", "--distance is missing"),
        ("--distance 90", "--atomic-volume [nm^3] or --element is missing"),
        ("--distance 90 --element Ni --radius apex", "--radius must be voltage, shank or a number [nm], got 'apex'"),
        ("--distance 90 --element Ni --radius -1", "--radius must be a finite number [nm] > 0, got -1.0"),
        ("--distance 90 --element Nix", "material"),
        ("--distance 90 --atomic-volume 0.01", 'radius="voltage" needs evaporation_field'),
        ("--distance 90 --element Ni --real-units", "--real-units needs a run (.h5)"),
        ("--distance 90 --element Ni -o ni.png", "format of 'ni.png' must be one of"),
        ("--distance 90 --element Ni --protocol geiser", "invalid choice: 'geiser'"),
    ],
)
def test_wrong_options_are_one_sentence(measured, capsys, tmp_path, options, sentence):
    assert main(["reconstruct", "ni.epos", *options.split()]) == 2
    told = capsys.readouterr().err
    assert sentence in told and told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["ni.epos"]


def test_ions_without_voltages(measured, capsys):
    ae.write("flat.epos", ae.Hits(x=measured.x, y=measured.y, positions=np.zeros((2000, 3)), pulse_id=np.arange(2000)))
    command = ["reconstruct", "flat.epos", "--element", "Ni", "--distance", "90"]
    assert main(command) == 2 and "has no voltages: --radius shank" in capsys.readouterr().err
    assert main([*command, "--radius", "40", "-o", "flat.xyz"]) == 0
