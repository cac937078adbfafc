"""Materials by name, as a table, and from a file; and in the commands."""

import json
import shlex

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.simulation.config.material_text import read_material, write_material

OWN = 'name = "X", structure = "fcc", a = 0.38, evaporation_field = 45.0, charge_state = 2, mass = 190.0'
LINES = OWN.replace(", ", "\n")
X = ae.Material("X", "fcc", 0.38, 45.0, 2, 190.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_name_a_table_and_a_file(folder):
    (folder / "mine.toml").write_text(f"[material]\n{LINES}\n")
    assert read_material("Ni") == ae.material("Ni")
    assert read_material(f"{{{OWN}}}") == X == read_material("mine.toml")
    hot = read_material('{name = "Ni", a = 0.3535}')
    assert hot == ae.material("Ni", a=0.3535) and hot.cohesive_energy == 4.44


@pytest.mark.parametrize("material", [X, ae.material("Mo"), ae.material("Ti", a=0.2951)], ids=["own", "known", "hot"])
def test_a_written_material_is_read(material):
    read = read_material(write_material(material))
    assert read == material and read.sources == material.sources


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Nx", "--element: no material is named 'Nx'"),
        ("Mn", "--element: no material is named 'Mn'"),
        ("", "--element: no material is named ''"),
        ("{name = 'X'}", "--element \"{name = 'X'}\": material must have structure, got name"),
        ("{name = 'Ni', a = 3.52}", r"a must be a finite number .* > 0 and <= 2, got 3.52"),
        ("{name = 'Ni', b = 1}", "'b'"),
        ("{name = ", "--element '{name = ': "),
        ("{}\nother = {}", "expected one table in one line"),
        ("[1]", "no material is named"),
        ("none.toml", "'none.toml'"),
    ],
)
def test_wrong_text_is_one_sentence(folder, text, message):
    with pytest.raises(ValueError, match=message.replace("{", r"\{")) as caught:
        read_material(text, "--element")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"must have one table \[material\], got \[\]"),
        (LINES.encode(), r"must have one table \[material\], got \['name'"),
        (b'material = "Ni"', r"must have one table \[material\]"),
        (b"[[material]]\nname = 'Ni'", r"must have one table \[material\]"),
        (b"[material]\nname = 'Ni'\n[tip]\n", r"must have one table \[material\], got \['material', 'tip'\]"),
        (b"[material]\nname = 'X'\n", r"\[material\]: material must have structure"),
        (b"[material]\nname = 'Ni'\nmass = nan\n", r"\[material\]: mass must be a finite number"),
        (b"[material]\nname = 3\nstructure = 'fcc'\n", r"\[material\]: "),
        (b"\xff\xfe", "not text in UTF-8"),
        (b"material = [", "not a TOML file"),
        (b"[material]\nsources = " + b"[" * 200 + b"]" * 200, "levels"),
    ],
)
def test_a_wrong_file_is_named_in_one_sentence(folder, content, message):
    (folder / "mine.toml").write_bytes(content)
    with pytest.raises(ae.FileError, match=f"'mine.toml'.*{message}") as caught:
        read_material("mine.toml", "--element")
    assert "\n" not in str(caught.value)


def test_folders_and_large_files_are_no_materials(folder):
    (folder / "dir.toml").mkdir()
    (folder / "big.toml").write_bytes(b"#" * (1 << 23))
    for name in ("dir.toml", "big.toml"):
        with pytest.raises(ae.FileError, match=f"'{name}'"):
            read_material(name)


@pytest.mark.slow
def test_commands_take_a_material_of_a_users_own(folder, rng, capsys):
    (folder / "mine.toml").write_text(f"[material]\n{LINES}\n")
    n = 300
    hits = ae.Hits(
        x=rng.uniform(-30, 30, n), y=rng.uniform(-30, 30, n), voltage=np.full(n, 5e3), mass_to_charge=np.full(n, 95.0)
    )
    ae.write("x.epos", hits)
    table = f"{{{OWN}}}"
    for k, element in enumerate(("mine.toml", table)):
        command = ["reconstruct", "x.epos", "--distance", "90", "-o", f"{k}.pos", "--json", "--element", element]
        assert main(command) == 0
        assert json.loads(capsys.readouterr().out)["settings"]["atomic_volume"] == pytest.approx(0.38**3 / 4)
    assert (folder / "0.pos").read_bytes() == (folder / "1.pos").read_bytes()
    for command in ("index x.epos --element", "start x.epos --element", "twin x.epos --element"):
        assert main([*shlex.split(command), "{name = 'X'}"]) == 2
        assert "--element" in (told := capsys.readouterr().err) and "structure" in told
    assert main(["map", "x.epos", "--poles", "{name = 'X'}", "-o", "x.png"]) == 2
    assert "--poles" in capsys.readouterr().err
    axis = ["--axis", "0,0,1", "--rotation", "0", "--scale", "60"]
    assert main(["map", "x.epos", "--poles", "mine.toml", *axis, "-o", "x.png"]) == 0
