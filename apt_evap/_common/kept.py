"""Check that kept results were made from the same input with the same options, before they are used again.

A data set, operators of a feature or the steps of a workflow are found again by the name of a file or folder, which
says nothing of their origin. They therefore store what they were made from, in plain types: settings as of `to_plain`,
and files as `sha256_of`. The next call compares this with what is asked for, by `check_made_from`.
"""

import hashlib
import json
import math
import re
from typing import Any

from apt_evap._common.codec import to_plain
from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text

_DIGEST = re.compile(r"'[0-9a-f]{64}'")
_RELATIVE, _ABSOLUTE = 1e-9, 1e-12  # differences of real numbers that are rounding, such as of sums of lengths


def digest_of(thing: Any) -> str:
    """SHA-256 of an object in plain types, str."""
    return hashlib.sha256(json.dumps(to_plain(thing), sort_keys=True).encode()).hexdigest()


def check_made_from(path: AnyPath, kept: Any, asked: Any, remedy: str) -> None:
    """Check that what is kept was made from what is asked for."""
    if difference := first_difference(kept, to_plain(asked)):
        name, before, now = difference
        if _DIGEST.fullmatch(before) and _DIGEST.fullmatch(now):
            raise FileError(f"{str(path)!r} was made from another {name}: {remedy}")
        raise FileError(f"{str(path)!r} was made with {name} = {before}, but {now} is asked for: {remedy}")


def first_difference(kept: Any, asked: Any, name: str = "") -> tuple[str, str, str] | None:
    """First difference of two objects in plain types: its name and both values as text; None if they are equal."""
    if isinstance(kept, dict) and isinstance(asked, dict):
        for key in {**asked, **kept}:
            path = f"{name}.{key}" if name else str(key)
            if key not in kept or key not in asked:
                before, now = (short_text(table[key]) if key in table else "nothing" for table in (kept, asked))
                return path, before, now
            if difference := first_difference(kept[key], asked[key], path):
                return difference
        return None
    if isinstance(kept, list) and isinstance(asked, list) and len(kept) == len(asked):
        differences = (first_difference(*pair, f"{name}.{k}") for k, pair in enumerate(zip(kept, asked, strict=True)))
        return next(filter(None, differences), None)
    return None if _equal(kept, asked) else (name or "content", short_text(kept), short_text(asked))


def _equal(kept, asked):
    numbers = [isinstance(value, int | float) and not isinstance(value, bool) for value in (kept, asked)]
    if not all(numbers):
        return type(kept) is type(asked) and kept == asked
    if kept == asked or (kept != kept and asked != asked):  # NaN differs from itself
        return True
    if isinstance(kept, int) and isinstance(asked, int):
        return False
    try:
        return math.isclose(kept, asked, rel_tol=_RELATIVE, abs_tol=_ABSOLUTE)
    except OverflowError:  # an integer of hundreds of digits
        return False
