"""Sweeps over specimens from files: the content of the file counts, not its name."""

import pytest
from sweeps import check_bits, do, planned, write_dump

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.cli.main import main
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.studies.sweep.planning import open_sweep, plan_sweep
from apt_evap.studies.sweep.point_folder import run_point

BASE = """
[tip]
file = "tip.dump"
types = {1 = "Ni"}

[simulation]
ions = 20

[maps]
bins = 16
"""
ONE = 'base = "base.toml"\n[[points]]\n"simulation.seed" = 1\n'
TWO = 'base = "base.toml"\n[sweep]\n"simulation.seed" = [1, 2]\n'


@pytest.fixture
def dump(tmp_path):
    return write_dump(tmp_path / "tip.dump")


def test_a_file_relative_to_the_base_is_found_from_each_point(tmp_path, dump):
    (tmp_path / "settings").mkdir()
    (tmp_path / "settings" / "base.toml").write_text(BASE.replace("tip.dump", "../tip.dump"))
    (tmp_path / "study.toml").write_text(TWO.replace("base.toml", "settings/base.toml"))
    sweep = plan_sweep(tmp_path / "study.toml")
    for key in sweep.keys:
        do(sweep, key)
    check_bits(sweep)
    (tmp_path / "elsewhere").mkdir()  # settings and specimen may be moved together
    for name in ("tip.dump", "study"):
        (tmp_path / name).rename(tmp_path / "elsewhere" / name)
    moved = open_sweep(tmp_path / "elsewhere" / "study")
    assert moved.keys == sweep.keys and {state.name for _, state in moved.states()} == {"done"}
    assert read_config(moved.folder_of(moved.keys[0]) / "settings.toml").specimen().settings["atoms"] > 100


def test_another_specimen_under_the_same_name_makes_new_points(tmp_path, dump):
    base = BASE.replace("tip.dump", str(dump))
    sweep = planned(tmp_path, ONE, base)
    do(sweep, sweep.keys[0])
    write_dump(dump, radius=1.4)
    with pytest.raises(FileError, match="changed since it was planned"):
        open_sweep(tmp_path / "study.toml")
    again = plan_sweep(tmp_path / "study.toml")
    assert not set(again.keys) & set(sweep.keys)
    do(again, again.keys[0])
    old, new = (ae.load(each.folder_of(each.keys[0]) / "run.h5") for each in (sweep, again))
    assert old.fingerprint() != new.fingerprint()
    write_dump(dump)
    assert plan_sweep(tmp_path / "study.toml").keys == sweep.keys  # and the first runs are found again
    assert {state.name for _, state in open_sweep(tmp_path / "study.toml").states()} == {"done"}
    dump.rename(tmp_path / "renamed.dump")
    assert planned(tmp_path, ONE, BASE.replace("tip.dump", "renamed.dump")).keys == sweep.keys


def test_a_specimen_that_changes_between_plan_and_work_is_refused(tmp_path, dump):
    sweep = planned(tmp_path, TWO, BASE)
    write_dump(dump, radius=1.4)
    state = run_point(sweep.folder_of(sweep.keys[0]))
    assert state.name == "failed" and "tip.dump" in state.message and "sha256" in state.message
    assert not (sweep.folder_of(sweep.keys[0]) / "run.h5").exists()


def test_a_file_swept_by_its_name(tmp_path, dump):
    write_dump(tmp_path / "large.dump", radius=1.4)
    sweep = planned(tmp_path, 'base = "base.toml"\n[sweep]\n"tip.file" = ["tip.dump", "large.dump"]\n', BASE)
    atoms = [len(sweep.config_of(key).specimen()) for key in sweep.keys]
    assert len(set(sweep.keys)) == 2 and atoms[0] < atoms[1]
    assert [sweep.value(point, "tip.file") for point in sweep.points] == [
        f"../../../{name}" for name in ("tip.dump", "large.dump")
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "cannot read"), ("ITEM: TIMESTEP\n0\n", "tip.dump"), ("two\n\n1\n", r"\[tip\]")],
)
def test_plan_reads_the_specimen(tmp_path, dump, content, message):
    dump.unlink()
    if content is not None:
        dump.write_text(content)
    with pytest.raises(FileError, match=message):
        planned(tmp_path, TWO, BASE)


def test_a_run_refuses_a_specimen_with_another_hash(tmp_path, dump, capsys):
    (tmp_path / "run.toml").write_text(BASE.replace("types", f'sha256 = "{"0" * 64}"\ntypes'))
    assert main(["run", str(tmp_path / "run.toml"), "-o", str(tmp_path / "run.h5"), "--quiet"]) == 2
    assert "sha256" in capsys.readouterr().err and not (tmp_path / "run.h5").exists()
    with pytest.raises(FileError, match="sha256"):
        planned(tmp_path, TWO, (tmp_path / "run.toml").read_text())
