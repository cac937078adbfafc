"""Memory of a long run: checks that it does not grow by more than the results.

    python benchmarks/soak.py                       # 100,000 ions of Ni[111], R = 20 a, one flight each
    python benchmarks/soak.py --ions 20000 --radius 40 --output soak.png

Records the resident memory during a run with checkpoints, and draws it against the number of ions. Fails (exit code 1)
if the memory grows, after the first fifth of the run, by more than the size of the results and the bound SLACK.
"""

import argparse
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import apt_evap as ae

# [bytes] variation of the sizes of the surface and of the copies of the tree, and memory that allocators do not return.
# A leak of 1 kB per ion, a sixth of the journal of an event, would be 100 MB in a run of 100,000 ions.
SLACK = 30e6


def resident():
    """Resident memory of this process [bytes] (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1024 * int(line.split()[1])
    raise OSError("/proc/self/status has no VmRSS")


def bytes_of(run):
    """Memory of the results of a run [bytes]."""
    arrays = [value for value in vars(run.emissions).values() if isinstance(value, np.ndarray)]
    arrays += [run.site, run.species, run.charges, run.fields]
    arrays += [array for flown in run.flown for array in (flown.directions, flown.times)]
    arrays += list(run.responses or ())
    return sum(array.nbytes for array in arrays)


def soak(radius, n_ions, responses, n_threads):
    """Run, and sample the memory twice per second; return the run, and the ions and memory [bytes] of each sample."""
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, apex_radius=radius * nickel.a, axis=(1, 1, 1), shank_length=2 * radius * nickel.a)
    simulation = ae.Simulation(tip, seed=1, n_threads=n_threads)
    print(f"{simulation!r}; {len(simulation.emitter):,} surface atoms; {resident() / 1e6:.0f} MB", flush=True)
    samples, done = [], threading.Event()

    def sample():
        while not done.wait(0.5):
            samples.append((simulation.n_evaporated, resident()))

    sampler = threading.Thread(target=sample)
    with tempfile.TemporaryDirectory() as folder:
        sampler.start()
        start = time.perf_counter()
        try:
            checkpoint = ae.simulation.Checkpoint(Path(folder, "soak.h5"), minutes=1.0)
            run = simulation.run(n_ions, responses=responses, checkpoint=checkpoint)
        finally:
            done.set()
            sampler.join()
    print(f"{len(run):,} ions, {len(run) / (time.perf_counter() - start):.0f} ions/s; {run.ended or 'complete'}")
    ions, memory = np.array(samples).T
    during = ions < len(run)  # at the end the parts are joined and are twice in memory for a moment
    return run, ions[during], memory[during]


def draw(path, ions, memory, expected):
    """Draw the memory against the number of ions."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(ions / 1e3, memory / 1e6, label="resident memory")
    axes.plot(ions / 1e3, expected / 1e6, "--", label="memory after a fifth of the run, plus later results")
    axes.set(xlabel="ions evaporated / 1000", ylabel="memory / MB", ylim=(0, 1.1e-6 * memory.max()), xlim=(0, None))
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=150)


def main():
    """Run, draw and check the memory."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--radius", type=float, default=20.0, help="apex radius in lattice constants")
    parser.add_argument("--ions", type=int, default=100_000)
    parser.add_argument("--responses", action="store_true", help="compute responses instead of one flight per ion")
    parser.add_argument("--threads", type=int, help="default: all processors")
    parser.add_argument(
        "--output", default="soak.png", help="figure; the samples are written to a .csv file with the same name"
    )
    options = parser.parse_args()
    run, ions, memory = soak(options.radius, options.ions, options.responses, options.threads)
    path = Path(options.output)
    np.savetxt(path.with_suffix(".csv"), np.column_stack([ions, memory]), "%d", ",", header="ions,bytes", comments="")
    per_ion = bytes_of(run) / len(run)
    fifth = int(np.searchsorted(ions, len(run) / 5))
    expected = memory[fifth] + per_ion * (ions - ions[fifth])
    draw(path, ions, memory, np.where(ions >= ions[fifth], expected, np.nan))
    over = float((memory - expected)[fifth:].max())
    print(
        f"memory {memory[fifth] / 1e6:.0f} MB at {ions[fifth]:,} ions, {memory[-1] / 1e6:.0f} MB at {ions[-1]:,}; "
        f"results {per_ion:.0f} B per ion, {per_ion * (ions[-1] - ions[fifth]) / 1e6:.0f} MB of the increase; "
        f"largest excess {over / 1e6:.0f} MB"
    )
    if over > SLACK:
        print(f"memory grows: the excess over the results must be <= {SLACK / 1e6:.0f} MB", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
