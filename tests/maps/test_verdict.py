"""Whether two maps show the same crystal: maps with lines of known symmetry, dark or bright, with noise."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.maps.registration.verdict import ALIKE, likeness

EDGES = np.linspace(-40, 40, 97)
HERE = ae.Registration(0.0, 1.0, (0.0, 0.0))
X, Y = np.meshgrid(*[(EDGES[1:] + EDGES[:-1]) / 2] * 2)


def lines(azimuths, *, sign=1.0, width=2.5, centre=(0.0, 0.0), ions=None, seed=0):
    """A map with a dark pole, and half lines from it at these azimuths [degrees]."""
    x, y = X - centre[0], Y - centre[1]
    density = 1.2 - 0.8 * np.exp(-(x**2 + y**2) / 50)
    for azimuth in np.radians(azimuths):
        along, across = x * np.cos(azimuth) + y * np.sin(azimuth), y * np.cos(azimuth) - x * np.sin(azimuth)
        density = density + sign * 0.5 * np.exp(-((across / width) ** 2) / 2) / (1 + np.exp(-along))
    density = np.clip(density, 0.05, None)
    counts = None
    if ions is not None:
        counts = np.random.default_rng(seed).poisson(density * ions / density.sum())
    mask = X**2 + Y**2 < 39**2
    values = density if counts is None else counts
    return ae.DetectorMap.from_array(values, EDGES, EDGES, mask=mask, is_counts=counts is not None)


THREE, SIX, CROSS = (10, 130, 250), tuple(range(10, 370, 60)), (35, 145, 215, 325)


def test_the_same_crystal_is_alike_if_its_lines_are_dark_wide_noisy_or_turned():
    simulated = lines(THREE, ions=12_000)
    for measured in (
        lines(THREE),
        lines(THREE, sign=-0.8, ions=60_000, seed=1),
        lines(THREE, width=4.0, ions=60_000, seed=2),
        lines(np.add(THREE, 25), ions=60_000, seed=3),  # the symmetry does not depend on the registered rotation
    ):
        found = likeness(simulated, measured, HERE)
        assert found.verdict == "alike" and found.symmetry > ALIKE
        assert np.isnan(found.halves) == (not measured.is_counts)


@pytest.mark.parametrize("other", [CROSS, (0, 180), (0, 90, 180, 270), (10, 70, 170)])
def test_another_crystal_is_not_alike(other):
    found = likeness(lines(THREE, ions=12_000), lines(other, ions=60_000, seed=1), HERE)
    assert found.verdict != "alike" and found.symmetry < ALIKE


def test_a_doubtful_registration_makes_the_verdict_doubtful():
    simulated, measured = lines(THREE, ions=12_000), lines(THREE, ions=60_000, seed=1)
    searched = replace(HERE, method="search", score=0.3, overlap=1.0)
    found = likeness(simulated, measured, searched)
    assert found.verdict == "doubtful" and found.symmetry > ALIKE and "start" in found.reason
    assert likeness(simulated, measured, replace(searched, score=0.8)).verdict == "alike"
    assert likeness(simulated, measured, replace(searched, method="start")).verdict == "alike"


def test_a_map_without_lines_or_of_noise_is_not_alike():
    simulated = lines(THREE, ions=12_000)
    for measured in (lines(()), lines((), ions=60_000), lines(THREE, ions=300)):
        assert likeness(simulated, measured, HERE).verdict != "alike"
    assert likeness(simulated, lines(THREE, ions=300), HERE).halves < ALIKE


def test_the_axis_decides_where_the_symmetry_is_measured():
    simulated, measured = lines(SIX, ions=12_000), lines(SIX, centre=(12.0, -9.0), ions=60_000)
    moved = ae.Registration(0.0, 1.0, (12.0, -9.0))
    seen = moved.hits(_ions_of(simulated)).map(like=measured, position_step=None)
    assert likeness(seen, measured, moved).verdict == "alike"
    assert likeness(simulated, measured, HERE).verdict != "alike"
    outside = likeness(simulated, measured, ae.Registration(0.0, 1.0, (60.0, 0.0)))
    assert outside.verdict == "doubtful" and np.isnan(outside.symmetry)


def _ions_of(map):
    """Ions at the centres of the bins of a map."""
    return ae.Hits(x=np.repeat(X.ravel(), map.counts.ravel()), y=np.repeat(Y.ravel(), map.counts.ravel()))


def test_maps_on_other_bins_are_refused():
    with pytest.raises(ValueError, match="simulated"):
        likeness(ae.DetectorMap.from_array(np.ones((9, 9)), EDGES[:10], EDGES[:10]), lines(SIX), HERE)


def test_the_first_place_with_enough_around_it_counts():
    simulated, measured = lines(THREE, centre=(8.0, 5.0), ions=12_000), lines(THREE, centre=(8.0, 5.0), ions=60_000)
    assert likeness(simulated, measured, HERE).verdict != "alike"  # the axis has no symmetry
    about = [(38.0, 0.0), (8.0, 5.0), (0.0, 0.0)]  # the first one is at the rim
    assert likeness(simulated, measured, HERE, about=about).verdict == "alike"
    assert likeness(simulated, measured, HERE, about=about[:1]).verdict == "doubtful"
    for wrong in ([], [(1.0,)], "pole"):
        with pytest.raises(ValueError, match="about"):
            likeness(simulated, measured, HERE, about=wrong)
