"""The course of a voltage without the jumps and restarts of an instrument."""

import numpy as np
import pytest
import scipy

from apt_evap.reconstruction.voltage_course import block_means, smoothed, without_jumps

N, WIDTH = 38_000, 680.0
PLACE = np.arange(N) / N
LAYER = scipy.ndimage.gaussian_filter1d(((PLACE > 0.3) & (PLACE < 0.6)).astype(float), WIDTH)
NOISE = 0.002 * np.random.default_rng(1).normal(size=N)


def deviation(voltage, true):
    """Largest relative difference of the course without jumps from the true one, its level aside; and the events."""
    factors, events = without_jumps(voltage, WIDTH)
    ratio = smoothed(voltage * factors, WIDTH) / smoothed(true, WIDTH)
    return np.abs(ratio / np.median(ratio) - 1).max(), events


def test_a_phase_is_no_jump():
    for change in (0.07, -0.1, 1.0):  # 1.0: a layer of twice the field
        factors, events = without_jumps(3000 * (1 + change * LAYER) * (1 + NOISE), WIDTH)
        assert events == 0 and (factors == 1).all()


@pytest.mark.parametrize("factor", [1.04, 0.95, 1.3])
def test_a_jump_is_taken_out(factor):
    true = 3000 * (1 + 0.07 * LAYER)
    found, events = deviation(true * np.where(PLACE > 0.8, factor, 1.0) * (1 + NOISE), true)
    assert events == 1 and found < 0.004


def test_a_restart_is_taken_out_and_the_level_stays():
    true = 3000 * (1 + 0.07 * LAYER)
    since = np.arange(N) - N // 10
    start = np.where(since >= 0, 1 - 0.1 * np.exp(-np.maximum(since, 0) / 200), 1.0)
    found, events = deviation(true * start * (1 + NOISE), true)
    assert events == 1 and found < 0.004
    both, events = deviation(true * start * np.where(PLACE > 0.8, 1.04, 1.0) * (1 + NOISE), true)
    assert events == 2 and both < 0.005


def test_few_ions_and_noise_are_no_jumps():
    assert without_jumps(np.full(10, 3000.0), 3.0)[1] == 0
    rng = np.random.default_rng(2)
    assert without_jumps(3000 * (1 + 0.03 * rng.normal(size=N)), WIDTH)[1] == 0
    means, starts = block_means(np.arange(7.0), 3)
    np.testing.assert_array_equal(means, [1.0, 4.0, 6.0])
    np.testing.assert_array_equal(starts, [0, 3, 6])
