import pickle

import numpy as np
import pytest
from skimage import morphology

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.maps.similarity import local_moments, local_similarity, similarity, similarity_ceiling

EDGES = np.linspace(-10, 10, 101)
CENTRES = (EDGES[1:] + EDGES[:-1]) / 2
GRID_X, GRID_Y = np.meshgrid(CENTRES, CENTRES)
INSIDE = np.hypot(GRID_X, GRID_Y) < 9.5
LINES = 1 + 0.5 * np.cos(6 * np.arctan2(GRID_Y, GRID_X))


def noisy(mean, seed):
    """A measured map of LINES with `mean` ions in a bin."""
    counts = np.random.default_rng(seed).poisson(mean * LINES)
    return DetectorMap.from_array(counts, EDGES, EDGES, INSIDE, is_counts=True)


def test_a_map_equals_itself_whatever_its_unit():
    a = DetectorMap.from_array(LINES, EDGES, EDGES, INSIDE)
    b = DetectorMap.from_array(7.5 * LINES, EDGES, EDGES, INSIDE)
    assert float(similarity(a, b)) == pytest.approx(1, abs=1e-12)
    assert float(similarity(a, b, smoothing=0.7)) == pytest.approx(1, abs=1e-12)


def test_the_measure_is_that_of_wang():
    a, b = noisy(20, 1), noisy(20, 2)
    result = similarity(a, b, data_range=3.0)
    # formula 13 of Wang et al. (2004) written out at one bin, window of half width 5
    row, column = 50, 47
    offset = np.arange(-5, 6)
    window = np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * 1.5**2))
    window /= window.sum()
    p, q = (m.values[row - 5 : row + 6, column - 5 : column + 6] / m.values[INSIDE].mean() for m in (a, b))
    mean_p, mean_q = (window * p).sum(), (window * q).sum()
    var_p, var_q = (window * (p - mean_p) ** 2).sum(), (window * (q - mean_q) ** 2).sum()
    both = (window * (p - mean_p) * (q - mean_q)).sum()
    c1, c2 = (0.01 * 3) ** 2, (0.03 * 3) ** 2
    expected = (2 * mean_p * mean_q + c1) * (2 * both + c2)
    expected /= (mean_p**2 + mean_q**2 + c1) * (var_p + var_q + c2)
    assert result.local[row, column] == pytest.approx(expected, rel=1e-10)
    assert float(result) == pytest.approx(np.nanmean(result.local), rel=1e-12)


@pytest.mark.parametrize("smoothing, data_range", [(0.0, 2.0), (0.5, 1.0), (1.7, 3.0)])
def test_without_noise_the_corrected_similarity_of_stacks_is_the_uncorrected_one(smoothing, data_range):
    """`similarity` is that of scikit-image; its window is where a disc of half width 5 fits into the common mask."""
    measured, *others = (noisy(20, seed) for seed in range(4))
    maps = [np.where(INSIDE, each.smoothed(smoothing).density, 1.0) for each in (measured, *others)]
    stacked = local_similarity(local_moments(np.array(maps)), local_moments(maps[0]), data_range, 0.0)
    inside = morphology.erosion(np.pad(INSIDE, 1), morphology.disk(5))[1:-1, 1:-1]
    for values, other in zip(stacked, (measured, *others), strict=True):
        alone = similarity(other, measured, smoothing=smoothing, data_range=data_range)
        assert np.array_equal(inside, np.isfinite(alone.local))
        assert values[inside] == pytest.approx(alone.local[inside], abs=1e-12)  # rounding
        assert float(alone) == pytest.approx(values[inside].mean(), abs=1e-12)
    assert stacked[0] == pytest.approx(1, abs=1e-12)


def test_noise_of_both_maps_counts_as_common_structure():
    """Formula 13 of Wang et al. (2004), with the variances of the noise in the term of the structure."""
    first, second = (local_moments(np.where(INSIDE, noisy(20, seed).density, 1.0)) for seed in (1, 2))
    plain, corrected = (local_similarity(first, second, 2.0, noise) for noise in (0.0, 0.1))
    both = first.mean * second.mean
    luminance = (2 * both + 0.02**2) / (first.mean**2 + second.mean**2 + 0.02**2)
    gain = luminance * 0.1 / (first.variance + second.variance + 0.06**2)
    assert corrected - plain == pytest.approx(gain, abs=1e-12)


def test_what_lies_outside_the_common_mask_does_not_matter():
    a, b = noisy(20, 1), noisy(20, 2)
    spoilt = np.where(INSIDE, b.values, 10_000)
    smaller = INSIDE & (GRID_X < 6)
    c = DetectorMap.from_array(spoilt, EDGES, EDGES, smaller, is_counts=True)
    clean = DetectorMap.from_array(b.values, EDGES, EDGES, smaller, is_counts=True)
    assert float(similarity(a, c)) == float(similarity(a, clean))
    assert np.isnan(similarity(a, c).local[:, CENTRES > 6]).all()


def test_a_dark_rim_does_not_make_noise_look_alike():
    lit = 2.0 * (np.hypot(GRID_X, GRID_Y) < 9.3)
    maps = [
        DetectorMap.from_array(np.random.default_rng(seed).poisson(lit), EDGES, EDGES, INSIDE) for seed in range(20)
    ]
    values = [float(similarity(a, b)) for a, b in zip(maps[::2], maps[1::2], strict=True)]
    # independent noise: near 0, 0.018 from pair to pair, so 0.006 for the mean; windows over the rim add 0.05
    assert abs(np.mean(values)) < 0.02


def test_more_ions_and_smoothing_raise_the_ceiling():
    few, many = similarity_ceiling(noisy(5, 1)), similarity_ceiling(noisy(500, 1))
    assert 0 < float(few) < float(many) < 1
    assert float(similarity_ceiling(noisy(5, 1), smoothing=0.5)) > float(few) + 0.2


def test_a_turned_map_is_less_alike_than_the_ceiling():
    map = noisy(100, 3)
    turned = DetectorMap.from_array(map.counts.T, EDGES, EDGES, INSIDE, is_counts=True)
    assert float(similarity(map, turned)) < float(similarity_ceiling(map)) - 0.3


def test_ceiling_is_keyed_by_its_seed_and_takes_hits():
    x, y = np.random.default_rng(0).uniform(-5, 5, (2, 60_000))
    hits = Hits(x=x, y=y)
    first, same, other = (float(similarity_ceiling(hits, bins=50, seed=seed)) for seed in (1, 1, 2))
    assert first == same != other
    assert float(similarity_ceiling(hits.map(bins=50), seed=1)) == first


def test_result_states_what_it_depends_on():
    text = repr(similarity(noisy(5, 1), noisy(5, 2), smoothing=0.25, data_range=4))
    for part in ("100 x 100 bins", "0.2 x 0.2 mm", "smoothed by 0.25 mm", "data range 4"):
        assert part in text


def test_maps_that_cannot_be_compared():
    a = noisy(5, 1)
    shifted = DetectorMap.from_array(LINES, EDGES + 1, EDGES)
    small = DetectorMap.from_array(LINES, EDGES, EDGES, np.abs(GRID_X) < 0.5)
    tiny = DetectorMap.from_array(np.ones((5, 5)), np.arange(6.0), np.arange(6.0))
    with pytest.raises(ValueError, match=r"equal bins.*x_edges"):
        similarity(a, shifted)
    with pytest.raises(ValueError, match="must contain a window"):
        similarity(a, small)
    with pytest.raises(ValueError, match="at least 11 bins"):
        similarity(tiny, tiny)
    with pytest.raises(ValueError, match="not counts"):
        similarity_ceiling(small)
    with pytest.raises(ValueError, match="data_range"):
        similarity(a, a, data_range=0)
    with pytest.raises(ValueError, match="options bins are for hits"):
        similarity_ceiling(a, bins=5)


def test_a_similarity_is_a_number():
    map = DetectorMap.from_array(np.random.default_rng(1).random((20, 20)), np.arange(21.0), np.arange(21.0))
    found = similarity(map, map.smoothed(0.5))
    assert f"{found:.3f}" == f"{found.value:.3f}" and round(found, 2) == round(found.value, 2)
    assert isinstance(found, float) and 0 < found < 1 and max(found, 0.0) is found
    copied = pickle.loads(pickle.dumps(found))
    assert copied == found and copied.bins == (20, 20) and np.array_equal(copied.local, found.local, True)
