"""The table ``[dataset]`` of a study file."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from apt_evap._common.codec import checked, choice, count, from_plain, settings, vector
from apt_evap._common.validation import check_choice, check_kind, did_you_mean, short_text
from apt_evap.detection.instrument import INSTRUMENT_PRESETS, Instrument
from apt_evap.simulation.config.perturbation_text import read_perturbation
from apt_evap.studies.dataset.fields import CHOICES
from apt_evap.studies.sweep.sampling import drawn, has_options

SPLITS = ("train", "validation", "test")
"""Names of the parts of a data set."""

MOST_EXAMPLES = 10_000_000
"""Largest number of examples of a data set: a larger one is a typing error."""

_PLACES = 64  # entries of the longest choice of which each is checked


def read_instrument(table: str | Mapping[str, Any]) -> Instrument:
    """Instrument from the name of a preset, or from a table of its fields, which change a ``preset`` in it."""
    if isinstance(table, str):
        table = {"preset": table}
    table = dict(check_kind(table, "instrument", Mapping, "a table or the name of a preset"))
    preset = (
        INSTRUMENT_PRESETS[check_choice(table.pop("preset"), "preset", INSTRUMENT_PRESETS)] if "preset" in table else {}
    )
    return from_plain({**preset, **table}, Instrument, what="instrument")


def _text(value, name):
    if not isinstance(value, str):
        raise ValueError(f"{name} must be a text, got {short_text(value)}")
    return value


def _instrument(value, name):
    _check_drawn(value, name, read_instrument)
    return value


class _Place:
    """In the place of random numbers: always the same one."""

    def __init__(self, place: float) -> None:
        self.random = lambda n: np.full(n, place)


def _check_drawn(value, name, read):
    """Read values of all parts of the ranges, and each of a choice: a wrong one must not end the making of a set."""
    try:
        for place in [*np.arange(_PLACES) / _PLACES, 1 - 1e-9] if has_options(value) else [0.0]:
            read(drawn(value, _Place(place), name))
    except RecursionError as error:
        raise ValueError(f"{name} must not have hundreds of tables in each other, got {short_text(value)}") from error


def _emissions(value, name):
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(f'{name} must be a list such as ["RollUp:0.2"], got {short_text(value)}')
    for emission in value:
        if not isinstance(emission, str | Mapping):
            raise ValueError(f"{name} must contain texts and tables, got {short_text(emission)}")
        _check_drawn(emission, name, read_perturbation)
    return tuple(value)


def _fields(value, name):
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(f'{name} must be a list such as ["x", "y"], got {short_text(value)}')
    for field in value:
        if field not in CHOICES:
            raise ValueError(
                f"{name} has no {short_text(field)}{did_you_mean(field, CHOICES)}; known are {', '.join(CHOICES)}"
            )
    return tuple(field for field in CHOICES if field in value)


def _fractions(value, name):
    if abs(sum(value) - 1.0) > 1e-6:
        raise ValueError(f"{name} must have the sum 1, got {value}")
    return value


@settings
class DatasetSettings:
    """The table ``[dataset]`` of a study file: what the examples of a data set contain.

    Numbers of the instrument and of the emissions can be ranges or choices, as in ``[sweep]``. They are drawn for each
    example.

    Examples
    --------
    >>> settings = ae.studies.DatasetSettings(emissions=["Unperturbed", "RollUp:0.2"], fields=["x", "y", "poles"])
    >>> settings.per_run  # examples from each run
    2
    """

    title: str = checked("Title of the data set.", "str", _text, default="")
    description: str = checked("What it is for, for the data sheet.", "str", _text, default="")
    licence: str = checked('Licence, such as "CC-BY-4.0".', "str", _text, default="not stated")
    instrument: Any = checked(
        "The instrument: a table of the fields of `Instrument`, perhaps with the name of a ``preset``.",
        "table or str",
        _instrument,
        default=dict,
    )
    emissions: tuple[Any, ...] = checked(
        'Perturbations, each a text such as "RollUp:0.2" or a table. Every run gives an example for each of them.',
        "sequence of str or table",
        _emissions,
        default=lambda: ("Unperturbed",),
    )
    draws: int = count(
        "Examples of each emission that has a range or choice.", default=1, at_least=1, at_most=MOST_EXAMPLES
    )
    fields: tuple[str, ...] = checked(
        "Columns of the ions, and further tables; by default all.", "sequence of str", _fields, default=lambda: CHOICES
    )
    families: int = count("Families of poles, see `maps.poles`.", default=6, at_least=1, at_most=50)
    format: str = choice("Format of the files.", ("hdf5", "parquet"), default="hdf5")
    runs_per_file: int = count("Runs whose examples share a file.", default=16, at_least=1)
    split: tuple[float, float, float] = vector(
        "Fractions of the specimens for training, validation and test.",
        3,
        default=(0.8, 0.1, 0.1),
        at_least=0,
        at_most=1,
        check=_fractions,
    )

    @property
    def plan(self) -> list[Any]:
        """Emission of each example of a run, with its ranges, list."""
        return [emission for emission in self.emissions for _ in range(self.draws if has_options(emission) else 1)]

    @property
    def per_run(self) -> int:
        """Number of examples of a run."""
        return sum(self.draws if has_options(emission) else 1 for emission in self.emissions)
