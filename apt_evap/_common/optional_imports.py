"""Import of optional packages."""

from importlib import import_module
from typing import Any


def optional_import(name: str, what: str) -> Any:
    """Import an optional package.

    Parameters
    ----------
    name : str
        Name of the module.
    what : str
        Name of the feature that needs it, for the message.

    Returns
    -------
    module

    Raises
    ------
    ImportError
        If it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise ImportError(f"{what} needs {package}, which is not installed: pip install {package}") from error
