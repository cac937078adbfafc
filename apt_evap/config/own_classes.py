"""Objects of a user's own classes in settings files: tables whose name is ``module:Class``."""

import importlib
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from apt_evap._common.files import read_small_file
from apt_evap._common.validation import short_text

_NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
_PLACES = ("law", "bonds", "rule", "perturbation", "perturbations", "energy", "others", "probability", "region",
           "regions", "core")  # fmt: skip
_MAX_BYTES = 1 << 22  # of a module


def with_own_objects(document: Mapping[str, Any], folder: Path | None) -> dict[str, Any]:
    """Make the objects of the user's own classes that settings name.

    Parameters
    ----------
    document : mapping
        Content of a settings file.
    folder : Path or None
        Where ``module.py`` may be, besides the Python path. None for settings that the user has not given: their
        modules are not imported.

    Returns
    -------
    dict
        The document, with an object for each table of a law, a rule, bonds, a perturbation, a distribution of energies,
        a probability or a region whose name is ``module:Class``; its other entries are the arguments of the class.

    Raises
    ------
    ValueError
        If there is such a table and no folder, or the module or its class raises any error.
    """
    return {key: _with_objects(value, key, folder) for key, value in document.items()}


def _with_objects(value, place, folder):
    if isinstance(value, list):
        return [_with_objects(entry, place, folder) for entry in value]
    if not isinstance(value, Mapping):
        return value
    table = with_own_objects(value, folder)
    name = table.get("name")
    if place in _PLACES and isinstance(name, str) and _NAME.fullmatch(name):
        del table["name"]
        return _object(place, name, table, folder)
    return table


def _object(place, name, arguments, folder):
    if folder is None:
        raise ValueError(
            f"{place} {short_text(name)}: a class of your own is imported for apt-evap run and read_config only"
        )
    module, _, kind = name.partition(":")
    try:
        return getattr(_module(module, folder), kind)(**arguments)
    except Exception as error:  # of the user's code
        reason = " ".join(str(error).split())
        raise ValueError(f"{place} {short_text(name)}: {type(error).__name__}: {reason}") from error


def _module(name, folder):
    """Module of the folder, executed again at each call: the file may have changed; or one of the Python path."""
    file = folder.joinpath(*name.split(".")).with_suffix(".py")
    if not file.is_file():
        return importlib.import_module(name)
    module = ModuleType(str(file.absolute()))
    module.__file__ = str(file)
    sys.modules[module.__name__] = module  # where dataclasses look up annotations
    exec(compile(read_small_file(file, _MAX_BYTES, "a Python module"), str(file), "exec"), vars(module))
    return module
