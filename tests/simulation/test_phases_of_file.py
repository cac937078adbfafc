"""Tables [[phases]] of a settings file."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.simulation.config.simulation_file import read_config

TEXT = """
[tip]
apex_radius = "10 a"
axis = [1, 1, 1]
seed = 3

[[phases]]
name = "gamma"
material = { name = "Ni", a = 0.356 }
vacancies = 0.01
solutes = { Al = 0.1, Ti = { bulk = 0.01, peak = 0.2, width = 0.4 } }

[[phases]]
name = "gamma prime"
material = { name = "Ni", a = 0.356 }
region = { name = "Union", regions = [
    { name = "Sphere", centre = [0, 0, 2], radius = 1.2 },
    { name = "CoreShell", core = { name = "Sphere", centre = [0, 0, -2], radius = 0.5 }, thickness = 0.5 },
] }
order = { prototype = "L1_2", second = { Al = 0.8, Ti = 0.2 } }
evaporation_field = { Al = 28.0 }

[[phases]]
name = "grain"
material = "Ni"
region = { name = "HalfSpace", point = [2, 0, 0], normal = [1, 0, 0] }
axis = [0, 0, 1]
rotation = 10
order = { sites = ["Al", "", "", ""] }

[simulation]
ions = 40
"""


def write(path, text):
    path.write_text(text)
    return path


def test_phases_of_a_file_are_those_of_the_script(tmp_path):
    config = read_config(write(tmp_path / "run.toml", TEXT))
    nickel = ae.material("Ni", a=0.356)
    core = ae.specimen.Sphere((0, 0, -2), 0.5)
    phases = [
        ae.specimen.Phase(
            "gamma", nickel, solutes={"Al": 0.1, "Ti": ae.specimen.Segregation(0.01, 0.2, 0.4)}, vacancies=0.01
        ),
        ae.specimen.Phase(
            "gamma prime",
            nickel,
            region=ae.specimen.Union((ae.specimen.Sphere((0, 0, 2), 1.2), ae.specimen.CoreShell(core, 0.5))),
            order=ae.specimen.Superlattice("L1_2", {"Al": 0.8, "Ti": 0.2}),
            evaporation_field={"Al": 28.0},
        ),
        ae.specimen.Phase(
            "grain",
            "Ni",
            region=ae.specimen.HalfSpace((2, 0, 0), (1, 0, 0)),
            axis=(0, 0, 1),
            rotation=10,
            order=ae.specimen.UnitCell(("Al", None, None, None)),
        ),
    ]
    tip = ae.Tip(phases=phases, apex_radius=10 * 0.356, axis=(1, 1, 1), seed=3)
    read = config.simulation(n_threads=1).tip
    assert read.phases == tip.phases and read.settings == tip.settings
    np.testing.assert_array_equal(read.species, tip.species)
    assert "Ni" in repr(config)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "Sphere", centre', 'name = "Ball", centre', r"\[phases\]: .*Ball"),
        ("radius = 1.2", "diameter = 1.2", r"\[phases\]: .*diameter"),
        ("vacancies = 0.01", "vacancy = 0.01", r"\[phases\]: .*vacanc"),
        ('name = "grain"\n', "", r"\[phases\]: .*name"),
        ('prototype = "L1_2"', 'prototype = "L12"', "prototype"),
        ("width = 0.4", "w = 0.4", "width"),
        ("seed = 3", "", r"\[tip\]: seed .* must be an integer"),
        ("seed = 3", 'seed = 3\nmaterial = "Ni"', r"\[tip\]: no key is named 'material'"),
        ('[[phases]]\nname = "gamma"', '[phases]\nname = "gamma"', "not a TOML file"),
        (
            'region = { name = "HalfSpace", point = [2, 0, 0], normal = [1, 0, 0] }',
            "",
            "phase grain must have a region",
        ),
    ],
)
def test_a_wrong_table_is_refused(tmp_path, old, new, message):
    assert old in TEXT
    path = write(tmp_path / "run.toml", TEXT.replace(old, new, 1))
    with pytest.raises(FileError, match=message):
        read_config(path).simulation(n_threads=1)
