from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._core.interactions import InteractionLists
from apt_evap._core.octree import Octree
from apt_evap._core.rule import FieldRule

class Robin(FieldRule):
    def __init__(self, tolerance: float, window: int) -> None: ...
    @property
    def tolerance(self) -> float: ...
    @property
    def window(self) -> int: ...
    @property
    def point(self) -> NDArray[np.float64]: ...
    def begin(self, point: ArrayLike) -> None: ...
    state: dict[str, Any]
    def solve(
        self,
        tree: Octree,
        normals: NDArray[np.float64],
        lists: InteractionLists,
        *,
        potential: float,
        tolerance: float,
        max_sweeps: int = 200,
        double_precision: bool = False,
        n_threads: int = 1,
    ) -> tuple[int, float]: ...
    def residuals(
        self,
        positions: NDArray[np.float64],
        normals: NDArray[np.float64],
        charges: NDArray[np.float64],
        chosen: NDArray[np.int64],
    ) -> NDArray[np.float64]: ...
    def iterate(
        self,
        tree: Octree,
        normals: NDArray[np.float64],
        lists: InteractionLists,
        *,
        tolerance: float = 1e-6,
        max_sweeps: int = 200,
        double_precision: bool = False,
        n_threads: int = 1,
    ) -> tuple[int, float]: ...
    def scale(self, tree: Octree, factor: float) -> None: ...
    def keep_inside(self, tree: Octree) -> NDArray[np.float64]: ...
    def distances(self, tree: Octree) -> NDArray[np.float64]: ...
    def mixed(self, maps: list[NDArray[np.float64]], steps: list[NDArray[np.float64]]) -> NDArray[np.float64]: ...
