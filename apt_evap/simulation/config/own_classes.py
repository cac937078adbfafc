"""Objects of a user's own classes in settings files: tables whose name is ``module:Class``.

They are off by default: to import a module is to execute it, and settings may be somebody else's.
"""

import importlib
import inspect
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from apt_evap._common.files import read_small_file
from apt_evap._common.validation import short_text
from apt_evap.emission.energies import Distribution
from apt_evap.emission.perturbations import Perturbation
from apt_evap.emission.roll_probability import RollProbability
from apt_evap.evaporation.bonds import BondField
from apt_evap.evaporation.law import Law
from apt_evap.evaporation.rule import CompiledRule, Rule
from apt_evap.evaporation.voltage import ThermalLaw
from apt_evap.specimen.regions import Region

_NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
# interfaces by the name of the table, or of the list of tables; a class needs the methods of one of them
_INTERFACES: dict[str, tuple[type, ...]] = {
    "law": (Law, CompiledRule, ThermalLaw),  # a compiled law has the method of a compiled rule: kernel(tip)
    "bonds": (BondField,),
    "rule": (Rule, CompiledRule),
    **dict.fromkeys(("perturbation", "perturbations"), (Perturbation,)),
    **dict.fromkeys(("energy", "others"), (Distribution,)),
    "probability": (RollProbability,),
    **dict.fromkeys(("region", "regions", "core"), (Region,)),
}
_MAX_BYTES = 1 << 22  # of a module


def with_own_objects(document: Mapping[str, Any], folder: Path | None) -> dict[str, Any]:
    """Settings with an object for each table whose name is a class of the user's own, ``module:Class``.

    These are tables of a law, a rule, bonds, a perturbation, a distribution of energies, a probability or a region;
    their other entries are the arguments of the class. ``module.py`` may be in the folder, besides the Python path;
    without a folder nothing is imported.
    """
    return {key: _with_objects(value, key, folder) for key, value in document.items()}


def _with_objects(value, place, folder):
    if isinstance(value, list):
        return [_with_objects(entry, place, folder) for entry in value]
    if not isinstance(value, Mapping):
        return value
    table = with_own_objects(value, folder)
    name = table.get("name")
    if place in _INTERFACES and isinstance(name, str) and _NAME.fullmatch(name):
        del table["name"]
        return _object(place, name, table, folder)
    return table


def _object(place, name, arguments, folder):
    if folder is None:
        raise ValueError(
            f"{place} {short_text(name)}: a class of one's own is imported only for the file that apt-evap run names, "
            "or with own_classes=True in Python"
        )
    module, _, kind = name.partition(":")
    try:
        made = getattr(_module(module, folder), kind)
        if not any(_implements(made, interface) for interface in _INTERFACES[place]):
            expected = " or ".join(" and ".join(_methods(interface).values()) for interface in _INTERFACES[place])
            raise ValueError(f"it must be a class with the method {expected}, got {short_text(made)}")
        return made(**arguments)
    except Exception as error:  # of the user's code
        reason = " ".join(str(error).split())
        raise ValueError(f"{place} {short_text(name)}: {type(error).__name__}: {reason}") from error


def _methods(interface):
    """Public methods of an interface as text, such as "keys(tip, atoms, fields, bonds)", by name."""
    return {
        name: f"{name}({', '.join(list(inspect.signature(method).parameters)[1:])})"
        for name, method in vars(interface).items()
        if inspect.isfunction(method) and not name.startswith("_")
    }


def _implements(kind, interface):
    """Whether a class is a subclass of an interface: it has all of its methods, and they take the same arguments."""
    if not isinstance(kind, type):
        return False
    for name in _methods(interface):
        n_arguments = len(inspect.signature(getattr(interface, name)).parameters)
        if isinstance(inspect.getattr_static(kind, name, None), classmethod | staticmethod):
            n_arguments -= 1  # no self
        try:
            inspect.signature(getattr(kind, name)).bind(*range(n_arguments))
        except (AttributeError, TypeError, ValueError):  # no method, other arguments, not in Python
            return False
    return True


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
