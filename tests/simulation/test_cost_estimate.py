"""Estimates of the memory and hours of a run."""

import pytest

from apt_evap.simulation.config.cost_estimate import estimate_cost, hours_text
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


FEW = """[responses.site]
degrees = [2, 0]
rings = [[0.0, 1], [1.0, 6]]
number = 10
[responses.rolled]
degrees = [2, 0]
rings = [[0.0, 1], [1.0, 6]]
number = 20
place = true
"""
ROLLED = '[maps]\npanels = [{ perturbation = "Unperturbed" }, { perturbation = "RollUp:0.2" }]\n'
CONSTANT = '[rule]\nname = "ConstantPotential"\n'


@pytest.mark.parametrize(
    ("material", "radius", "more", "ions", "start", "per_ion"),
    [
        ("Ni", 12, "", 1000, 0.10, 0.804),
        ("Ni", 80, "", 600, 35.3, 1.137),
        ("W", 40, CONSTANT, 800, 2.04, 0.952),
        ("Al", 50, "", 700, 5.40, 1.064),
        ("Mg", 20, "", 1000, 0.16, 0.753),
        ("W", 40, FEW, 800, 1.59, 0.683),
        ("Fe", 12, FEW, 1000, 0.06, 0.461),
        ("W", 30, "responses = false\n", 1000, 0.66, 0.346),
        ("Al", 40, "responses = false\n" + ROLLED, 800, 2.74, 0.492),
    ],
)
def test_the_time_of_a_run_is_the_measured_one(tmp_path, material, radius, more, ions, start, per_ion):
    """Processor seconds to the first ion and milliseconds per ion of runs that no constant of the estimate is from."""
    tip = f'material = "{material}"\napex_radius = "{radius} a"\nshank_length = "{radius} a"\n'
    times = []
    for number in (ions, 2 * ions):
        (tmp_path / "run.toml").write_text(f"[tip]\n{tip}[simulation]\nions = {number}\n{more}")
        times.append(3600 * estimate_cost(read_config(tmp_path / "run.toml"), 1).hours)
    # the largest deviations of 24 such runs, in the comment at the constants; the program itself needs 3 s
    assert 0.69 < (times[1] - times[0]) / (1e-3 * per_ion * ions) < 1.37
    assert 0.7 < (2 * times[0] - times[1] - 3.0) / start < 1.65


def test_a_time_has_the_unit_that_fits():
    assert [hours_text(hours) for hours in (2.0, 0.5, 17 / 3600)] == ["2 h", "30 min", "17 s"]


def test_every_ion_of_a_run_takes_three_kilobytes(tmp_path):
    """Measured: the peak with 14,000 ions less that with 2,000 is 3,050 bytes per ion; estimates are within 30 %."""
    many = estimated(tmp_path, "").memory
    (tmp_path / "few").mkdir()
    (tmp_path / "few" / "run.toml").write_text(BASE.replace("10_000", "2_000"))
    few = estimate_cost(read_config(tmp_path / "few" / "run.toml"), 1).memory
    assert (many - few) / 8_000 == pytest.approx(3_050, rel=0.3)
