from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._core.interactions import InteractionLists
from apt_evap._core.octree import Octree
from apt_evap._core.potentials import Potentials
from apt_evap._core.rule import FieldRule

LATTICE_SUM: float
ROUGH_ANGLE: float
ROUGH_ERROR: float

def gaussian_table(eta: float) -> tuple[NDArray[np.float64], float]: ...

class ConstantPotential(FieldRule):
    def __init__(self, self_term: float, gaussian: bool, sees_others: bool, tolerance: float) -> None: ...
    @property
    def tolerance(self) -> float: ...
    @property
    def self_term(self) -> float: ...
    @property
    def gaussian(self) -> bool: ...
    @property
    def sees_others(self) -> bool: ...
    @property
    def n_iterations(self) -> int: ...
    @property
    def potentials(self) -> NDArray[np.float64]: ...
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
    def field_unit(self, coulomb: float) -> float: ...
    def preconditioned(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def effective_area(self, tree: Octree) -> float: ...
    def correct(
        self,
        rough: Potentials,
        change: NDArray[np.float64],
        residuals: NDArray[np.float64],
        mean: float,
        tolerance: float,
        sweeps: int,
        max_sweeps: int,
        double_precision: bool,
        n_threads: int,
    ) -> tuple[int, float]: ...
    def multiply(
        self,
        sums: Potentials,
        charges: NDArray[np.float64],
        image: NDArray[np.float64],
        double_precision: bool,
        n_threads: int,
    ) -> None: ...
    def indefinite(self) -> str: ...
    def fields_of(self, tree: Octree, lists: InteractionLists, n_threads: int) -> None: ...
    def residuals(
        self,
        positions: NDArray[np.float64],
        normals: NDArray[np.float64],
        charges: NDArray[np.float64],
        chosen: NDArray[np.int64],
    ) -> NDArray[np.float64]: ...
