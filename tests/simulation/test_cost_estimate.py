"""Estimates of the memory and hours of a run."""

import pytest

from apt_evap.simulation.config.cost_estimate import estimate_cost
from apt_evap.simulation.config.simulation_file import read_config

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


def test_responses_with_fewer_launches_take_less_time(tmp_path):
    rings = "rings = [[0.0, 1], [1.0, 6]]\n"
    designs = f"[responses.site]\ndegrees = [2, 0]\n{rings}number = 10\n"
    designs += f"[responses.rolled]\ndegrees = [2, 0]\n{rings}number = 20\nplace = true\n"
    usual, other = estimated(tmp_path), estimated(tmp_path, designs)
    # measured with 30 launches; the time before the first ion is small
    assert other.hours / usual.hours == pytest.approx(0.70, rel=0.12)
    assert usual.memory - other.memory == pytest.approx(24 * (102 - 7 - 16) * 10_000)


def test_every_ion_of_a_run_takes_three_kilobytes(tmp_path):
    """Measured: the peak with 14,000 ions less that with 2,000 is 3,050 bytes per ion; estimates are within 30 %."""
    many = estimated(tmp_path, "").memory
    (tmp_path / "few").mkdir()
    (tmp_path / "few" / "run.toml").write_text(BASE.replace("10_000", "2_000"))
    few = estimate_cost(read_config(tmp_path / "few" / "run.toml"), 1).memory
    assert (many - few) / 8_000 == pytest.approx(3_050, rel=0.3)
