"""The data set "find the precipitate", articles/find_the_precipitate: a small one, and the counts of its baseline."""

import json
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae

ARTICLE = Path(__file__).parents[2] / "articles" / "find_the_precipitate"


@pytest.fixture(scope="session")
def baseline():
    return runpy.run_path(str(ARTICLE / "baseline.py"))


@pytest.fixture
def specimen(baseline):
    """A cube of 20 x 20 x 20 ions, 0.3 nm apart, with a ball of Cu of 1 nm and a smaller one in a pure matrix."""
    sites = 0.3 * np.stack(np.meshgrid(*[np.arange(20.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.full(len(sites), -1)
    number[np.linalg.norm(sites - 1.5, axis=1) <= 1.0] = 0
    number[np.linalg.norm(sites - 4.5, axis=1) <= 0.5] = 1
    specimen = object.__new__(baseline["Specimen"])
    specimen.__dict__ = SimpleNamespace(
        measured=sites, sites=sites, number=number, truth=number >= 0, copper=number >= 0, spacing=0.6
    ).__dict__ | {"size": np.select([number == 0, number == 1], [1.0, 0.5], 0.0)}
    return specimen


def test_both_methods_find_balls_of_copper_and_no_single_ion(baseline, specimen):
    alone = np.flatnonzero(np.linalg.norm(specimen.sites - [4.5, 1.5, 3.0], axis=1) < 0.1)
    specimen.copper = specimen.copper.copy()
    specimen.copper[alone] = True
    # the six neighbours are 0.3 nm apart, the next ones 0.42 nm; d = 0.36 nm
    ((_, marked),) = baseline["separation"](specimen.sites, specimen, {"d": [0.6], "n": [1], "e": [0.1]})
    np.testing.assert_array_equal(marked, specimen.truth)
    ((_, marked),) = baseline["composition"](specimen.sites, specimen, {"k": [7], "c": [0.2]})
    assert len(alone) == 1 and not marked[alone] and marked[specimen.truth].all()
    row = baseline["counts"](specimen, marked, "sites")
    assert row["far"] == 0 and row["right"] == row["true"] < row["marked"]


def test_counts_of_what_is_marked_by_hand(baseline, specimen):
    perfect = baseline["counts"](specimen, specimen.truth, "sites")
    assert perfect["right"] == perfect["marked"] == perfect["true"] == np.sum(specimen.truth)
    assert baseline["score"](perfect) == pytest.approx(2 / 3)  # no ball of 2 nm
    everything = np.ones(len(specimen.truth), bool)
    row = baseline["counts"](specimen, everything, "sites")
    near = [row[f"marked {size}"] - row[f"true {size}"] for size in ("0.5", "1")]
    assert min(near) > 0 and sum(near) + row["far"] == row["matrix"] == np.sum(~specimen.truth)
    assert baseline["score"](row) < baseline["score"](perfect)
    half = specimen.truth & (specimen.number == 0)
    found = baseline["precipitates"](specimen, half)
    assert (found["precipitates 1"], found["found 1"], found["precipitates 0.5"], found["found 0.5"]) == (1, 1, 1, 0)


def test_errors_are_those_of_the_tips(baseline):
    """Equal tips have no scatter, however many examples they have; of two different ones the ratio scatters by 0.35."""
    rows = [{"right": 5, "true": 10}] * 6
    assert baseline["ratio"](rows, list("aabbcc"), "right", "true") == (0.5, 0.0)
    mean, error = baseline["ratio"]([{"right": 0, "true": 10}, {"right": 10, "true": 10}], ["a", "b"], "right", "true")
    # two draws of 0 or 1: sqrt(1 / 8); four standard errors of 300 draws
    assert mean == 0.5 and error == pytest.approx(8**-0.5, abs=4 * 8**-0.5 / np.sqrt(2 * 300))


@pytest.mark.slow
def test_a_small_set_and_its_score(tmp_path, monkeypatch):
    changes = {
        "base.toml": {"ions = 10_000": "ions = 1_500"},
        "study.toml": {
            "sample = 24": "sample = 3",
            '["12 a", "16 a"]': '["8 a", "9 a"]',
            "[3.5, 6.0]": "[1.5, 3.0]",
            "[-3.0, 3.0]": "[-1.5, 1.5]",
            "[0.05, 0.25]": "[0.05, 0.15]",
        },
    }
    for name, texts in changes.items():
        content = (ARTICLE / name).read_text()
        for old, new in texts.items():
            assert old in content, old
            content = content.replace(old, new)
        (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    ae.studies.make_dataset(ae.studies.plan_dataset("study.toml"), "set")
    monkeypatch.setattr(sys, "argv", ["baseline.py", "set", "-o", "out"])
    runpy.run_path(str(ARTICLE / "baseline.py"), run_name="__main__")
    table = json.loads(Path("out/table.json").read_text())
    assert len(table) == 2 and Path("out/find_the_precipitate.png").stat().st_size > 10_000
    test = ae.load_dataset("set").split("test")
    by_chance = np.concatenate([example.ions["phase"] for example in test]).mean()
    for method in table.values():
        for place in ("measured", "sites"):
            (precision, _), (recall, _) = method["scores"]["all"][place]["all"].values()
            assert by_chance < precision <= 1 and 0 < recall <= 1
