"""Time and memory of the commands that read a large file, beside a program that only reads its bytes.

    python benchmarks/measure_files.py                 # makes an .epos of 20 million ions, 880 MB
    python benchmarks/measure_files.py --ions 2000000 --turns 5
    PYTHONPATH=other/version python benchmarks/measure_files.py          # measures that one

The commands and the plain read run in turn. A table gives medians of processor time and of time by the clock, the
latter over that of the plain reads of the same turn, and the peak of the memory.
"""

import argparse
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

IONS = (
    "Ni2:.4 Ni1:.08 Al2:.05 Al1:.06 Al3:.03 Cr2:.14 Cr1:.005 Co2:.12 Ti2:.02 Ti3:.01 H1:.03 W3:.008 W2:.002 CrO2:.003 "
    "C1:.004 C2:.004 B1:.002 Mo2:.003 Mo3:.004"
)
"""Ions of a nickel alloy with charges and parts."""
READ = "import sys, numpy; numpy.fromfile(sys.argv[1], 'u1')"
COMMANDS = {
    "plain read": ["-c", READ, "a.epos"],
    "info": ["-m", "apt_evap", "info", "a.epos"],
    "map": ["-m", "apt_evap", "map", "a.epos", "-o", "a.png"],
    "spectrum": ["-m", "apt_evap", "spectrum", "a.epos", "-o", "a_spectrum.png"],
    "composition": ["-m", "apt_evap", "composition", "a.epos"],
    "export": ["-m", "apt_evap", "export", "a.epos", "-o", "b.epos", "--force"],
    "reconstruct": (
        ["-m", "apt_evap", "reconstruct", "a.epos", "--distance", "90", "--element", "Ni", "-o", "b.pos", "--force"]
    ),
}


def write_file(path, n):
    """Write ions with the tails, background, pulses and voltages of a measurement."""
    # in a process of its own: programs that are started count the memory of this one
    import numpy as np

    from apt_evap.detection.hits import Hits
    from apt_evap.io.epos import write_epos
    from apt_evap.spectra.ion_names import Abundances

    rng = np.random.default_rng(7)
    lines = [(*Abundances(None).lines(text.partition(":")[0][:-1]), text) for text in IONS.split()]
    mass = np.concatenate([masses / int(text.partition(":")[0][-1]) for masses, _, text in lines])
    share = np.concatenate([shares / shares.sum() * float(text.partition(":")[2]) for _, shares, text in lines])
    mass = rng.choice(mass, n, p=share / share.sum())
    mass += rng.exponential(0.03, n) * np.sqrt(mass / 27) * (rng.random(n) < 0.4) + rng.normal(0, 0.01, n)
    mass = np.where(rng.random(n) < 0.03, (rng.random(n) * 12) ** 2, mass)
    radius, azimuth = 18 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)  # mm
    x, y, volts = radius * np.cos(azimuth), radius * np.sin(azimuth), np.linspace(3000, 7500, n)
    columns = {"x": x, "y": y, "mass_to_charge": mass, "voltage": volts, "pulse_voltage": volts / 5}
    columns["time_of_flight"] = 6.5e3 * np.sqrt(mass / volts)  # ns, of 90 mm
    columns["positions"] = np.stack([1.5 * x, 1.5 * y, np.linspace(0, 200, n)], 1)
    pulse = np.cumsum(rng.random(n) < 0.85)
    write_epos(path, Hits(**{name: values.astype("f4") for name, values in columns.items()}, pulse_id=pulse))


def measured(words, folder):
    """Processor time and time by the clock [s], and peak memory [GB], of a program."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *words], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)} failed")
    return used.ru_utime + used.ru_stime, time.perf_counter() - began, used.ru_maxrss / 1e6


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ions", type=int, default=20_000_000)
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else compiling the modules would be measured
    turns = {name: [] for name in COMMANDS}
    with tempfile.TemporaryDirectory() as folder:
        writer = multiprocessing.get_context("spawn").Process(
            target=write_file, args=(Path(folder, "a.epos"), options.ions)
        )
        writer.start()
        writer.join()
        if writer.exitcode:
            raise SystemExit("the file was not written: is apt_evap of this PYTHONPATH compiled?")
        for turn in range(options.turns + 1):  # the first one writes bytecode
            for name, words in COMMANDS.items():
                found = measured(words, folder)
                if turn:
                    turns[name].append(found)
    reads = [clock for _, clock, _ in turns["plain read"]]
    print(f"{options.ions:,} ions, {options.turns} turns; plain reads {', '.join(f'{read:.2f}' for read in reads)} s")
    print(f"{'command':12} {'processor [s]':>13} {'clock [s]':>10} {'over read':>10} {'memory [GB]':>12}")
    for name, rows in turns.items():
        cpu, clock, memory = map(statistics.median, zip(*rows, strict=True))
        over = statistics.median(row[1] / read for row, read in zip(rows, reads, strict=True))
        print(f"{name:12} {cpu:13.2f} {clock:10.2f} {over:10.1f} {memory:12.2f}")


if __name__ == "__main__":
    main()
