"""Search by local contrast: its evidence, and orientations of maps with lines of either sign."""

from pathlib import Path

import numpy as np
import pytest
import scipy

import apt_evap as ae
from apt_evap.maps.crystallography.directions import poles, zones
from apt_evap.maps.indexing import contrast_search as module
from apt_evap.maps.indexing.contrast_search import (
    PIECES,
    Terms,
    evidence,
    exact_evidence,
    local_contrast,
    refine_contrast,
    terms_of,
)
from apt_evap.maps.indexing.joint_search import CONTRAST, JointSearch
from apt_evap.maps.indexing.master_pattern import HALF, PIXEL, master_patterns, nearest_pixels
from apt_evap.maps.indexing.orientation_search import Start, disc_of, misorientation
from apt_evap.maps.indexing.refine import directions_of
from apt_evap.specimen.symmetry import point_group

SCALE, WIDTH = 60.0, 70.0
FINE = 2.5, 0.07  # steps of the axes [degrees] and of the logarithm of the scale
GROUP = point_group("fcc")
PROPER = GROUP[np.linalg.det(GROUP) > 0]


def map_of_lines(orientation, amplitude, ions=60_000):
    """Counts with bright or dark lines along the zones of a crystal, and a slow change by a factor of 3."""
    edges = np.linspace(-WIDTH / 2, WIDTH / 2, 97)
    middle = (edges[:-1] + edges[1:]) / 2
    x, y = (values.ravel() for values in np.meshgrid(middle, middle))
    directions = ae.detection.Projection(SCALE).directions(np.column_stack([x, y])) @ orientation.matrix
    axes = zones(orientation.material)
    sines = np.abs(directions @ axes.directions[axes.families == 0].T).min(axis=1)
    density = (1 + amplitude * np.exp(-0.5 * (sines / 0.03) ** 2)) * np.exp(np.log(3) * x / WIDTH)
    mask = np.hypot(x, y) < WIDTH / 2
    mean = np.where(mask, density, 0) * (ions / density[mask].sum())
    counts = np.random.default_rng(2).poisson(mean).reshape(96, 96)
    return ae.DetectorMap.from_array(counts, edges, edges, mask.reshape(96, 96), is_counts=True)


def test_the_evidence_is_the_marginal_likelihood():
    """That of y ~ N(0, v (1 + T S^2 T')), integrated over the variance v with the prior 1 / v, by its formula."""
    random = np.random.default_rng(3)
    terms = random.normal(size=(PIECES, 3)) @ np.array([[1.0, 0.4, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 0.5]])
    priors = np.array([0.6, 1.0, 0.3])
    pictures = terms @ np.array([[0.3, 0.0], [-0.2, 0.05], [0.1, 0.0]]) + random.normal(size=(PIECES, 2))
    pictures /= np.sqrt((pictures**2).mean(axis=0))
    covariance = np.eye(PIECES) + (terms * priors**2) @ terms.T
    squares = (pictures * np.linalg.solve(covariance, pictures)).sum(axis=0)
    direct = -PIECES * np.log(squares / PIECES) - np.linalg.slogdet(covariance)[1]
    gram, cross = terms.T @ terms / PIECES, terms.T @ pictures / PIECES
    assert evidence(gram, cross, priors, np.ones(3, bool)) == pytest.approx(direct, abs=1e-6)
    # an amplitude that may not be negative explains nothing where it is
    single = evidence(gram[:1, :1], np.array([[0.4, -0.4]]), priors[:1], np.zeros(1, bool))
    volume = np.log(1 + PIECES * priors[0] ** 2 * gram[0, 0])
    assert single[1] == pytest.approx(-volume) and single[0] > single[1] + 50
    # with amplitudes of any sign both are the same; the best ones that are not negative by trying all sets of zeros
    for k in (0, 1):
        value, _ = exact_evidence(gram, cross[:, k], priors, np.ones(3, bool))
        assert value == pytest.approx(direct[k], abs=1e-6)
    value, amplitudes = exact_evidence(gram, cross[:, 0], priors, np.zeros(3, bool))
    ridge = gram + np.diag(1 / (PIECES * priors**2))
    best = 0.0
    for zeros in range(7):
        free = np.array([not zeros >> k & 1 for k in range(3)])
        trial = np.zeros(3)
        trial[free] = np.linalg.solve(ridge[np.ix_(free, free)], cross[free, 0])
        if (trial >= 0).all():
            best = max(best, trial @ (2 * cross[:, 0] - ridge @ trial))
    assert (amplitudes >= 0).all() and amplitudes @ (2 * cross[:, 0] - ridge @ amplitudes) == pytest.approx(
        best, rel=1e-9
    )


def test_local_contrast_has_no_unit_and_no_slow_change():
    random = np.random.default_rng(4)
    image = 1 + 0.1 * random.random((80, 80))
    mask = np.hypot(*(np.indices((80, 80)) - 39.5)) < 38
    first = local_contrast(image, mask, 1.0, 4.0)
    assert local_contrast(1e6 * image, mask, 1.0, 4.0) == pytest.approx(first, abs=1e-9)
    slow = np.exp(np.indices((80, 80))[0] / 60)  # by 7 % over the wide Gaussian
    inner = np.hypot(*(np.indices((80, 80)) - 39.5)) < 26
    texture = 1 + 0.3 * random.random((80, 80))
    both = local_contrast(texture, mask, 1.0, 4.0), local_contrast(texture * slow, mask, 1.0, 4.0)
    assert np.corrcoef(both[0][inner], both[1][inner])[0, 1] > 0.99
    # ten times as much structure on one side: the same after the division, far from the border
    weaker = local_contrast(1 + (texture - 1) * np.where(np.arange(80) < 40, 1.0, 0.1), mask, 1.0, 4.0)
    left, right = (np.std(weaker[20:60, columns]) for columns in (slice(15, 30), slice(55, 66)))
    assert right > 0.2 * left  # 0.1 before it
    spot = np.zeros((80, 80))
    spot[40, 40] = 1.0
    assert np.isfinite(local_contrast(spot, mask, 1.0, 4.0)).all()
    assert np.abs(local_contrast(np.full((80, 80), 3.0), mask, 1.0, 4.0))[mask].max() < 1e-6
    several = local_contrast(np.stack([image, texture]), mask, 1.0, 4.0)
    assert several[1] == pytest.approx(both[0], abs=1e-9)
    part, used = (slice(30, 52), slice(3, 20)), np.zeros((80, 80), bool)
    used[32:50, 10:18] = True
    whole = local_contrast(texture, mask, 1.0, 4.0, used)
    assert local_contrast(texture, mask, 1.0, 4.0, used, part) == pytest.approx(whole[part], abs=1e-9)


@pytest.mark.parametrize("element", ["W", "Ti"])
def test_lines_and_poles_are_there_in_all_four_quarters_of_the_disc(element):
    material = ae.material(element)
    terms, axes, crystal = terms_of(material), zones(material), poles(material, 1)
    directions = np.random.default_rng(5).normal(size=(400, 3)) * (1, 1, 0) + (0, 0, 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    row, column = nearest_pixels(directions)
    first = 2 * len(master_patterns(material.structure))
    line, pole = terms._images[first, row, column], terms._images[first + axes.families.max() + 1, row, column]
    sines = np.abs(directions @ axes.directions[axes.families == 0].T).min(axis=1)
    angles = np.degrees(np.arccos(np.abs(directions @ crystal.normals.T).max(axis=1)))
    assert (line[sines < 0.01] > 1.85).all() and (line[sines > 0.11] < 1.05).all()
    assert (pole[angles < 0.7] < 0.5).all() and (pole[angles > 12] > 0.9).all()
    # what is filtered is a part of the filtered disc
    inside = np.hypot(*(np.indices((2 * HALF + 1,) * 2) - HALF)) * PIXEL <= np.sqrt(2)
    sizes = np.array([module.NARROW, module.WIDE]) * np.exp(-10 * module._FILTER_STEP) / PIXEL
    whole = local_contrast(terms._images[first : first + 1], inside, *sizes, terms._used)
    part = terms.images(np.exp(-10 * module._FILTER_STEP))[first]
    top, left = terms.corner
    assert part == pytest.approx(whole[0, top : top + part.shape[0], left : left + part.shape[1]], abs=1e-4)


def normalised(terms, disc, matrix, scale):
    """Pictures of the terms in an orientation, with a mean of 0 and a variance of 1."""
    places, areas = module.places_of()
    directions = directions_of(places, disc.radius, scale, 0.0) @ matrix
    pictures = terms.at(directions, disc.radius / scale)[0].astype(float)
    pictures -= (pictures @ areas)[:, None]
    return pictures / np.sqrt(pictures**2 @ areas)[:, None]


def direct_evidence(disc, patterns, matrix, scale):
    """Evidence of an orientation, without Fourier transforms."""
    terms, areas = Terms(ae.material("Ni"), patterns), module.places_of()[1]
    pictures = normalised(terms, disc, matrix, scale)
    cross = (pictures * areas) @ module.picture_of(disc)
    return evidence((pictures * areas) @ pictures.T, cross[:, None], terms.priors, terms.signed)[0]


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [0.6, -0.5])
def test_bright_and_dark_lines_give_the_orientation(amplitude, monkeypatch):
    """The truth has more evidence than all results, and is among them within the steps of a fine search.

    On the coarser grid of `index`, which also has the counts, lines of 1.7 degrees alone give another scale first.
    """
    monkeypatch.setattr("apt_evap.maps.indexing.joint_search.AXIS_STEP", FINE[0])
    monkeypatch.setattr("apt_evap.maps.indexing.joint_search.SCALE_STEP", FINE[1])
    orientation = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    disc = disc_of(map_of_lines(orientation, amplitude))
    patterns = master_patterns("fcc")
    terms, picture = Terms(ae.material("Ni"), patterns), module.picture_of(disc)
    starts = JointSearch(disc, picture, terms, patterns, (45.0, 80.0)).starts(CONTRAST, 8)
    scores = [start.score for start in starts]
    assert len(starts) == 8
    assert scores == sorted(scores, reverse=True)
    assert direct_evidence(disc, patterns, orientation.matrix, SCALE) > scores[0]
    near = [start for start in starts if misorientation(start.matrix, orientation.matrix, PROPER) < 1.5 * FINE[0]]
    assert any(start.scale == pytest.approx(SCALE, rel=FINE[1]) for start in near)
    # refined, they reach the maximum that the truth is refined to, within the width of its peak
    bounds = (40.0, 90.0)
    best = max(refine_contrast(picture, disc.radius, terms, start, bounds).evidence for start in near)
    truth = refine_contrast(picture, disc.radius, terms, Start(orientation.matrix, SCALE, 0.0), bounds)
    assert best > truth.evidence - 5 and truth.evidence > scores[0]
    assert misorientation(truth.matrix, orientation.matrix, PROPER) < 1.5
    assert truth.scale == pytest.approx(SCALE, rel=0.06)


def test_the_search_is_the_direct_evidence(monkeypatch):
    monkeypatch.setattr("apt_evap.maps.indexing.joint_search.AXIS_STEP", 2.0)  # so that one step is near the truth
    orientation = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    disc = disc_of(map_of_lines(orientation, 0.6))
    patterns = master_patterns("fcc")
    terms, picture = Terms(ae.material("Ni"), patterns), module.picture_of(disc)
    search = JointSearch(disc, picture, terms, patterns, (SCALE, SCALE))
    start = search.starts(CONTRAST, 1)[0]
    pictures = normalised(terms, disc, search._turns[7], SCALE)
    ridge = (pictures * module.places_of()[1]) @ pictures.T + np.diag(1 / (PIECES * terms.priors**2))
    assert search._slices[0].ridge[7] == pytest.approx(ridge, abs=2e-3)
    # both take the nearest pixel, of equal directions that are not the same
    direct = direct_evidence(disc, patterns, start.matrix, SCALE)
    assert start.score == pytest.approx(direct, rel=0.1) and start.score > 50


@pytest.mark.slow
def test_a_measured_map_of_nickel_is_decided():
    """Six lines meet at (-9.6, -0.4) mm in a {111} pole, ten poles give 25.8 mm/rad."""
    path = Path(__file__).parents[3] / "shared" / "data" / "ni111_map.npz"
    if not path.exists():
        pytest.skip(f"the measured map {path} is missing")
    found = ae.index(ae.read(path), "Ni")
    assert found.decided
    best = found.best
    poles = best.projection.places(best.orientation.directions(GROUP @ np.ones(3)))
    assert np.nanmin(np.hypot(*(poles - (-9.6, -0.4)).T)) < 1.5
    assert best.projection.scale == pytest.approx(25.8, rel=0.1)


def test_the_filter_is_a_gaussian():
    """By products with matrices, against the filter of SciPy."""
    values, mask = np.random.default_rng(5).random((3, 40, 60)), np.hypot(*(np.indices((40, 60)) - 20)) < 19
    along = 2.0, 3.3
    sums, area = (
        scipy.ndimage.gaussian_filter(image, sigma, mode="constant", truncate=3.0)
        for image, sigma in ((values * mask, (0, *along)), (mask.astype(float), along))
    )
    assert module._mean(values, mask, along) == pytest.approx(sums / np.maximum(area, 1e-6), rel=1e-12)


@pytest.mark.parametrize("element", ["Ni", "Ti"])
def test_equal_directions_are_in_one_triangle(element):
    """Equal by the symmetry of the crystal; one for all directions that are equal; on the pixels that are kept."""
    terms, group = terms_of(ae.material(element)), point_group(ae.material(element).structure)
    directions = np.random.default_rng(6).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    equal = terms.equal(directions)
    apart = np.linalg.norm(np.einsum("gij,nj->gni", group, directions) - equal, axis=2)
    assert apart.min(axis=0).max() < 1e-12
    for member in group:
        assert terms.equal(directions @ member.T) == pytest.approx(equal, abs=1e-12)
    rows, columns = np.subtract(nearest_pixels(equal), np.reshape(terms.corner, (2, 1)))
    shape = terms.images(0.5).shape[1:]
    assert rows.min() >= 0 and columns.min() >= 0 and rows.max() < shape[0] and columns.max() < shape[1]
    assert np.prod(shape) < 0.15 * 321**2  # a part of the disc
