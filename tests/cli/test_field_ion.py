"""`apt-evap map --field-ion`: the surface of a run is rebuilt and imaged."""

import json

import pytest

import apt_evap as ae
from apt_evap.cli.main import main


@pytest.fixture
def run(tmp_path, monkeypatch, small_tip):
    monkeypatch.chdir(tmp_path)
    run = ae.Simulation(small_tip, seed=1).run(60, [ae.Unperturbed()], responses=False, progress=False)
    run.save("ni.h5")
    return run


def test_an_image_of_a_run(run, capsys, blank_pictures):
    assert main(["map", "ni.h5", "--field-ion", "He", "--bins", "64", "--json", "-o", "image.png"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["maps"][0]["title"] == "field-ion image, He" and told["maps"][0]["bins"] == [64, 64]
    assert main(["map", "ni.h5", "--field-ion", "-o", "neon.png"]) == 0  # the default gas, as the last word but options
    assert "surface atoms in Ne at " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["ni.h5", "--perturbation", "Unperturbed"], "--field-ion and --perturbation exclude each other"),
        (["ni.h5", "--ions", "0,20"], "--field-ion shows a surface: it excludes a selection of ions"),
        (["ni.pos"], "--field-ion needs a run (.h5), got 'ni.pos'"),
    ],
)
def test_options_that_do_not_fit(run, capsys, options, sentence):
    ae.write("ni.pos", run.hits(ae.Unperturbed()))
    assert main(["map", *options, "--field-ion", "Ne"]) == 2
    assert sentence in capsys.readouterr().err
