"""Estimates of the memory and hours of a run."""

import pytest

from apt_evap.config.cost_estimate import estimate_cost
from apt_evap.config.simulation_file import read_config

BASE = """
[tip]
material = "Ni"
apex_radius = 7.04
axis = [1, 1, 1]
[simulation]
ions = 10_000
"""


def estimated(tmp_path, text=""):
    (tmp_path / "run.toml").write_text(BASE + text)
    return estimate_cost(read_config(tmp_path / "run.toml"), 1)


@pytest.mark.parametrize(
    ("table", "ratio", "coefficients"),
    [("wide = true", 2.10, 60), ("wide = true\nshells = 2", 2.86, 108)],
)
def test_responses_with_more_launches_take_longer(tmp_path, table, ratio, coefficients):
    usual, other = estimated(tmp_path), estimated(tmp_path, f"[responses]\n{table}\n")
    # measured ratios; the time before the first ion is small
    assert other.hours / usual.hours == pytest.approx(ratio, rel=0.12)
    assert other.memory - usual.memory == pytest.approx(12 * coefficients * 10_000)
