"""Settings as TOML: reading with a limit on nested tables, and writing, which the standard library does not do."""

import json
import math
import re
import tomllib
from collections.abc import Mapping
from typing import Any

from apt_evap._common.validation import short_text

MOST_LEVELS = 64
"""Levels of tables and lists in settings: each of them is read by a few nested calls."""
_BARE = re.compile(r"[A-Za-z0-9_-]+")


def read_toml(text: str) -> dict[str, Any]:
    """Content of a text in TOML, dict; ValueError if it is not TOML, or has too many levels."""
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:
        raise ValueError("integers must not have thousands of digits") from None
    check_levels(document)
    return document


def check_levels(document: Any) -> None:
    """Raise a ValueError if tables and lists have more than `MOST_LEVELS` levels."""
    level = [document]
    for _ in range(MOST_LEVELS + 1):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, Mapping) else outer)
            if isinstance(inner, Mapping | list)
        ]
        if not level:
            return
    raise ValueError(_TOO_DEEP)


_TOO_DEEP = f"settings must have at most {MOST_LEVELS} levels of tables and lists"


def toml_text(document: Mapping[str, Any]) -> str:
    """Text of a TOML file with this content."""
    plain = [(key, value) for key, value in document.items() if not isinstance(value, Mapping)]
    tables = [(key, value) for key, value in document.items() if isinstance(value, Mapping)]
    lines = [f"{_key(key)} = {inline(value)}" for key, value in plain]
    for name, table in tables:
        lines += ["", f"[{_key(name)}]", *(f"{_key(key)} = {inline(value)}" for key, value in table.items())]
    return "\n".join(lines).lstrip("\n") + "\n"


def _key(key):
    return key if _BARE.fullmatch(key) else _text(key)


def comment(text: str) -> str:
    """Comment of one line, "# ..."; characters that cannot be printed, such as line breaks, are escaped."""
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return f"# {shown}"


def _text(value):
    try:
        value.encode()
    except UnicodeEncodeError:  # of a file name that is not in UTF-8
        raise ValueError(f"texts of settings must be Unicode, got {value!a:.80}") from None
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON allows this character, TOML does not


def inline(value: Any) -> str:
    """Text of a value in one line; tables are inline."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return _text(value)
        case int():
            return str(value)
        case float() if math.isnan(value):
            return "nan"
        case float():
            return repr(value)
        case list() | tuple():
            return "[" + ", ".join(map(inline, value)) + "]"
        case Mapping():
            return "{" + ", ".join(f"{_key(key)} = {inline(item)}" for key, item in value.items()) + "}"
    raise ValueError(f"settings must be texts, numbers, booleans, lists and tables, got {short_text(value)}")
