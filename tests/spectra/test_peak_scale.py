"""Widths of the peaks of a spectrum: of Gaussian ones, and of hydrogen; errors of their places."""

import numpy as np
import pytest

from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.peak_scale import PeakScale

PLACES = np.array([12.0, 27.0, 40.0, 58.0, 93.0, 120.0])


@pytest.mark.parametrize(("width", "power"), [(3e-4, 0.0), (1e-3, 0.0), (5e-3, -0.5)])
def test_the_width_of_gaussian_peaks_is_found(rng, width, power):
    mass = np.repeat(PLACES, 4000)
    scale = PeakScale(mass * np.exp(width * mass**power * rng.normal(size=len(mass))))
    # 4,000 ions: 1.1 % a peak by the standard deviation, about twice as much by the half height
    assert scale.sigma(PLACES) == pytest.approx(width * PLACES**power, rel=0.03)
    assert scale.power == pytest.approx(power)


def with_hydrogen(rng, width, factor, number=1000):
    """m/n of common peaks, and of H+ that is broader and has a tail to low masses."""
    mass = np.repeat(PLACES, 4000)
    mass = mass * np.exp(width * rng.normal(size=len(mass)))
    light = 1.008 * np.exp(width * (factor * rng.normal(size=number) - (factor > 1) * rng.exponential(3, number)))
    return np.concatenate([mass, light, (0.8 + 12 * rng.random(2000)) ** 2])


@pytest.mark.parametrize("factor", [3.0, 8.0])
def test_the_width_of_broader_light_peaks_is_their_own(rng, factor):
    scale = PeakScale(with_hydrogen(rng, 5e-4, factor))
    assert scale.light == pytest.approx(factor, rel=0.35)  # its sharper side, of 500 ions and with a part of the tail
    assert scale.sigma(PLACES) == pytest.approx(np.full(6, 5e-4), rel=0.05)
    places = np.array([0.7, 1.008, 2.016, 3.29, 3.31, 58.0])
    assert scale.mass(scale.bins(places)) == pytest.approx(places)
    assert np.diff(scale.bins(places * 1.00001)) == pytest.approx(np.diff(scale.bins(places)), abs=0.1)


def test_light_peaks_that_are_as_broad_as_the_others_have_the_common_width(rng):
    """Up to 1.45 times as broad in 200 random specimens; from 1.5 times they would have their own."""
    assert [PeakScale(with_hydrogen(rng, 5e-4, 1.0, number)).light for number in (100, 300, 1000, 10_000)] == [1.0] * 4


def test_many_points_on_a_smooth_curve_make_the_calibration_sure():
    """Between them the error is theirs; of few points, and of a curve with a bump, it is that of any smooth error."""
    mass = np.array([7.0, 11.0, 28.0, 34.5, 42.0, 70.0, 85.0])
    smooth, bump = 1e-4 * np.log(mass), 4e-3 * np.exp(-((np.log(mass / 28) / 0.4) ** 2))
    errors = []
    for number, curve in ((7, smooth), (7, bump), (5, smooth)):
        calibration = MassCalibration()
        calibration.learn([(m, shift, 1e-4) for m, shift in zip(mass[:number], curve[:number], strict=True)])
        (value,), (error,) = calibration.shift(17.5)
        assert abs(value - np.interp(np.log(17.5), np.log(mass), curve)) < (1e-4 if curve is smooth else 2e-3)
        errors.append(error)
    assert errors == pytest.approx([1.2e-4, 3.0e-4, 3.5e-4], rel=0.1)
