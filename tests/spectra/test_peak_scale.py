"""Widths of the peaks of a spectrum: those of Gaussian peaks are found."""

import numpy as np
import pytest

from apt_evap.spectra.peak_scale import PeakScale

PLACES = np.array([12.0, 27.0, 40.0, 58.0, 93.0, 120.0])


@pytest.mark.parametrize(("width", "power"), [(3e-4, 0.0), (1e-3, 0.0), (5e-3, -0.5)])
def test_the_width_of_gaussian_peaks_is_found(rng, width, power):
    mass = np.repeat(PLACES, 4000)
    scale = PeakScale(mass * np.exp(width * mass**power * rng.normal(size=len(mass))))
    # 4,000 ions: 1.1 % a peak by the standard deviation, about twice as much by the half height
    assert scale.sigma(PLACES) == pytest.approx(width * PLACES**power, rel=0.03)
    assert scale.power == pytest.approx(power)
