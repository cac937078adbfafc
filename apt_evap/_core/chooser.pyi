import numpy as np
from numpy.typing import NDArray

from apt_evap._core.octree import Octree

class Tournament:
    def __init__(self, tree: Octree, rank: NDArray[np.float64]) -> None: ...
