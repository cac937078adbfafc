"""A sweep of twelve small points, and what must be true of its journal after workers were killed."""

import contextlib
import datetime
import os
import random
import signal
import threading
import time
from pathlib import Path

import apt_evap as ae
from apt_evap.config.simulation_file import read_config
from apt_evap.simulation.run import load
from apt_evap.sweep.claims import Claims
from apt_evap.sweep.planning import plan

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


def do(sweep, key):
    """Run a point in this process, as a worker would."""
    claims = Claims(sweep.folder_of(key))
    claim = claims.take(len(claims.all()), 0)
    config = read_config(sweep.folder_of(key) / "settings.toml")
    run = config.simulation(n_threads=1).run(config.n_ions, config.emissions, progress=False)
    run = config.as_saved(run)
    run.save(sweep.folder_of(key) / "run.h5")
    claims.end(claim, code=0, seconds=36.0, ions=len(run), message="")
    return run


def poison(sweep, key):
    """Give a point settings that its run refuses."""
    path = sweep.folder_of(key) / "settings.toml"
    path.write_text(path.read_text().replace('material = "Ni"', 'material = "Unobtainium"'))


def write_dump(path, radius=1.1):
    """A specimen of nickel as a text dump of LAMMPS."""
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, apex_radius=radius, shank_length=1.0)
    positions = 10 * tip.positions
    low, high = positions.min(axis=0) - 1, positions.max(axis=0) + 1
    lines = ["ITEM: TIMESTEP", "0", "ITEM: NUMBER OF ATOMS", str(len(positions)), "ITEM: BOX BOUNDS ff ff ff"]
    lines += [f"{one:.6f} {other:.6f}" for one, other in zip(low, high, strict=True)]
    lines += ["ITEM: ATOMS id type x y z"]
    lines += [f"{number + 1} 1 {x:.6f} {y:.6f} {z:.6f}" for number, (x, y, z) in enumerate(positions)]
    path.write_text("\n".join(lines) + "\n")
    return path


class Killer:
    """Ends the owner of a random running point, or its run, every few seconds, at most a number of times.

    The kinds are worker and run (by SIGKILL), and SIGTERM (to the worker). They take turns, so that a fast machine,
    where a sweep sees few ends, sees all of them.
    """

    def __init__(self, sweep, seconds, most=1000, seed=1, kinds=("worker",)):
        self.sweep, self.seconds, self.most, self.kinds = sweep, seconds, most, kinds
        self.count = dict.fromkeys(kinds, 0)
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
            if states and sum(self.count.values()) < self.most:
                pid = self._random.choice(states).claims[-1].owner.get("pid")
                if pid:
                    with contextlib.suppress(ProcessLookupError):
                        self._kill_one(pid, min(self.kinds, key=self.count.__getitem__))

    def _kill_one(self, pid, kind):
        children = living_children(pid)
        if kind == "run":
            for child in children:
                os.kill(child, signal.SIGKILL)
        elif kind == "worker":
            self.runs += children
            self.killed.setdefault(pid, time.time())
            os.kill(pid, signal.SIGKILL)
        else:
            os.kill(pid, signal.SIGTERM)
        self.count[kind] += bool(children) or kind != "run"


def check_journal(sweep, killed):
    """Every point was finished once, and a try began only after the end, or the death, of the try before.

    A worker that is killed after its run was written leaves no end.
    """
    lost = 0
    for point, state in sweep.states():
        assert state.name == "done", (str(point), state)
        assert all(claim.end is None or claim.end["code"] != 0 for claim in state.claims[:-1])
        lost += state.claims[-1].end is None
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
