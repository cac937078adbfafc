"""Sampled settings of a study: ranges, choices and random axes, drawn from Sobol' points."""

import hashlib
import inspect
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap._common.validation import did_you_mean, short_text
from apt_evap._core.elementary import exponential, logarithm, sine_and_cosine
from apt_evap.specimen.lattice import direction_vectors
from apt_evap.specimen.materials import Material

AXIS, RANDOM = "tip.axis", "random"
"""The setting that can be random, and the word for it."""
SEEDS = ("simulation.seed", "tip.seed", "tip.offset_seed")
"""Seeds, which differ between samples."""
_DIGITS = 6  # of a drawn number: the same text, and the same key of a point, on every machine
_DECIMALS = 5  # of a random axis: 0.001 degrees
_BITS = 30  # of Sobol' points: 1e9 samples
_LENGTH = re.compile(r"\s*([-+.\deE]+)\s*(a|nm)\s*")


@dataclass(frozen=True)
class Option:
    """A setting that is sampled."""

    width: int
    """Number of coordinates in the unit interval that a value takes."""
    value: Callable[[Sequence[float]], Any]
    """Value for these coordinates."""


@dataclass(frozen=True)
class RandomAxis:
    """A direction in the standard triangle of a crystal that is not known yet."""

    first: float
    second: float

    def __str__(self):
        return RANDOM

    def of(self, material: Material) -> list[float]:
        """Crystal direction [u v w] for a material.

        Uniform on the sphere, in the triangle [001], [011], [111] of a cubic crystal, or in the triangle [0001],
        [2-1-10], [10-10] of a hexagonal one.
        """
        across = np.sqrt(1.0 - self.first * self.first)
        sector = np.pi / 6 if material.structure == "hcp" else 2 * np.pi
        sine, cosine = (float(part[0]) for part in sine_and_cosine(np.array([sector * self.second])))
        vector = np.array([across * cosine, across * sine, self.first])
        if material.structure == "hcp":
            vector = np.linalg.solve(direction_vectors("hcp", material.a, material.c).T, vector)
        else:
            vector = np.sort(np.abs(vector))
        return [float(index) for index in np.round(vector, _DECIMALS)]


def is_option(value: Any) -> bool:
    """Whether a value is a table of one range or choice, such as ``{ uniform = [20, 60] }``."""
    return isinstance(value, Mapping) and len(value) == 1 and next(iter(value)) in _KINDS


def option_of(value: Any, path: str) -> Option:
    """Option of a value of a study: a range, a choice, or "random" for an axis."""
    if value == RANDOM and path == AXIS:
        return Option(2, lambda u: RandomAxis(*u))
    if not is_option(value):
        known, key = ", ".join(_KINDS), next(iter(value), "") if isinstance(value, Mapping) else value
        raise ValueError(f"{path} must be one of {known}, got {short_text(value)}{did_you_mean(key, _KINDS)}")
    ((kind, content),) = value.items()
    if kind == "choice":
        if not isinstance(content, list) or not content:
            raise ValueError(f"{path}: choice must be a list of values, got {short_text(content)}")
        return Option(1, lambda u: content[int(u[0] * len(content))])
    low, high, unit = _bounds(content, f"{path}: {kind}")
    if kind == "integer":
        if unit or not (low.is_integer() and high.is_integer()):
            raise ValueError(f"{path}: integer must be two integers, got {short_text(content)}")
        return Option(1, lambda u: int(low) + int(u[0] * (high - low + 1)))
    if kind == "uniform":
        return Option(1, lambda u: _rounded(low + u[0] * (high - low), unit))
    if low <= 0:
        raise ValueError(f"{path}: log_uniform must be two positive numbers, got {short_text(content)}")
    first, last = logarithm(np.array([low, high]))
    return Option(1, lambda u: _rounded(float(exponential(np.array([first + u[0] * (last - first)]))[0]), unit))


_KINDS = ("uniform", "log_uniform", "integer", "choice")


def _bounds(content, name):
    """Two numbers in increasing order and their unit, "" if they have none."""
    if isinstance(content, list) and len(content) == 2:
        if all(isinstance(bound, int | float) and not isinstance(bound, bool) for bound in content):
            numbers, units = content, {""}
        else:
            matches = [_LENGTH.fullmatch(bound) if isinstance(bound, str) else None for bound in content]
            numbers, units = [bound and bound[1] for bound in matches], {bound and bound[2] for bound in matches}
        try:
            low, high = map(float, numbers)
        except (TypeError, ValueError, OverflowError):  # no number, or an integer of hundreds of digits
            low = high = np.nan
        if len(units) == 1 and low < high and np.isfinite(high - low):
            return low, high, units.pop()
    raise ValueError(
        f'{name} must be two numbers in increasing order, or two lengths such as ["20 a", "60 a"], '
        f"got {short_text(content)}"
    )


def _rounded(number, unit):
    text = f"{number:.{_DIGITS}g}"
    return f"{text} {unit}" if unit else float(text)


def sobol(n: int, width: int, seed: int) -> Floats:
    """First points of a scrambled Sobol' sequence; more points do not change the first ones.

    Returns
    -------
    ndarray
        Coordinates from 0 to 1, shape (n, width).
    """
    if not width:
        return np.empty((n, 0))
    kind = scipy.stats.qmc.Sobol  # loaded here: it takes as long as all else that a study needs
    scrambled_by = "rng" if "rng" in inspect.signature(kind).parameters else "seed"  # since SciPy 1.15
    sequence = kind(width, scramble=True, bits=_BITS, **{scrambled_by: np.random.default_rng(seed)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the balance of a power of 2 is lost on purpose
        return sequence.random(n)


def seed_of(*words: Any) -> int:
    """Seed that is derived from words and numbers, from 0 to 2^31 - 1."""
    digest = hashlib.sha256("/".join(map(str, words)).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1


def samples(options: Mapping[str, Option], n: int, seed: int) -> list[dict[str, Any]]:
    """Values by path of each sample, and its seeds."""
    points = sobol(n, sum(option.width for option in options.values()), seed)
    sampled = []
    for number, coordinates in enumerate(points.tolist()):
        values, first = {}, 0
        for path, option in options.items():
            values[path] = option.value(coordinates[first : first + option.width])
            first += option.width
        sampled.append(values | {path: seed_of(seed, number, path) for path in SEEDS})
    return sampled


def drawn(thing: Any, random: np.random.Generator, name: str) -> Any:
    """A table or list with a drawn value in the place of each range or choice in it."""
    if is_option(thing):
        option = option_of(thing, name)
        return option.value(random.random(option.width).tolist())
    if isinstance(thing, Mapping):
        return {key: drawn(value, random, f"{name}.{key}") for key, value in thing.items()}
    return [drawn(value, random, name) for value in thing] if isinstance(thing, list) else thing


def has_options(thing: Any) -> bool:
    """Whether a table or list contains a range or choice."""
    if is_option(thing):
        return True
    return any(
        map(has_options, thing.values() if isinstance(thing, Mapping) else thing if isinstance(thing, list) else ())
    )
