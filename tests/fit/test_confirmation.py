"""Maps are alike only if their folded maps correlate and their lines have the same sign; numbers with their digits."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.digits import decimals_for, rounded_text
from apt_evap.fit.confirmation import LEAST_CORRELATION, confirmed, lines_of_other_sign
from apt_evap.fit.structure import Structure
from apt_evap.fit.study import bounded_text
from apt_evap.maps.folded_map import folded
from apt_evap.maps.pole_profiles import pole_profile
from apt_evap.maps.registration.verdict import Likeness, likeness
from apt_evap.maps.rings import RINGS, ring_statistics

EDGES = np.linspace(-40, 40, 161)
X, Y = np.meshgrid(*[(EDGES[1:] + EDGES[:-1]) / 2] * 2)
PROJECTION, POLE, TOWARD = ae.detection.Projection(90.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)  # 25 degrees at the rim
HERE = ae.Registration(0.0, 1.0, (0.0, 0.0))
ALIKE = Likeness("alike", 0.9, float("nan"), "their symmetries agree")


def lines(sign, *, seed=None):
    """A map with a pole and three lines, bright or dark."""
    density = 1.2 - 0.8 * np.exp(-(X**2 + Y**2) / 20)
    for azimuth in np.radians((0, 120, 240)):
        along, across = X * np.cos(azimuth) + Y * np.sin(azimuth), Y * np.cos(azimuth) - X * np.sin(azimuth)
        density = density + sign * 0.5 * np.exp(-((across / 2.5) ** 2) / 2) / (1 + np.exp(-along))
    density = np.clip(density, 0.05, None)
    counts = np.random.default_rng(seed).poisson(density * 400_000 / density.sum())
    return ae.DetectorMap.from_array(counts, EDGES, EDGES, mask=X**2 + Y**2 < 39**2, is_counts=True)


def structure(map):
    rings = ring_statistics(map, PROJECTION, POLE, RINGS, fold=3, sectors=36)
    whole = folded(map, PROJECTION, POLE, "3m", TOWARD, reach=RINGS[-1][1])
    return Structure(tuple(rings), pole_profile(map, PROJECTION, POLE), whole)


@pytest.mark.slow
def test_lines_of_the_other_sign_are_not_alike():
    """The symmetry alone calls bright and dark lines alike."""
    bright, same, dark = lines(1.0, seed=1), lines(0.8, seed=2), lines(-1.0, seed=3)
    assert likeness(dark, bright, HERE).verdict == likeness(same, bright, HERE).verdict == "alike"
    first, second, third = map(structure, (bright, same, dark))
    assert confirmed(ALIKE, second, first) is ALIKE and not lines_of_other_sign(second, first)
    assert len(lines_of_other_sign(third, first)) == len(RINGS)
    assert confirmed(ALIKE, third, first).verdict == "doubtful"
    # also where the folded maps correlate, such as by the pole and other rings
    part = third._replace(folded=second.folded, rings=(*second.rings[:2], third.rings[2]))
    assert part.correlation(first) > LEAST_CORRELATION and confirmed(ALIKE, part, first).verdict == "doubtful"


def test_alike_needs_folded_maps_that_correlate():
    first, second = structure(lines(1.0, seed=1)), structure(lines(1.0, seed=2))
    noise = np.random.default_rng(0).poisson(30, (161 - 1, 161 - 1))
    unrelated = structure(ae.DetectorMap.from_array(noise, EDGES, EDGES, mask=X**2 + Y**2 < 39**2, is_counts=True))
    assert confirmed(ALIKE, second._replace(folded=unrelated.folded), first).verdict == "doubtful"
    assert confirmed(ALIKE, second._replace(folded=None), first).verdict == "doubtful"
    faint = second._replace(folded=structure(lines(0.1, seed=2)).folded)
    assert 0.1 < faint.correlation(first) < LEAST_CORRELATION and confirmed(ALIKE, faint, first).verdict == "doubtful"
    assert confirmed(ALIKE, None, None).verdict == "doubtful"
    for verdict in ("doubtful", "not alike"):  # it never makes maps alike
        by_symmetry = ALIKE._replace(verdict=verdict)
        assert confirmed(by_symmetry, second, first) is by_symmetry


def test_a_faint_measured_line_decides_nothing():
    first, third = structure(lines(1.0, seed=1)), structure(lines(-1.0, seed=3))
    faint = first._replace(rings=tuple(replace(ring, contrast=0.01, error=0.02) for ring in first.rings))
    assert lines_of_other_sign(third, faint) == []


@pytest.mark.parametrize("value, error, text", [
    (77.413, 48.0, "80"), (77.413, 3.0, "77.4"), (77.413, 6.0, "77"),
    (0.16634, 0.0321, "0.166"), (0.16634, 0.04, "0.17"),
    (1234.5, 99.6, "1230"), (1234.5, 0.0, "1230"), (77.413, float("nan"), "77.4"), (-0.001, 0.2, "0.00"),
])  # fmt: skip
def test_digits_are_those_of_the_error(value, error, text):
    assert rounded_text(value, error) == text


def test_rounding_is_small_beside_the_error():
    for error in np.geomspace(1e-4, 1e4, 1000):
        assert 10.0 ** -decimals_for(error) / 2 < error / 7


def test_digits_of_a_value_and_its_interval():
    assert bounded_text(0.48512, (0.31234, 0.62345)) == "0.49 (0.31 to 0.62)"
    assert bounded_text(0.48512, (0.1, 0.9)) == "0.5 (0.1 to 0.9)"
    assert bounded_text(0.2, (0.10, 0.30), (True, False), 10.0) == "2.0 (at most 1.0 to 3.0)"
