"""Settings of runs that earlier versions saved, as this version writes them."""

from collections.abc import Mapping
from typing import Any

_ROBIN = {"name": "Robin", "tolerance": 1e-5, "window": 8}  # earlier versions saved the name of the rule only
_RENAMED = {"flights": {"most_steps": "max_steps"}, "watch": {"share_bound": "fraction_bound"}}


def upgraded(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run under the names that they have today.

    Parameters
    ----------
    settings : mapping
        As a file has them; those of this version stay as they are.

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
    if new.get("law") == {"name": "Extremal", "repr": "Extremal()"}:
        new["law"] = {"name": "Extremal"}
    return new
