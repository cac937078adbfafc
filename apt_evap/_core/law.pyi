from typing import Any

import numpy as np
from numpy.typing import NDArray

class LawKernel:
    def begin(self, field_unit: float) -> None: ...
    def evaluate(
        self, strength: NDArray[np.float64], atom: NDArray[np.int64], bonds: NDArray[np.int32]
    ) -> NDArray[np.float64]: ...

class WeightedField(LawKernel):
    def __init__(self, weight: NDArray[np.float64]) -> None: ...

class PythonLaw(LawKernel):
    def __init__(self, law: Any, tip: Any) -> None: ...
    @property
    def law(self) -> Any: ...
    @property
    def tip(self) -> Any: ...
