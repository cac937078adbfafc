"""The one door where a user's numbers and arrays are checked."""

import math
from numbers import Integral, Real

import numpy as np


def check_array(value, name, shape, *, dtype=np.float64, finite=True):
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
        array = np.ascontiguousarray(given, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers of shape {wanted}, got {value!r:.80}") from error
    lengths = {}
    fits = array.ndim == len(shape) and given.ndim == len(shape)
    for length, expected in zip(array.shape, shape, strict=False):
        fits = fits and length == (lengths.setdefault(expected, length) if isinstance(expected, str) else expected)
    if not fits:
        raise ValueError(f"{name} must have shape {wanted}, got {given.shape}")
    if np.issubdtype(array.dtype, np.integer) and not np.array_equal(array, given):
        raise ValueError(f"{name} must hold whole numbers that fit {array.dtype}, got {given.dtype} values")
    if finite and np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
        first = np.argwhere(~np.isfinite(array))[0]
        raise ValueError(f"{name} must be finite, got {array[tuple(first)]} at index {tuple(int(i) for i in first)}")
    return array


def check_number(value, name, *, above=None, at_least=None, at_most=None, unit=""):
    """Return `value` as a finite float within its bounds, or say in one sentence what is wrong.

    Parameters
    ----------
    value : float
        What the user gave.
    name : str
        Name of the argument, for the message.
    above, at_least, at_most : float, optional
        Bounds; `above` is exclusive.
    unit : str
        Unit for the message.

    Returns
    -------
    float

    Raises
    ------
    ValueError
        Naming the argument, its value and the bounds.
    """
    bounds = [
        f"{word} {bound:g}"
        for word, bound in (("above", above), ("at least", at_least), ("at most", at_most))
        if bound is not None
    ]
    expected = "a finite number" + (f" [{unit}]" if unit else "") + (" " + " and ".join(bounds) if bounds else "")
    good = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    good = good and (above is None or value > above) and (at_least is None or value >= at_least)
    if not (good and (at_most is None or value <= at_most)):
        raise ValueError(f"{name} must be {expected}, got {value!r}")
    return float(value)


def check_count(value, name, *, at_least=0):
    """Return `value` as an int of at least `at_least`, or say in one sentence what is wrong.

    Parameters
    ----------
    value : int
        What the user gave.
    name : str
        Name of the argument, for the message.
    at_least : int
        Smallest value allowed.

    Returns
    -------
    int

    Raises
    ------
    ValueError
        Naming the argument, its value and the bound.
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < at_least:
        raise ValueError(f"{name} must be a whole number of at least {at_least}, got {value!r}")
    return int(value)
