from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._core.interactions import InteractionLists
from apt_evap._core.octree import Octree

class ChargingRule:
    @property
    def area(self) -> float: ...
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
    def begin(self, point: ArrayLike) -> None: ...
    state: dict[str, Any]
    def field_unit(self, coulomb: float) -> float: ...
    def strengths(self, tree: Octree) -> NDArray[np.float64]: ...
    def residuals(
        self,
        positions: NDArray[np.float64],
        normals: NDArray[np.float64],
        charges: NDArray[np.float64],
        chosen: NDArray[np.int64],
    ) -> NDArray[np.float64]: ...

class FieldRule(ChargingRule): ...

class PythonRule(FieldRule):
    def __init__(self, rule: Any) -> None: ...
    @property
    def rule(self) -> Any: ...
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
