"""`apt-evap examples`: the examples of the repository, also for those who have only the wheel."""

import json
import os
import tomllib
from pathlib import Path

import pytest
from systems import PIPES

from apt_evap.cli import examples
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
    monkeypatch.setattr(examples, "_PLACES", (folder / "none",))
    assert main(["examples"]) == 2
    assert "the examples are not in" in capsys.readouterr().err
