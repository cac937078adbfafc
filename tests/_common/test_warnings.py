import ast
import warnings
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae

PACKAGE = Path(ae.__file__).parent


@pytest.mark.slow
def test_every_warning_goes_through_one_function():
    for path in PACKAGE.rglob("*.py"):
        if path != PACKAGE / "warnings.py":
            calls = [ast.unparse(node.func) for node in ast.walk(ast.parse(path.read_text())) if hasattr(node, "func")]
            assert "warnings.warn" not in calls, path


@pytest.mark.slow
def test_a_warning_names_the_line_of_the_caller(tmp_path, small_tip):
    """Whatever is between: a method, a generator, a context manager, a dispatch by the format."""
    hits = ae.Hits(x=np.array([1.0, np.nan]), y=np.array([1.0, 2.0]), voltage=np.array([5.0, 6.0]))
    with pytest.warns(ae.warnings.AptWarning) as caught:
        ae.write(tmp_path / "ions.epos", hits)
        list(ae.io.chunks(tmp_path / "ions.epos", 10))
        ae.spectra.Ranges(("Si", "Ge"), np.array([1.0, 1.5]), np.array([2.0, 3.0]))
        ae.Simulation(small_tip, seed=1).run(10**6, progress=lambda ions, all_ions: None)
    kinds = {warning.category for warning in caught}
    assert kinds == {ae.warnings.DataWarning, ae.warnings.RunWarning} and len(caught) > 4
    assert {warning.filename for warning in caught} == {__file__}


def test_no_module_filters_warnings_by_their_text():
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text()
        for node in ast.walk(ast.parse(source)) if "filterwarnings" in source else ():
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
