"""Compare two commits bit by bit: install both, make three runs with each, and compare every dataset.

    python tools/same_bits.py BASE [HEAD]        two commits; HEAD is the working tree if not given
    python tools/same_bits.py BASE --times 5     the same, and pairs of timed runs

The runs: Ni[111], R = 20 a, with responses; a random alloy with a user-defined perturbation; a shell with R = 60 a
that is deepened. Prints the hashes of each dataset that differs. The exit code is 1 if a dataset differs.
"""

import argparse
import hashlib
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]

CASES = """
import sys
import time
import warnings
from dataclasses import dataclass

import numpy as np

import apt_evap as ae

warnings.simplefilter("ignore")


@dataclass(frozen=True)
class FromAbove:
    height: float

    def launch(self, emissions, random):
        n = len(emissions)
        height = self.height * random.uniform()
        return ae.Launches(emissions.positions + height * emissions.normals, np.zeros((n, 3)), np.zeros(n, bool))


def simulation(name):
    if name == "nickel":
        nickel = ae.material("Ni")
        tip = ae.Tip(nickel, apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_length=20 * nickel.a)
        return ae.Simulation(tip, seed=1, detector=ae.Detector(distance=100.0, width=300.0)), 3000, ()
    if name == "alloy":
        al = ae.material("Al")
        tip = ae.Tip(al, apex_radius=12 * al.a, axis=(0, 1, 2), solutes={"Ni": 0.05}, seed=3, offset_seed=5)
        return ae.Simulation(tip, seed=2, voltage=800.0), 3000, (FromAbove(0.3), ae.LateralVelocity(0.2))
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, apex_radius=60 * nickel.a, axis=(1, 1, 1), shank_length=20 * nickel.a, depth=0.9)
    return ae.Simulation(tip, seed=3), 1500, ()


for name in sys.argv[2:]:
    case, ions, emissions = simulation(name)
    start = time.perf_counter()
    run = case.run(ions, emissions, progress=False)
    print(name, time.perf_counter() - start, len(case.tip.positions), flush=True)
    run.save(f"{sys.argv[1]}/{name}.h5")
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
    """Make the runs; return their times [s] by name."""
    outcome = subprocess.run(
        [python, folder / "cases.py", folder, *cases], check=True, cwd=folder, capture_output=True, text=True
    )
    return {line.split()[0]: float(line.split()[1]) for line in outcome.stdout.splitlines()}


def datasets(path):
    """Hash of every dataset of a run file, by name."""
    import h5py  # from the environment of this tool

    hashes = {}

    def visit(name, item):
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf":  # no texts, such as the time
            values = item[()]
            hashes[name] = hashlib.sha256(str(values.dtype).encode() + str(values.shape).encode() + values.tobytes())

    with h5py.File(path) as file:
        file.visititems(visit)
    return {name: digest.hexdigest()[:16] for name, digest in hashes.items()}


def main():
    """Install both commits, make the runs and compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base")
    parser.add_argument("head", nargs="?")
    parser.add_argument("--times", type=int, default=0, help="number of pairs of timed runs")
    options = parser.parse_args()
    cases = ("nickel", "alloy", "shell")
    with tempfile.TemporaryDirectory() as folder:
        sides = {}
        for side, commit in (("base", options.base), ("head", options.head)):
            path = Path(folder, side)
            path.mkdir()
            sides[side] = install(commit, path), path
            run_cases(*sides[side], cases)
        differences = 0
        for case in cases:
            base, head = (datasets(path / f"{case}.h5") for _, path in sides.values())
            for name in sorted(base | head):
                if base.get(name) != head.get(name):
                    differences += 1
                    print(f"{case}: {name} {base.get(name)} -> {head.get(name)}")
            print(f"{case}: {sum(base[name] == head.get(name) for name in base)} of {len(base)} datasets equal")
        ratios = {case: [] for case in cases}
        for _ in range(options.times):
            base, head = (run_cases(*sides[side], cases) for side in ("base", "head"))
            for case in cases:
                ratios[case].append(head[case] / base[case])
        for case, values in ratios.items():
            if values:
                print(f"{case}: head / base {statistics.median(values):.3f} ({min(values):.3f} to {max(values):.3f})")
    return bool(differences)


if __name__ == "__main__":
    sys.exit(main())
