"""Damage files of runs, ions, data sets and operators at random, read each, and compare what comes back.

python tools/fuzz_runs.py [--mutants 20000] [--seed 1] [--processes 2] [--run RUN.h5]

Each mutant is read in a child process. It must come back as the original or be refused by a FileError. Exit code 1 if
one is silently wrong, hangs, or ends in a crash or in another error.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import fields, is_dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

import apt_evap as ae
from apt_evap.simulation.run_hdf5 import count_ions, is_run
from apt_evap.studies.dataset.fields import TEXT, Field
from apt_evap.studies.dataset.shards import read_table, write_shard

KINDS = ("flipped bits", "zeroed range", "random range", "truncation", "insertion", "deletion")
GOOD = ("as the original", "FileError")
SECONDS, MEMORY = 20, 6 << 30  # of one mutant
SCHEMA = {
    "examples": (Field("ions", np.int64, ""), Field("settings", TEXT, "")),
    "ions": (Field("example", np.uint32, ""), Field("position", np.float32, "", "nm", (3,))),
}


def make_files(folder):
    """A file of each kind, and how it is read: a run with all that it may contain, ions, a data set, and operators."""
    tip = ae.Tip("Ni", apex_radius=1.8, axis=(1, 1, 1), shank_length=1.8, depth=1.2, solutes={"Al": 0.1}, seed=1)
    settings, monitor = ae.evaporation.ChargeSettings(sweep_interval=20), ae.simulation.Monitor(interval=20)
    simulation = ae.Simulation(tip, seed=1, n_threads=1, charge_settings=settings, monitor=monitor)
    run = simulation.run(60, [ae.RollUp(0.2), ae.Unperturbed()], progress=False)
    run.save(folder / "run.h5")
    ae.write(folder / "ions.nxs", run.hits(ae.RollUp(0.2)), elements=["Ni", "Al"])
    random = np.random.default_rng(1)
    tables = {
        "examples": {"ions": np.array([500, 300]), "settings": ["one " * 300, "other"]},
        "ions": {"example": np.repeat([0, 1], [500, 300]).astype("u4"), "position": random.random((800, 3), "f4")},
    }
    write_shard(folder, "train-0000", tables, SCHEMA, "hdf5")
    layer = ae.specimen.Phase("layer", "Ni", ae.specimen.Layer(1.0, 1.4), solutes={"Al": 0.5})
    specimen = ae.Tip("Ni", apex_radius=1.8, axis=(1, 1, 1), shank_length=3.6)
    operators = ae.studies.origin_operators(layer, specimen, ae.Instrument(), axes={"size": [0.4]}, n_threads=1)
    operators.save(folder / "operators.h5")
    return {
        "run.h5": load_run,
        "ions.nxs": ae.read,
        "train-0000.h5": load_shard,
        "operators.h5": load_operators,
    }


def values_of(thing):
    """All values of an object, as nested lists of what can be compared."""
    if isinstance(thing, np.ndarray):
        return [thing.dtype.str, thing.shape, hashlib.sha256(np.ascontiguousarray(thing).tobytes()).hexdigest()]
    if is_dataclass(thing) and not isinstance(thing, type):
        return [type(thing).__name__, *(values_of(getattr(thing, item.name)) for item in fields(thing))]
    if isinstance(thing, dict):
        return [[key, values_of(value)] for key, value in sorted(thing.items())]
    if isinstance(thing, list | tuple):
        return [values_of(each) for each in thing]
    return repr(thing)


def load_run(path):
    """Read a run in every way that there is."""
    is_run(path), count_ions(path)
    return ae.load(path)


def load_operators(path):
    """Read origin operators, without the name of their file."""
    return replace(ae.studies.OriginOperators.load(path), source="")


def load_shard(path):
    """Read the tables of a file of a data set, the ions also in part."""
    folder, name = path.parent, path.stem
    tables = [read_table(folder, name, table, SCHEMA, "hdf5") for table in SCHEMA]
    return tables, read_table(folder, name, "ions", SCHEMA, "hdf5", slice(9, 70))


def mutant(content, random):
    """Damaged content, and the kind of the damage."""
    kind = KINDS[int(random.integers(len(KINDS)))]
    n = len(content)
    place = int(random.integers(n))
    length = int(random.integers(1, 2 ** int(random.integers(1, 15))))
    damaged, after = bytearray(content), content[place + length :]
    if kind == "flipped bits":
        for at in (place, *random.integers(n, size=int(random.integers(3)))):
            damaged[at] ^= 1 << int(random.integers(8))
    elif kind == "zeroed range":
        damaged[place : place + length] = bytes(n - place - len(after))
    elif kind == "random range":
        damaged[place : place + length] = random.bytes(n - place - len(after))
    elif kind == "truncation":
        del damaged[place:]
    elif kind == "insertion":
        damaged[place:place] = random.bytes(length)
    else:
        del damaged[place : place + length]
    return bytes(damaged), kind


def outcome_of(path, load, original):
    """How reading a mutant ends."""
    try:
        return GOOD[0] if values_of(load(path)) == original else "silently other values"
    except ae.FileError:
        return GOOD[1]
    except Exception as error:
        return f"{type(error).__name__}: {error!s:.60}"


def try_some(numbers, seed, content, load, original, folder):
    """Outcomes of some mutants; a child that dies takes one with it, and another child goes on behind that."""
    path, done = Path(folder) / f"{os.getpid()}.h5", []
    while len(done) < len(numbers):
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            with os.fdopen(writer, "w") as told:
                for number in numbers[len(done) :]:
                    signal.alarm(SECONDS)
                    damaged, kind = mutant(content, np.random.default_rng([seed, number]))
                    path.write_bytes(damaged)
                    print(json.dumps([kind, None]), file=told, flush=True)
                    print(json.dumps([kind, outcome_of(path, load, original)]), file=told, flush=True)
            os._exit(0)
        os.close(writer)
        with os.fdopen(reader) as told:
            lines = [json.loads(line) for line in told if line.endswith("\n")]
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        done += [(kind, outcome) for kind, outcome in lines if outcome is not None]
        if status and len(done) < len(numbers):
            how = "hangs" if status == -signal.SIGALRM else f"crash ({signal.Signals(-status).name})"
            done.append((lines[-1][0] if lines else "?", how))
    return list(zip(numbers, done, strict=True))


def fuzz(path, load, options, folder):
    """Try all mutants of a file; return whether all ended well."""
    original = values_of(load(path))
    content, began = path.read_bytes(), time.perf_counter()
    numbers = [list(range(k, options.mutants, 50 * options.processes)) for k in range(50 * options.processes)]
    same = (options.seed, content, load, original, folder)
    context = multiprocessing.get_context("fork")
    with context.Pool(options.processes) as pool:
        parts = pool.starmap(try_some, [(part, *same) for part in numbers if part], chunksize=1)
    counts, firsts = Counter(), {}
    for number, (kind, outcome) in sorted(chain.from_iterable(parts)):
        counts[kind, outcome] += 1
        firsts.setdefault(outcome, number)
    seconds = time.perf_counter() - began
    print(f"{path.name} ({len(content):,} bytes): {options.mutants:,} mutants in {seconds:.0f} s")
    for outcome in sorted(firsts):
        by_kind = ", ".join(f"{kind} {counts[kind, outcome]:,}" for kind in KINDS if counts[kind, outcome])
        total = sum(counts[kind, outcome] for kind in (*KINDS, "?"))
        first = "" if outcome in GOOD else f"; the first is number {firsts[outcome]}"
        print(f"  {outcome}: {total:,} ({by_kind}){first}")
    return set(firsts) <= set(GOOD)


def main():
    """Damage the files as often as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutants", type=int, default=1000, help="of each file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--run", type=Path, help="a run file in addition to those that are made here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = {Path(folder, name): load for name, load in make_files(Path(folder)).items()}
        if options.run:
            files[options.run] = load_run
        well = all([fuzz(path, load, options, folder) for path, load in files.items()])
    sys.exit(not well)


if __name__ == "__main__":
    main()
