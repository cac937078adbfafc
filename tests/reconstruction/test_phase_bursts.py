"""Bursts in which ions of a phase leave."""

from __future__ import annotations

import numpy as np
import pytest

from apt_evap.reconstruction.phase_bursts import rate_variation

DEPTHS = np.linspace(0, 8, 40_000)
VOLUME = 0.25**3  # windows of 0.1 nm


def members(rate):
    """A part of the ions at random that follows a rate."""
    return np.random.default_rng(2).random(len(DEPTHS)) < rate


@pytest.mark.parametrize("swing", [0.0, 0.3, 0.8, 1.0])
def test_a_rate_that_changes_within_a_plane_varies_by_half_the_changes_of_its_windows(swing):
    wave = 0.1 * (1 + swing * np.sin(2 * np.pi * DEPTHS / 0.25))
    # a sine over 2.5 windows: its mean over a window, and the change from one to the next
    expected = swing / np.sqrt(2) * np.sinc(1 / 2.5) * np.sqrt(1 - np.cos(2 * np.pi / 2.5))
    assert rate_variation(members(wave), DEPTHS, VOLUME, 0.5) == pytest.approx(expected, abs=0.1)  # 50 ions in a window


def test_a_phase_that_leaves_in_every_second_window_varies_by_root_two():
    bursts = 0.2 * (DEPTHS % 0.2 < 0.1)
    assert rate_variation(members(bursts), DEPTHS, VOLUME, 0.5) == pytest.approx(np.sqrt(2), abs=0.03)


def test_a_phase_that_comes_and_goes_does_not_burst_nor_does_what_is_before_the_first_shape():
    sphere = 0.3 * np.maximum(0.0, 1 - ((DEPTHS - 4) / 3) ** 2)
    assert rate_variation(members(sphere), DEPTHS, VOLUME, 0.5) < 0.1
    first = 0.1 + 0.5 * ((DEPTHS < 1) & (DEPTHS % 0.8 < 0.4))
    assert rate_variation(members(first), DEPTHS, VOLUME, 3.0) < 0.06
    thin = 0.2 * (np.abs(DEPTHS - 4) < 0.3)
    assert rate_variation(members(thin), DEPTHS, VOLUME, 0.5) == 0.0  # shorter than ten windows
    assert rate_variation(np.zeros(len(DEPTHS), bool), DEPTHS, VOLUME, 0.5) == 0.0
