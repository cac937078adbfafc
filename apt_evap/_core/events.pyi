from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apt_evap._core.journal import Journal

class Column(NamedTuple):
    name: str
    dtype: type[np.generic]
    row: tuple[int, ...]
    unit: str | None
    meaning: str

COLUMNS: tuple[Column, ...]
ROW: np.dtype[np.void]

class Events:
    def __init__(self, positions: NDArray[np.float64], max_events: int) -> None: ...
    @property
    def journal(self) -> Journal: ...
    def columns(self) -> dict[str, NDArray[Any]]: ...
