"""`apt-evap visible`: a settings file with an analysis of the user's own."""

import json

import pytest

from apt_evap.cli.main import main

FILE = """
[tip]
apex_radius = 2.2
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
    ],
)
def test_wrong_settings_are_named(folder, capsys, old, new, word):
    path = folder / "particle.toml"
    path.write_text(FILE.replace(old, new))
    assert main(["visible", str(path)]) == 2
    assert word in capsys.readouterr().err
