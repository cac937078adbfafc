"""Gains of the densities of a pattern over drawn lines, the turned pattern and other crystals."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.maps.gains import DensityGains
from apt_evap.maps.indexing.master_pattern import master_patterns

PROJECTION = ae.detection.Projection(60.0)
ORIENTATION = ae.Orientation("Ni", axis=(1, 1, 1), rotation=20.0)


def densities(structure="fcc", matrix=ORIENTATION.matrix):
    return lambda directions: master_patterns(structure)[0].at(directions @ matrix, sigma=0.6)


def drawn(density, ions=150_000):
    """A map of a density of directions in the specimen."""
    edges = np.linspace(-25, 25, 81)
    middle = (edges[1:] + edges[:-1]) / 2
    x, y = np.meshgrid(middle, middle)
    values = density(PROJECTION.directions(np.column_stack([x.ravel(), y.ravel()]))).reshape(x.shape)
    mask = np.hypot(x, y) < 25
    counts = np.random.default_rng(0).poisson(np.where(mask, values * ions / values[mask].sum(), 0))
    return ae.DetectorMap.from_array(counts, edges, edges, mask, is_counts=True)


def gains(map, pattern=None, **options):
    return ae.maps.density_gains(map, ORIENTATION, PROJECTION, pattern or densities(), (1, 1, 1), **options)


def test_the_pattern_itself_is_alike_and_others_are_not():
    map = drawn(lambda directions: densities()(directions)[1])
    found = gains(map, others=[densities("bcc")])
    assert found.level == "alike" and found.correlation > 0.8
    assert str(found).startswith("alike")
    # turned by 60 degrees about [111], it is the other hand of the pole
    turned = ae.Orientation("Ni", axis=(1, 1, 1), rotation=80.0)
    found = gains(map, densities(matrix=turned.matrix))
    assert found.level == "none" and found.over_turned < -3 and np.isnan(found.over_others)


def test_drawn_lines_are_better_drawn():
    """A map of a line along one family of zones, bright: lines explain it, and a pattern does not better."""
    zones = ae.maps.zones("Ni")
    members = zones.directions[zones.families == 0]

    def lines(directions):
        distance = np.degrees(np.arcsin(np.abs(directions @ ORIENTATION.matrix @ members.T).min(axis=1)))
        return 1 + 0.6 * np.exp(-0.5 * distance**2)

    found = gains(drawn(lines))
    assert found.over_lines < -3 and found.level != "alike"


def test_noise_reaches_no_level():
    found = gains(drawn(lambda directions: np.ones(len(directions))), others=[densities("bcc")])
    assert found.level == "none" and abs(found.over_turned) < 3 and abs(found.correlation) < 0.2


@pytest.mark.parametrize(
    "numbers, level",
    [
        ((4, 4, 4), "alike"),
        ((2, 4, 4), "same orientation"),
        ((-1, 4, 4), "same orientation"),
        ((9, 4, 2), "orientation about the pole"),
        ((9, 2, 9), "none"),
        ((9, 9, np.nan), "orientation about the pole"),
    ],
)
def test_levels(numbers, level):
    assert DensityGains(0.5, *numbers).level == level


def test_bad_input():
    map = drawn(lambda directions: np.ones(len(directions)))
    with pytest.raises(ValueError, match="rotational symmetry"):
        ae.maps.density_gains(map, ORIENTATION, PROJECTION, densities(), (1, 1, 3))
    with pytest.raises(ValueError, match="at least 300 bins within 5 degrees"):
        ae.maps.density_gains(map, ORIENTATION, ae.detection.Projection(9.0), densities(), (1, 1, 1), reach=5)
