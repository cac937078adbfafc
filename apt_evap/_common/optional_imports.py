"""Import of optional packages."""

from importlib import import_module
from typing import Any


def optional_import(name: str, what: str) -> Any:
    """Import an optional package."""
    try:
        return import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise ImportError(f"{what} needs {package}, which is not installed: pip install {package}") from error
