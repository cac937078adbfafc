"""Processor seconds of the examples and commands: ``python -m benchmarks`` writes docs/costs.csv.

README, the examples, the docs and ``--help`` promise times in words. ``tests/project/test_costs.py`` compares their
words with this table. One thread; processor time counts, so that a busy machine changes little.
"""

import argparse
import contextlib
import csv
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "costs.csv"
_RUNS = (
    "core_shell", "gamma_prime", "gp_zone", "grain_boundary", "multilayer", "multilayer_across", "ni111", "precipitate",
)  # fmt: skip
COMMANDS = {
    **{f"run {name}": ("run", name) for name in _RUNS},
    "sweep plan sweep": ("sweep", "plan", "sweep"),
    "sweep work sweep": ("sweep", "work", "sweep"),
    "dataset dataset": ("dataset", "dataset"),
    "visible visible, first call": ("visible", "visible"),
    "visible visible, next calls": ("visible", "visible"),
    "map ni111.h5": ("map", "ni111.h5", "-o", "a.png"),
    "reconstruct ni111.h5": ("reconstruct", "ni111.h5"),
    "index example_ni111.npz": ("index", "example_ni111.npz", "--element", "Ni"),
    "--help": ("--help",),
}
"""Commands by their names in the table, in an order in which each finds the files that it needs."""


def processor_seconds(words, folder):
    """Processor time of a command, with its processes [s], and its exit code."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"
    }  # fmt: skip
    before = os.times()
    process = subprocess.run(
        [sys.executable, "-m", "apt_evap", *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    if process.returncode:
        print(process.stderr[-500:], file=sys.stderr)
    return spent, process.returncode


def main(arguments=None):
    """Measure all commands, or those whose names contain a text, and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", help="parts of names; default: all")
    parser.add_argument("--folder", help="where the commands run and leave their files; default: a temporary one")
    options = parser.parse_args(arguments)
    known = {}
    if TABLE.exists():
        with TABLE.open(newline="") as file:
            known = {row["command"]: row["processor_seconds"] for row in csv.DictReader(file)}
    with contextlib.nullcontext(options.folder) if options.folder else tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, "-c", "from apt_evap.explore.start_page import write_example; write_example()"],
            cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True,
        )  # fmt: skip
        for name, words in COMMANDS.items():
            if options.names and not any(part in name for part in options.names):
                continue
            began = time.monotonic()
            spent, code = processor_seconds(words, folder)
            print(f"{name}: {spent:.1f} s of processor, {time.monotonic() - began:.0f} s, exit code {code}", flush=True)
            if not code:
                known[name] = f"{spent:.1f}" if spent > 0.1 else f"{spent:.2f}"
                with TABLE.open("w", newline="") as file:
                    writer = csv.writer(file, lineterminator="\n")
                    writer.writerow(["command", "processor_seconds"])
                    writer.writerows((name, known[name]) for name in COMMANDS if name in known)
    return 0


if __name__ == "__main__":
    sys.exit(main())
