"""Options of the commands: they are those of the functions and settings that they set."""

import argparse

import pytest

from apt_evap._common.codec import declared
from apt_evap.analysis.ion_image import GASES
from apt_evap.cli.parser import make_parser
from apt_evap.detection.binning import MAX_BINS
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import MEANS, MECHANISMS, ROLLUP_FRACTIONS, RSDS, EnergyGrid
from apt_evap.reconstruction.reconstruct import FRAMES
from apt_evap.reconstruction.reconstruction_settings import PROJECTIONS, PROTOCOLS


@pytest.fixture(scope="module")
def options():
    """The options of each command by the names of their values."""
    (commands,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    return {name: {action.dest: action for action in parser._actions} for name, parser in commands.choices.items()}


def test_choices_and_bounds_are_those_of_the_functions(options):
    assert set(options["map"]["field_ion"].choices) == set(GASES)
    for name, known in (("frame", FRAMES), ("projection", PROJECTIONS), ("protocol", PROTOCOLS)):
        assert options["reconstruct"][name].choices == known
    for command in ("compare", "map", "explore"):
        bins = options[command]["bins"].type
        assert bins(str(MAX_BINS)) == MAX_BINS
        with pytest.raises(argparse.ArgumentTypeError):
            bins(str(MAX_BINS + 1))


def test_a_study_can_be_set_by_options(options):
    """Every setting of a fit has an option, but the range of densities and the model error."""
    study = options["compare"]
    assert set(declared(EnergyGrid)) <= set(study)
    assert set(declared(FitSettings)) - set(study) == {"data_range", "model_error"}
    assert study["mechanism"].choices == MECHANISMS
    for name, values in (("means", MEANS), ("relative_spreads", RSDS), ("rollup_fractions", ROLLUP_FRACTIONS)):
        default = study[name].help.rpartition(" ")[2]
        assert study[name].type(default) == values
    for objective in study["objective"].choices:
        assert FitSettings(objective=objective).objective == objective
    assert str(FitSettings().resamples) in study["resamples"].help
    assert f"{FitSettings().temperature:g}" in study["temperature"].help
    assert str(FitSettings().seed) in study["seed"].help


def test_options_have_hyphens_and_no_underscores(options):
    for command, actions in options.items():
        for action in actions.values():
            assert not [text for text in action.option_strings if "_" in text], command
