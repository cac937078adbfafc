from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._core.chooser import Chooser
from apt_evap._core.control import Control
from apt_evap._core.events import Events
from apt_evap._core.law import LawKernel
from apt_evap._core.neighbourhood import Neighbourhood
from apt_evap._core.octree import Octree
from apt_evap._core.rule import ChargingRule

DONE: int
SWEEP_DUE: int
EXHAUSTED: int
TOO_SHALLOW: int

class Start:
    def __init__(
        self,
        n_removed: int,
        charges: NDArray[np.float64],
        lonely: NDArray[np.int64],
        lonely_normals: NDArray[np.float64],
        rule_state: dict[str, Any],
    ) -> None: ...
    @property
    def n_removed(self) -> int: ...
    @property
    def charges(self) -> NDArray[np.float64]: ...
    @property
    def lonely(self) -> NDArray[np.int64]: ...
    @property
    def lonely_normals(self) -> NDArray[np.float64]: ...
    @property
    def rule_state(self) -> dict[str, Any]: ...

class Evaporation:
    def __init__(
        self,
        atoms: Neighbourhood,
        rule: ChargingRule,
        law: LawKernel,
        potential: float,
        coulomb: float,
        patch_radius: float,
        update_radius: float,
        opening_angle: float,
        seed: int = 0,
        control: Control | None = None,
        target_stretch: float = 1.0,
    ) -> None: ...
    @property
    def atoms(self) -> Neighbourhood: ...
    @property
    def tree(self) -> Octree: ...
    @property
    def rule(self) -> ChargingRule: ...
    @property
    def law(self) -> LawKernel: ...
    @property
    def potential(self) -> float: ...
    @property
    def coulomb(self) -> float: ...
    @property
    def field_unit(self) -> float: ...
    @property
    def patch_radius(self) -> float: ...
    @property
    def update_radius(self) -> float: ...
    @property
    def opening_angle(self) -> float: ...
    @property
    def n_removed(self) -> int: ...
    @property
    def since_relaxation(self) -> int: ...
    @property
    def control(self) -> Control: ...
    @property
    def target_stretch(self) -> float: ...
    @property
    def seed(self) -> int: ...
    @property
    def chooser(self) -> Chooser: ...
    def log_rate_at(self, voltage_factor: float, n_threads: int = 1) -> float: ...
    n_clipped: int
    n_unsettled: int
    @property
    def start(self) -> Start: ...
    def take_over(self, atoms: Neighbourhood, law: LawKernel) -> None: ...
    def relax(
        self,
        *,
        tolerance: float = 1e-4,
        max_sweeps: int = 200,
        double_precision: bool = False,
        extra: int = 0,
        opening_angle: float = 0.0,
        n_threads: int = 1,
        start: Start | None = None,
    ) -> tuple[int, float]: ...
    def start_here(self, surface: NDArray[np.int64], n_threads: int = 1) -> Start: ...
    def evaporate(self, events: Events, sweep_interval: int) -> int: ...
    @property
    def next_slot(self) -> int: ...
    @property
    def slots(self) -> NDArray[np.int64]: ...
    @property
    def slot_normals(self) -> NDArray[np.float64]: ...
    @property
    def slot_fields(self) -> NDArray[np.float64]: ...
