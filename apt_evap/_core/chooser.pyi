import numpy as np
from numpy.typing import NDArray

from apt_evap._core.octree import Octree

class Chooser:
    def chosen(self, u: float = 0.5) -> int: ...

class Largest(Chooser):
    def __init__(self, tree: Octree, key: NDArray[np.float64]) -> None: ...
