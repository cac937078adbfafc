"""Materials from text: a name, a table, or a file with a table."""

from collections.abc import Mapping

from apt_evap._common.codec import to_plain
from apt_evap._common.files import FileError
from apt_evap._common.validation import short_text
from apt_evap.simulation.config.simulation_file import read_document
from apt_evap.simulation.config.toml_text import inline, read_toml
from apt_evap.specimen.materials import MATERIALS, Material, as_material, material, unknown_name

_TABLE = "material"


def read_material(text: str, name: str = "material") -> Material:
    """Make a material from text.

    Parameters
    ----------
    text : str
        The name of a known material; a table in TOML syntax, ``'{name = "W", a = 0.3165}'``; or a TOML file, whose name
        ends in .toml, with a table ``[material]``. A table has the name of a known material and the numbers that are
        changed, or all fields of `Material`.
    name : str
        Name of the argument, for the message.
    """
    if text.lower().endswith(".toml"):
        document = read_document(text)
        table = document.get(_TABLE)
        if list(document) != [_TABLE] or not isinstance(table, Mapping):
            raise FileError(f"{text!r} must have one table [{_TABLE}], got {short_text(list(document))}")
        try:
            return as_material(table, _TABLE)
        except ValueError as error:
            raise FileError(f"{text!r}, [{_TABLE}]: {error}") from error
    if text.lstrip().startswith("{"):
        try:
            table, *further = read_toml(f"{_TABLE} = {text}").values()
            if further:
                raise ValueError("expected one table in one line")
            return as_material(table, _TABLE)
        except ValueError as error:
            raise ValueError(f"{name} {short_text(text)}: {error}") from error
    if text not in MATERIALS:
        others = f"others are a table {{name = ...}} or a file .toml with a table [{_TABLE}]"
        raise ValueError(f"{name}: {unknown_name(text)}; {others}")
    return material(text)


def material_value(material: Material) -> str:
    """Value of a key of a settings file: the name of a known material in quotes, or a table of another one."""
    if _is_known(material):
        return inline(material.name)
    # with its sources, so that no field is that of a known material with this name
    return inline({name: value for name, value in to_plain(material).items() if value is not None})


def write_material(material: Material) -> str:
    """Text that `read_material` reads: the name of a known material, or a table of another one."""
    return material.name if _is_known(material) else material_value(material)


def _is_known(material):
    return material == MATERIALS.get(material.name)
