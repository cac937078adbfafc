"""Local composition: contents, contrast against counting noise, slopes without its bias, and planes beyond the rim."""

import numpy as np
import pytest
import scipy

from apt_evap.reconstruction import local_composition as module
from apt_evap.reconstruction.beyond_view import Feature, continued
from apt_evap.reconstruction.local_composition import (
    contents,
    core_of,
    local_composition,
    noise_free_slopes,
    solute_contrast,
)

VOLUME = 0.033  # nm^3 per detected ion


def alloy(matrix, phase, n=30_000, seed=1):
    """Ions in a box of 10 x 10 nm with a layer 2.4 nm thick, which are of a solute, and halves of them."""
    rng = np.random.default_rng(seed)
    height = n * VOLUME / 100
    positions = rng.random((n, 3)) * (10, 10, height) - (5, 5, 0)
    positions = positions[np.argsort(-positions[:, 2])]  # in sequence
    layer = np.abs(positions[:, 2] - height / 2) < 1.2
    solute = rng.random(n) < np.where(layer, phase, matrix)
    return positions, layer, solute, rng.integers(0, 2, n).astype(bool)


def test_the_variance_of_a_composition_is_that_of_its_neighbours():
    positions, _, solute, halves = alloy(0.2, 0.2)
    found = local_composition(positions, solute, halves, 60, VOLUME)
    inside = (np.abs(positions[:, :2]) < 4).all(axis=1) & (np.abs(positions[:, 2] - 5) < 3.5)
    # 60 draws; the cells of the grid are not part of a Gaussian: 10 %
    assert found.all[inside].var() == pytest.approx(0.2 * 0.8 / 60, rel=0.15)
    assert found.all[inside].mean() == pytest.approx(0.2, abs=0.01)
    # the halves are independent: their covariance is less than a tenth of their variance
    assert abs(np.cov(found.first[inside], found.second[inside])[0, 1]) < 0.1 * found.first[inside].var()


@pytest.mark.parametrize(("phase", "is_seen"), [(0.02, False), (0.1, True), (0.4, True)])
def test_a_contrast_is_seen_if_it_is_larger_than_its_noise(phase, is_seen):
    positions, _, solute, halves = alloy(0.02, phase)
    contrast = solute_contrast(positions, solute, halves, VOLUME)
    assert contrast.is_seen == is_seen
    if is_seen:
        assert contrast.matrix == pytest.approx(0.02, abs=0.006)  # 5 standard deviations of 60 neighbours' mean
        assert contrast.phase == pytest.approx(phase, rel=0.2)  # a third of the layer is within the Gaussian of an edge
        assert contrast.contrast > 10
    else:
        assert abs(contrast.contrast) < 2.5  # standard normal without a contrast


@pytest.mark.parametrize("phase", [0.06, 0.2, 0.4])
def test_contents_are_those_of_the_matrix_and_the_phase_without_their_interface(phase):
    differences = []
    for seed in range(3):
        positions, _, solute, halves = alloy(0.02, phase, n=20_000, seed=seed)
        neighbours = solute_contrast(positions, solute, halves, VOLUME).neighbours
        found = local_composition(positions, solute, halves, neighbours, VOLUME)
        matrix, content, error = contents(positions, solute, halves, found, neighbours, VOLUME)
        assert matrix == pytest.approx(0.02, abs=0.004)  # 4 standard deviations of 15,000 ions
        # the layer has 7,300 ions; its core of neighbours has half of them or less, each counted once
        assert np.sqrt(phase * (1 - phase) / 7300) < error < np.sqrt(phase * (1 - phase) / 400)
        differences.append((content - phase) / error)
    # a mixture of two binomials alone gives 0.17 to 0.18 for 0.2, and 0.35 to 0.36 for 0.4
    assert abs(np.mean(differences)) < 1.5 and np.abs(differences).max() < 3.5


@pytest.mark.parametrize(("matrix", "phase"), [(0.02, 0.06), (0.02, 0.4), (0.3, 0.9)])
def test_contents_of_counts_are_those_of_two_binomials_of_the_greatest_likelihood(matrix, phase):
    rng = np.random.default_rng(8)
    counts = rng.binomial(250, np.where(rng.random(20_000) < 0.1, phase, matrix))
    low, high = module._two_binomials(counts / 250, 250)
    errors = (np.sqrt(one * (1 - one) / 250 / ions) for one, ions in ((matrix, 18_000), (phase, 2000)))
    assert [low, high] == [
        pytest.approx(one, abs=4 * error) for one, error in zip((matrix, phase), errors, strict=True)
    ]

    def likelihood(low, high):
        lower, upper = (scipy.stats.binom.pmf(counts, 250, one) for one in (low, high))
        return np.log(0.9 * lower + 0.1 * upper).sum()

    assert all(likelihood(low, high) > likelihood(low, high + step) for step in (-0.005, 0.005))


def test_a_core_has_neighbours_of_its_own_kind_or_as_many_as_leave_a_hundred_ions():
    near = np.repeat([0.95, 0.85, 0.3], [150, 150, 700])
    few = np.where(near > 0.9, near - 0.1, near)
    chosen = np.arange(1000) % 10 < 9
    assert np.count_nonzero(core_of(chosen, near)) == 135
    assert np.count_nonzero(core_of(chosen, few)) == 270
    np.testing.assert_array_equal(core_of(chosen, near / 2), chosen)


def test_slopes_have_no_bias_by_the_noise_of_the_counts():
    positions, layer, solute, halves = alloy(0.02, 0.12)
    found = local_composition(positions, solute, halves, 60, VOLUME)
    rng = np.random.default_rng(2)
    values = 1 + 1.5 * np.where(layer, 0.12, 0.02) + 0.05 * rng.standard_normal(len(layer))
    slope = noise_free_slopes(values, [found])[0]
    naive = np.cov(values, found.all)[0, 1] / found.all.var()
    # 30,000 values with a noise of 0.05 over a spread of 0.04: 0.5 %; the rest is the width of the Gaussian
    assert slope == pytest.approx(1.5, rel=0.12)
    assert naive < 0.9 * slope


def test_two_solutes_have_their_own_slopes():
    positions, layer, first, halves = alloy(0.05, 0.3)
    rng = np.random.default_rng(3)
    column = np.hypot(*positions[:, :2].T) < 2.5
    second = rng.random(len(layer)) < np.where(column, 0.4, 0.1)
    values = 1 - 0.5 * np.where(layer, 0.3, 0.05) + 0.8 * np.where(column, 0.4, 0.1)
    found = [local_composition(positions, one, halves, 60, VOLUME) for one in (first, second)]
    # the Gaussian is a fifth of the layer and of the column
    assert noise_free_slopes(values, found) == pytest.approx([-0.5, 0.8], rel=0.12)


def feature_of(positions, inside, ratio):
    return Feature(inside.astype(float), inside, 0.0, 1.0, ratio)


def test_a_plane_is_continued_and_a_sphere_inside_is_not():
    positions, layer, _, _ = alloy(0.0, 0.0)
    ring = np.hypot(*positions[:, :2].T) > 4
    middle = positions[:, 2].mean()
    outside, (way,) = continued([feature_of(positions, layer, 1.2)], positions, ring)
    assert way.way == "plane"
    assert way.share == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(np.abs(way.normal), [0, 0, 1], atol=0.02)
    places = np.array([[20.0, 0, middle], [20.0, 0, middle + 3], [-15.0, 9.0, middle - 0.6]])
    np.testing.assert_allclose(outside(places), [1.2, 1.0, 1.2], atol=0.01)
    ball = np.linalg.norm(positions - (0, 0, middle), axis=1) < 2
    outside, (way,) = continued([feature_of(positions, ball, 0.8)], positions, ring)
    assert way.way == "none"
    np.testing.assert_array_equal(outside(places), 1.0)


def test_what_is_not_flat_is_continued_at_its_azimuth():
    positions, _, _, _ = alloy(0.0, 0.0)
    middle = positions[:, 2].mean()
    ring = np.hypot(*positions[:, :2].T) > 4
    ball = np.linalg.norm(positions - (4.0, 0, middle), axis=1) < 2
    outside, (way,) = continued([feature_of(positions, ball, 0.8)], positions, ring)
    assert way.way == "ring"
    beside = outside(np.array([[8.0, 0, middle], [-8.0, 0, middle], [8.0, 0, middle + 4]]))
    # a tenth of the ions of its sector and depth: 1 - 0.2 * 0.1
    assert beside[0] == pytest.approx(0.98, abs=0.01)
    np.testing.assert_allclose(beside[1:], 1.0, atol=0.01)
