"""Validation of user input."""

import hashlib
import math
import reprlib
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

LARGEST_SEED = 2**64 - 1
_LARGEST_COUNT = 2**63 - 1  # integer type of the compiled core
_LARGEST = 1e100  # the cube of a number is still finite
_LONGEST_NAME = 100  # characters


class _Repr(reprlib.Repr):
    """Short texts of values, in which the numbers of NumPy look like those of Python, also within others."""

    def repr1(self, x: Any, level: int) -> str:
        return super().repr1(x.item() if isinstance(x, np.generic) else x, level)


_SHORT = _Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 100


def without_mask(value: Any, name: str, dtype: DTypeLike = np.float64) -> Any:
    """Return an array whose masked values are NaN; other values unchanged.

    NumPy drops the mask in conversions, so that missing values would become numbers.
    """
    if isinstance(value, list | tuple) and any(np.ma.isMaskedArray(part) for part in value):
        value = np.ma.array(value)
    if not np.ma.is_masked(value):
        return value
    if not np.issubdtype(dtype, np.inexact):
        count = int(np.ma.count_masked(value))
        raise ValueError(f"{name} must have no masked values, got {count:,} of {value.size:,}")
    return np.ma.filled(value if value.dtype.kind == "f" else value.astype(np.float64), np.nan)


def check_values(value: Any, name: str, *, finite: bool = True) -> NDArray[np.float64]:
    """Return a number, or an array of numbers of any shape, as an array, or raise an error that names the argument."""
    try:
        values = np.asarray(without_mask(value, name))
    except ValueError:  # rows of different lengths
        values = np.empty(0, object)
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be numbers, got {short_text(value)}")
    if finite and not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite, got {short_text(value)}")
    return values.astype(np.float64)


def check_array(
    value: Any, name: str, shape: tuple[int | str, ...], *, dtype: DTypeLike = np.float64, finite: bool = True
) -> NDArray[Any]:
    """Return `value` as a C-contiguous array of `dtype`, or raise an error that names the argument.

    Parameters
    ----------
    value : array_like
        Input of the user.
    name : str
        Name of the argument, for the message.
    shape : tuple
        Expected shape; a str for any length, equal strings for equal lengths: ``("n", 3)``.
    dtype : dtype
        Type of the result; a conversion that loses a fraction or a sign is an error.
    finite : bool
        Whether NaN and infinities are errors.
    """
    value = without_mask(value, name, dtype)
    expected_shape = "(" + ", ".join(str(length) for length in shape) + ("," if len(shape) == 1 else "") + ")"
    try:
        original = np.asarray(value)
        if original.dtype.kind not in "biufO" or (original.ndim == 0 and shape):
            raise TypeError(f"{original.dtype} is not an array of numbers")
        with np.errstate(invalid="ignore", over="ignore"):
            array = np.ascontiguousarray(original, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        expected = f"an array of numbers of shape {expected_shape}"
        raise ValueError(f"{name} must be {expected}, got {short_text(value)}") from error
    lengths = {}
    fits = array.ndim == len(shape) and original.ndim == len(shape)
    for length, expected in zip(array.shape, shape, strict=False):
        fits = fits and length == (lengths.setdefault(expected, length) if isinstance(expected, str) else expected)
    if not fits:
        raise ValueError(f"{name} must have shape {expected_shape}, got {original.shape}")
    if array.dtype == bool and original.dtype != bool and original.size:  # indices do not count as a mask
        raise ValueError(f"{name} must contain booleans, got {original.dtype} values such as {original.flat[0]}")
    if np.issubdtype(array.dtype, np.integer) and not np.array_equal(array, original):
        first = _at_first(original, array != original)
        raise ValueError(f"{name} must contain integers that fit {array.dtype}, got {first}")
    if finite and np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {_at_first(array, ~np.isfinite(array))}")
    return array


def _at_first(array, wrong):
    """First wrong value and its index."""
    first = tuple(int(i) for i in np.argwhere(wrong)[0])
    return f"{array[first]} at index {first}"


def check_number(
    value: Any,
    name: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    unit: str = "",
    why: str = "",
) -> float:
    """Return `value` as a finite float within its bounds, or raise an error that names the argument.

    The bounds `above` and `below` are exclusive. The message has the unit, and the meaning of the bound in `why`.
    """
    value = value.item() if isinstance(value, np.number) else value  # bounds may overflow in single precision
    number = isinstance(value, Real) and not isinstance(value, bool)
    if number and at_most is None and below is None and _LARGEST < abs(value) < math.inf:
        at_most = _LARGEST
    good = number and abs(value) <= _LARGEST  # no NaN, no infinity
    good = good and (above is None or value > above) and (at_least is None or value >= at_least)
    if not (good and (at_most is None or value <= at_most) and (below is None or value < below)):
        bounds = [
            f"{sign} {bound:g}"
            for sign, bound in ((">", above), (">=", at_least), ("<=", at_most), ("<", below))
            if bound is not None
        ]
        expected = "a finite number" + (f" [{unit}]" if unit else "") + (" " + " and ".join(bounds) if bounds else "")
        expected += f" ({why})" if why else ""
        raise ValueError(f"{name} must be {expected}, got {short_text(value)}")
    return float(value)


def check_count(value: Any, name: str, *, at_least: int = 0, at_most: int = _LARGEST_COUNT) -> int:
    """Return `value` as an int from `at_least` to `at_most`, or raise an error that names the argument."""
    integer = isinstance(value, Integral) and not isinstance(value, bool)
    if not integer or not at_least <= value <= at_most:
        bounds = f">= {at_least}"
        if at_most < _LARGEST_COUNT or (integer and value > at_most):
            bounds = f"from {at_least} to {at_most:,}"
        raise ValueError(f"{name} must be an integer {bounds}, got {short_text(value)}")
    return int(value)


def check_seed(value: Any, name: str = "seed") -> int:
    """Return a seed, an integer from 0 to 2^64 - 1; ValueError otherwise."""
    return check_count(value, name, at_most=LARGEST_SEED)


def check_switch(value: Any, name: str) -> bool:
    """Return `value` if it is True or False; ValueError otherwise, also for the word "no"."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {short_text(value)}")
    return bool(value)


def check_choice(value: Any, name: str, known: Iterable[str]) -> str:
    """Return `value` if it is in `known`; otherwise a ValueError lists the known words and the most similar one."""
    if not isinstance(value, str) or value not in list(known):
        hint = did_you_mean(value, known)
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {short_text(value)}{hint}")
    return value


def check_kind(value: Any, name: str, kind: Any, expected: str) -> Any:
    """Return `value` if it is of a type, or has a method of this name, or raise an error that names the argument."""
    good = callable(getattr(value, kind, None)) if isinstance(kind, str) else isinstance(value, kind)
    if not good or isinstance(value, type):
        raise ValueError(f"{name} must be {expected}, got {short_text(value)}")
    return value


def check_name(value: Any, name: str) -> str:
    """Return `value` if it is a line of 1 to 100 characters: names are used in messages, titles and files."""
    if not isinstance(value, str) or not 1 <= len(value) <= _LONGEST_NAME or not value.isprintable():
        raise ValueError(f"{name} must be text of 1 to {_LONGEST_NAME} printable characters, got {short_text(value)}")
    return value


def check_sequence(value: Any, name: str, expected: str) -> tuple[Any, ...]:
    """Return the items of a sequence as a tuple; ValueError otherwise, also for text."""
    try:
        if isinstance(value, str | bytes | Mapping):
            raise TypeError("text")
        return tuple(value)
    except TypeError as error:
        raise ValueError(f"{name} must be a sequence of {expected}, got {short_text(value)}") from error


def check_pairs(value: Any, name: str, expected: str) -> list[tuple[Any, Any]]:
    """Return the keys and values of a mapping, or of a list of pairs, its plain form if keys are not texts."""
    if isinstance(value, Mapping):
        return list(value.items())
    pairs = isinstance(value, list | tuple) and all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in value)
    if not pairs:
        raise ValueError(f"{name} must be {expected}, or a list of pairs of these, got {short_text(value)}")
    return [(key, content) for key, content in value]


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """Hint at the most similar word in `known`, in upper or lower case; "" if none is similar.

    A symbol of an element must differ by one more letter at most: calcium, Ca, is not tantalum, Ta.
    """
    lower = {name.lower(): name for name in known}
    text = word.lower() if isinstance(word, str) else ""
    close = get_close_matches(text, [name for name in lower if len(name) > 2], n=1, cutoff=0.5)
    close = get_close_matches(text, [*(name for name in lower if len(name) <= 2), *close], n=1, cutoff=0.75) or close
    return f" (did you mean {lower[close[0]]!r}?)" if close else ""


def short_text(value: object) -> str:
    """Value as one short line, for messages."""
    try:
        text = _SHORT.repr(value)
    except ValueError:  # Python does not print an integer of thousands of digits
        return "an integer of thousands of digits"
    return " ".join(text.split())


def digest(*arrays: Any) -> str:
    """Hash of arrays (str), to compare them with others."""
    hashed = hashlib.sha256()
    for array in arrays:
        hashed.update(np.ascontiguousarray(array))  # type: ignore[arg-type]
    return hashed.hexdigest()
