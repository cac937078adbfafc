"""Stars of drawn lines, which need no crystal, and maps that are such stars."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.maps.indexing import drawn_star as module
from apt_evap.maps.indexing.contrast_search import picture_of, places_of
from apt_evap.maps.indexing.drawn_star import best_star
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.maps.indexing.orientation_search import AZIMUTHS, RINGS, disc_of, flattened_by_rings

DATA = Path(__file__).parents[3] / "shared" / "data"


def drawn(azimuths, point=(0.0, 0.0), *, height=1.0, ions=40_000, seed=1, radius=30.0):
    """A map of bright lines through a point in radii."""
    edges = np.linspace(-radius, radius, 101)
    middle = (edges[1:] + edges[:-1]) / 2 / radius
    x, y = np.meshgrid(middle, middle)
    density = np.ones_like(x)
    for azimuth in azimuths:
        distance = (x - point[0]) * math.sin(azimuth) - (y - point[1]) * math.cos(azimuth)
        density += height * np.exp(-0.5 * (distance / 0.04) ** 2)
    mask = np.hypot(x, y) < 1
    counts = np.random.default_rng(seed).poisson(np.where(mask, density * ions / density[mask].sum(), 0))
    return ae.DetectorMap.from_array(counts, edges, edges, mask, is_counts=True)


def star_of(map):
    return best_star(picture_of(flattened_by_rings(disc_of(map))))


@pytest.mark.parametrize("point", [(0.0, 0.0), (0.31, -0.22)])
def test_a_drawn_star_is_found(point):
    star = star_of(drawn(0.3 + np.arange(4) * math.pi / 4, point))
    assert star.evidence > 200 and star.lines >= 4
    # the disc is 4 % smaller than the map
    assert star.point == pytest.approx(np.array(point) / 0.96, abs=0.02)


def test_noise_is_no_star_and_a_crystal_is_more_than_one():
    assert star_of(drawn([])).evidence < 10
    orientation = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    map = master_patterns("fcc")[0].map(
        orientation, ae.detection.Projection(60.0), 70.0, ions=40_000, rolled=0.5, seed=1
    )
    assert star_of(map).evidence < 120  # of its patterns: more than 300


def test_products_with_all_lines_are_the_direct_ones():
    """Of a picture with lines of every distance, turned to an azimuth, by Fourier transforms and by sums."""
    places, areas = places_of()
    picture = np.random.default_rng(2).normal(size=len(places))
    pictures, spectra = module._lines()
    spectrum = np.fft.rfft((picture * areas).reshape(RINGS, AZIMUTHS), axis=1)
    products = np.fft.irfft((spectra * spectrum).sum(axis=2), AZIMUTHS, axis=2)
    turn, offset, width = 7, 61, 1
    angle = turn * 2 * math.pi / AZIMUTHS
    distance = places @ [-math.sin(angle), math.cos(angle)] - module._OFFSETS[offset]
    line = module._normal(module._line(distance, module.WIDTHS[width]))
    assert products[width, offset, turn] == pytest.approx(line @ (picture * areas), abs=1e-9)
    turned = module._turned(pictures[width], np.full(AZIMUTHS // 2, offset))[turn]
    assert turned == pytest.approx(line, abs=1e-9)


def test_more_lines_cost_more():
    costs = [module._cost(lines) for lines in range(1, 7)]
    assert (np.diff(costs) > 4).all() and costs[0] == pytest.approx(
        2 * math.log(math.pi / 0.07**2 * 4 * 2 * math.pi / 0.07)
    )


@pytest.mark.slow
@pytest.mark.parametrize("lines", [2, 3])
def test_drawn_stars_are_no_crystals(lines):
    """Both are preferred to other orientations by more than 20."""
    found = ae.index(drawn(0.3 + np.arange(lines) * math.pi / lines), "Ni")
    assert not found.decided and "without a crystal" in found.reason
    numbers = re.search(r"evidence (\d+) .* and (-?\d+) .* where (\d+) more", found.reason)
    of_lines, of_crystal, more = map(int, numbers.groups())
    assert of_lines + more > of_crystal and ("better than" in found.reason) == (of_lines > of_crystal)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "W_tap.raw").exists(), reason="needs the measured tungsten, which is not distributed")
@pytest.mark.filterwarnings("ignore:.*1 of 66,388 ions lies far outside:apt_evap.warnings.DataWarning")
def test_a_narrow_view_of_a_bright_cross_does_not_decide():
    """It fits [001] better than the true [011], by 34, and lines without a crystal better than both."""
    ions = ae.read(DATA / "W_tap.raw").with_masses(316.67, -7.3).window(mass_to_charge=(58.59, 62.27))
    found = ae.index(ions.within_circle(50.0), "W", distance=316.67)
    assert not found.decided and "without a crystal" in found.reason
