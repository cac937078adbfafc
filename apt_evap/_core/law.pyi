from typing import Any

import numpy as np
from numpy.typing import NDArray

BARRIERS: tuple[str, ...]

class LawKernel:
    @property
    def surroundings(self) -> Any: ...
    def begin(self, field_unit: float) -> None: ...
    def evaluate(
        self, strength: NDArray[np.float64], atom: NDArray[np.int64], bonds: NDArray[np.int32]
    ) -> NDArray[np.float64]: ...

class WeightedField(LawKernel):
    def __init__(
        self,
        weight: NDArray[np.float64],
        surroundings: Any = None,
        table: NDArray[np.float64] | None = None,
        species: NDArray[np.int32] | None = None,
    ) -> None: ...

class ThermalRate(WeightedField):
    def __init__(
        self,
        weight: NDArray[np.float64],
        stiffness: NDArray[np.float64],
        log_frequency: float,
        barrier: str,
        reach: float,
        surroundings: Any = None,
        table: NDArray[np.float64] | None = None,
        species: NDArray[np.int32] | None = None,
    ) -> None: ...
    def begin(self, field_unit: float) -> None: ...

class PythonLaw(LawKernel):
    def __init__(self, law: Any, tip: Any) -> None: ...
    def begin(self, field_unit: float) -> None: ...
    @property
    def law(self) -> Any: ...
    @property
    def tip(self) -> Any: ...
