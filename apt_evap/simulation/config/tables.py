"""Validation of tables of a TOML file."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import did_you_mean, short_text


def check_table(value: Any, name: str) -> None:
    """Raise a ValueError if `value` is not a table."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a table, got {short_text(value)}")


def check_keys(table: Mapping[str, Any], known: tuple[str, ...], needed: tuple[str, ...] = ()) -> None:
    """Raise a ValueError for an unknown or missing key."""
    for key in table:
        if key not in known:
            raise ValueError(
                f"no key is named {short_text(key)}{did_you_mean(key, known)}; known are {', '.join(known)}"
            )
    for key in needed:
        if key not in table:
            raise ValueError(f"{key} is missing; required are {', '.join(needed)}")


@contextmanager
def located(path: AnyPath, table: str | None = None) -> Iterator[None]:
    """Add the file and table to the message of an error."""
    try:
        yield
    except ValueError as error:
        raise FileError(f"{str(path)!r}{f', [{table}]' if table else ''}: {error}") from error
