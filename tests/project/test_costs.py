"""Times that are promised in words are those of docs/costs.csv, which ``python -m benchmarks`` measures."""

import csv
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WORDS = {
    "some seconds": 5, "ten seconds": 10, "fifteen seconds": 15, "twenty seconds": 20, "half a minute": 30,
    "forty seconds": 40, "three quarters of a minute": 45, "a minute": 60,
}  # fmt: skip
SLACK = 1.4  # the words are steps of up to a factor of 2, and processors differ
with (ROOT / "docs" / "costs.csv").open(newline="") as file:
    COSTS = {row["command"]: float(row["processor_seconds"]) for row in csv.DictReader(file)}


def promised(text):
    """Seconds that a text promises."""
    found = re.search("|".join(sorted(WORDS, key=len, reverse=True)), text.lower())
    assert found is not None, text
    return WORDS[found[0]]


@pytest.mark.parametrize("name", [name for name in COSTS if name.startswith("run ")])
def test_an_example_takes_as_long_as_its_first_line_says(name):
    first = (ROOT / "examples" / f"{name.removeprefix('run ')}.toml").read_text().partition("\n")[0]
    assert COSTS[name] / SLACK < promised(first) < COSTS[name] * SLACK


@pytest.mark.parametrize(
    ("name", "page", "before"),
    [
        ("run ni111", "README.md", "of a nickel tip in "),
        ("visible visible, first call", "examples/visible.toml", "be found? "),
        ("dataset dataset", "examples/dataset.toml", "nickel tips, "),
        ("sweep work sweep", "examples/sweep.toml", "nickel tips, "),
    ],
)
def test_a_page_promises_what_was_measured(name, page, before):
    text = " ".join((ROOT / page).read_text().split())
    assert COSTS[name] / SLACK < promised(text.partition(before)[2][:60]) < COSTS[name] * SLACK
