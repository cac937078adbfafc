"""Type hints: they distinguish right use from wrong."""

import ast
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
from source_trees import tree_of

import apt_evap as ae

ROOT = Path(__file__).parents[2]


# what a user writes, and in which lines mypy must find fault
USE = """
from dataclasses import dataclass
import numpy as np
import apt_evap as ae

@dataclass(frozen=True)
class FromAbove:
    height: float

    def launch(self, emissions: ae.emission.Emissions, random: ae.emission.IonRandom) -> ae.emission.Launches:
        n = len(emissions)
        return ae.emission.Launches(emissions.positions + self.height, np.zeros((n, 3)), np.zeros(n, bool))

class NoPerturbation:
    pass

solutes = {"Al": 0.1}
tip = ae.Tip("Ni", apex_radius=2, axis=(1, 1, 1), solutes=solutes, seed=1)
wrong = ae.Tip("Ni", apex_radius="20 a")  # error
simulation = ae.Simulation(tip, voltage=1000, detector=ae.Detector(distance=100.0))
run = simulation.run(100, emissions=[FromAbove(0.3)])
hits = run.hits(ae.RollUp(ae.TruncatedNormal(0.155, 0.155)))
hits = run.hits(ae.LateralVelocity(0.3))
hits = run.hits(FromAbove(0.3))
run.hits(NoPerturbation())  # error
ae.RollUp("0.3 eV")  # error
name: str = run.voltage  # error
ae.write("ni.epos", hits)
ae.plot.detector_map(hits.map(bins=64).smoothed(2.0), title="Ni")
ae.plot.detector_map(hits)
ae.plot.detector_map(tip)  # error
charges = simulation.emitter.charges.sum()
simulation.emitter.charge  # error
"""


# a script without any hints, as users write it
SCRIPT = """
import apt_evap as ae
import numpy as np

nickel = ae.material("Ni")
tip = ae.Tip(nickel, apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_angle=1.5)
simulation = ae.Simulation(tip, voltage=1000.0, seed=1)
run = simulation.run(15_000)
run.save("ni111.h5")
hits = ae.load("ni111.h5").hits(ae.RollUp(ae.TruncatedNormal(0.155, 0.155)))
inside = hits[np.hypot(hits.x, hits.y) < 50.0]
print(len(inside), inside.x.mean(), hits.time_of_flight[:10], float(hits.y.max()))
measured = ae.read("R5083.epos")
map_ = measured.map(bins=128).smoothed(1.0)
registration = ae.register(hits, map_)
moved = registration.hits(hits).map(like=map_)
similarity = ae.similarity(moved, map_, smoothing=1.0)
print(f"{similarity:.3f}", round(float(similarity), 3), similarity.value > 0.2)
ax = ae.plot.detector_map(moved, title="Ni [111]")
ax.figure.savefig("ni111.png")
ae.plot.detector_maps([moved, map_])[0].figure.savefig("both.png", dpi=200)
study = ae.fit_energies(run, measured, ae.fit.EnergyGrid("roll-up"), registration=registration)
ae.plot.score_matrix(study)[0].figure.savefig("scores.png")
print(study.optimum.mean, study.registration.rotation, tip.positions[:, 2].max())
ae.write("ni111.epos", hits)
"""


@pytest.mark.slow
def test_hints_tell_right_use_from_wrong(tmp_path):
    """Under strict rules and without the settings of the project, as in a project of the user."""
    pytest.importorskip("mypy")
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "use.py").write_text(USE)
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", os.devnull, "script.py", "use.py"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    found = {tuple(line.split(":")[:2]) for line in done.stdout.splitlines() if ": error:" in line}
    wrong = {("use.py", str(k)) for k, line in enumerate(USE.splitlines(), 1) if line.endswith("# error")}
    assert found == wrong and not done.stderr, done.stdout


@pytest.mark.parametrize("name", [name for name in dir(ae) if inspect.isroutine(getattr(ae, name))])
def test_help_shows_aliases_of_types(name):
    """Not what they stand for, which takes four lines for each array."""
    assert "_SupportsArray" not in str(inspect.signature(getattr(ae, name)))


def public_functions():
    """Functions and methods without an underscore, with where they are."""
    for path in sorted((ROOT / "apt_evap").rglob("*.py")):
        holders = [tree_of(path.read_text())]
        while holders:
            holder = holders.pop()
            for node in holder.body:
                if isinstance(node, ast.ClassDef):
                    holders.append(node)
                elif isinstance(node, ast.FunctionDef) and (node.name[0] != "_" or node.name == "__init__"):
                    yield f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", node


def test_every_public_function_is_annotated():
    found = dict(public_functions())
    assert len(found) > 100
    bare = []
    for name, node in found.items():
        given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg]
        untyped = [arg.arg for arg in given if arg and arg.annotation is None and arg.arg not in ("self", "cls")]
        if untyped or node.returns is None:
            bare.append(f"{name}: {', '.join(untyped) or 'what it returns'}")
    assert bare == []
