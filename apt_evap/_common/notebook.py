"""Views of data in a notebook, made by a module above those of the data when a notebook requests them."""

from importlib import import_module
from typing import Any

_makers: list[str] = []


def shown_by(module: str) -> None:
    """Set the module whose functions `picture` and `folded_table` make the views."""
    _makers[:] = [module]


def as_picture(map: Any) -> bytes | None:
    """Picture as PNG, bytes; assigned to ``_repr_png_``."""
    return import_module(_makers[0]).picture(map) if _makers else None


def as_table(data: Any) -> str | None:
    """Table as HTML; assigned to ``_repr_html_``."""
    return import_module(_makers[0]).folded_table(data) if _makers else None
