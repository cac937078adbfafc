"""Conversion of the settings in files of earlier versions."""

from collections.abc import Mapping
from typing import Any

_ROBIN = {"name": "Robin", "tolerance": 1e-5, "window": 8}  # earlier versions saved the name of the rule only
_RENAMED = {"flights": {"most_steps": "max_steps"}, "watch": {"share_bound": "fraction_bound"}}


def upgraded(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run with the names of this version.

    Parameters
    ----------
    settings : mapping
        Settings in a file; settings of this version are not changed.

    Returns
    -------
    dict
    """
    new = dict(settings)
    for table, names in _RENAMED.items():
        if table in new:
            new[table] = {names.get(key, key): value for key, value in new[table].items()}
    if new.get("rule") == "Robin":
        new["rule"] = dict(_ROBIN)
    if new.get("law") in ({"name": "Extremal", "repr": "Extremal()"}, {"name": "Extremal"}):
        new["law"] = {"name": "Extremal", "bonds": None}
    if "responses" in new:
        new["responses"] = {"height": 0.0, "shells": 1, "rolls": 1} | dict(new["responses"])
    new.setdefault("control", None)
    new.setdefault("pulse_length", None)
    return new
