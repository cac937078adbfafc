import numpy as np
from numpy.typing import NDArray

def morton_order(
    positions: NDArray[np.float64], n_threads: int = 1
) -> tuple[NDArray[np.int64], NDArray[np.uint64]]: ...
def split(
    keys: NDArray[np.uint64], leaf_size: int, n_threads: int = 1
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]: ...
