"""`apt-evap examples`: the examples of the repository, also for those who have only the wheel."""

import json
import os
import tomllib
from pathlib import Path

import pytest
from systems import PIPES

from apt_evap.cli import _shipped
from apt_evap.cli.main import main

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def originals():
    return {path.name: path.read_bytes() for path in (ROOT / "examples").iterdir() if path.suffix in (".py", ".toml")}


def test_the_list_has_a_title_for_each(capsys):
    assert main(["examples"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-2]] == sorted(originals())
    assert all(len(line.split()) > 2 for line in lines[:-2])
    assert main(["examples", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["examples"]
    assert told["tutorial_1_first_map.py"] == "1. First map" and told["ni111.toml"].startswith("A small nickel tip")


def test_copies_are_the_originals_and_can_be_run(folder, capsys):
    assert main(["examples", "--to", "a/b"]) == 0
    assert capsys.readouterr().out == f"wrote {len(originals())} files to {Path('a/b')}\n"
    assert {path.name: path.read_bytes() for path in Path("a/b").iterdir()} == originals()
    assert tomllib.loads(Path("a/b/ni111.toml").read_text())["tip"]["material"] == "Ni"


def test_changed_files_are_kept(folder, capsys):
    assert main(["examples", "--to", "here", "--quiet"]) == 0
    Path("here/ni111.toml").write_text("mine")
    Path("here/measured_map.py").unlink()
    assert main(["examples", "--to", "here"]) == 2
    assert (
        f"'{Path('here/ni111.toml')}' exists and differs from the example: --force overwrites it"
        in capsys.readouterr().err
    )
    assert Path("here/ni111.toml").read_text() == "mine" and not Path("here/measured_map.py").exists()
    assert main(["examples", "--to", "here", "--force", "--quiet"]) == 0
    assert {path.name: path.read_bytes() for path in Path("here").iterdir()} == originals()


@PIPES
def test_a_pipe_is_refused(folder, capsys):
    Path("pipes").mkdir()
    os.mkfifo("pipes/ni111.toml")
    assert main(["examples", "--to", "pipes"]) == 2
    assert "Not a regular file" in capsys.readouterr().err and os.listdir("pipes") == ["ni111.toml"]


def test_what_is_refused(folder, capsys, monkeypatch):
    Path("file").touch()
    assert main(["examples", "--to", "file"]) == 2
    assert "cannot write to 'file': " in capsys.readouterr().err
    monkeypatch.setattr(_shipped, "_PLACES", (folder / "none",))
    assert main(["examples"]) == 2
    assert "the examples are not in" in capsys.readouterr().err


def test_an_example_is_found_by_its_name(folder, capsys):
    """It is copied with what it reads; a file of this name in the folder wins, and is not replaced."""
    assert main(["sweep", "plan", "sweep"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("example sweep: copied sweep.toml and ni111.toml to this folder; its first lines say ")
    assert Path("sweep.toml").read_bytes() == originals()["sweep.toml"] and Path("sweep/points").is_dir()
    assert main(["sweep", "status", "sweep", "--json"]) == 0  # the folder that the first call has made
    assert json.loads(capsys.readouterr().out)["points"] == 4
    Path("gamma_prime.toml").write_text("mine = 1")
    assert main(["run", "gamma_prime"]) == 2
    told = capsys.readouterr()
    assert told.out.startswith("example gamma_prime: gamma_prime.toml is in this folder already; its first lines ")
    assert "mine" in told.err and Path("gamma_prime.toml").read_text() == "mine = 1"
    Path("core_shell").write_text("mine = 2")  # a path without suffix
    assert main(["run", "core_shell"]) == 2
    assert not Path("core_shell.toml").exists()


def test_other_names_are_refused_with_the_examples_of_the_command(folder, capsys):
    assert main(["run", "precipitat"]) == 2
    error = capsys.readouterr().err
    assert "'precipitat' is neither a file nor an example of apt-evap run (did you mean 'precipitate'?)" in error
    assert "core_shell, gamma_prime, gp_zone, grain_boundary, multilayer" in error and "sweep" not in error
    assert main(["run", "sweep"]) == 2 and main(["run", "else/gamma_prime"]) == 2 and main(["run", "none.toml"]) == 2
    assert os.listdir() == []


SETTINGS = sorted(name for name in originals() if name.endswith(".toml"))


def test_every_settings_file_is_named_in_the_help_of_its_command(capsys):
    commands = {"visible.toml": "visible", "sweep.toml": "sweep", "dataset.toml": "dataset"}
    for name in SETTINGS:
        assert main([commands.get(name, "run"), "--help"]) == 0
        assert name in capsys.readouterr().out, name


SMALLER = {  # texts of the settings files and what stands for them in a test
    "visible.toml": {"= 4.0 ": "= 2.2 ", "2.8]": "1.4]", "radius = 0.8": "radius = 0.4", "twins = 20": "twins = 2"},
    "sweep.toml": {"3_000": "20", "[0, 0, 1], ": "", '"10 a", "14 a"': '"6 a", "7 a"', "14 a": "6 a"},
    "dataset.toml": {"1_000": "60", "sample = 10": "sample = 2", '"8 a", "12 a"': '"5 a", "6 a"', '["8 a"]': '["5 a"]'},
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # of few ions and small specimens
@pytest.mark.parametrize("name", SETTINGS)
def test_the_settings_files_work(name, folder, capsys):
    """Each one with fewer ions or smaller specimens; its keys are those of the example."""
    assert main(["examples", "--to", ".", "--quiet"]) == 0
    text = Path(name).read_text()
    for large, small in SMALLER.get(name, {}).items():
        assert large in text
        text = text.replace(large, small)
    Path(name).write_text(text)
    match name:
        case "visible.toml":
            assert main(["visible", name, "--threads", "1", "--json"]) == 0
            assert 0 <= json.loads(capsys.readouterr().out)["probability"]["value"] <= 1
            assert Path("visible_operators.h5").exists()
        case "sweep.toml":
            assert all(main(["sweep", action, name]) == 0 for action in ("plan", "work", "collect"))
            assert "2 of 2 points are done" in capsys.readouterr().out and Path("sweep/report.html").exists()
            assert main(["sweep", "collect", name]) == 0
            assert f"replaced {folder / 'sweep' / 'index.csv'}, " in capsys.readouterr().out
        case "dataset.toml":
            assert main(["dataset", name, "-o", "set", "--quiet"]) == 0
            assert main(["dataset", "set"]) == 0
            assert "set: all files are as in its checksums" in capsys.readouterr().out
        case _:
            assert main(["run", name, "--ions", "30", "--threads", "1", "--quiet"]) == 0
            assert Path(name).with_suffix(".h5").exists() and Path(name).with_suffix(".png").exists()
