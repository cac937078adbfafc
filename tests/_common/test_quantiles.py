"""Quantiles of numbers in parts, compared with NumPy."""

import numpy as np
import pytest

from apt_evap._common.quantiles import quantile


@pytest.mark.parametrize("n", [1, 2, 3, 51, 1000, 20_001])
def test_quantiles_of_parts_are_those_of_numpy(n):
    random = np.random.default_rng(n)
    normal = random.normal(size=n)
    for values in (normal, np.round(normal, 1), np.zeros(n), random.integers(0, 3, n) * 1.0, np.append(normal, 1e9)):
        parts = [values[start : start + 777] for start in range(0, len(values), 777)]
        for share in (0.0, 0.01, 0.5, 0.99, 1.0):
            found = quantile(lambda parts=parts: parts, values.min(), values.max(), share)
            assert found == np.quantile(values, share)
