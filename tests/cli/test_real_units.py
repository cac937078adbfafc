"""Real units, temperature and export in the shell."""

import json
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main

HOT = """
[tip]
material = "Ni"
axis = [1, 1, 1]
apex_radius = "6 a"
shank_length = "6 a"

[simulation]
ions = 60
seed = 1

[law]
name = "Arrhenius"
temperature = 80.0

[control]
rate = 0.02

[real_units]
field_reference = "site"
flight_charges = { Ni = 2 }
timing = { jitter = 0.1, temperature = 80.0 }
"""


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A run at 80 K in real units, and one at 0 K as simulated, made once by the command line."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "hot.toml").write_text(HOT)
    (folder / "cold.toml").write_text(HOT.partition("[law]")[0])
    for name in ("hot", "cold"):
        assert main(["run", str(folder / f"{name}.toml"), "-o", str(folder / f"{name}.h5"), "--quiet"]) == 0
    return folder


def summary(path, capsys):
    assert main(["info", str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_a_run_at_a_temperature_is_saved_in_real_units(made, capsys):
    run = ae.load(made / "hot.h5")
    assert run.settings["law"]["temperature"] == 80.0 and run.settings["control"]["rate"] == 0.02
    assert run.units.field_reference == "site" and (run.flight_charges == 2).all()
    assert run.units.control == ae.evaporation.VoltageControl(rate=0.02)
    told = summary(made / "hot.h5", capsys)
    assert told["real_units"]["flight_charges"] == {"Ni2+": 60} and told["real_units"]["field_reference"] == "site"
    pulses = run.clock.waits.sum() / run.settings["pulse_length"]
    assert told["clock"]["duration"] == pytest.approx(pulses / 200e3, rel=1e-5)
    assert main(["info", str(made / "hot.h5")]) == 0
    text = capsys.readouterr().out
    assert "Arrhenius(temperature=80" in text and "operating field [V/nm]" in text


@pytest.mark.slow
def test_a_settings_file_with_a_microscope(made, tmp_path, monkeypatch, capsys):
    """The run is saved behind the lens, as --lens shows a run that is not."""
    monkeypatch.chdir(tmp_path)
    text = HOT.partition("[law]")[0] + '[microscope]\npreset = "local electrode"\nshank_angle = 7.0\n'
    Path("lens.toml").write_text(text)
    assert main(["run", "lens.toml", "-o", "lens.h5"]) == 0
    assert "lens: shank of 7 degrees, R 1" in capsys.readouterr().out
    lens = ae.detection.LocalElectrode.preset("local electrode", shank_angle=7.0)
    run, plain = ae.load("lens.h5"), ae.load(made / "cold.h5")
    assert run.lens.lens == lens and run.fingerprint() == plain.fingerprint()
    told = summary("lens.h5", capsys)["microscope"]
    factor = min(lens.field_factor(radius) for radius in told["radius"])
    assert told["shank_angle"] == 7.0 and told["field_factor"][0] == pytest.approx(factor, rel=1e-5)
    assert summary(made / "cold.h5", capsys)["microscope"] is None
    for command in ("export", "reconstruct", "map"):
        outputs = [f"{command}{name}.png" if command == "map" else f"{command}{name}.epos" for name in "12"]
        assert main([command, "lens.h5", "-o", outputs[0], "--quiet"]) == 0
        option = "--lens=local-electrode:shank_angle=7"
        assert main([command, str(made / "cold.h5"), option, "-o", outputs[1], "--quiet"]) == 0
        one, two = (Path(name).read_bytes() for name in outputs)
        assert command == "map" or one == two


@pytest.mark.parametrize(
    "text", ["remote-electrode", "local-electrode:angle=3", "local-electrode:5", "local-electrode:shank_angle=99"]
)
def test_a_wrong_lens_is_named(made, tmp_path, text, capsys):
    assert main(["map", str(made / "cold.h5"), "--lens", text, "-o", str(tmp_path / "map.png")]) == 2
    assert text in capsys.readouterr().err and not (tmp_path / "map.png").exists()


def test_info_of_a_run_at_the_simulated_voltage(made, capsys):
    told = summary(made / "cold.h5", capsys)
    assert told["real_units"] is None and told["clock"] is None and told["law"]["name"] == "Extremal"


@pytest.mark.slow
def test_a_run_says_its_real_units(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hot.toml").write_text(HOT)
    assert main(["run", "hot.toml"]) == 0
    told = capsys.readouterr().out
    assert "real units: " in told and "V/nm at the site; 60 Ni2+; 1 eV at 1000 V is " in told
    first = ae.load("hot.h5")
    assert main(["run", "hot.toml", "--ions", "90", "--resume"]) == 0
    longer = ae.load("hot.h5")
    assert len(longer) == 90 and np.array_equal(longer.site[:60], first.site) and longer.units is not None
    assert np.array_equal(longer.clock.waits[:60], first.clock.waits)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # of a small specimen: below 100 V
def test_a_map_in_real_units(made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["map", str(made / "cold.h5"), "--perturbation", "RollUp:0.3", "--bins", "32"]
    assert main([*command, "-o", "as_simulated.png"]) == main([*command, "--real-units", "-o", "real.png"]) == 0
    assert (tmp_path / "real.png").read_bytes() != (tmp_path / "as_simulated.png").read_bytes()
    ae.write("ions.epos", ae.load(made / "hot.h5").hits(ae.Unperturbed()))
    assert main(["map", "ions.epos", "--real-units"]) == 2
    assert "--real-units needs a run (.h5)" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # of a small specimen: below 100 V
def test_ions_are_exported_as_an_instrument_would_write_them(made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["export", str(made / "cold.h5"), "--real-units", "-o", "ni.epos", "--perturbation", "RollUp:0.3"]
    assert main([*command, "--temperature", "50", "--jitter", "0.1"]) == 0
    ions = ae.read("ni.epos")
    assert f"wrote {len(ions)} ions to ni.epos" in capsys.readouterr().out
    assert ions.pulse_voltage == pytest.approx(0.2 * ions.voltage, rel=1e-5) and ions.pulses.sum() > 0
    assert 28 < np.median(ions.mass_to_charge) < 31
    assert main(command) == 2 and "ni.epos' exists: --force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
    assert main(["export", "ni.epos", "-o", "other.epos", "--perturbation", "Unperturbed"]) == 2
    assert "--perturbation needs a run (.h5), 'ni.epos' contains measured ions" in capsys.readouterr().err
    assert main(["export", str(made / "cold.h5"), "-o", "x.pos", "--jitter", "0.1"]) == 2
    assert "or --real-units" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            'name = "Arrhenius"',
            'name = "Arhenius"',
            "[law]: law must have a name of Extremal, Arrhenius",
        ),
        ("temperature = 80.0\n\n", "\n", "[law]: law must have temperature"),
        ("rate = 0.02", "rate = -1", "[control]: rate must be a finite number > 0 and <= 1e+06, got -1"),
        ('"site"', '"apex"', "[real_units]: field_reference must be"),
        ("{ Ni = 2 }", "{ Al = 2 }", "[real_units]: flight_charges must be of the elements Ni, got 'Al'"),
    ],
)
def test_wrong_tables_are_one_sentence(tmp_path, monkeypatch, capsys, old, new, sentence):
    monkeypatch.chdir(tmp_path)
    assert old in HOT
    (tmp_path / "hot.toml").write_text(HOT.replace(old, new, 1))
    assert main(["run", "hot.toml"]) == 2
    assert sentence in capsys.readouterr().err
