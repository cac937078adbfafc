"""The examples in the docstrings run, and their output is as shown.

Examples do not repeat ``import apt_evap as ae`` and ``import numpy as np``. Each runs in an empty folder.
"""

import ast
import doctest
import importlib
import inspect
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae

SECTIONS = (  # in the order of numpydoc
    *("Parameters", "Returns", "Yields", "Attributes", "Methods", "Raises", "Warns", "Warnings"),
    *("See Also", "Notes", "References", "Examples"),
)
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


SPACES = [name for name in ae.__all__ if inspect.ismodule(getattr(ae, name))]
FRONT_ROW = [name for name in ae.__all__ if name not in (*SPACES, "__version__")]
IN_SPACES = [f"{space}.{name}" for space in SPACES for name in getattr(getattr(ae, space), "__all__", ())]
NAMES = [
    *FRONT_ROW,
    *(name for name in (*SPACES, *IN_SPACES) if ">>>" in (inspect.getdoc(attrgetter(name)(ae)) or "")),
]
PACKAGE = Path(ae.__file__).parent


def of_modules():
    """Module and name of each function or class with an example, but for the public ones."""
    public = {id(attrgetter(name)(ae)) for name in NAMES}
    for path in sorted(path for path in PACKAGE.rglob("*.py") if ">>>" in path.read_text()):
        module = ".".join(("apt_evap", *path.relative_to(PACKAGE).with_suffix("").parts))
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and ">>>" in (ast.get_docstring(node) or ""):
                if id(getattr(importlib.import_module(module), node.name)) not in public:
                    yield f"{module}:{node.name}"


def titles(docstring):
    lines = docstring.splitlines()
    return [
        title.strip() for title, line in pairwise(lines) if title.strip() and line.strip() == "-" * len(title.strip())
    ]


def run_examples(docstring_tests):
    """Text of the failures; empty if all examples show what they print."""
    failures = []
    runner = doctest.DocTestRunner(optionflags=OPTIONS, verbose=False)
    for test in docstring_tests:
        runner.run(test, out=failures.append)
    return "".join(failures)


@pytest.mark.docs
@pytest.mark.filterwarnings("error::UserWarning")  # of the package: an example causes none
@pytest.mark.parametrize("name", NAMES)
def test_examples_show_what_they_print(name, tmp_path, monkeypatch):
    """The examples of a name and of its methods."""
    monkeypatch.chdir(tmp_path)
    tests = doctest.DocTestFinder().find(attrgetter(name)(ae), name, globs={"ae": ae, "np": np})
    own = [test for test in tests if test.name == name]
    assert own and any(example.want for example in own[0].examples), f"{name} has no example with an output"
    assert run_examples(tests) == ""


@pytest.mark.parametrize("name", NAMES)
def test_examples_are_the_last_section(name):
    found = titles(inspect.getdoc(attrgetter(name)(ae)))
    assert found[-1] == "Examples"
    assert found == sorted(found, key=SECTIONS.index) and len(set(found)) == len(found)


@pytest.mark.docs
@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("place", [*of_modules()])
def test_examples_of_helpers_show_what_they_print(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module, name = place.split(":")
    helper = getattr(importlib.import_module(module), name)
    assert run_examples(doctest.DocTestFinder().find(helper, name, globs={"ae": ae, "np": np})) == ""


def test_a_wrong_example_is_found():
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    assert "3" in run_examples([wrong])
