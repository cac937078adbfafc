import numpy as np
from numpy.typing import NDArray

from apt_evap._core.interactions import InteractionLists

class Potentials:
    def __init__(
        self, lists: InteractionLists, gaussian: NDArray[np.float64] | None = None, per_square: float = 1.0
    ) -> None: ...
    @property
    def lists(self) -> InteractionLists: ...
    def of(
        self,
        charges: NDArray[np.float64],
        potential: NDArray[np.float64],
        double_precision: bool = False,
        n_threads: int = 1,
    ) -> None: ...
