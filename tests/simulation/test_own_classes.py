"""Classes of a user's own that a settings file names."""

import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.cli.main import main
from apt_evap.simulation.config.perturbation_text import read_perturbation
from apt_evap.simulation.config.simulation_file import config_of, read_config, read_document

MODULE = '''
from __future__ import annotations
from dataclasses import dataclass

import numpy as np

import apt_evap as ae


@dataclass
class FromAbove:
    """Without a hash."""

    height: float

    def launch(self, emissions, random):
        n = len(emissions)
        starts = emissions.positions + self.height * random.uniform() * emissions.normals
        return ae.emission.Launches(starts, np.zeros((n, 3)), np.zeros(n, bool))


@dataclass(frozen=True)
class Uniform:
    most: float

    def quantile(self, u):
        return self.most * u


@dataclass(frozen=True)
class BoundAtoms:
    per_bond: float

    def keys(self, tip, atoms, fields, bonds):
        evaporation_fields = tip.evaporation_fields[tip.species[atoms]] * (1 + self.per_bond * bonds)
        return (fields / evaporation_fields) * tip.evaporable[atoms]


@dataclass(frozen=True)
class Fixed:
    """A rule: the charges stay as they are."""

    area: float = 0.05

    def solve(self, positions, normals, charges, field_of, potential, tolerance):
        return np.full(len(positions), 1.0), self.area

    def solve_patch(self, positions, normals, charges, field):
        return charges


@dataclass(frozen=True)
class Ball:
    radius: float

    def distance(self, points):
        return np.sqrt((points**2).sum(axis=1)) - self.radius


class Inside:
    def __call__(self, points):
        return points[:, 0] > 0


def made():
    return BoundAtoms(1.0)


class Broken:
    keys = BoundAtoms.keys

    def __init__(self):
        raise KeyError("broken")
'''
SETTINGS = """
[tip]
material = "Ni"
apex_radius = 1.5
axis = [1, 1, 1]
shank_length = 1.0
[simulation]
ions = 20
responses = {responses}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(MODULE)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return tmp_path


def read(folder, text, responses="true"):
    path = folder / "a.toml"
    path.write_text(SETTINGS.format(responses=responses) + text)
    return read_config(path, own_classes=True)


@pytest.mark.slow
def test_a_perturbation_without_responses_is_flown(folder):
    text = """
[[maps.panels]]
perturbation = { name = "mine:FromAbove", height = 0.3 }
[[maps.panels]]
perturbation = { name = "RollUp", energy = 0.4 }
"""
    (above,) = read(folder, text).emissions
    assert above.height == 0.3
    assert main(["run", str(folder / "a.toml"), "--quiet"]) == 0
    run = ae.load("a.h5")
    assert len(run.perturbations) == 1 and run.responses is not None
    assert np.isfinite(run.hits(above).x).any() and np.isfinite(run.hits(ae.RollUp(0.4)).x).any()
    assert main(["run", str(folder / "a.toml"), "--quiet", "--resume"]) == 0  # complete
    (folder / "a.toml").write_text((folder / "a.toml").read_text().replace("ions = 20", "ions = 25"))
    assert main(["run", str(folder / "a.toml"), "--quiet", "--resume"]) == 0
    assert len(ae.load("a.h5")) == 25


@pytest.mark.slow
def test_a_run_with_a_law_and_perturbations_of_ones_own(folder, capsys):
    text = """
[law]
name = "mine:BoundAtoms"
per_bond = 0.05
[[maps.panels]]
perturbation = { name = "mine:FromAbove", height = 0.3 }
[[maps.panels]]
perturbation = { name = "RollUp", energy = { name = "mine:Uniform", most = 0.4 } }
"""
    config = read(folder, text, responses="false")
    law, (above, rolled) = config.law, config.emissions
    assert (type(law).__name__, law.per_bond, above.height, rolled.energy.most) == ("BoundAtoms", 0.05, 0.3, 0.4)
    assert main(["run", str(folder / "a.toml"), "--quiet"]) == 0
    run = ae.load("a.h5")
    tip = config.specimen()
    expected = ae.Simulation(tip, law=law).run(20, emissions=[above, rolled], responses=False, progress=False)
    assert np.array_equal(run.site, expected.site) and run.settings["law"] == {"name": "BoundAtoms", "per_bond": 0.05}
    described = {"name": "FromAbove", "repr": repr(above)}
    assert np.array_equal(run.hits(described).x, expected.hits(above).x, equal_nan=True)
    # the run is read and shown without the module
    (folder / "mine.py").unlink()
    assert main(["info", "a.h5"]) == 0
    assert main(["map", "a.h5", "-o", "b.png"]) == 2
    error = capsys.readouterr().err
    assert "a.h5" in error and "--perturbation" in error and "Traceback" not in error


def test_a_rule_bonds_and_a_region_of_ones_own(folder):
    config = read(folder, '[rule]\nname = "mine:Fixed"\narea = 0.04\n')
    assert config.rule.area == 0.04
    text = '[tip]\napex_radius = 1.5\nseed = 1\n[simulation]\nions = 5\n[[phases]]\nname = "a:b"\nmaterial = "Ni"\n'
    text += '[[phases]]\nname = "ball"\nmaterial = "Ni"\nsolutes = { Al = 0.5 }\n'
    (folder / "b.toml").write_text(text + 'region = { name = "mine:Ball", radius = 1.0 }\n')
    phases = read_config(folder / "b.toml", own_classes=True).tip["phases"]
    assert phases[0].name == "a:b" and phases[1].region.radius == 1.0


def test_the_module_is_that_of_the_folder_and_of_now(folder, tmp_path):
    text = '[law]\nname = "mine:BoundAtoms"\nper_bond = 0.05\n'
    assert not hasattr(read(folder, text).law, "mark")
    other = tmp_path / "other"
    other.mkdir()
    for at in (other, folder):  # another folder, and the same one after a change
        (at / "mine.py").write_text(MODULE.replace("    per_bond: float\n", "    per_bond: float\n    mark = 1\n"))
        assert read(at, text).law.mark == 1


def test_a_module_of_the_python_path(folder, monkeypatch):
    (folder / "lib").mkdir()
    (folder / "lib" / "of_the_path.py").write_text(MODULE)
    monkeypatch.syspath_prepend(folder / "lib")
    law = read(folder, '[law]\nname = "of_the_path:BoundAtoms"\nper_bond = 0.05\n').law
    assert type(law) is sys.modules["of_the_path"].BoundAtoms


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ("law", 'name = "none:Law"'),
        ("law", 'name = "mine:None_"'),
        ("law", 'name = "mine:Broken"'),
        ("law", 'name = "mine:BoundAtoms"\nwrong = 1'),
        ("law", 'name = "mine:Ball"\nradius = 1.0'),
        ("law", 'name = "json:dumps"\nobj = 1'),
        ("law", 'name = "shelve:DbfilenameShelf"\nfilename = "written"'),  # has a method keys, without arguments
        ("law", 'name = "mine:made"'),
        ("region", 'name = "mine:Inside"'),  # a function of points
        ("law", 'name = "syntax:Law"'),
        ("rule", 'name = "mine:BoundAtoms"\nper_bond = 0.1'),
        ("maps", 'panels = [{ perturbation = { name = "mine:Ball", radius = 1.0 } }]'),
    ],
)
def test_what_is_wrong_is_one_sentence(folder, table, text):
    (folder / "syntax.py").write_text("class = 3")
    header = '[[phases]]\nmaterial = "Ni"\n[phases.region]' if table == "region" else f"[{table}]"
    with pytest.raises(FileError, match=r"a\.toml'") as refused:
        read(folder, f"{header}\n{text}\n")
    assert len(str(refused.value).splitlines()) == 1 and len(str(refused.value)) < 500
    assert not list(Path().glob("written*"))


def test_the_class_is_not_made_before_it_is_known_to_be_one_of_the_interface(folder):
    """Popen is a class, but no perturbation."""
    program = f'["{sys.executable}", "-c", "open(\'executed\', \'w\')"]'
    text = f'[[maps.panels]]\nperturbation = {{ name = "subprocess:Popen", args = {program} }}\n'
    with pytest.raises(FileError, match=r"launch\(emissions, random\), got .*Popen"):
        read(folder, text)
    time.sleep(0.2)
    assert not Path("executed").exists()


def test_settings_that_the_user_has_not_given_import_nothing(folder):
    (folder / "mine.py").write_text("open('imported', 'w')")
    path = folder / "a.toml"
    path.write_text(SETTINGS.format(responses="true") + '[law]\nname = "mine:BoundAtoms"\nper_bond = 0.05\n')
    for reader in (read_config, ae.simulate, lambda path: config_of(read_document(path), path)):
        with pytest.raises(FileError, match=r"mine:BoundAtoms.*own_classes=True"):
            reader(path)
    (folder / "study.toml").write_text('base = "a.toml"\n[sweep]\n"tip.apex_radius" = [1.5, 2.0]\n')
    assert main(["sweep", str(folder / "study.toml"), "-o", "work", "--plan"]) == 2
    with pytest.raises(ValueError, match="mine:FromAbove"):
        read_perturbation(json.loads('{"name": "mine:FromAbove", "height": 0.3}'))
    with pytest.raises(ValueError, match="own_classes"):
        read_config(path, own_classes="yes")
    assert not list(folder.rglob("imported"))
