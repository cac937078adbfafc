"""A sweep of twelve small points, and what must be true of it after processes were killed."""

import os
import random
import signal
import subprocess
import sys
import threading
from pathlib import Path

import apt_evap as ae
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.run import load
from apt_evap.studies.sweep.planning import plan_sweep
from apt_evap.studies.sweep.point_folder import run_point

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
each = { checkpoint = 0 }

[sweep]
"tip.axis" = [[0, 0, 1], [1, 1, 1], [0, 1, 2]]
"tip.apex_radius" = ["8 a", "9 a"]
"tip.offset_seed" = [1, 2]
"""


def planned(folder, study=TWELVE, base=BASE):
    """The sweep of a study in this folder."""
    (folder / "base.toml").write_text(base)
    (folder / "study.toml").write_text(study)
    return plan_sweep(folder / "study.toml")


def do(sweep, key):
    """Run a point in this process; return its run."""
    assert run_point(sweep.folder_of(key)).name == "done"
    return load(sweep.folder_of(key) / "run.h5")


def command(sweep, *options, **environment):
    """`apt-evap sweep work` as a process."""
    words = [sys.executable, "-P", "-m", "apt_evap", "sweep", "work", str(sweep.folder), "--quiet", *options]
    return subprocess.Popen(words, env=os.environ | environment, stderr=subprocess.PIPE, text=True)


def poison(sweep, key):
    """Give a point settings that its run refuses; its key is that of the plan, of which the maps are no part."""
    with open(sweep.folder_of(key) / "settings.toml", "a") as file:
        file.write('\n[[maps.panels]]\nperturbation = "Unobtainium"\n')


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


def has_begun(sweep, *keys):
    """Whether checkpoints of all these points are on the disk."""
    return all((sweep.folder_of(key) / "run.h5.unfinished").exists() for key in keys)


class Killer:
    """Kills a random process again and again while the block lasts, but only while a point is half run.

    What it waits for is the work, not the clock: on a fast machine, it kills as many.

    Parameters
    ----------
    sweep : Sweep
        The points that are run.
    processes : callable
        Returns the numbers of the processes that may be killed.
    most : int
        Largest number.
    """

    def __init__(self, sweep, processes, most, seed=1):
        self.sweep, self.processes, self.most = sweep, processes, most
        self.killed = []
        self._random, self._stop = random.Random(seed), threading.Event()
        self._thread = threading.Thread(target=self._kill)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._stop.set()
        self._thread.join()

    def _kill(self):
        pause = 0.0
        while len(self.killed) < self.most and not self._stop.wait(pause):
            pause = 0.01
            if any(has_begun(self.sweep, key) for key in self.sweep.keys) and (numbers := self.processes()):
                number = self._random.choice(numbers)
                try:
                    os.kill(number, signal.SIGKILL)
                except ProcessLookupError:
                    continue
                self.killed.append(number)
                pause = self._random.uniform(0.5, 3.0)  # most points end in between


def single_fingerprint(sweep, key):
    """Hash of the bits of a point that is run alone and without interruption, in this process."""
    config = read_config(sweep.folder_of(key) / "settings.toml")
    return config.simulation(n_threads=1).run(config.n_ions, config.emissions, progress=False).fingerprint()


def check_bits(sweep, keys=None):
    """The runs of the points are those of single runs, bit by bit."""
    for key in sweep.keys if keys is None else keys:
        assert load(sweep.folder_of(key) / "run.h5").fingerprint() == single_fingerprint(sweep, key)


def check_done(sweep):
    """All points are done, by no other runs than their own."""
    assert {state.name for _, state in sweep.states()} == {"done"}
    check_bits(sweep)


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
