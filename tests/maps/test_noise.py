"""The number of hits behind a map of densities, told from its noise."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.maps.noise import effective_ions

EDGES = np.linspace(-20, 20, 101)
X, Y = np.meshgrid((EDGES[1:] + EDGES[:-1]) / 2, (EDGES[1:] + EDGES[:-1]) / 2)


@pytest.mark.parametrize("mean", [4.0, 50.0, 2000.0])
def test_the_number_of_hits_is_told(rng, mean):
    """Of maps with broad structures and one line of three bins; 4 hits per bin to 2,000."""
    expected = mean * (1 + 0.5 * np.cos(X / 4) * np.sin(Y / 5)) * np.where(np.abs(X + Y) < 0.9, 1.5, 1.0)
    counts = rng.poisson(expected)
    densities = ae.DetectorMap.from_array(counts / counts.max(), EDGES, EDGES, mask=np.hypot(X, Y) < 18)
    # 6,000 bins: 3 %, and the structure raises the noise by its own second difference
    assert effective_ions(densities) == pytest.approx(counts[densities.mask].sum(), rel=0.12 if mean < 1000 else 0.4)


def test_no_noise_is_an_infinite_number_of_hits():
    assert effective_ions(ae.DetectorMap.from_array(np.ones_like(X), EDGES, EDGES)) == np.inf
    # a plane has no second difference but rounding
    assert effective_ions(ae.DetectorMap.from_array(X - X.min() + 1, EDGES, EDGES)) > 1e20


def test_smoothed_and_small_maps_are_refused(rng):
    map = ae.DetectorMap.from_array(rng.poisson(20.0, X.shape), EDGES, EDGES, is_counts=True)
    with pytest.raises(ValueError, match="map"):
        effective_ions(map.smoothed(1.0))
    small = ae.DetectorMap.from_array(np.ones((5, 5)), np.arange(6.0), np.arange(6.0))
    with pytest.raises(ValueError, match="at least 50 bins with eight neighbours, got 9"):
        effective_ions(small)
