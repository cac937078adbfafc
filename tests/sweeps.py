"""A sweep of twelve small points, and what must be true of its journal after workers were killed."""

import datetime
import os
import random
import signal
import threading
import time
from pathlib import Path

from apt_evap.config.simulation_file import read_config
from apt_evap.simulation.run import load
from apt_evap.sweep.plan import plan

BASE = """
[tip]
material = "Ni"
apex_radius = "8 a"
shank_length = "8 a"

[simulation]
ions = 300

[maps]
bins = 32
"""
TWELVE = """
base = "base.toml"
each = { checkpoint = 0, tries = 50 }

[sweep]
"tip.axis" = [[0, 0, 1], [1, 1, 1], [0, 1, 2]]
"tip.apex_radius" = ["8 a", "9 a"]
"tip.offset_seed" = [1, 2]
"""


def planned(folder, study=TWELVE, base=BASE):
    """The sweep of a study in this folder."""
    (folder / "base.toml").write_text(base)
    (folder / "study.toml").write_text(study)
    return plan(folder / "study.toml")


def poison(sweep, key):
    """Give a point settings that its run refuses."""
    path = sweep.folder_of(key) / "settings.toml"
    path.write_text(path.read_text().replace('material = "Ni"', 'material = "Unobtainium"'))


class Killer:
    """Kills the owner of a random running point every few seconds, at most a number of times."""

    def __init__(self, sweep, seconds, most=1000, seed=1):
        self.sweep, self.seconds, self.most = sweep, seconds, most
        self.killed, self.runs = {}, []  # times by process, and the runs that they had started
        self._random, self._stop = random.Random(seed), threading.Event()
        self._thread = threading.Thread(target=self._kill)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._stop.set()
        self._thread.join()

    def _kill(self):
        while not self._stop.wait(self.seconds * self._random.uniform(0.5, 1.5)):
            states = [state for _, state in self.sweep.states() if state.name == "running"]
            if states and len(self.killed) < self.most:
                pid = self._random.choice(states).claims[-1].owner.get("pid")
                if pid:
                    self.runs += living_children(pid)
                    self.killed.setdefault(pid, time.time())
                    os.kill(pid, signal.SIGKILL)


def check_journal(sweep, killed):
    """Every point was finished once, and a try began only after the end, or the death, of the try before."""
    lost = 0
    for point, state in sweep.states():
        assert state.name == "done", (str(point), state)
        assert [claim.end["code"] for claim in state.claims if claim.end].count(0) == 1
        assert state.claims[-1].end["code"] == 0
        for before, after in zip(state.claims, state.claims[1:], strict=False):
            began = datetime.datetime.fromisoformat(after.owner["began"]).timestamp()
            if before.end is None:
                lost += 1
                assert killed[before.owner["pid"]] <= began
            else:
                assert datetime.datetime.fromisoformat(before.end["ended"]).timestamp() <= began
    return lost


def single_fingerprint(sweep, key):
    """Hash of the bits of a point that is run alone and without interruption, in this process."""
    config = read_config(sweep.folder_of(key) / "settings.toml")
    return config.simulation(n_threads=1).run(config.n_ions, config.emissions, progress=False).fingerprint()


def check_bits(sweep, keys=None):
    """The runs of the points are those of single runs, bit by bit."""
    for key in sweep.keys if keys is None else keys:
        assert load(sweep.folder_of(key) / "run.h5").fingerprint() == single_fingerprint(sweep, key)


def no_flock(folder):
    """A folder for PYTHONPATH that takes flock away from all processes, as on some file systems of clusters."""
    folder = Path(folder) / "no_flock"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(
        "import errno, fcntl\n\n"
        "def flock(*arguments):\n"
        '    raise OSError(errno.ENOTSUP, "Operation not supported")\n\n'
        "fcntl.flock = flock\n"
    )
    return folder


def living_children(pid):
    """Process numbers of the processes that a process has started and that still live."""
    numbers = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] not in "ZX":
            numbers.append(int(stat.parent.name))
    return numbers
