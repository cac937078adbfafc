"""Counter-based random numbers: hashes of integers, independent of the order in which they are computed."""

from typing import Any

import numpy as np

GAMMA = np.uint64(0x9E3779B97F4A7C15)
"""Increment of SplitMix64."""
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)


def mix(z: Any) -> Any:
    """Finalizer of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), on an array of uint64."""
    z = (z ^ (z >> np.uint64(30))) * _FIRST
    z = (z ^ (z >> np.uint64(27))) * _SECOND
    return z ^ (z >> np.uint64(31))


def open_interval(bits: Any) -> Any:
    """Numbers in (0, 1) from an array of uint64 with random bits."""
    return ((bits >> np.uint64(12)) + 0.5) * 2.0**-52
