"""The one door where a user's numbers and arrays are checked."""

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
_LARGEST_COUNT = 2**63 - 1  # what the compiled core counts with
_LARGEST = 1e100  # the cube of a number is still a number
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 100


def check_array(
    value: Any, name: str, shape: tuple[int | str, ...], *, dtype: DTypeLike = np.float64, finite: bool = True
) -> NDArray[Any]:
    """Return `value` as a C-contiguous array of `dtype`, or say in one sentence what is wrong.

    Parameters
    ----------
    value : array_like
        What the user gave.
    name : str
        Name of the argument, for the message.
    shape : tuple
        Expected shape; a str stands for any length, the same str for the same length: ``("n", 3)``.
    dtype : dtype
        Type of the result; a cast that loses a fraction or a sign is an error.
    finite : bool
        Whether NaN and infinities are errors.

    Returns
    -------
    ndarray

    Raises
    ------
    ValueError
        Naming the argument, what it is and what was expected.
    """
    wanted = "(" + ", ".join(str(length) for length in shape) + ("," if len(shape) == 1 else "") + ")"
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biufO" or (given.ndim == 0 and shape):
            raise TypeError(f"{given.dtype} is no array of numbers")
        with np.errstate(invalid="ignore", over="ignore"):
            array = np.ascontiguousarray(given, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be an array of numbers of shape {wanted}, got {shown(value)}") from error
    lengths = {}
    fits = array.ndim == len(shape) and given.ndim == len(shape)
    for length, expected in zip(array.shape, shape, strict=False):
        fits = fits and length == (lengths.setdefault(expected, length) if isinstance(expected, str) else expected)
    if not fits:
        raise ValueError(f"{name} must have shape {wanted}, got {given.shape}")
    if array.dtype == bool and given.dtype != bool and given.size:  # indices are not taken for a mask
        raise ValueError(f"{name} must hold true or false, got {given.dtype} values such as {given.flat[0]}")
    if np.issubdtype(array.dtype, np.integer) and not np.array_equal(array, given):
        whole = f"whole numbers that fit {array.dtype}"
        raise ValueError(f"{name} must hold {whole}, got {_at_first(given, array != given)}")
    if finite and np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {_at_first(array, ~np.isfinite(array))}")
    return array


def _at_first(array, wrong):
    """The first value that is wrong, and where."""
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
    """Return `value` as a finite float within its bounds, or say in one sentence what is wrong.

    Parameters
    ----------
    value : float
        What the user gave.
    name : str
        Name of the argument, for the message.
    above, at_least, at_most, below : float, optional
        Bounds; `above` and `below` are exclusive.
    unit : str
        Unit for the message.
    why : str
        What the bound is, for the message.

    Returns
    -------
    float

    Raises
    ------
    ValueError
        Naming the argument, its value and the bounds.
    """
    number = isinstance(value, Real) and not isinstance(value, bool)
    if number and at_most is None and below is None and _LARGEST < abs(value) < math.inf:
        at_most = _LARGEST
    good = number and abs(value) <= _LARGEST  # no NaN, no infinity
    good = good and (above is None or value > above) and (at_least is None or value >= at_least)
    if not (good and (at_most is None or value <= at_most) and (below is None or value < below)):
        bounds = [
            f"{word} {bound:g}"
            for word, bound in (("above", above), ("at least", at_least), ("at most", at_most), ("below", below))
            if bound is not None
        ]
        expected = "a finite number" + (f" [{unit}]" if unit else "") + (" " + " and ".join(bounds) if bounds else "")
        expected += f" ({why})" if why else ""
        raise ValueError(f"{name} must be {expected}, got {shown(value)}")
    return float(value)


def check_count(value: Any, name: str, *, at_least: int = 0, at_most: int = _LARGEST_COUNT) -> int:
    """Return `value` as an int from `at_least` to `at_most`, or say in one sentence what is wrong.

    Parameters
    ----------
    value : int
        What the user gave.
    name : str
        Name of the argument, for the message.
    at_least, at_most : int
        Smallest and largest value allowed.

    Returns
    -------
    int

    Raises
    ------
    ValueError
        Naming the argument, its value and the bounds.
    """
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or not at_least <= value <= at_most:
        bounds = f"at least {at_least}"
        if at_most < _LARGEST_COUNT or (whole and value > at_most):
            bounds += f" and at most {at_most:,}"
        raise ValueError(f"{name} must be a whole number of {bounds}, got {shown(value)}")
    return int(value)


def check_seed(value: Any, name: str = "seed") -> int:
    """Return a seed, a whole number from 0 to 2^64 - 1, or say what is wrong (ValueError)."""
    return check_count(value, name, at_most=LARGEST_SEED)


def check_switch(value: Any, name: str) -> bool:
    """Return `value` if it is true or false, or say what it is (ValueError): "no" counts as neither."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def check_choice(value: Any, name: str, known: Iterable[str]) -> str:
    """Return `value` if it is one of the words in `known`, or say which ones are and the nearest (ValueError)."""
    if not isinstance(value, str) or value not in list(known):
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {shown(value)}{did_you_mean(value, known)}")
    return value


def check_kind(value: Any, name: str, kind: Any, wanted: str) -> Any:
    """Return `value` if it is of a type, or say what was wanted.

    Parameters
    ----------
    value : object
        What the user gave.
    name : str
        Name of the argument, for the message.
    kind : type or str
        The type, or the name of a method that `value` must have.
    wanted : str
        What it must be, such as "a Detector".

    Returns
    -------
    object

    Raises
    ------
    ValueError
        Naming the argument, its value and what was wanted.
    """
    good = callable(getattr(value, kind, None)) if isinstance(kind, str) else isinstance(value, kind)
    if not good or isinstance(value, type):
        raise ValueError(f"{name} must be {wanted}, got {shown(value)}")
    return value


def check_sequence(value: Any, name: str, wanted: str) -> tuple[Any, ...]:
    """Return the members of a sequence as a tuple, or say what was wanted (ValueError); text is no sequence."""
    try:
        if isinstance(value, str | bytes | Mapping):
            raise TypeError("text")
        return tuple(value)
    except TypeError as error:
        raise ValueError(f"{name} must be a sequence of {wanted}, got {shown(value)}") from error


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """A hint at the nearest of the words in `known`, whatever their case; "" if none is near."""
    lower = {name.lower(): name for name in known}
    close = get_close_matches(str(word).lower(), lower, n=1, cutoff=0.5) if isinstance(word, str) else ()
    return f" (did you mean {lower[close[0]]!r}?)" if close else ""


def shown(value: object) -> str:
    """A value in one short line, for messages."""
    try:
        text = _SHORT.repr(value.item() if isinstance(value, np.generic) else value)
    except ValueError:  # Python does not print a whole number of thousands of digits
        return "a whole number of thousands of digits"
    return " ".join(text.split())


def digest(*arrays: Any) -> str:
    """Hash of some arrays (str), by which they are known again."""
    hashed = hashlib.sha256()
    for array in arrays:
        hashed.update(np.ascontiguousarray(array))  # type: ignore[arg-type]
    return hashed.hexdigest()
