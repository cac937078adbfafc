"""Settings files of `apt-evap visible`: a specimen with a feature, an instrument and an analysis."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from apt_evap._common.codec import checked, count, from_plain, number, part, settings, to_plain
from apt_evap._common.files import FileError
from apt_evap._common.kept import check_made_from
from apt_evap._common.validation import check_array, check_choice, short_text
from apt_evap.detection.instrument import Instrument
from apt_evap.simulation.config.perturbation_text import read_perturbation
from apt_evap.simulation.config.simulation_file import config_of, read_document
from apt_evap.simulation.config.tables import check_keys, check_table
from apt_evap.specimen.phases import Phase
from apt_evap.specimen.tip import Tip
from apt_evap.studies.visibility.operators import REMEDY, OriginOperators, default_axes, grid_of, origin_operators
from apt_evap.studies.visibility.probability import (
    MOST_TWINS,
    Visibility,
    check_permutations,
    estimate_visibility,
    is_simulated_in_full,
)


def _analysis(value, name):
    file, _, function = value.rpartition(":") if isinstance(value, str) else ("", "", "")
    if not (file.endswith(".py") and function.isidentifier()):
        raise ValueError(f"{name} must be a function in a Python file, such as 'clusters.py:pairs', got {value!r}")
    return value


def _sizes(value, name):
    return tuple(check_array(value, name, ("n",)).tolist())


def _text(value, name):
    if not (isinstance(value, str) and value):
        raise ValueError(f"{name} must be a text, got {short_text(value)}")
    return value


@settings
class VisibilitySettings:
    """The table ``[visibility]``: what is looked for, with which instrument and analysis."""

    analysis: str = checked(
        'Your analysis, a function of positions and labels in a Python file, such as "clusters.py:pairs". The path is '
        "relative to the folder of the settings.",
        "str",
        _analysis,
    )
    feature: str | None = checked(
        "Name of the phase that is the feature; by default the last phase.", "str", _text, default=None
    )
    instrument: Instrument = part(
        "The instrument.", Instrument, default=lambda: Instrument(field_of_view=160.0, efficiency=0.5)
    )
    perturbation: Any = checked(
        'Initial conditions of the ions, such as "RollUp:0.2"; by default they start at rest.',
        "str or table",
        lambda value, name: read_perturbation(value) if isinstance(value, str | dict) else value,
        default=None,
    )
    sizes: tuple[float, ...] | None = checked(
        "Sizes of the feature that are simulated; by default half, all and twice its size.",
        "sequence of float",
        _sizes,
        default=None,
        unit="nm",
    )
    operators: str | None = checked(
        "File of the operators, relative to the folder of the settings: it is read if it exists, or else written.",
        "str",
        _text,
        default=None,
    )
    reach: float | None = number(
        "The analysis gets the ions within this distance from the feature; by default all ions.",
        default=None,
        above=0,
        unit="nm",
    )
    twins: int = count(
        "Twins of the feature, and of those with other sizes.", default=50, at_least=1, at_most=MOST_TWINS
    )
    permutations: int = count(
        "Permutations of the labels for each p-value, at least 1/significance - 1.", default=39, at_least=1
    )
    significance: float = number("Largest p-value of a feature that is found.", default=0.05, above=0, below=1)
    seed: int | None = count("Seed of all twins; by default that of the table ``[tip]``, or else 0.", default=None)

    def _check(self):
        check_permutations(self.permutations, self.significance)


_TABLES = (  # those that are used
    *("tip", "phases", "simulation", "detector", "charges", "flights", "responses", "law", "rule", "control"),
    "visibility",
)


def visibility_of_file(path: str | Path, *, n_threads: int | None = None) -> Visibility:
    """Answer of the settings file of `apt-evap visible`.

    The file contains tables of a simulation (see `read_config`) and ``[visibility]``, with the fields of
    `VisibilitySettings`. The number of ions follows from the feature, and every twin has another shift of the lattice
    and other random numbers: what would be ignored is refused. The Python file of the analysis is run.

    Parameters
    ----------
    path : str or path-like
        The file.
    n_threads : int, optional
        As for `Simulation`.

    Returns
    -------
    Visibility

    Raises
    ------
    FileError
        If the file cannot be read, or a table, key or value is wrong.
    """
    document = read_document(path)
    folder = Path(path).parent
    try:
        chosen = _settings(document)
        analysis = _function(folder, chosen.analysis)
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error
    document["simulation"] = {"ions": 1, **document.get("simulation", {})}
    config = config_of(document, Path(path))
    if "phases" not in config.tip:
        raise FileError(f"{str(path)!r}: [[phases]] is missing, with the matrix and the feature")
    phases: dict[str, Phase] = {phase.name: phase for phase in config.tip["phases"]}
    name = chosen.feature or list(phases)[-1]
    feature = phases.pop(check_choice(name, "feature", tuple(phases)))
    seed = config.tip.get("seed", 0) if chosen.seed is None else chosen.seed
    specimen = Tip(**{**config.tip, "phases": tuple(phases.values()), "seed": seed})
    simulation: dict[str, Any] = {
        "voltage": config.voltage,
        "law": config.law,
        "rule": config.rule,
        "charge_settings": config.charge_settings,
        "flight_settings": config.flight_settings,
        "response_settings": config.response_settings,
        "control": config.control,
        "detector": config.detector,
        "n_threads": n_threads,
    }
    operators = None
    if chosen.operators is not None:
        if is_simulated_in_full(feature):
            raise FileError(
                f"{str(path)!r}, [visibility]: operators must be those of a sphere or layer without an order: "
                f"the twins of {feature.name!r} are simulated in full"
            )
        operators = _operators(folder / chosen.operators, feature, specimen, chosen, seed + 1, simulation)
    return estimate_visibility(
        feature,
        specimen,
        chosen.instrument,
        analysis,
        operators=operators,
        perturbation=chosen.perturbation,
        sizes=chosen.sizes,
        reach=chosen.reach,
        twins=chosen.twins,
        permutations=chosen.permutations,
        significance=chosen.significance,
        seed=seed,
        **simulation,
    )


def _function(folder: Path, text: str) -> Callable[..., Any]:
    """The function of a Python file."""
    name, _, function = text.rpartition(":")
    file = folder / name
    if not file.is_file():
        raise FileError(f"analysis: {str(file)!r} does not exist")
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    try:
        return getattr(module, function)
    except AttributeError:
        raise ValueError(f"analysis: {str(file)!r} has no function {function!r}") from None


def _settings(document):
    """Settings of the table [visibility], which is removed; ValueError for keys that would be ignored."""
    check_keys(document, _TABLES)
    table = document.pop("visibility", {})
    check_table(table, "[visibility]")
    chosen = from_plain(table, VisibilitySettings, what="[visibility]")
    for name in ("simulation", "tip"):
        check_table(document.get(name, {}), f"[{name}]")
    ignored = [f"[simulation] {key}" for key in document.get("simulation", {}) if key != "voltage"]
    ignored += [f"[tip] {key}" for key in document.get("tip", {}) if key in ("offset_seed", "depth")]
    if chosen.seed is not None and "seed" in document.get("tip", {}):
        ignored.append("[tip] seed (beside that of [visibility])")
    if ignored:
        raise ValueError(f"{ignored[0]} must not be given, because it would be ignored")
    return chosen


def _operators(file, feature, specimen, chosen, seed, simulation):
    """Operators from a file that was made with these settings; without it they are made and saved."""
    axes = default_axes(feature) if chosen.sizes is None else {"size": chosen.sizes}
    if os.path.lexists(file):
        operators = OriginOperators.load(file)
        made_with = {"axes": operators.axes, "seed": operators.settings["seed"]}
        requested = {"axes": {**operators.axes, **grid_of(axes)}, "seed": seed}
        check_made_from(file, to_plain(made_with), requested, REMEDY)
        return operators
    operators = origin_operators(
        feature, specimen, chosen.instrument, chosen.perturbation, axes=axes, seed=seed, **simulation
    )
    operators.save(file)
    return operators
