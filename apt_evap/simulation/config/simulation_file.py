"""Simulations from TOML files, with validation of every table and key."""

import hashlib
import inspect
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apt_evap._common.codec import from_plain, is_plain
from apt_evap._common.files import FileError, check_path, read_small_file
from apt_evap._common.validation import check_count, check_number, check_seed, check_switch, short_text
from apt_evap.detection.detector import Detector
from apt_evap.evaporation.charge_settings import ChargeSettings
from apt_evap.evaporation.law import check_law
from apt_evap.evaporation.rule import RULES, check_rule
from apt_evap.evaporation.thermal import LAWS
from apt_evap.evaporation.voltage import VoltageControl, check_voltage
from apt_evap.simulation.config.lens_text import read_lens
from apt_evap.simulation.config.map_panels import MapSettings
from apt_evap.simulation.config.own_classes import with_own_objects
from apt_evap.simulation.config.simulation_settings import Config, host_of
from apt_evap.simulation.config.tables import check_keys, check_table, located
from apt_evap.simulation.config.toml_text import check_levels, read_toml
from apt_evap.simulation.flight.flight_pool import FlightSettings
from apt_evap.simulation.flight.response import ResponseSettings
from apt_evap.simulation.monitor import Monitor
from apt_evap.simulation.real_units import OperatingPoint
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.specimen.materials import as_material
from apt_evap.specimen.phases import Phase, check_phases
from apt_evap.specimen.tip import Tip

_MAX_BYTES = 1 << 22  # bytes
_DIGITS = 12  # of a key: two of 100,000 settings have the same one with a probability of 2e-5
_LENGTH = re.compile(r"\s*(\S+?)\s*(a|nm)\s*")


def read_config(path: str | Path, *, own_classes: bool = False) -> Config:
    """Read a simulation from a TOML file.

    The tables are ``[tip]`` (the arguments of `Tip`; lengths in nm or, as text, in lattice constants: "20 a"; or a
    ``file``, relative to the folder of the settings, with ``types``, further arguments of `read_tip` and perhaps its
    ``sha256``),
    ``[simulation]`` (ions, voltage, seed, responses), ``[detector]``, ``[charges]``, ``[flights]``, ``[responses]``,
    ``[monitor]`` (fields of `Detector`, `ChargeSettings`, `FlightSettings`, `ResponseSettings`, `Monitor`),
    ``[[phases]]`` (fields of `Phase`; instead of a material in ``[tip]``), ``[law]`` and ``[rule]`` (a name and the
    fields of that class), ``[control]`` (`VoltageControl`), ``[real_units]`` (fields of `OperatingPoint`),
    ``[microscope]`` (fields of `LocalElectrode`, or a ``preset``)
    and ``[maps]`` (fields of `MapSettings`). A law, a rule, bonds, a perturbation, a distribution of energies or a
    region may also be of a class of one's own, by the name ``"module:Class"``, if they are turned on
    (:doc:`/extending`). Only ``[tip]`` with a material and an apex_radius, or with a file, and the ions in
    ``[simulation]``, are required.

    Parameters
    ----------
    path : str or path-like
        The file.
    own_classes : bool
        Whether modules with classes of one's own are imported, which executes them. Off by default: turn it on only for
        a file that you trust.

    Returns
    -------
    Config

    Raises
    ------
    FileError
        If the file cannot be read or is not TOML, or a table, key or value is wrong; the message names it.
    """
    return config_of(read_document(path), Path(path), own_classes=own_classes)


def read_document(path: str | Path) -> dict[str, Any]:
    """Content of a TOML file, dict; FileError if it cannot be read or is not TOML."""
    check_path(path)
    if is_run(path):
        raise FileError(f"{str(path)!r} is a run: see apt-evap info")
    content = read_small_file(path, _MAX_BYTES, "a TOML file")
    try:
        return read_toml(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise FileError(f"{str(path)!r} is not a TOML file: it is not text in UTF-8") from error
    except ValueError as error:
        raise FileError(f"{str(path)!r} is not a TOML file: {error}") from error


# tables with the fields of a class, and the classes, of which the first one is the default
_CLASSES: dict[str, tuple[Any, ...]] = {
    "detector": (Detector,),
    "charges": (ChargeSettings,),
    "flights": (FlightSettings,),
    "monitor": (Monitor,),
    "law": LAWS,
    "rule": RULES,
    "control": (VoltageControl,),
}


def config_of(document: dict[str, Any], path: Path, *, own_classes: bool = False) -> Config:
    """Settings of a simulation from the tables of a TOML file, see `read_config`; its path is for messages."""
    with located(path):
        check_switch(own_classes, "own_classes")
        key = key_of(document)
        document = with_own_objects(document, path.parent if own_classes else None)
    # the specimen
    phases = None
    if "phases" in document:
        with located(path, "phases"):
            phases = check_phases(_phases(document["phases"]))
    with located(path, "tip"):
        if phases is not None and "file" in document["tip"]:
            raise ValueError("[[phases]] cannot be combined with a specimen file")
        tip = _tip_from_file(document["tip"], path) if "file" in document["tip"] else _tip(document["tip"], phases)
    with located(path, "simulation"):
        simulation = _simulation(document["simulation"])
    # tables that are the fields of a class; objects of the user's own classes are checked as those of Python
    objects = {}
    for name, kinds in _CLASSES.items():
        with located(path, name):
            table = document.get(name, {})
            if is_plain(table):
                table = from_plain(table, *kinds, what=name) if table else kinds[0]()
            objects[name] = table
    with located(path, "law"):
        check_law(objects["law"])
    with located(path, "rule"):
        check_rule(objects["rule"])
    with located(path, "responses"):
        response_settings = from_plain(document.get("responses", {}), ResponseSettings, what="responses")
    with located(path, "real_units"):
        real_units = None
        if "real_units" in document:
            real_units = from_plain(document["real_units"], OperatingPoint, what="real_units")
    with located(path, "microscope"):
        microscope = read_lens(document["microscope"]) if "microscope" in document else None
    with located(path, "maps"):
        maps = from_plain(document.get("maps", {}), MapSettings, what="maps")
        maps.check_detector(objects["detector"])
    return Config(
        path=path,
        tip=tip,
        **simulation,
        detector=objects["detector"],
        charge_settings=objects["charges"],
        flight_settings=objects["flights"],
        response_settings=response_settings,
        monitor=objects["monitor"],
        maps=maps,
        output=document.get("output"),
        law=objects["law"],
        control=objects["control"] if document.get("control") else None,
        real_units=real_units,
        rule=objects["rule"],
        microscope=microscope,
        key=key,
    )


def _simulation(table):
    """Fields of `Config` from the table [simulation]."""
    check_keys(table, ("ions", "voltage", "seed", "responses"), ("ions",))
    responses = table.get("responses", True)
    if not isinstance(responses, bool):
        raise ValueError(f"responses must be true or false, got {short_text(responses)}")
    return {
        "n_ions": check_count(table["ions"], "ions", at_least=1),
        "voltage": check_voltage(table.get("voltage", 1000.0)),
        "seed": check_seed(table.get("seed", 0)),
        "responses": responses,
    }


def _check_tables(document):
    """Raise ValueError unless the document has tables with known names, and a name of the output."""
    tables = ("tip", "simulation", *_CLASSES, "responses", "real_units", "microscope", "maps")
    check_keys(document, ("output", "phases", *tables), ("tip", "simulation"))
    for name in tables:
        check_table(document.get(name, {}), f"[{name}]")
    check_levels(document)
    output = document.get("output")
    if output is not None and not (isinstance(output, str) and output):
        raise ValueError(f"output must be a file name such as 'run.h5', got {short_text(output)}")


def key_of(document: Mapping[str, Any]) -> str:
    """Key of settings: the first 12 digits of the SHA-256 of their canonical JSON.

    The name of the output does not count, nor do the maps if the run has responses: they only select pictures then.
    The file of a specimen with a SHA-256 counts by this, not by its name. Numbers that are equal have equal keys.
    """
    _check_tables(document)
    document = {name: value for name, value in document.items() if name != "output"}
    if document["simulation"].get("responses", True):
        document.pop("maps", None)
    if "sha256" in document["tip"]:
        document["tip"] = {name: value for name, value in document["tip"].items() if name != "file"}
    return hashlib.sha256(json.dumps(_canonical(document), sort_keys=True).encode()).hexdigest()[:_DIGITS]


def _canonical(value):
    match value:
        case Mapping():
            return {key: _canonical(item) for key, item in value.items()}
        case list():
            return [_canonical(item) for item in value]
        case float() if math.isfinite(value):
            return int(value) if value.is_integer() else value
        case bool() | int() | str() | None:
            return value
    raise ValueError(f"settings must be texts, finite numbers, booleans, lists and tables, got {short_text(value)}")


def _phases(tables):
    """Phases of a tip from the tables ``[[phases]]``, with the fields of `Phase`."""
    if not isinstance(tables, list):
        raise ValueError(f"phases must be tables [[phases]], got {short_text(tables)}")
    return [from_plain(table, Phase, what="phases") for table in tables]


def _tip(table, phases):
    """Arguments of `Tip` from the table [tip], and the phases if there are any."""
    known = tuple(name for name in inspect.signature(Tip).parameters if name != "phases")
    if phases is None:
        check_keys(table, known, ("material", "apex_radius"))
        settings = dict(table, material=as_material(table["material"]))
    else:
        known = tuple(name for name in known if name not in ("material", "solutes"))
        check_keys(table, known, ("apex_radius",))
        settings = dict(table, phases=phases)
    host = host_of(settings)
    for name in ("apex_radius", "shank_length", "depth"):
        if name in settings:
            settings[name] = _length(settings[name], name, host.a)
    if isinstance(settings.get("origin"), list):
        settings["origin"] = [_length(value, "origin", host.a) for value in settings["origin"]]
    if "solutes" in settings:
        check_table(settings["solutes"], "solutes")
    return settings


_FILE_KEYS = (
    "file",
    "sha256",
    "types",
    "format",
    "units",
    "frame",
    "style",
    "neighbour_radius",
    "surface_threshold",
    "potential_point",
)


def _tip_from_file(table, path):
    """Arguments of `read_tip` from the table [tip]."""
    check_keys(table, _FILE_KEYS)
    settings = {key: value for key, value in table.items() if key != "file"}
    if not (isinstance(table["file"], str) and table["file"]):
        raise ValueError(f"file must be a file name such as 'tip.lmp', got {short_text(table['file'])}")
    check_table(settings.get("types", {}), "types")
    settings["types"] = {key: as_material(value, f"types.{key}") for key, value in settings.get("types", {}).items()}
    return {"path": path.parent / table["file"], **settings}


def _length(value, name, a):
    """Length [nm] from a number [nm] or text such as "20 a"; `Tip` checks its range."""
    if not isinstance(value, str):
        return check_number(value, name, unit="nm")
    match = _LENGTH.fullmatch(value)
    try:
        return float(match[1]) * (a if match[2] == "a" else 1.0)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be a number [nm] or text such as '20 a' or '7 nm', got {short_text(value)}"
        ) from None
