"""Concordance of maps folded about a pole: its limiting cases, its noise, and the energies that it finds."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.fit.comparison import FoldedComparison
from apt_evap.maps.folded_map import symmetric_cells

PLANE = ae.detection.Projection(100.0, compression=1.0)
ORIENTATION = ae.Orientation("W", (0.1, 1.0, 1.05), 25.0)
POLE = ORIENTATION.nearest_pole((0, 1, 1))
SETTINGS = ae.fit.FitSettings(smoothing=0.0, flattening=0.0, resamples=0, objective="folded")


def map_of(height, rng=None, ions=200_000):
    """Lines along the mirror planes, `height` above the ground; with counts for a generator."""
    grid = ae.Detector(width=80.0).grid(160)
    x, y = np.meshgrid(*grid.centres)
    directions = PLANE.directions(np.column_stack([x.ravel(), y.ravel()]))
    a, b, c = np.sort(np.abs(directions @ ORIENTATION.matrix), axis=1).T
    lines = np.exp(-(((c - b) / 0.03) ** 2)) + np.exp(-((a / 0.03) ** 2))
    values = (1 + height * (lines - lines.mean())).reshape(x.shape)
    if rng is not None:
        values = rng.poisson(values / values.sum() * ions)
    return ae.DetectorMap.from_array(values, grid.x_edges, grid.y_edges, is_counts=rng is not None)


def cells_of(map):
    return symmetric_cells(map, PLANE, POLE.direction, POLE.symmetry, POLE.toward, 15.0, 1.0)


def concordance(simulated, measured, settings=SETTINGS):
    """Of two maps; of counts, with the correction for the noise of the measured one."""
    comparison = FoldedComparison(measured, settings, cells_of(measured))
    return comparison.similarity(simulated.values[comparison.box].astype(float))


def test_symmetric_places_have_one_cell():
    map = map_of(0.5)
    cells = cells_of(map)
    x, y = np.meshgrid(*map.centres)
    directions = PLANE.directions(np.column_stack([x.ravel(), y.ravel()]))
    across = np.cross(POLE.direction, POLE.toward)
    u, v, w = directions @ POLE.toward, directions @ across, directions @ POLE.direction
    inside = np.degrees(np.arccos(w)) < 15
    assert np.array_equal(cells.ravel() >= 0, inside)
    for turned in ((-u, v), (u, -v), (-u, -v)):
        moved = np.outer(turned[0], POLE.toward) + np.outer(turned[1], across) + np.outer(w, POLE.direction)
        places = PLANE.places(moved[inside])
        column, row = (np.floor((each + 40) / 0.5).astype(int) for each in places.T)
        there = (column >= 0) & (column < 160) & (row >= 0) & (row < 160)
        # a bin is 0.3 degrees: a place may be that of the next bin, across the edge of a cell
        same = cells.ravel()[inside][there] == cells[row[there], column[there]]
        assert same.mean() > 0.6
    # the quarter of the circle, in cells of a square degree
    assert len(np.unique(cells[cells >= 0])) == pytest.approx(np.pi * 15**2 / 4, rel=0.15)


def test_the_concordance_of_known_contrasts():
    measured = map_of(0.5)
    assert concordance(measured, measured) == pytest.approx(1.0, abs=1e-12)
    # 2 c / (1 + c^2) for c times the contrast, of either sign, and 0 for blur to nothing
    for c in (0.5, 2.0, -1.0):
        assert concordance(map_of(0.5 * c), measured) == pytest.approx(2 * c / (1 + c**2), abs=1e-6)
    assert concordance(map_of(0.0), measured) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_noise_of_the_measured_ions_is_corrected(rng):
    """The mean of 20 measurements of 20,000 ions is 1 within its error, without the correction less than 0.9."""
    truth = map_of(0.5)
    maps = [map_of(0.5, rng, 20_000) for _ in range(20)]
    plain = replace(SETTINGS, allow_noise=False)
    corrected, uncorrected = (np.array([concordance(truth, each, s) for each in maps]) for s in (SETTINGS, plain))
    assert corrected.mean() == pytest.approx(1.0, abs=4 * corrected.std() / np.sqrt(20))
    assert uncorrected.mean() < 0.9


def test_a_small_pole_is_refused():
    measured = map_of(0.5)
    few = np.where(np.arange(160) < 4, cells_of(measured), -1)
    with pytest.raises(ValueError, match="a folded comparison needs 50 cells about the pole, got"):
        FoldedComparison(measured, SETTINGS, few)
