"""Perturbations as text and as Python, and back."""

import pytest

import apt_evap as ae
from apt_evap._common.codec import to_python
from apt_evap.simulation.config.lens_text import read_lens
from apt_evap.simulation.config.perturbation_text import read_perturbation, title_of, write_perturbation

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
            ae.RollUp(ae.emission.Thermal(50)),
            '{name = "RollUp", energy = {name = "Thermal", temperature = 50.0}}',
            "ae.RollUp(ae.emission.Thermal(50.0))",
        ),
        (
            ae.RollUp(0.2, ae.emission.ChargeRatio(0.9, 0.05), height=0.05),
            '{name = "RollUp", energy = 0.2, '
            'probability = {name = "ChargeRatio", threshold = 0.9, width = 0.05}, height = 0.05}',
            "ae.RollUp(0.2, ae.emission.ChargeRatio(0.9, 0.05), height=0.05)",
        ),
    ],
)
def test_text_and_python_are_read_back(perturbation, text, python):
    assert write_perturbation(perturbation) == text
    assert read_perturbation(text) == perturbation
    assert to_python(perturbation) == python
    assert eval(python, {"ae": ae}) == perturbation


def test_a_class_of_ones_own_is_for_settings_files():
    with pytest.raises(ValueError, match="'mine:Along': a class of one's own is imported only for the file that"):
        read_perturbation('{name = "mine:Along", energy = 0.2}')
    with pytest.raises(ValueError, match="energy 'mine:Uniform': a class of one's own"):
        read_perturbation('{name = "RollUp", energy = {name = "mine:Uniform"}}')


@pytest.mark.parametrize(
    ("perturbation", "title"),
    [
        (ae.RollUp(NORMAL), "roll-up, 0.155 ± 0.1 eV"),
        (ae.RollUp(NORMAL, 0.5, 0.1, 0.05), "roll-up, 0.155 ± 0.1 eV, probability 0.5, sharpness 0.1, height 0.05 nm"),
        (ae.RollUp(0.2, 0.5, others=ae.emission.Thermal(50)), "roll-up, 0.2 eV, probability 0.5, others 50 K"),
        (
            ae.RollUp(0.2, ae.emission.ChargeRatio(0.9)),
            "roll-up, 0.2 eV, probability ChargeRatio(0.9)",
        ),
        (
            ae.RollUp(0.2, ae.emission.Migration(4.44, 35.0)),
            "roll-up, 0.2 eV, probability Migration(4.44, 35.0)",
        ),
        (ae.Unperturbed(0.1), "unperturbed, height 0.1 nm"),
        (ae.Combined(NORMAL, 0.75), "0.75 roll-up + 0.25 lateral, 0.155 ± 0.1 eV"),
    ],
)
def test_titles_name_the_options(perturbation, title):
    assert title_of(perturbation) == title


def test_a_perturbation_of_a_user_has_no_text():
    class Mine:
        pass

    with pytest.raises(ValueError, match="perturbation"):
        write_perturbation(Mine())


@pytest.mark.parametrize(
    "text",
    [
        "{a=" + "[" * 2_000,
        "{a" + ".a" * 1_500 + "=1}",
        '{name="RollUp", energy=' + "1" * 5_000 + "}",
        "RollUp:" + "1" * 5_000 + "x",
        "X" * 100_000,
        "X" * 100_000 + ":1,2,3",
        '{name="Mixture", perturbations=5}',
        '{name="Unperturbed"}\nx=1',
    ],
    ids=lambda text: text[:20],
)
def test_a_text_that_is_none_is_refused_in_a_short_sentence(text):
    with pytest.raises(ValueError, match="perturbation") as refused:
        read_perturbation(text)
    assert len(str(refused.value)) < 600


@pytest.mark.parametrize("text", ["a:b=" + "[" * 2_000, "local-electrode:" + "x" * 100_000, "x" * 100_000, 5])
def test_a_lens_that_is_none_is_refused_in_a_short_sentence(text):
    with pytest.raises(ValueError, match="lens") as refused:
        read_lens(text)
    assert len(str(refused.value)) < 600
