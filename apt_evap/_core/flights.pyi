import numpy as np
from numpy.typing import NDArray

from apt_evap._core.journal import Journal
from apt_evap._core.octree import Octree

LEFT: int
NEVER_LEFT: int

class Flights:
    def __init__(
        self,
        tree: Octree,
        *,
        coulomb: float,
        length: float,
        centre: tuple[float, float, float],
        reach: float,
        opening_angle: float,
        tolerance: float,
        max_steps: int,
    ) -> None: ...
    @property
    def n_steps(self) -> int: ...
    @property
    def n_evaluations(self) -> int: ...
    @property
    def n_pairs(self) -> int: ...
    def begin(self, tree: Octree) -> None: ...
    def follow(self, journal: Journal) -> None: ...
    def fly(
        self,
        journal: Journal,
        event: NDArray[np.int64],
        start: NDArray[np.int64],
        positions: NDArray[np.float64],
        velocities: NDArray[np.float64],
        end: NDArray[np.float64],
        outcome: NDArray[np.int8],
        counter: NDArray[np.int64],
        halt: NDArray[np.int64],
    ) -> None: ...
