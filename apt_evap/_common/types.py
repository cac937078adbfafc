"""Types of arrays, paths and results in signatures."""

import os
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

AnyPath = str | os.PathLike[str]
Booleans = NDArray[np.bool_]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
# A column that may be missing, None: Any lets a checker accept its use without a test for None, and the test, too.
Column = NDArray[Any] | Any


class Estimated(NamedTuple):
    """A number and its standard deviation."""

    value: float
    """The number."""
    error: float
    """Its standard deviation."""
