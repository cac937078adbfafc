"""Perturbations as text and as Python, and back."""

import pytest

import apt_evap as ae
from apt_evap.config.perturbation_text import python_of, read_perturbation, write_perturbation

NORMAL = ae.TruncatedNormal(0.155, 0.1)


@pytest.mark.parametrize(
    ("perturbation", "text", "python"),
    [
        (ae.Unperturbed(), "Unperturbed", "ae.Unperturbed()"),
        (ae.RollUp(0.2), "RollUp:0.2", "ae.RollUp(0.2)"),
        (ae.LateralVelocity(NORMAL), "LateralVelocity:0.155,0.1", "ae.LateralVelocity(ae.TruncatedNormal(0.155, 0.1))"),
        (ae.Combined(NORMAL, 0.75), "Combined:0.155,0.1,0.75", "ae.Combined(ae.TruncatedNormal(0.155, 0.1), 0.75)"),
        (ae.Combined(1 / 3, 0.1), "Combined:0.3333333333333333,0.1", "ae.Combined(0.3333333333333333, 0.1)"),
        (
            ae.RollUp(ae.Thermal(50)),
            '{name = "RollUp", energy = {name = "Thermal", temperature = 50.0}}',
            "ae.RollUp(ae.Thermal(50.0))",
        ),
    ],
)
def test_text_and_python_are_read_back(perturbation, text, python):
    assert write_perturbation(perturbation) == text
    assert read_perturbation(text) == perturbation
    assert python_of(perturbation) == python
    assert eval(python, {"ae": ae}) == perturbation


def test_a_perturbation_of_a_user_has_no_text():
    class Mine:
        pass

    with pytest.raises(ValueError, match="perturbation must be a built-in one"):
        write_perturbation(Mine())
