"""Options of the commands: they are those of the functions and settings that they set."""

import argparse
from dataclasses import MISSING, fields

import pytest

from apt_evap._common.codec import declared
from apt_evap.cli._declared_options import declarations
from apt_evap.cli.parser import make_parser
from apt_evap.detection.binning import MAX_BINS
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import MEANS, MECHANISMS, ROLLUP_FRACTIONS, RSDS, EnergyGrid
from apt_evap.reconstruction.reconstructed import FRAMES
from apt_evap.reconstruction.reconstruction_settings import PROJECTIONS, PROTOCOLS, ReconstructionSettings
from apt_evap.simulation.ion_image import GASES


@pytest.fixture(scope="session")
def options():
    """The options of each command by the names of their values."""
    (commands,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    return {name: {action.dest: action for action in parser._actions} for name, parser in commands.choices.items()}


def test_choices_and_bounds_are_those_of_the_functions(options):
    assert set(options["map"]["field_ion"].choices) == set(GASES)
    assert options["reconstruct"]["frame"].choices == FRAMES
    for command in ("compare", "map", "explore"):
        bins = options[command]["bins"].type
        assert bins(str(MAX_BINS)) == MAX_BINS
        with pytest.raises(argparse.ArgumentTypeError):
            bins(str(MAX_BINS + 1))


@pytest.mark.parametrize("kind", [EnergyGrid, FitSettings, ReconstructionSettings], ids=lambda kind: kind.__name__)
def test_declarations_read_off_the_source_are_those_of_the_class(kind):
    """Text, unit, bounds, type and default of every field."""
    read = declarations(kind.__module__.removeprefix("apt_evap."), kind.__name__)
    declared_fields = declared(kind)
    assert list(read) == list(declared_fields)
    for field in fields(kind):
        seen, setting = read[field.name], declared_fields[field.name]
        assert (seen.text, seen.options.get("unit", "")) == (setting.text, setting.unit)
        assert seen.kind in ("", setting.kind)
        assert all(f'"{word}"' in setting.kind for word in seen.words)
        bounds = [seen.options[name] for name in ("above", "at_least", "at_most", "below") if name in seen.options]
        assert all(f"{bound:g}" in setting.bounds for bound in bounds)
        if seen.by == "number" or seen.options.get("default") is not None:
            default = field.default if field.default_factory is MISSING else field.default_factory()
            assert seen.options.get("default", MISSING) == default
        if setting.kind.startswith("{"):
            assert seen.words


def test_a_study_can_be_set_by_options(options):
    """Every setting of a fit has an option, but the range of densities and the model error."""
    study = options["compare"]
    assert set(declared(EnergyGrid)) <= set(study)
    assert set(declared(FitSettings)) - set(study) == {"data_range", "model_error"}
    assert study["mechanism"].choices == MECHANISMS
    assert study["objective"].choices == ("similarity", "folded")
    assert options["reconstruct"]["protocol"].choices == PROTOCOLS
    assert options["reconstruct"]["projection"].choices == PROJECTIONS
    for name, values in (("means", MEANS), ("relative_spreads", RSDS), ("rollup_fractions", ROLLUP_FRACTIONS)):
        shown = ",".join(f"{value:g}" for value in values)
        assert study[name].type(shown) == values
        assert all(f"{value:g}" in study[name].help for value in values)
    assert study["seed"].help == "seed of the resamples; default: 0"
    assert study["resamples"].type("0") == 0
    with pytest.raises(argparse.ArgumentTypeError, match="must be an integer from 11 to 16384, got '10'"):
        study["bins"].type("10")


def test_every_help_is_formatted(options):
    """A percent sign of a declaration is one of the help."""
    (commands,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    assert "within 5 %" in " ".join(commands.choices["compare"].format_help().split())


def test_options_have_hyphens_and_no_underscores(options):
    for command, actions in options.items():
        for action in actions.values():
            assert not [text for text in action.option_strings if "_" in text], command
