"""Tables [law], [rule], [control] and [real_units] of a TOML file."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from apt_evap._common.validation import check_choice, check_count, check_number, did_you_mean, short_text
from apt_evap.config.tables import check_keys, check_table
from apt_evap.detection.timing import Timing
from apt_evap.emission.post_ionisation import PostIonisation
from apt_evap.evaporation.bonds import TUNGSTEN_TABLE, CoordinationTable, PairEnergies
from apt_evap.evaporation.law import Extremal
from apt_evap.evaporation.rule import ConstantPotential, Robin
from apt_evap.evaporation.thermal import Arrhenius, Laser
from apt_evap.evaporation.voltage import VoltageControl
from apt_evap.simulation.real_units import REFERENCES

_LAWS = {"Extremal": Extremal, "Arrhenius": Arrhenius}
_RULES = {"Robin": Robin, "ConstantPotential": ConstantPotential}
_BONDS = {"CoordinationTable": CoordinationTable, "PairEnergies": PairEnergies}
_REAL_UNITS = ("field_reference", "operating_field", "flight_charges", "timing", "smoothing", "field_factor", "seed")


def _names(kind):
    return tuple(item.name for item in fields(kind))


def _parts(table, what, known):
    """Name and other entries of a table that names a class."""
    check_table(table, what)
    name = table.get("name")
    if not isinstance(name, str) or name not in known:
        raise ValueError(
            f"{what} must have a name of {', '.join(known)}, got {short_text(name)}{did_you_mean(name, known)}"
        )
    return name, {key: value for key, value in table.items() if key != "name"}


def read_law(table: Mapping[str, Any]) -> Extremal | Arrhenius:
    """Read an evaporation law from a table such as ``[law]``.

    Parameters
    ----------
    table : mapping
        ``name`` ("Extremal" or "Arrhenius") and the parameters of the class. ``laser`` is a table with the parameters
        of `Laser`; ``bonds`` is "TUNGSTEN_TABLE" or a table with a name ("PairEnergies" or "CoordinationTable") and its
        parameters. An empty table is the extremal law.

    Returns
    -------
    law

    Raises
    ------
    ValueError
        Names the key, its value and the expected value.
    """
    if not table:
        return Extremal()
    name, settings = _parts(table, "law", _LAWS)
    check_keys(settings, _names(_LAWS[name]), ("temperature",) if name == "Arrhenius" else ())
    if "laser" in settings:
        check_table(settings["laser"], "laser")
        check_keys(settings["laser"], _names(Laser), ("temperature_rise",))
        settings["laser"] = Laser(**settings["laser"])
    if "bonds" in settings:
        settings["bonds"] = _bonds(settings["bonds"])
    return _LAWS[name](**settings)


def _bonds(entry):
    if entry == "TUNGSTEN_TABLE":
        return TUNGSTEN_TABLE
    name, settings = _parts(entry, "bonds", _BONDS)
    check_keys(settings, _names(_BONDS[name]))
    if name == "CoordinationTable" and isinstance(settings.get("table"), Mapping):  # keys of TOML are text
        settings["table"] = {
            element: {_integer(n, element): value for n, value in by_bonds.items()}
            if isinstance(by_bonds, Mapping)
            else by_bonds
            for element, by_bonds in settings["table"].items()
        }
    return _BONDS[name](**settings)


def _integer(text, element):
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"keys in the table of {element} must be numbers of bonds, got {short_text(text)}") from None


def read_rule(table: Mapping[str, Any]) -> Robin | ConstantPotential:
    """Read a charging rule from a table ``[rule]``.

    Parameters
    ----------
    table : mapping
        ``name`` ("Robin" or "ConstantPotential") and the parameters of the class. An empty table is Robin's rule.

    Returns
    -------
    rule

    Raises
    ------
    ValueError
        Names the key, its value and the expected value.
    """
    if not table:
        return Robin()
    name, settings = _parts(table, "rule", _RULES)
    check_keys(settings, _names(_RULES[name]))
    return _RULES[name](**settings)


def read_control(table: Mapping[str, Any]) -> VoltageControl | None:
    """Read the control of the voltage from a table ``[control]``; None for no table."""
    check_keys(table, _names(VoltageControl))
    return VoltageControl(**table) if table else None


def read_real_units(table: Mapping[str, Any]) -> dict[str, Any]:
    """Read the arguments of `Run.at_evaporation_field` from a table ``[real_units]``.

    Parameters
    ----------
    table : mapping
        The arguments but control. ``flight_charges`` is a number, a table by element, or a table with the name
        "PostIonisation" and its field_scale; ``timing`` is a table with the parameters of `Timing`.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        Names the key, its value and the expected value.
    """
    check_keys(table, _REAL_UNITS)
    arguments = dict(table)
    if "field_reference" in arguments:
        check_choice(arguments["field_reference"], "field_reference", REFERENCES)
    for name, limit in (("operating_field", 1000.0), ("field_factor", 100.0)):
        if name in arguments:
            check_number(arguments[name], name, above=0, at_most=limit)
    if "smoothing" in arguments:
        check_count(arguments["smoothing"], "smoothing", at_least=1)
    if "timing" in arguments:
        check_table(arguments["timing"], "timing")
        check_keys(arguments["timing"], _names(Timing))
        arguments["timing"] = Timing(**arguments["timing"])
    charges = arguments.get("flight_charges")
    if isinstance(charges, Mapping) and "name" in charges:
        _, settings = _parts(charges, "flight_charges", {"PostIonisation": PostIonisation})
        check_keys(settings, _names(PostIonisation))
        arguments["flight_charges"] = PostIonisation(**settings)
    elif charges is not None and not isinstance(charges, Mapping):
        check_count(charges, "flight_charges", at_least=1)
    return arguments
