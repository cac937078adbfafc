"""`apt-evap map --field-ion`: the surface of a run is rebuilt and imaged."""

import json

import numpy as np
import pytest
from matplotlib.image import imread

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


@pytest.mark.slow
def test_an_image_is_grey(run, tmp_path):
    """Also its bar: brightness is not a density of hits."""
    assert main(["map", "ni.h5", "--field-ion", "Ne", "--bins", "64", "-o", "image.png"]) == 0
    assert main(["map", "ni.h5", "--perturbation", "Unperturbed", "-o", "map.png"]) == 0
    image, other = (imread(tmp_path / name)[..., :3] for name in ("image.png", "map.png"))
    assert np.ptp(image, axis=-1).max() == 0 < np.ptp(other, axis=-1).max()


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
