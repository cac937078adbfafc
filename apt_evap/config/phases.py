"""Tables [[phases]] of a TOML file."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from apt_evap._common.validation import check_choice, short_text
from apt_evap.config.tables import check_keys, check_table
from apt_evap.specimen.ordered import order_from_dict
from apt_evap.specimen.phases import Phase, segregation_from_dict
from apt_evap.specimen.regions import region_from_dict

_KEYS = ("name", "material", "region", "axis", "rotation", "order", "solutes", "evaporation_field", "vacancies")


def read_phases(tables: Any, read_material: Callable[[Any], Any]) -> list[Phase]:
    """Read the phases of a tip from the tables ``[[phases]]``.

    Parameters
    ----------
    tables : list of mappings
        Each with the arguments of `Phase`. ``region`` is a table with the name of a region and its parameters;
        ``order`` a table with ``prototype`` and ``second``, or with ``sites`` and ``cells``; a solute is a fraction or
        a table with ``bulk``, ``peak``, ``width`` and, if necessary, ``region``.
    read_material : callable
        Reads a material from its name or table.

    Returns
    -------
    list of Phase

    Raises
    ------
    ValueError
        Names the phase, the key, its value and the expected value.
    """
    if isinstance(tables, Mapping) or not isinstance(tables, Sequence) or isinstance(tables, str):
        raise ValueError(f"phases must be tables [[phases]], got {short_text(tables)}")
    phases = []
    for table in tables:
        check_table(table, "phases")
        check_keys(table, _KEYS, ("name", "material"))
        phases.append(_phase(dict(table), read_material))
    return phases


def _phase(arguments, read_material):
    arguments["material"] = read_material(arguments["material"])
    if "region" in arguments:
        arguments["region"] = region_from_dict(arguments["region"])
    if "order" in arguments:
        order = arguments["order"]
        check_table(order, "order")
        kind = "Basis" if "sites" in order else "Order"
        check_choice(order.get("name", kind), "name of order", (kind,))
        arguments["order"] = order_from_dict({**order, "name": kind})
    if "solutes" in arguments:
        check_table(arguments["solutes"], "solutes")
        arguments["solutes"] = {
            element: segregation_from_dict(each) if isinstance(each, Mapping) else each
            for element, each in arguments["solutes"].items()
        }
    return Phase(**arguments)
