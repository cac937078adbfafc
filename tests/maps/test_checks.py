"""Checks that a result of the indexing can fail: halves, surrogates, other structures; lenses; threads of BLAS."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common import blas_threads
from apt_evap._common.blas_threads import one_blas_thread
from apt_evap.maps.indexing import halves_and_surrogates as module
from apt_evap.maps.indexing import index_map
from apt_evap.maps.indexing.contrast_search import PIECES, evidence, places_of, terms_of
from apt_evap.maps.indexing.halves_and_surrogates import HALVES, Surrogates, second_grain, second_lattice, unseen_grain
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.maps.indexing.orientation_search import AZIMUTHS, RINGS, disc_of, flattened_by_rings
from apt_evap.maps.indexing.refine import directions_of, refine
from apt_evap.maps.indexing.two_criteria import view_of

SCALE, WIDTH = 60.0, 70.0


def drawn(axis, rotation=20.0, *, ions=40_000, projection=None, seed=1):
    orientation = ae.Orientation("Ni", axis=axis, rotation=rotation)
    projection = projection or ae.detection.Projection(SCALE)
    return orientation, master_patterns("fcc")[0].map(orientation, projection, WIDTH, ions=ions, rolled=0.5, seed=seed)


def two_grains():
    """One grain on the left, another on the right."""
    (first, left), (_, right) = drawn((0.30, 0.54, 0.79)), drawn((0.1, 0.2, 0.97), 75.0, seed=2)
    values = np.where(left.centres[0] < 0, left.values, right.values)
    return first, ae.DetectorMap.from_array(values, left.x_edges, left.y_edges, left.mask, is_counts=True)


def quickly(measured, **options):
    return ae.index(measured, "Ni", patterns=master_patterns("fcc")[:1], scales=(54.0, 66.0), **options)


def fit_of(map, orientation):
    disc = flattened_by_rings(disc_of(map))
    view = view_of(disc)
    densities = master_patterns("fcc")[0].smoothed(0.7)
    return view, refine(view.bins, disc, densities, orientation.matrix, SCALE, steps=8)


@pytest.mark.slow
def test_a_second_grain_has_evidence_in_a_half():
    orientation, single = drawn((0.30, 0.54, 0.79))
    terms = terms_of(ae.material("Ni"))
    view, fit = fit_of(single, orientation)
    one, least = second_lattice(view, terms, fit)
    assert least > 0
    _, both = two_grains()
    view, fit = fit_of(both, orientation)
    # the half of the other grain has its evidence, of a map whose lines are those of the patterns: far above 12
    assert second_lattice(view, terms, fit)[0] > 30 and one < 0


@pytest.mark.slow
def test_two_grains_are_not_indexed_as_one():
    _, both = two_grains()
    found = quickly(both)
    assert not found.decided and "second lattice" in found.reason


@pytest.mark.slow
def test_a_small_grain_at_the_rim_has_evidence_in_its_segment():
    orientation, single = drawn((0.30, 0.54, 0.79))
    _, other = drawn((0.1, 0.2, 0.97), 75.0, seed=2)
    terms = terms_of(ae.material("Ni"))
    view, fit = fit_of(single, orientation)
    assert second_grain(view, terms, fit).evidence < -20
    # 18 % of the area, towards 90 degrees
    values = np.where(single.centres[1][:, None] > 0.52 * WIDTH / 2, other.values, single.values)
    both = ae.DetectorMap.from_array(values, single.x_edges, single.y_edges, single.mask, is_counts=True)
    view, fit = fit_of(both, orientation)
    found = second_grain(view, terms, fit)
    assert found.evidence > 40 and found.chord == 0.5 and found.azimuth == pytest.approx(90, abs=23)


def with_another_grain_at_the_rim():
    """A map of one grain, and the same map with another grain in 8 % of its area, towards 90 degrees."""
    orientation, single = drawn((0.30, 0.54, 0.79))
    _, other = drawn((0.1, 0.2, 0.97), 75.0, seed=2)
    values = np.where(single.centres[1][:, None] > 0.74 * WIDTH / 2, other.values, single.values)
    both = ae.DetectorMap.from_array(values, single.x_edges, single.y_edges, single.mask, is_counts=True)
    return orientation, single, both


def test_the_winner_is_not_seen_in_another_grain_at_the_rim():
    """The evidence is that of weighted straight lines of the density in the segment, without and with the pattern."""
    orientation, single, both = with_another_grain_at_the_rim()
    densities = master_patterns("fcc")[0].smoothed(0.7)
    view, fit = fit_of(single, orientation)
    assert unseen_grain(view, densities, fit).evidence < -10
    view, fit = fit_of(both, orientation)
    found = unseen_grain(view, densities, fit)
    assert found.evidence > 15 and found.chord == 0.74 and found.azimuth == pytest.approx(90, abs=16)
    bins, azimuth = view.bins, np.radians(found.azimuth)
    slow = np.exp(bins.slow @ fit.slow)
    inside = bins.places @ (np.cos(azimuth), np.sin(azimuth)) > found.chord
    directions = directions_of(bins.places, view.disc.radius, fit.scale, fit.stretch) @ fit.matrix
    pattern = fit.amplitudes @ (module.sampled(densities, directions) - 1)
    root = np.sqrt(slow[inside])
    lines = np.column_stack([np.ones(inside.sum()), bins.places[inside]]) * root[:, None]
    left = [np.linalg.lstsq(lines, (bins.counts / slow - 1 - model)[inside] * root)[1].item() for model in (0, pattern)]
    assert found.evidence == pytest.approx((left[1] - left[0]) / fit.dispersion, rel=1e-3)


@pytest.mark.slow
def test_a_grain_of_a_twelfth_at_the_rim_is_not_passed_over():
    _, single, both = with_another_grain_at_the_rim()
    assert quickly(single).decided
    found = quickly(both)
    assert not found.decided and "the pattern of this orientation is not seen" in found.reason


def test_the_evidence_of_a_segment_is_the_direct_one(monkeypatch):
    """Of one axis and every azimuth, by sums over the points of a segment without Fourier transforms."""
    orientation, map = drawn((0.30, 0.54, 0.79))
    view, fit = fit_of(map, orientation)
    terms = terms_of(ae.material("Ni"))
    first_axis = module.axes_of("fcc", 3.0)[5:6]
    for name, value in (("axes_of", lambda *arguments: first_axis), ("CHORDS", (0.3,)), ("_FREED", (0.0,))):
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(module, "_SEGMENT_SCALES", (1.0,))
    monkeypatch.setattr(module, "SEGMENTS", 2)  # towards 0 and 180 degrees
    places, areas = places_of()
    local = directions_of(places, view.disc.radius, fit.scale, fit.stretch)
    images = terms.images(view.disc.radius / fit.scale).astype(float)

    def pictures(matrix):
        shown = module.sampled(images, terms.equal(local @ matrix), terms.corner)
        return shown - (shown @ areas)[:, None]

    winner = pictures(fit.matrix)
    norms = np.sqrt(winner**2 @ areas)
    gram, cross = (winner * areas) @ winner.T / norms / norms[:, None], (winner * areas) @ view.picture / norms
    amplitudes = module.exact_evidence(gram, cross, terms.priors, terms.signed)[1] / norms
    left = areas @ (view.picture - amplitudes @ winner) ** 2

    def gain(matrix, inside):
        """Decrease of the squared deviations in a segment, both pictures without their means there."""
        weights = areas * inside
        shown, seen = (v - weights @ v / weights.sum() for v in (amplitudes @ pictures(matrix), view.picture))
        return (weights @ seen**2 - weights @ (seen - shown) ** 2) * PIECES / left

    (turn,) = [module.about_axis(axis) for axis in first_axis]
    angles = np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS
    about = [np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in angles]
    matrices = [a @ t for a in about for t in (turn, np.diag([1.0, -1.0, 1.0]) @ -turn)]
    direct = [
        max(gain(matrix, inside) for matrix in matrices) - gain(fit.matrix, inside)
        for inside in (places[:, 0] > 0.3, places[:, 0] < -0.3)
    ]
    assert second_grain(view, terms, fit).evidence == pytest.approx(max(direct), abs=0.05)


@pytest.mark.parametrize("excess, proved, decided", [(30, True, False), (30, False, True), (50, False, False)])
def test_another_structure_needs_the_same_proof(monkeypatch, excess, proved, decided):
    """Refused if the other structure passes the checks of the own one, or is far better."""
    result = index_map.Indexing(drawn((0.3, 0.5, 0.8), ions=5_000)[1], (), True, "best")

    class Crystal:
        material = ae.material("Ni")

        def __init__(self, refused=""):
            self.refused = refused

        def refusal(self, best):
            return self.refused

        def starts(self):
            return []

        def refined(self, starts):
            return []

        def different(self, results, dispersion):
            return [None, None], np.array([100.0, 60.0])

    monkeypatch.setattr(index_map, "_best_rival", lambda *arguments: (excess, Crystal("" if proved else "a star")))
    found = index_map._checked(result, Crystal(), None, 1.0, 70.0, lambda part: None)
    assert found.decided == decided and f"{excess}" in found.reason


@pytest.mark.parametrize("excess, stages", [(-50, 3), (-100, 2), (-150, 1)])
def test_another_structure_is_refined_as_far_as_it_matters(monkeypatch, excess, stages):
    refined = []

    class Crystal:
        view = scales = bounds = None
        material = ae.material("Ni")

        def __init__(self, *arguments):
            self.search = SimpleNamespace(largest=10.0)

        def starts(self, n):
            return 3 * [n]

        def refined(self, starts, n):
            refined.append((starts[0], n))
            return [SimpleNamespace(weight=lambda dispersion: 300.0 + excess)]

    monkeypatch.setattr(index_map, "_Crystal", Crystal)
    assert index_map._best_rival(Crystal(), 1.0, 300.0, lambda part: None)[0] == excess
    # bcc, diamond, hcp
    assert len(refined) == 3 * stages and refined[stages - 1] == index_map._STAGES[stages - 1][:2]


@pytest.mark.slow
def test_the_evidence_of_a_half_is_the_direct_one(monkeypatch):
    """Of the best turned pattern in every half, against sums over its points without Fourier transforms."""
    orientation, map = drawn((0.30, 0.54, 0.79))
    view, fit = fit_of(map, orientation)
    terms = terms_of(ae.material("Ni"))
    windows = module._windows()
    assert windows.sum(axis=1) == pytest.approx(np.ones(HALVES))
    pictures = module._in_windows(view.picture, windows)
    local = directions_of(places_of()[0], view.disc.radius, fit.scale, fit.stretch)
    # the first axis of the search, at every azimuth
    turn = module.about_axis(module.axes_of("fcc", module.STEP)[0])
    direct = np.full(HALVES, -np.inf)
    for k, hand in product(range(AZIMUTHS), (turn, np.diag([1.0, -1.0, 1.0]) @ -turn)):
        shown = terms.at(local @ hand, view.disc.radius / fit.scale)[0].reshape(-1, RINGS, AZIMUTHS)
        shown = np.roll(shown, k, axis=2).reshape(len(shown), -1).astype(float)
        for half, (window, picture) in enumerate(zip(windows, pictures, strict=True)):
            inside = shown - (shown @ window)[:, None]
            inside /= np.maximum(np.sqrt(inside**2 @ window), 1e-3)[:, None]
            value = module._evidence(terms, (inside * window) @ inside.T, inside @ picture)
            direct[half] = max(direct[half], value)
    first_axis = module.axes_of("fcc", module.STEP)[:1]
    monkeypatch.setattr(module, "axes_of", lambda structure, step: first_axis)
    fast = module._of_others(view, terms, fit, windows, pictures)
    assert fast == pytest.approx(direct, abs=0.05)  # single precision
    whole = evidence(np.eye(1), np.array([[0.5]]), np.array([1.0]), np.ones(1, bool))[0]
    half = module._evidence(_OneTerm, np.eye(1), np.array([0.5]))
    # N of a half is half of N: -N ln(1 - r^2) is halved, the volume ln(1 + N) is not; the prior is 1 / N
    assert half + np.log(1 + PIECES / 2) == pytest.approx(
        (whole + np.log(1 + PIECES)) / 2, rel=5e-3
    )  # the prior is 1 / N


class _OneTerm:
    priors, signed = np.ones(1), np.ones(1, bool)


def test_surrogates_keep_the_rings():
    random = np.random.default_rng(3)
    picture = random.normal(size=(RINGS, AZIMUTHS)) + np.arange(RINGS)[:, None]
    phases = np.exp(1j * random.uniform(0, 2 * np.pi, AZIMUTHS // 2 + 1))
    phases[0] = 1
    scrambled = module._with_phases(picture, phases)
    assert scrambled.mean(axis=1) == pytest.approx(picture.mean(axis=1))
    # the power of the harmonics is kept; of the last one only its real part
    before, after = (np.abs(np.fft.rfft(values, axis=1))[:, :-1] for values in (picture, scrambled))
    assert after == pytest.approx(before, rel=1e-9) and not np.allclose(picture, scrambled, atol=0.5)
    # relations between rings are kept: phases are common to all
    cross = [
        np.fft.rfft(values, axis=1)[3] * np.conj(np.fft.rfft(values, axis=1)[7]) for values in (picture, scrambled)
    ]
    assert cross[0][:-1] == pytest.approx(cross[1][:-1])
    numbers = Surrogates(10.0, np.array([1.0, 2.0, 3.0, 12.0]))
    assert numbers.above == 1 and numbers.deviations == pytest.approx((10 - 4.5) / np.std([1, 2, 3, 12], ddof=1))


def test_the_counts_of_a_map_pass_the_polar_grid():
    orientation, map = drawn((0.30, 0.54, 0.79), ions=200_000)
    view, _ = fit_of(map, orientation)
    counts = module._counts_of(module._polar(view.bins), view.bins)
    inside = np.hypot(*view.bins.places.T) < 0.95
    # interpolated twice: the contrast is kept, its noise is smoothed
    before, after = (values[inside] / view.bins.mu[inside] for values in (view.bins.counts, counts))
    assert np.corrcoef(before, after)[0, 1] > 0.95 and after.std() == pytest.approx(before.std(), rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("barrel", [-0.2, -0.1, 0.1, 0.2])
def test_a_lens_is_not_hidden(barrel):
    """The scale at the centre within 3 %, and the change to the rim, of a lens of this part of it at 30 degrees."""
    rim = np.radians(30)
    lens = ae.detection.Projection(49.5, barrel=barrel / rim**2)
    width = 2 * float(lens.places([[np.sin(rim), 0.0, np.cos(rim)]])[0, 0])
    orientation = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    map = master_patterns("fcc")[0].map(orientation, lens, width, ions=60_000, rolled=0.5, seed=1)
    found = ae.index(map, "Ni", patterns=master_patterns("fcc")[:1], scales=(42.0, 58.0))
    best = found.best
    assert best.projection.scale == pytest.approx(49.5, rel=0.03)
    # the disc ends 4 % inside the rim; a standard error of the change is about 0.02
    assert best.rim_change == pytest.approx(-barrel * 0.96**2, abs=0.05)
    change = abs(round(100 * best.rim_change))
    assert abs(best.projection.scale - 49.5) < best.scale_error < 0.08 * 49.5
    scale = f"{best.projection.scale:.1f} ± {best.scale_error:.1f} mm/rad"
    assert f"{scale} in the centre, {change} % {'less' if barrel > 0 else 'more'} at the rim" in str(found)


def test_rings_are_flattened_and_lines_are_kept():
    _, map = drawn((0.30, 0.54, 0.79), ions=300_000)
    x, y = np.meshgrid(*map.centres)
    along = np.exp(-np.hypot(x, y) / 15)
    darker = ae.DetectorMap.from_array(
        np.random.default_rng(0).binomial(map.values.astype(int), along), map.x_edges, map.y_edges, map.mask,
        is_counts=True,
    )  # fmt: skip
    flat, plain = (flattened_by_rings(disc_of(each)) for each in (darker, map))
    ring = [flat.map.values[(np.hypot(x, y) > r) & (np.hypot(x, y) < r + 4)].mean() for r in (4, 12, 20, 26)]
    assert max(ring) / min(ring) < 1.2  # a factor of 4 before; trimmed means are not means
    assert flat.hits == darker.values[disc_of(darker).map.mask].sum()
    both = flat.map.mask & plain.map.mask
    smooth = [each.map.smoothed(1.5).values[both] for each in (flat, plain)]
    assert np.corrcoef(*smooth)[0, 1] > 0.8


def test_one_thread_of_blas_and_back(monkeypatch):
    threads = [4]
    functions = (lambda: threads[0], lambda number: threads.__setitem__(0, number))
    monkeypatch.setattr(blas_threads, "_libraries", lambda: (functions,))
    with one_blas_thread():
        assert threads == [1]
        with pytest.raises(RuntimeError), one_blas_thread():
            raise RuntimeError
        assert threads == [1]  # the outer block goes on
    assert threads == [4]


@pytest.mark.slow
def test_a_clear_map_is_seen_in_every_half(monkeypatch):
    """The reason of a result that is clear in the whole map and less likely than no crystal in a half."""
    _, single = drawn((0.30, 0.54, 0.79))
    found = quickly(single)
    assert found.decided
    monkeypatch.setattr("apt_evap.maps.indexing.index_map.second_lattice", lambda *arguments: (-10.0, -99.0))
    found = quickly(single)
    assert not found.decided and "second lattice" in found.reason and "those in half of it -99, where" in found.reason
