import os
import re
import subprocess

import pytest
from sweeps import planned

from apt_evap._common.files import FileError
from apt_evap.cli.main import main
from apt_evap.sweep.batch_system import scripts, submit

STUDY = 'base = "base.toml"\neach = { threads = 2, hours = 1.51 }\n[sweep]\n"tip.offset_seed" = [1, 2, 3]\n'


@pytest.fixture
def sweep(tmp_path):
    return planned(tmp_path, STUDY)


def run(script, folder, **environment):
    """Run a script by a program that prints its last three arguments instead of running a point."""
    fake = folder / "python"
    fake.write_text('#!/bin/sh\nfor last; do before=$this this=$last; done; echo "$before $this"\n')
    fake.chmod(0o755)
    script = re.sub(r"exec \S+ -P -m", f"exec {fake} -P -m", script)
    done = subprocess.run(["bash", "-euc", script], env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_each_task_of_slurm_runs_its_point(sweep, tmp_path):
    (script,) = scripts(sweep, sweep.keys, options=["--partition=short"], at_once=2)
    for line in (
        "#SBATCH --array=0-2%2",
        "#SBATCH --cpus-per-task=2",
        "#SBATCH --mem=300M",
        "#SBATCH --time=01:30:36",
        "#SBATCH --signal=B:TERM@120",
        "#SBATCH --requeue",
        "#SBATCH --partition=short",
    ):
        assert line in script.splitlines()
    for task, key in enumerate(sweep.keys):
        assert run(script, tmp_path, SLURM_ARRAY_TASK_ID=str(task)) == f"--point {key}"


def test_each_task_of_pbs_runs_its_point(sweep, tmp_path):
    (script,) = scripts(sweep, sweep.keys, "pbs", options=["-q short"])
    for line in ("#PBS -J 0-2", "#PBS -l select=1:ncpus=2:mem=300mb", "#PBS -l walltime=01:30:36", "#PBS -q short"):
        assert line in script.splitlines()
    assert run(script, tmp_path, PBS_ARRAY_INDEX="2") == f"--point {sweep.keys[2]}"
    (single,) = scripts(sweep, sweep.keys[:1], "pbs")
    assert "-J" not in single
    assert run(single, tmp_path) == f"--point {sweep.keys[0]}"


def test_large_arrays_are_cut(sweep):
    first, second = scripts(sweep, sweep.keys, largest=2)
    assert "--array=0-1\n" in first and "--array=0-0\n" in second
    assert f"KEYS=({sweep.keys[2]})" in second


def test_the_memory_is_that_of_the_largest_point(tmp_path):
    sweep = planned(tmp_path, 'base = "base.toml"\n[sweep]\n"tip.apex_radius" = ["8 a", "60 a"]\n')
    largest = max(needs.memory for needs in sweep.foresights)
    (script,) = scripts(sweep, sweep.keys)
    assert int(re.search(r"--mem=(\d+)M", script)[1]) == pytest.approx(1.3 * largest / 1e6, abs=1)


def test_a_template_of_ones_own(sweep, tmp_path, capsys):
    template = tmp_path / "job.sh"
    template.write_text(
        "#BSUB -J x[1-@COUNT@] -W @HOURS@\n@OPTIONS@\nfor key in @KEYS@; do @COMMAND@ --point $key; done\n"
    )
    command = ["sweep", "submit", str(tmp_path / "study.toml"), "--template", str(template)]
    assert main([*command, "--dry-run"]) == 0
    assert capsys.readouterr().out.startswith(f"#BSUB -J x[1-3] -W 1.51\nfor key in {' '.join(sweep.keys)}; do")
    assert not (sweep.folder / "jobs").exists()
    assert main([*command, "--submit-command", "cat"]) == 0
    out = capsys.readouterr().out
    assert "0001.sh: #BSUB -J x[1-3]" in out
    template.write_text("@WALLTIME@")
    assert main([*command, "--dry-run"]) == 2
    assert "unknown placeholder @WALLTIME@; known are @KEYS@" in capsys.readouterr().err


def test_a_refused_script_is_reported(sweep):
    with pytest.raises(FileError, match=r"false refused .*0001\.sh' \(exit code 1\)"):
        submit(sweep, ["#!/bin/sh\n"], "slurm", "false")
    with pytest.raises(FileError, match=r"cannot start 'no-such-command': No such file.*0002\.sh"):
        submit(sweep, ["#!/bin/sh\n"], "slurm", "no-such-command -x")


def test_nothing_to_submit(tmp_path, capsys, monkeypatch):
    sweep = planned(tmp_path, STUDY)
    monkeypatch.setattr(type(sweep), "state", lambda self, key: type("State", (), {"name": "done"}))
    assert main(["sweep", "submit", str(tmp_path / "study.toml")]) == 0
    assert "no point is open" in capsys.readouterr().out
