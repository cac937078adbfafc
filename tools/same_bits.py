"""Compare two commits bit by bit: install both, make the same runs with each, and compare the hashes of the results.

    python tools/same_bits.py BASE [HEAD]        two commits; HEAD is the working tree if not given
    python tools/same_bits.py BASE --times 5     the same, and pairs of timed runs

The runs: Ni[111], R = 20 a, with responses; two phases at a temperature with a controlled voltage; a constant
potential with responses; a random alloy with a user-defined perturbation; a shell with R = 60 a that
is deepened. Compared are `Run.fingerprint`, and the hits of the ions: unperturbed and rolled up. The exit code is 1 if
one differs.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]

CASES = """
import hashlib
import json
import sys
import time
import warnings
from dataclasses import dataclass

import numpy as np

import apt_evap as ae
from apt_evap.emission.emissions import Launches
from apt_evap.specimen.phases import Phase
from apt_evap.specimen.regions import Sphere

warnings.simplefilter("ignore")


@dataclass(frozen=True)
class FromAbove:
    height: float

    def launch(self, emissions, random):
        n = len(emissions)
        height = self.height * random.uniform()
        return Launches(emissions.positions + height * emissions.normals, np.zeros((n, 3)), np.zeros(n, bool))


def simulation(name):
    nickel, aluminium = ae.material("Ni"), ae.material("Al")
    a = nickel.a
    if name == "nickel":
        tip = ae.Tip(nickel, apex_radius=20 * a, axis=(1, 1, 1), shank_length=20 * a)
        return ae.Simulation(tip, seed=1, detector=ae.Detector(distance=100.0, width=300.0)), 3000, ()
    if name == "phases":
        core = Sphere((0, 0, 8 * a), 3 * a)
        matrix = Phase("matrix", nickel, solutes={"Al": 0.1})
        phases = [matrix, Phase("core", nickel, core, evaporation_field=30.0)]
        tip = ae.Tip(phases=phases, apex_radius=12 * a, axis=(0, 0, 1), seed=4)
        control = ae.evaporation.VoltageControl(rate=0.02, memory=100)
        return ae.Simulation(tip, seed=4, law=ae.Arrhenius(60.0), control=control), 2000, ()
    if name == "potential":
        tip = ae.Tip(nickel, apex_radius=12 * a, axis=(1, 1, 1))
        rule = ae.ConstantPotential(charges="gaussian", law_field="charge")
        return ae.Simulation(tip, seed=5, rule=rule), 1500, ()
    if name == "alloy":
        radius = 12 * aluminium.a
        tip = ae.Tip(aluminium, apex_radius=radius, axis=(0, 1, 2), solutes={"Ni": 0.05}, seed=3, offset_seed=5)
        return ae.Simulation(tip, seed=2, voltage=800.0), 3000, (FromAbove(0.3), ae.LateralVelocity(0.2))
    tip = ae.Tip(nickel, apex_radius=60 * a, axis=(1, 1, 1), shank_length=20 * a, depth=0.9)
    return ae.Simulation(tip, seed=3), 1500, ()


def digest(hits):
    columns = [np.nan_to_num(each, nan=-1e9) for each in (hits.x, hits.y, hits.time_of_flight)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(each).tobytes() for each in columns)).hexdigest()[:16]


for name in sys.argv[1:]:
    case, ions, emissions = simulation(name)
    start = time.perf_counter()
    run = case.run(ions, emissions, progress=False)
    seconds = time.perf_counter() - start
    rolled = ae.RollUp(ae.TruncatedNormal(0.155, 0.155), **({"sharpness": 0.3} if name == "potential" else {}))
    hashes = {"run": run.fingerprint()} | {repr(each): digest(run.hits(each)) for each in (ae.Unperturbed(), rolled)}
    if name != "phases":
        hashes["real units"] = digest(run.at_evaporation_field().hits(rolled))
    print(json.dumps([name, seconds, hashes]), flush=True)
"""


def install(commit, folder):
    """Install a commit, or the working tree, into a new environment; return its Python executable."""
    source = folder / "source"
    if commit:
        subprocess.run(["git", "clone", "-q", str(ROOT), str(source)], check=True)
        subprocess.run(["git", "checkout", "-q", commit], cwd=source, check=True)
    else:
        command = ["git", "ls-files", "-co", "--exclude-standard"]
        listing = subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        for name in listing.stdout.decode().split():
            if (ROOT / name).exists():
                (source / name).parent.mkdir(parents=True, exist_ok=True)
                (source / name).write_bytes((ROOT / name).read_bytes())
    subprocess.run([sys.executable, "-m", "venv", str(folder / "env")], check=True)
    subprocess.run([folder / "env/bin/pip", "install", "-q", str(source)], check=True)
    (folder / "cases.py").write_text(CASES)
    return folder / "env/bin/python"


def run_cases(python, folder, cases):
    """Make the runs; return their times [s] and their hashes by name."""
    command = [python, folder / "cases.py", *cases]
    outcome = subprocess.run(command, check=True, cwd=folder, capture_output=True, text=True)
    return {name: (seconds, hashes) for name, seconds, hashes in map(json.loads, outcome.stdout.splitlines())}


def main():
    """Install both commits, make the runs and compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base")
    parser.add_argument("head", nargs="?")
    parser.add_argument("--times", type=int, default=0, help="number of pairs of timed runs")
    options = parser.parse_args()
    cases = ("nickel", "phases", "potential", "alloy", "shell")
    with tempfile.TemporaryDirectory() as folder:
        sides, results = {}, {}
        for side, commit in (("base", options.base), ("head", options.head)):
            path = Path(folder, side)
            path.mkdir()
            sides[side] = install(commit, path), path
            results[side] = run_cases(*sides[side], cases)
        differences = 0
        for case in cases:
            base, head = (list(results[side][case][1].items()) for side in ("base", "head"))
            for (name, one), (_, other) in zip(base, head, strict=True):
                differences += one != other
                print(f"{case}, {name}: {'equal' if one == other else f'{one} -> {other}'}")
        ratios = {case: [] for case in cases}
        for _ in range(options.times):
            base, head = (run_cases(*sides[side], cases) for side in ("base", "head"))
            for case in cases:
                ratios[case].append(head[case][0] / base[case][0])
        for case, values in ratios.items():
            if values:
                print(f"{case}: head / base {statistics.median(values):.3f} ({min(values):.3f} to {max(values):.3f})")
    return bool(differences)


if __name__ == "__main__":
    sys.exit(main())
