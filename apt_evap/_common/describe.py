"""Description of a law, a rule or a perturbation in a file: its name and parameters in plain types."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def describe(thing: Any) -> dict[str, Any]:
    """Name and parameters of an object, in the plain types of JSON.

    Parameters
    ----------
    thing : object
        Its parameters are the result of its method ``settings``, the fields of a dataclass, or else its attributes
        without a leading underscore.

    Returns
    -------
    dict
        The name of its class under "name", and its parameters.
    """
    return {"name": type(thing).__name__, **{name: _plain(value) for name, value in _parameters(thing).items()}}


def _parameters(thing):
    if callable(getattr(thing, "settings", None)):
        return thing.settings()
    if is_dataclass(thing):
        return {item.name: getattr(thing, item.name) for item in fields(thing)}
    return {name: value for name, value in getattr(thing, "__dict__", {}).items() if not name.startswith("_")}


def _plain(value):
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if callable(value) and hasattr(value, "__qualname__"):  # a function has no parameters to store
        return f"{value.__module__}.{value.__qualname__}"
    return describe(value)
