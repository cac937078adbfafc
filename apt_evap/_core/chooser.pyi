from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._core.octree import Octree

class Chooser:
    def chosen(self, u: ArrayLike = 0.5) -> Any: ...
    @property
    def rate(self) -> float: ...

class Largest(Chooser):
    def __init__(self, tree: Octree, key: NDArray[np.float64]) -> None: ...

class RateSum(Chooser):
    def __init__(self, tree: Octree, key: NDArray[np.float64]) -> None: ...
    @property
    def root_error(self) -> float: ...
