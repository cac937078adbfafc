"""Type hints: mypy agrees with them, and the stubs of the compiled modules say what these hold."""

import ast
import importlib
import importlib.util
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CORE = ROOT / "apt_evap" / "_core"
MODULES = sorted(path.stem for path in CORE.glob("*.pyx"))
OF_CYTHON = {"__pyx_vtable__", "__reduce__", "__setstate__", "__reduce_cython__", "__setstate_cython__", "__new__"}


def test_mypy():
    """On the source tree; quick because mypy follows the annotated signatures only."""
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", "mypy", "--no-incremental", "--cache-dir", "/dev/null"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


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
                found[name] = held(value)
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
        if isinstance(node, ast.ClassDef):
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
