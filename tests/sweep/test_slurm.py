"""By a real Slurm: `tools/slurm_here.sh unpack FOLDER`, `. tools/slurm_here.sh start FOLDER`, `pytest -m slurm`."""

import contextlib
import os
import shutil
import signal
import subprocess
import time

import pytest
from sweeps import TWELVE, check_bits, check_journal, planned, poison

from apt_evap.cli.main import main
from apt_evap.sweep.batch_system import largest_array

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(shutil.which("sbatch") is None or "SLURM_CONF" not in os.environ, reason="needs a Slurm"),
]


def jobs(states="all"):
    done = subprocess.run(["squeue", "-h", "-t", states, "-r", "-o", "%i %T"], capture_output=True, text=True)
    return [line.split() for line in done.stdout.splitlines()]


def until_idle():
    while jobs("pending,running,completing,requeued"):
        time.sleep(0.5)


def test_twelve_points_by_slurm(tmp_path):
    """Tasks are killed, cancelled and requeued; open points are submitted again until all are done."""
    folder = tmp_path / "100 % of %A, $(touch PWN) 'and' #"
    folder.mkdir()
    sweep = planned(folder, TWELVE + '[[points]]\n"tip.shank_angle" = 2.5\n')
    study, bad = str(folder / "study.toml"), sweep.keys[-1]
    poison(sweep, bad)
    assert largest_array("slurm") == 1000
    assert main(["sweep", "submit", study, "--largest-array", "8"]) == 0  # two arrays
    assert len(list((sweep.folder / "jobs").glob("*.sh"))) == 2
    killed, cancelled, requeued = {}, 0, 0
    end = time.monotonic() + 500
    while time.monotonic() < end:
        states = {point.key: state for point, state in sweep.states()}
        if {state.name for state in states.values()} <= {"done", "failed"}:
            break
        running = [state.claims[-1] for state in states.values() if state.name == "running"]
        if running and len(killed) < 4 and running[0].owner.get("pid"):
            owner = running[0].owner
            time.sleep(0.3)
            if len(killed) % 2:
                with contextlib.suppress(ProcessLookupError):  # a point takes 3 s and may just have ended
                    os.kill(owner["pid"], signal.SIGKILL)
                    killed[owner["pid"]] = time.time()
            elif not requeued:
                subprocess.run(["scontrol", "requeue", owner["job"]], check=True)
                killed[owner["pid"]] = time.time()
                requeued += 1
            else:
                subprocess.run(["scancel", owner["job"]], check=True)
                killed[owner["pid"]] = time.time()
                cancelled += 1
        elif not jobs("pending,running,completing"):
            assert main(["sweep", "submit", study, "--quiet"]) == 0
        time.sleep(0.3)
    until_idle()
    states = {point.key: state for point, state in sweep.states()}
    assert states[bad].name == "failed" and "Unobtainium" in states[bad].message
    good = type(sweep)(sweep.folder, sweep.points[:-1], sweep.foresights[:-1], sweep.each, None)
    lost = check_journal(good, killed)
    tries = sum(state.tries for _, state in good.states())
    print(f"{len(killed)} tasks killed, cancelled ({cancelled}) or requeued ({requeued}); {tries} tries, {lost} lost")
    assert tries >= 14 and cancelled == requeued == 1
    assert all(claim.owner["job"] for _, state in good.states() for claim in state.claims)
    check_bits(good)
    assert len(list((sweep.folder / "jobs").glob("[0-9]*_[0-9]*.log"))) >= 13
    assert [path.name for path in tmp_path.iterdir()] == [folder.name] and not list(tmp_path.rglob("PWN"))
