import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from apt_evap._common.processes import birth, machine
from apt_evap.sweep import claims as claims_module
from apt_evap.sweep.claims import LOST_AFTER, Claims


@pytest.fixture
def claims(tmp_path):
    return Claims(tmp_path)


def foreign(claims, **changes):
    """Make the last claim that of another process."""
    path = sorted(path for path in claims.folder.glob("*.json") if "end" not in path.name)[-1]
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return claims.all()[-1]


def test_one_of_many_gets_the_point(claims):
    for previous in range(5):
        with ThreadPoolExecutor(16) as pool:
            taken = [each for each in pool.map(lambda _, p=previous: claims.take(p, 0), range(64)) if each]
        assert len(taken) == 1 and taken[0].number == previous + 1
    assert [claim.number for claim in claims.all()] == [1, 2, 3, 4, 5]


def test_one_of_many_processes_gets_the_point(tmp_path):
    program = (
        "import sys, time; from pathlib import Path; from apt_evap.sweep.claims import Claims\n"
        "while time.time() < float(sys.argv[2]): pass\n"
        "print(Claims(Path(sys.argv[1])).take(0, 0) is not None)"
    )
    command = [sys.executable, "-c", program, str(tmp_path), str(time.time() + 3)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    assert sorted(process.communicate()[0].strip() for process in processes) == ["False"] * 3 + ["True"]


def test_a_living_owner_keeps_its_claim(claims):
    claim = claims.take(0, 7)
    assert claim.owner["ions"] == 7 and claim.owner["pid"] == os.getpid()
    assert claims.is_held(claims.all()[0])
    os.utime(claims.folder / "0001.json", (0, 0))
    assert claims.is_held(claims.all()[0])  # however old: on this machine the process is known to live


def test_a_killed_owner_loses_its_claim(claims, tmp_path):
    program = (
        "import sys, time; from pathlib import Path; from apt_evap.sweep.claims import Claims\n"
        "Claims(Path(sys.argv[1])).take(0, 0); print('taken', flush=True); time.sleep(100)"
    )
    process = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE)
    process.stdout.readline()
    assert claims.is_held(claims.all()[0])
    process.send_signal(signal.SIGKILL)
    while claims.is_held(claims.all()[0]):  # also before anyone has waited for it
        time.sleep(0.01)
    process.wait()
    assert claims.take(1, 0).number == 2


def test_a_process_number_that_is_used_again_is_another_process(claims):
    claims.take(0, 0)
    assert not claims.is_held(foreign(claims, birth="1"))


def test_a_claim_of_another_machine_is_lost_after_a_while(claims):
    claims.take(0, 0)
    claim = foreign(claims, machine="elsewhere", pid=1)
    assert claims.is_held(claim)
    path = claims.folder / "0001.json"
    for age, held in ((LOST_AFTER - 60, True), (LOST_AFTER + 60, False)):
        os.utime(path, (time.time() - age,) * 2)
        assert claims.is_held(claim) is held
    assert claims.renew(claim)
    assert claims.is_held(claim)


def test_the_clock_of_the_file_system_counts(claims, monkeypatch):
    claims.take(0, 0)
    claim = foreign(claims, machine="elsewhere")
    monkeypatch.setattr(claims_module.time, "time", lambda: 0.0)  # this machine believes in 1970
    assert claims.is_held(claim)
    os.utime(claims.folder / "0001.json", (1e9, 1e9))
    assert not claims.is_held(claim)


def test_a_claim_that_is_not_written_yet_is_held(claims):
    claims.take(0, 0)
    (claims.folder / "0001.json").write_text("")
    claim = claims.all()[0]
    assert claim.owner == {} and claims.is_held(claim)
    assert claim.who == "an unknown process"


def test_a_job_that_is_started_again_takes_its_point_back(claims, monkeypatch):
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "17")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    claims.take(0, 0)
    claim = foreign(claims, machine="the node that failed")
    assert claim.owner["job"] == "17_3"
    assert claims.is_held(claim)
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert not claims.is_held(claim)
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "4")
    assert claims.is_held(claim)


def test_a_suspended_owner_learns_that_its_point_is_taken(claims):
    first = claims.take(0, 0)
    assert claims.renew(first)
    claims.take(1, 0)
    assert not claims.renew(first)


def test_the_end_of_a_claim(claims):
    claim = claims.take(0, 0)
    claims.end(claim, code=2, seconds=1.5, ions=0, message="no")
    read = claims.all()[0]
    assert read.end["code"] == 2 and read.end["message"] == "no"


def test_this_process():
    assert birth(os.getpid()) == birth(os.getpid()) is not None
    assert birth(2**22 + 1) is None  # above the largest number of Linux
    assert machine() == machine()
