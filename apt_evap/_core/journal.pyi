import numpy as np
from numpy.typing import NDArray

from apt_evap._core.octree import Octree

class Journal:
    def __init__(self, positions: NDArray[np.float64], max_events: int) -> None: ...
    @property
    def n_events(self) -> int: ...
    def replay_on(self, tree: Octree, event: int) -> None: ...
