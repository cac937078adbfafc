"""Ions as points with data, for the formats of visualisation programs."""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import AnyPath, Booleans, Floats
from apt_evap.detection.hits import Hits
from apt_evap.warnings import DataWarning, warn

_NAMES = {"x": "detector_x", "y": "detector_y"}


def points_and_data(path: AnyPath, hits: Hits) -> tuple[Booleans | slice, Floats, dict[str, NDArray[Any]]]:
    """Selection of the ions to write, their positions (n, 3) [nm], and other columns of numbers or texts, by name.

    Detector coordinates are called detector_x and detector_y.
    """
    (positions,) = hits.require("positions")
    finite = np.isfinite(positions).all(axis=1)
    n_omitted = len(hits) - np.count_nonzero(finite)
    reason = f"{n_omitted:,} of {len(hits):,} ions have positions that are not finite"
    if len(hits) == 0:
        raise ValueError(f"no ion to write to {str(path)!r}: the hits are empty")
    if n_omitted == len(hits):
        raise ValueError(f"no ion to write to {str(path)!r}: {reason}")
    if n_omitted:
        warn(f"ions left out of {str(path)!r}: {reason}", DataWarning)
    chosen = finite if n_omitted else slice(None)
    data = {_NAMES.get(name, name): getattr(hits, name) for name in hits.columns if name != "positions"}
    for name, values in hits.extra.items():
        if is_data(name, values):
            data[distinct(name, data)] = values
    return chosen, positions[chosen], {name: values[chosen] for name, values in data.items()}


def is_data(name: str, values: NDArray[Any]) -> bool:
    """Whether points can have a column: numbers, or one text for each."""
    return values.dtype.kind in "iuf" or (values.dtype.kind == "U" and values.ndim == 1)


def numbered(texts: NDArray[Any]) -> tuple[list[str], NDArray[np.int32]]:
    """Distinct texts in alphabetical order, and the number of that of each ion, int32 (n,)."""
    names, numbers = np.unique(texts, return_inverse=True)
    return names.tolist(), numbers.astype(np.int32)


def distinct(name: str, others: Iterable[str]) -> str:
    """Return a word of letters, digits and underscores that differs from the others."""
    word = re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_") or "column"
    word = "_" + word if word[0].isdigit() else word
    taken = {*others, "species", "pos"}
    number = 2
    unused = word
    while unused in taken:
        unused = f"{word}_{number}"
        number += 1
    return unused
