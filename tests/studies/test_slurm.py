"""By a real Slurm: `tools/slurm_here.sh unpack FOLDER`, `. tools/slurm_here.sh start FOLDER`, `pytest -m slurm`."""

import os
import re
import shutil
import subprocess
import textwrap
import time
from pathlib import Path

import pytest
from sweeps import TWELVE, check_bits, planned, poison

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(shutil.which("sbatch") is None or "SLURM_CONF" not in os.environ, reason="needs a Slurm"),
]
DOCS = Path(__file__).parents[2] / "docs" / "howto" / "cluster.rst"


def script(last):
    """The script of the documentation, for this machine and these points."""
    block = re.search(
        r"\.\. code-block:: bash\n\n((?:    .*\n|\n)*?    #SBATCH(?:.*\n)(?:    .*\n|\n)*)", DOCS.read_text()
    )
    text, n_arrays = re.subn(r"--array=\S+", f"--array=0-{last}", textwrap.dedent(block[1]).strip())
    assert n_arrays == 1 and text.startswith("#!/bin/bash\n") and "apt-evap sweep work" in text
    return text.replace("exec apt-evap", "exec python -P -m apt_evap") + "\n"


def tasks(states="all"):
    done = subprocess.run(["squeue", "-h", "-t", states, "-r", "-o", "%i %T"], capture_output=True, text=True)
    return [line.split() for line in done.stdout.splitlines()]


def until_idle():
    while tasks("pending,running,completing,requeued"):
        time.sleep(0.5)


def test_twelve_points_by_slurm(tmp_path, monkeypatch):
    """Tasks are killed, cancelled and requeued; the same array is submitted again until all points are done."""
    sweep = planned(tmp_path, TWELVE + '[[points]]\n"tip.shank_angle" = 2.5\n')
    *good, bad = sweep.keys
    poison(sweep, bad)
    (tmp_path / "job.sh").write_text(script(len(sweep.keys) - 1))
    monkeypatch.chdir(tmp_path)
    killed, submitted = [], 0
    actions = ["kill", "requeue", "cancel", "kill"]
    end = time.monotonic() + 500
    while {sweep.state(key).name for key in good} != {"done"}:
        assert time.monotonic() < end
        if not tasks("pending,running,completing,requeued"):
            subprocess.run(["sbatch", "job.sh"], check=True, stdout=subprocess.DEVNULL)
            submitted += 1
        running = [task for task, _ in tasks("running")]
        if running and actions and any(state.name == "running" for _, state in sweep.states()):
            action = actions.pop(0)
            if action == "requeue":
                subprocess.run(["scontrol", "requeue", running[0]], check=True)
            else:
                signal = ["--signal=KILL", "--full"] if action == "kill" else []
                subprocess.run(["scancel", *signal, running[0]], check=True)
            killed.append(action)
        time.sleep(0.5)
    until_idle()
    print(f"{', '.join(killed)}; {submitted} arrays")
    assert submitted >= 2 and not actions
    state = sweep.state(bad)
    assert state.name == "failed" and "Unobtainium" in state.message
    check_bits(sweep, good)
    assert len(list(tmp_path.glob("*.log"))) >= 13
