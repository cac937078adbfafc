"""`apt-evap visible`: a settings file with an analysis of the user's own."""

import json

import pytest

from apt_evap.cli.main import main

FILE = """
[tip]
apex_radius = 2.2
seed = 1
axis = [1, 1, 1]
shank_length = 2.2

[[phases]]
name = "matrix"
material = "Ni"

[[phases]]
name = "particle"
material = "Ni"
region = { name = "Sphere", centre = [0.0, 0.0, 1.4], radius = 0.5 }
solutes = { Al = 0.5 }
evaporation_field = 35.0

[visibility]
analysis = "clusters.py:count"
sizes = [0.5]
twins = 3
permutations = 19
reach = 0.6
operators = "operators.h5"
instrument = { name = "Instrument", field_of_view = 160.0, efficiency = 0.8 }
"""
ANALYSIS = """
import numpy as np


def count(positions, labels):
    return -positions[labels == 0].std()
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "particle.toml").write_text(FILE)
    (tmp_path / "clusters.py").write_text(ANALYSIS)
    return tmp_path


@pytest.mark.usefixtures("rough_layout")
def test_an_answer_and_its_operators(folder, capsys):
    arguments = ["visible", str(folder / "particle.toml"), "--threads", "1"]
    assert main([*arguments, "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["twins"] == 3 and first["size"] == 0.5 and 0 < first["probability"]["value"] < 1
    assert "apparent composition" in first["errors"]
    assert (folder / "operators.h5").exists()
    assert main([*arguments, "--json"]) == 0  # with the stored operators
    assert json.loads(capsys.readouterr().out) == first


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ('analysis = "clusters.py:count"', 'analysis = "clusters.py"', "analysis"),
        ("clusters.py:count", "clusters.py:other", "analysis"),
        ("clusters.py:count", "missing.py:count", "analysis"),
        ("twins = 3", "twins = 0", "twins"),
        ("[visibility]", '[visibility]\nfeature = "layer"', "feature"),
        ("permutations = 19", "permutations = 9", "permutations"),
        ("[visibility]", '[microscope]\npreset = "local electrode"\n[visibility]', "microscope"),
        ("[visibility]", "[real_units]\ntemperature = 50.0\n[visibility]", "real_units"),
        ("[visibility]", "[monitor]\nsample = 64\n[visibility]", "monitor"),
        ("[visibility]", "[maps]\nbins = 32\n[visibility]", "maps"),
        ("[tip]", 'output = "run.h5"\n[tip]', "output"),
        ("[visibility]", "[simulation]\nions = 500\n[visibility]", "ions"),
        ("[visibility]", "[simulation]\nseed = 5\n[visibility]", "seed"),
        ("[visibility]", "[simulation]\nresponses = false\n[visibility]", "responses"),
        ("[tip]", "[tip]\noffset_seed = 5", "offset_seed"),
        ("[tip]", "[tip]\ndepth = 2.0", "depth"),
        ("[visibility]", "[visibility]\nseed = 2", "seed"),
        ("twins = 3", "twins = 2000000000", "twins"),
        ("solutes = { Al = 0.5 }", 'order = { name = "Superlattice", prototype = "L1_2", second = "Al" }', "operators"),
    ],
)
def test_wrong_settings_are_named(folder, capsys, old, new, word):
    path = folder / "particle.toml"
    path.write_text(FILE.replace(old, new))
    assert main(["visible", str(path)]) == 2
    assert word in capsys.readouterr().err
    assert not (folder / "operators.h5").exists()


@pytest.mark.slow
def test_stored_operators_are_those_of_the_settings(folder, capsys):
    """Whatever changes the operators is compared with those that are stored; the rest of the file is free."""
    path = folder / "particle.toml"
    assert main(["visible", str(path), "--threads", "1"]) == 0
    before = (folder / "operators.h5").read_bytes()
    for old, new, word in (
        ("Al = 0.5", "Al = 0.02", "feature.solutes"),
        ("seed = 1", "seed = 2", "seed"),
        ("sizes = [0.5]", "sizes = [0.5, 0.6]", "axes.size"),
        ("sizes = [0.5]\n", "", "axes.size"),
        ("reach = 0.6", 'reach = 0.6\nperturbation = "RollUp:0.1"', "perturbation"),
        ("field_of_view = 160.0", "field_of_view = 150.0", "instrument.field_of_view"),
        ("[visibility]", '[law]\nname = "Arrhenius"\ntemperature = 50.0\n[visibility]', "simulation.law"),
        ("[visibility]", "[charges]\ntolerance = 0.01\n[visibility]", "simulation.charges"),
    ):
        path.write_text(FILE.replace(old, new))
        capsys.readouterr()
        assert main(["visible", str(path), "--threads", "1"]) == 2
        message = capsys.readouterr().err
        assert "operators.h5" in message and word in message, message
    assert (folder / "operators.h5").read_bytes() == before
    path.write_text(FILE.replace("efficiency = 0.8", "efficiency = 0.4").replace("twins = 3", "twins = 4"))
    assert main(["visible", str(path), "--threads", "1"]) == 0
