"""Type hints: they tell right use from wrong, and the stubs of the compiled modules say what these hold."""

import ast
import importlib
import importlib.util
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

import apt_evap as ae

ROOT = Path(__file__).parents[2]
CORE = ROOT / "apt_evap" / "_core"
MODULES = sorted(path.stem for path in CORE.glob("*.pyx"))
OF_CYTHON = {"__pyx_vtable__", "__reduce__", "__setstate__", "__reduce_cython__", "__setstate_cython__", "__new__"}


# what a user writes, and in which lines mypy must find fault
USE = """
from dataclasses import dataclass
import numpy as np
import apt_evap as ae

@dataclass(frozen=True)
class FromAbove:
    height: float

    def launch(self, emissions: ae.Emissions, random: ae.IonRandom) -> ae.Launches:
        n = len(emissions)
        return ae.Launches(emissions.positions + self.height, np.zeros((n, 3)), np.zeros(n, bool))

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
similarity = ae.ssim(moved, map_, smoothing=1.0)
print(f"{similarity:.3f}", round(float(similarity), 3), similarity.value > 0.2)
ax = ae.plot.detector_map(moved, title="Ni [111]")
ax.figure.savefig("ni111.png")
ae.plot.detector_maps([moved, map_])[0].figure.savefig("both.png", dpi=200)
study = ae.fit_energies(run, measured, ae.EnergyGrid("roll-up"), registration=registration)
ae.plot.ssim_matrix(study)[0].figure.savefig("ssim.png")
print(study.optimum.mean, study.registration.rotation, tip.positions[:, 2].max())
ae.write("ni111.epos", hits)
"""


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
        holders = [ast.parse(path.read_text())]
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


def arguments(node):
    """Names of the arguments of a function in a stub, with the value that each has by default."""
    plain, named = node.args.args, node.args.kwonlyargs
    defaults = [None] * (len(plain) - len(node.args.defaults)) + node.args.defaults + node.args.kw_defaults
    return {
        arg.arg: inspect.Parameter.empty if default is None else ast.literal_eval(default)
        for arg, default in zip((*plain, *named), defaults, strict=True)
    }


def described(body):
    """What a stub describes: functions with their arguments, everything else with None."""
    found = {}
    for node in body:
        if isinstance(node, ast.FunctionDef):
            decorated = any(isinstance(mark, ast.Name) and mark.id == "property" for mark in node.decorator_list)
            if not any(isinstance(mark, ast.Attribute) for mark in node.decorator_list):  # a setter
                found[node.name] = None if decorated else arguments(node)
        elif isinstance(node, ast.ClassDef):
            found[node.name] = described(node.body)
        elif isinstance(node, ast.AnnAssign):
            found[node.target.id] = None
    return found


def held(holder):
    """What a compiled module or class holds, in the same form."""
    found = {}
    for name, value in vars(holder).items():
        if name in OF_CYTHON or inspect.ismodule(value) or (name.startswith("_") and name != "__init__"):
            continue
        if isinstance(value, type):
            if value.__module__ == holder.__name__:
                fields = getattr(value, "_fields", None)  # a named tuple
                found[name] = held(value) if fields is None else dict.fromkeys(fields)
        elif name == "__init__":
            found[name] = None  # its signature is not kept
        elif callable(value):
            parameters = inspect.signature(value).parameters
            found[name] = {parameter.name: parameter.default for parameter in parameters.values()}
        else:
            found[name] = None
    return found


@pytest.mark.parametrize("module", MODULES)
def test_stubs_describe_the_compiled_modules(module):
    stub = described(ast.parse((CORE / f"{module}.pyi").read_text()).body)
    compiled = held(importlib.import_module(f"apt_evap._core.{module}"))
    for members in (*stub.values(), *compiled.values()):
        if isinstance(members, dict) and "__init__" in members:
            members["__init__"] = None
    assert stub == compiled


@pytest.mark.parametrize("module", MODULES)
def test_stubs_have_the_arguments_of_the_source(module):
    """Of `__init__`, whose signature a compiled class does not keep: the names in the .pyx."""
    source = (CORE / f"{module}.pyx").read_text()
    for node in ast.parse((CORE / f"{module}.pyi").read_text()).body:
        if isinstance(node, ast.ClassDef) and f"cdef class {node.name}" in source:
            inits = [part for part in node.body if getattr(part, "name", "") == "__init__"]
            start = source.index(f"cdef class {node.name}")
            at = source.find("def __init__(", start, (source.find("\ncdef class ", start + 1) + 1) or len(source))
            assert (at >= 0) == bool(inits)
            if inits:
                written = source[at + len("def __init__(") : source.index("):\n", at)]
                names = [part.split("=")[0].split()[-1] for part in unbracketed(written).split(",") if part.strip()]
                assert [name for name in names if name != "*"] == list(arguments(inits[0]))


def unbracketed(text):
    """A text without what is in square brackets."""
    depth, kept = 0, ""
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        kept += letter if depth == 0 and letter != "]" else ""
    return kept
