"""Types of arrays and paths in signatures."""

import os

import numpy as np
from numpy.typing import NDArray

AnyPath = str | os.PathLike[str]
Booleans = NDArray[np.bool_]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
