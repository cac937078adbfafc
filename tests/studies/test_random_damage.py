"""Random damage to the files of a sweep: each call answers or ends with a FileError, and no file elsewhere changes."""

import csv
import json
import os
import random
import shutil

import pytest
from sweeps import do, planned

from apt_evap._common.files import FileError
from apt_evap.studies.sweep.collection import collect_sweep
from apt_evap.studies.sweep.planning import open_sweep, plan_sweep, retry, sweep_status
from apt_evap.studies.sweep.point_folder import run_point

BASE = """
[tip]
material = "Ni"
apex_radius = "4 a"
shank_length = "4 a"

[simulation]
ions = 10

[maps]
bins = 8
"""
STUDY = 'base = "base.toml"\neach = {checkpoint = 5}\n[sweep]\n"tip.offset_seed" = [1, 2]\n"simulation.seed" = [0, 1]\n'
VALUES = [
    None, 0, 1, -1, 1.5, 1e400, -1e400, float("nan"), 10**400, True, "", "x", "../../..", "../../../victim", "\ud800",
    "$(touch PWN)", "`touch PWN`;", "a\nb", "a\x00b", "\x1b[2J", [], {}, [1], {"a": 1}, [[[]]], "1" * 10_000, ...,
]  # fmt: skip
NAMES = ["work.json", "lock", "run.h5.unfinished", "run.png", "x", "$(touch PWN)", "a\nb", ".x"]
TEXTS = ["", "{", "{}", "[]", "null", "NaN", "1e999", "[" * 5000, '{"code": 0}', '{"pid": 1}', "\x00" * 100]


def changed(text, chance):
    """A JSON text with another value, or with a flipped bit."""
    if chance.random() < 0.2:
        content = bytearray(text.encode())
        if content:
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        return bytes(content)
    places = []

    def walk(thing, path):
        entries = thing.items() if isinstance(thing, dict) else enumerate(thing) if isinstance(thing, list) else ()
        for key, value in entries:
            places.append((thing, key))
            walk(value, (*path, key))

    document = json.loads(text)
    walk(document, ())
    for thing, key in chance.sample(places, min(len(places), chance.choice([1, 1, 1, 3]))):
        value = chance.choice(VALUES)
        if value is not ...:
            thing[key] = value
        elif isinstance(thing, dict):
            thing.pop(key, None)
    return json.dumps(document).encode()


def damage(folder, victim, chance):
    """Damage one thing in the folder of a sweep; return what."""
    point = chance.choice(sorted((folder / "points").iterdir()))
    kind = chance.choice(["plan", "plan", "plan", "notes", "notes", "name", "link", "pipe", "run", "swap", "settings"])
    if kind in ("plan", "notes"):
        path = folder / "plan.json" if kind == "plan" else point / "work.json"
        path.write_bytes(changed(path.read_text(), chance))
    elif kind == "name":
        path = chance.choice([point, folder / "points", folder]) / chance.choice(NAMES)
        path.write_text(chance.choice(TEXTS), errors="surrogatepass")
    elif kind in ("link", "pipe"):
        names = ("work.json", "lock", "run.h5", "run.png", "settings.toml", "run.h5.unfinished")
        places = [point, folder / "points", folder / "index.csv", folder / "maps.h5"]
        path = chance.choice([*(point / name for name in names), *places])
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        else:
            path.symlink_to(chance.choice([victim, victim / "file", victim / "missing", "loop"]))
    elif kind == "run":
        path = point / "run.h5"
        content = bytearray(path.read_bytes())
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        path.write_bytes(content[: chance.choice([None, None, chance.randrange(len(content))])])
    elif kind == "swap":
        path = chance.choice(sorted((folder / "points").iterdir())) / "run.h5"
        shutil.copy(point / "run.h5", point / "copy.h5")
        os.replace(point / "copy.h5", path)
    else:
        path = point / "settings.toml"
        path.write_text(
            path.read_text().replace(*chance.choice([("10", "5"), ("Ni", "Al"), ("[", "{"), ("1", "1e400")]))
        )
        (point / "run.h5").unlink()
    return kind, path


def snapshot(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


def work(sweep):
    """Run all points that are waiting, in this process, with few seconds of simulation."""
    for point, state in sweep.states():
        if state.name == "waiting":
            run_point(sweep.folder_of(point.key))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mutants", "seed"), [(25, 1), *(pytest.param(500, seed, marks=pytest.mark.slow) for seed in (2, 3))]
)
@pytest.mark.filterwarnings("ignore")
def test_damaged_sweeps(tmp_path, monkeypatch, mutants, seed):
    chance, outcomes = random.Random(seed), {}
    (tmp_path / "good").mkdir()
    sweep = planned(tmp_path / "good", STUDY, BASE)
    right = {key: do(sweep, key).fingerprint() for key in sweep.keys}
    monkeypatch.setattr("apt_evap.plot.report.sweep_report._MOST_MAPS", 0)  # pictures take a second, for every mutant
    victim, place = tmp_path / "victim", tmp_path / "place"
    victim.mkdir()
    (victim / "file").write_text("mine")
    monkeypatch.chdir(victim)
    for number in range(mutants):
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(tmp_path / "good", place)
        kind, path = damage(place / "study", victim, chance)
        before = snapshot(victim)
        calls = {
            "open": lambda sweep: open_sweep(place / "study"),
            "status": sweep_status,
            "retry": retry,
            "work": work,
            "collect": lambda sweep: check_collected(sweep, right),
            "plan": lambda sweep: plan_sweep(place / "study.toml"),
        }
        sweep = None
        for name, call in calls.items():
            if sweep is None and name not in ("open", "plan"):
                continue
            if name == "collect" and kind in ("notes", "name") and chance.random() < 0.7:
                continue  # it takes longest
            try:
                answer, outcome = call(sweep), "answered"
            except FileError:
                answer, outcome = None, "refused"
            except Exception as error:
                raise AssertionError(f"mutant {number}: {name} after {kind} of {path}") from error
            sweep = answer if name == "open" else sweep
            outcomes[name, outcome] = outcomes.get((name, outcome), 0) + 1
        assert snapshot(victim) == before, (number, kind, path)
        assert sorted(each.name for each in tmp_path.iterdir()) == ["good", "place", "victim"]
    print(outcomes)
    assert outcomes["open", "answered"] > mutants / 3 and outcomes["open", "refused"]


def check_collected(sweep, right):
    """Collect; every row that is done has the bits of its point."""
    result = collect_sweep(sweep)
    with open(sweep.folder / "index.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        assert row["fingerprint"] in ("", right[row["key"]])
        assert (row["state"] == "done") == bool(row["fingerprint"])
    assert sum(row["state"] == "done" for row in rows) == result["done"]
