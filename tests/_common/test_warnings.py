import ast
import warnings
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae

PACKAGE = Path(ae.__file__).parent
WITHOUT_CLASS = ("simulation", "evaporation")  # rooms whose warnings do not have one yet


def warn_calls(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "warnings.warn":
            yield node


@pytest.mark.parametrize("room", sorted({path.parent.name for path in PACKAGE.glob("*/*.py")} - {*WITHOUT_CLASS}))
def test_every_warning_has_a_class_of_the_package(room):
    for path in (PACKAGE / room).glob("*.py"):
        for node in warn_calls(path):
            names = [ast.unparse(argument) for argument in node.args[1:]]
            assert names and issubclass(getattr(ae.warnings, names[0], int), ae.warnings.AptWarning), (
                f"{path}:{node.lineno}"
            )


def test_warnings_are_found():
    assert sum(1 for path in PACKAGE.rglob("*.py") for _ in warn_calls(path)) > 15


def test_no_module_filters_warnings_by_their_text():
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "warnings.filterwarnings":
                assert "message" not in [keyword.arg for keyword in node.keywords], f"{path}:{node.lineno}"


def test_a_class_of_warnings_can_be_ignored(tmp_path):
    hits = ae.Hits(x=np.array([1.0, np.nan]), y=np.array([1.0, 2.0]), pulse_id=np.arange(2))
    with pytest.warns(ae.warnings.DataWarning, match="1 of 2 ions left out of"):
        ae.write(tmp_path / "ions.epos", hits)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ae.warnings.AptWarning)
        ae.write(tmp_path / "ions.epos", hits)
