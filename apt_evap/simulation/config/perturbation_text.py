"""Perturbations from a table or from text such as RollUp:0.155,0.155."""

from collections.abc import Mapping
from typing import Any

from apt_evap._common.codec import declared, is_settings, to_plain, to_python
from apt_evap._common.validation import short_text
from apt_evap.emission.energies import Thermal, TruncatedNormal
from apt_evap.emission.perturbations import Perturbation, perturbation_of
from apt_evap.simulation.config.own_classes import with_own_objects
from apt_evap.simulation.config.toml_text import inline, read_toml


def read_perturbation(settings: str | Mapping[str, Any]) -> Perturbation:
    """Make a perturbation from a table with name and parameters, or from text.

    Parameters
    ----------
    settings : str or mapping
        ``{"name": "RollUp", "energy": {"name": "TruncatedNormal", "mean": 0.3, "standard_deviation": 0.1}}``, a number
        as energy is the same for every ion [eV]. As text: the name alone, ``"RollUp:0.2"`` for equal energies,
        ``"RollUp:0.3,0.1"`` for mean and standard deviation [eV], ``"Combined:0.3,0.1,0.75"`` with the rollup_fraction
        at the end, or the table in TOML syntax.
    """
    if isinstance(settings, str):
        try:
            return read_perturbation(_perturbation_table(settings))
        except ValueError as error:
            example = "an example is RollUp:0.155,0.155"
            raise ValueError(f"perturbation {short_text(settings)}: {error}; {example}") from error
    return perturbation_of(settings)


def _perturbation_table(text):
    """Table of a perturbation from text."""
    if text.lstrip().startswith("{"):
        table, *further = read_toml(f"perturbation = {text}").values()
        if further:
            raise ValueError("expected one table in one line")
        return with_own_objects({"perturbation": table}, None)["perturbation"]  # none here, says its error
    name, colon, numbers = text.partition(":")
    if not colon:
        return {"name": name}
    try:
        values = [float(number) for number in numbers.split(",")]
    except ValueError:
        expected = "expected numbers separated by commas after the colon"
        raise ValueError(f"{expected}, got {short_text(numbers)}") from None
    fraction = {"rollup_fraction": values.pop()} if name == "Combined" else {}
    if len(values) not in (1, 2):
        expected = "1 or 2 numbers (an energy, or mean and standard deviation)"
        expected += " and the roll-up fraction" if fraction else ""
        raise ValueError(f"{short_text(name)} takes {expected}, got {short_text(numbers)}")
    normal = dict(zip(("name", "mean", "standard_deviation"), ("TruncatedNormal", *values), strict=False))
    return {"name": name, "energy": values[0] if len(values) == 1 else normal, **fraction}


def write_perturbation(perturbation: Perturbation) -> str:
    """Text of a built-in perturbation that `read_perturbation` reads.

    Returns
    -------
    str
        The short form, such as ``"RollUp:0.155,0.155"``, or a table in TOML syntax.
    """
    settings = to_plain(perturbation, short=True)
    numbers = list(_numbers_of(settings))
    short = ":".join([settings["name"], ",".join(map(repr, numbers))] if numbers else [settings["name"]])
    for text in (short, inline(settings)):
        try:
            if read_perturbation(text) == perturbation:
                return text
        except ValueError:
            continue
    raise ValueError(f"perturbation must be a built-in one such as RollUp(0.2), got {short_text(perturbation)}")


def _numbers_of(settings):
    """Numbers of a table in the order of its keys, those of inner tables included."""
    for value in settings.values():
        if isinstance(value, Mapping):
            yield from _numbers_of(value)
        elif isinstance(value, float):
            yield value


def title_of(perturbation: Any) -> str:
    """Title of a map for a perturbation (str), such as "roll-up, 0.155 ± 0.155 eV, probability 0.5"."""
    name = type(perturbation).__name__
    if name == "Mixture":
        weights = perturbation.weights or (1.0,) * len(perturbation.perturbations)
        parts = [
            f"{weight / sum(weights):.2g} {title_of(one)}"
            for one, weight in zip(perturbation.perturbations, weights, strict=True)
        ]
        return "; ".join(parts)
    words = {"Unperturbed": "unperturbed", "LateralVelocity": "lateral velocity", "RollUp": "roll-up"}
    title = words.get(name, name)
    if name == "Combined":
        title = f"{perturbation.rollup_fraction:.3g} roll-up + {1 - perturbation.rollup_fraction:.3g} lateral"
    parts = [title, _energy_text(getattr(perturbation, "energy", None))]
    fields = declared(type(perturbation))
    for option in to_plain(perturbation, short=True):  # those that are not the default
        if option in fields and option not in ("energy", "rollup_fraction"):
            value, unit = getattr(perturbation, option), fields[option].unit
            number = isinstance(value, float) and option != "others"
            text = f"{value:g}" if number else _energy_text(value) or _short(value)
            parts.append(" ".join(filter(None, (option.replace("_", " "), text, unit))))
    return ", ".join(filter(None, parts))


def _short(value):
    return to_python(value, "") if is_settings(value) else str(value)


def _energy_text(energy):
    """Text of an energy or of a built-in distribution, empty for any other."""
    if isinstance(energy, float):
        return f"{energy:g} eV"
    if isinstance(energy, Thermal):
        return f"{energy.temperature:g} K"
    if isinstance(energy, TruncatedNormal):
        return f"{energy.mean:g} ± {energy.standard_deviation:g} eV"
    return ""
