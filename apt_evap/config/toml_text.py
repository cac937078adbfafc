"""Writing of settings as TOML; the standard library only reads it."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(document: Mapping[str, Any]) -> str:
    """Text of a TOML file with this content.

    Parameters
    ----------
    document : mapping
        Tables, lists, texts, numbers and booleans, as `tomllib` reads them.

    Returns
    -------
    str
        `tomllib.loads` of it gives the document.

    Raises
    ------
    ValueError
        If a value has another type, such as a date.
    """
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
            return "{" + ", ".join(f"{_key(key)} = {inline(each)}" for key, each in value.items()) + "}"
    raise ValueError(f"settings must be texts, numbers, booleans, lists and tables, got {value!r:.80}")
