"""Clusters against plain references, to the ion, and the choice of their parameters against random labels."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.spectra.ion_names import Abundances

Settings = ae.measures.ClusterSettings


def plain_clusters(positions, solute, d_max, n_min, order):
    """The reference: solutes that are linked, by flooding; others join the nearest core."""
    rows = np.flatnonzero(solute)
    away = np.linalg.norm(positions[rows, None] - positions[rows], axis=2)
    core = (away <= d_max).sum(axis=1) - 1 >= order
    label = np.arange(len(rows))
    for _ in rows:
        for i in np.flatnonzero(core):
            label[i] = label[core & (away[i] <= d_max)].min()
    for i in np.flatnonzero(~core):
        near = np.where(core, away[i], np.inf)
        label[i] = label[near.argmin()] if near.min() <= d_max else -1 - i
    return [set(rows[label == one]) for one in np.unique(label) if (label == one).sum() >= n_min]


def cloud(seed, ions=400):
    rng = np.random.default_rng(seed)
    positions = np.concatenate(
        [4 * rng.random((ions, 3)), 1 + 0.25 * rng.normal(size=(30, 3)), 3 + 0.2 * rng.normal(size=(25, 3))]
    )
    return positions, np.r_[rng.random(ions) < 0.2, np.ones(30, bool), rng.random(25) < 0.9]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("d_max", "n_min", "order"), [(0.3, 5, 1), (0.5, 2, 1), (0.35, 3, 3), (0.5, 10, 5)])
def test_clusters_are_those_of_a_plain_reference(seed, d_max, n_min, order):
    positions, solute = cloud(seed)
    labels = ae.measures.label_clusters(positions, solute, Settings(d_max, n_min, order))[0]
    found = [set(np.flatnonzero(labels == one)) for one in range(labels.max() + 1)]
    reference = plain_clusters(positions, solute, d_max, n_min, order)
    assert len(found) == len(reference) > 0
    assert all(cluster in reference for cluster in found)
    assert sorted(map(len, found), reverse=True) == list(map(len, found))


def test_envelope_and_erosion_are_those_of_a_plain_reference():
    positions, solute = cloud(1)
    plain, _ = ae.measures.label_clusters(positions, solute, Settings(0.3, 5))
    _, wide = ae.measures.label_clusters(positions, solute, Settings(0.3, 5, envelope=0.4, erosion=0.0))
    away = np.linalg.norm(positions[:, None] - positions, axis=2)
    to_cores = np.where(plain >= 0, away, np.inf)
    expected = np.where(plain >= 0, plain, np.where(to_cores.min(axis=1) <= 0.4, plain[to_cores.argmin(axis=1)], -1))
    assert np.array_equal(wide, expected) and (wide >= 0).sum() > (plain >= 0).sum()
    _, eroded = ae.measures.label_clusters(positions, solute, Settings(0.3, 5, envelope=0.4, erosion=0.25))
    default = ae.measures.label_clusters(positions, solute, Settings(0.3, 5))[1]
    both = ae.measures.label_clusters(positions, solute, Settings(0.3, 5, envelope=0.3, erosion=0.3))[1]
    assert np.array_equal(default, both)
    near_matrix = np.where(wide < 0, away, np.inf).min(axis=1) <= 0.25
    assert np.array_equal(eroded, np.where(near_matrix, -1, wide)) and (eroded >= 0).sum() < (wide >= 0).sum()


def test_a_bound_is_within_and_lone_solutes_are_clusters_of_one():
    row = np.column_stack([[0.0, 0.5, 1.0, 2.0], np.zeros(4), np.zeros(4)])
    every = np.ones(4, bool)
    assert ae.measures.label_clusters(row, every, Settings(0.5, 1))[0].tolist() == [0, 0, 0, 1]
    assert ae.measures.label_clusters(row, every, Settings(0.49, 1))[0].tolist() == [0, 1, 2, 3]
    assert ae.measures.label_clusters(row, every, Settings(0.5, 4))[0].tolist() == [-1] * 4


def test_the_choice_finds_clusters_and_their_scale():
    rng = np.random.default_rng(2)
    centres = 2 + 16 * rng.random((12, 3))
    particles = (centres[:, None] + 0.5 * rng.normal(size=(12, 40, 3))).reshape(-1, 3)
    positions = np.concatenate([20 * rng.random((40_000, 3)), particles])
    solute = np.r_[rng.random(40_000) < 0.02, np.ones(480, bool)]
    choice = ae.measures.choose_separation(positions, solute)
    assert choice.found and choice.p_value == 0.05
    labels = ae.measures.label_clusters(positions, solute, Settings(choice.d_max, choice.n_min))[0]
    # two of 12 centres may be nearer than their size, and chance adds at most 5 %
    assert 10 <= labels.max() + 1 <= 13
    right = labels[-480:] >= 0
    wrong = labels[:-480][solute[:-480]] >= 0
    assert right.mean() > 0.9  # a Gaussian has 3 % of its ions beyond 3 standard deviations, where none is near
    assert wrong.mean() < 0.05


def test_the_choice_finds_balls_whole_and_nothing_else():
    rng = np.random.default_rng(1)
    centres = np.array([[x, y, z] for x in (2.5, 7.5) for y in (2.5, 7.5) for z in (2.5, 7.5)])
    positions = 10 * rng.random((50_000, 3))
    inside = np.linalg.norm(positions[:, None] - centres, axis=2).min(axis=1) < 1.0
    cloud = ae.measures.PointCloud(
        positions, (rng.random(50_000) < np.where(inside, 0.6, 0.01)).astype(int), ["Al", "Cu"]
    )
    clusters = cloud.clusters("Cu")
    assert len(clusters) == 8
    # a ball of 126 solutes: its radius has an error of 0.33 / sqrt(126) = 0.03 nm, and some of the matrix join
    assert clusters.radii == pytest.approx(np.ones(8), abs=0.12)
    assert clusters.number_density(1000.0).value == pytest.approx(0.008)


@pytest.mark.slow
def test_random_labels_are_found_as_often_as_the_level_says():
    """The null hypothesis: 60 random alloys, of which 5 % should be found."""
    found = 0
    for seed in range(60):
        rng = np.random.default_rng(100 + seed)
        positions = 6 * rng.random((1500, 3))
        found += ae.measures.choose_separation(positions, rng.random(1500) < 0.1, seed=seed).found
    assert found <= 8  # three found on average; nine or more with a probability of 0.3 %


def test_clusters_of_a_random_alloy_are_none_with_a_warning():
    rng = np.random.default_rng(4)  # one seed in 20 has clusters by chance
    random = ae.measures.PointCloud(6 * rng.random((1500, 3)), (rng.random(1500) < 0.1).astype(int), ["Al", "Cu"])
    with pytest.warns(ae.warnings.DataWarning, match="no more clusters of Cu than by chance"):
        clusters = random.clusters("Cu")
    assert len(clusters) == 0 and clusters.clustered_fraction == 0.0
    assert clusters.to_dict()["clusters"] == 0


def test_distances_of_neighbours_are_those_of_all_pairs():
    positions, solute = cloud(4)
    result = ae.measures.nearest_neighbours(positions, solute, order=2)
    away = np.sort(np.linalg.norm(positions[solute, None] - positions[solute], axis=2), axis=1)[:, 2]
    assert result.mean == pytest.approx(away.mean(), rel=1e-12)
    assert np.array_equal(result.solutes, np.histogram(away, result.edges)[0])
    assert result.mean < result.random_mean - 2 * result.random_mean_deviation and result.p_value == 0.05


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda p, s: ae.measures.label_clusters(p, s & False, Settings(0.5)),
            "must mark at least one ion, got none of",
        ),
        (lambda p, s: ae.measures.label_clusters(p, s[:5], Settings(0.5)), "solute must have shape"),
        (
            lambda p, s: ae.measures.choose_separation(p, s | True),
            "at least 10 of the ions and not all",
        ),
        (lambda p, s: ae.measures.choose_separation(p[-2:], [True, False]), "at least 10 of the ions"),
        (lambda p, s: ae.measures.choose_separation(p, s, trials=5), "trials must be an integer from 19"),
        (lambda p, s: ae.measures.choose_separation(p, s, separations=[0.5, 0.4]), "separations must be increasing"),
        (lambda p, s: ae.measures.nearest_neighbours(p, s, order=200), "solute must mark more than 200 ions"),
        (lambda p, s: Settings(-0.5), "d_max must be a finite number"),
    ],
)
def test_wrong_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(*cloud(1))


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "share", "matrix"), [(1.0, 0.6, 0.01), (0.8, 0.4, 0.02), (1.5, 0.25, 0.05)])
def test_the_choice_is_near_the_best_of_all_parameters(radius, share, matrix):
    """Known balls: the solutes that are found, by their harmonic mean of precision and recall."""
    rng = np.random.default_rng(1)
    centres = np.array([[x, y, z] for x in (3, 9) for y in (3, 9) for z in (3, 9)]) + 0.5 * rng.normal(size=(8, 3))
    positions = 12 * rng.random((51_840, 3))
    inside = np.linalg.norm(positions[:, None] - centres, axis=2).min(axis=1) < radius
    solute = rng.random(len(positions)) < np.where(inside, share, matrix)

    def merit(d_max, n_min):
        found = ae.measures.label_clusters(positions[solute], np.ones(solute.sum(), bool), Settings(d_max, n_min))[0]
        return 2 * np.count_nonzero((found >= 0) & inside[solute]) / ((found >= 0).sum() + inside[solute].sum())

    choice = ae.measures.choose_separation(positions, solute)
    every = [merit(d_max, n_min) for d_max in choice.separations for n_min in (3, 8, 20, 30)]
    assert choice.found and merit(choice.d_max, choice.n_min) > max(every) - 0.05 > min(every)


def test_a_spectrum_gives_the_composition_of_clusters_without_background_and_overlaps():
    rng = np.random.default_rng(1)
    positions = 8 * rng.random((20_000, 3))
    inside = np.linalg.norm(positions - 4, axis=1) < 1.6
    chromium = rng.random(20_000) < np.where(inside, 0.6, 0.05)
    mass = np.empty(20_000)
    for element, rows in (("Cr", chromium), ("Fe", ~chromium)):
        lines, shares = Abundances().lines(element)
        mass[rows] = rng.choice(lines, rows.sum(), p=shares / shares.sum()) / 2
    mass *= 1 + rng.normal(0, 4e-4, 20_000) + rng.exponential(1e-3, 20_000)
    background = rng.random(20_000) < 0.15
    mass[background] = (3 + 5 * rng.random(background.sum())) ** 2
    hits = ae.Hits(mass_to_charge=mass, positions=positions)
    # 54Cr is in the range of iron
    ranges = ae.spectra.Ranges(["Cr", "Fe"], [24.8, 26.8], [26.7, 28.5])
    clusters = ae.measures.PointCloud.of(hits, ranges).clusters("Cr", 0.4, 20)
    assert len(clusters) == 1
    spectrum = ae.spectrum(hits, ["Fe", "Cr"])
    for rows in (clusters.labels >= 0, clusters.labels < 0):
        composition = spectrum.composition_of(rows)
        true = 100 * np.mean(chromium[rows & ~background])
        assert abs(composition["Cr"] - true) < 3 * composition.error["Cr"] < 10
    in_ranges, _ = clusters.matrix_fractions()["Cr"]
    assert abs(100 * in_ranges - true) > 3 * abs(composition["Cr"] - true)


def test_clusters_are_those_of_pyccapt():
    theirs = pytest.importorskip("pyccapt.calibration.clustering.clustering", reason="pyccapt is not installed")
    rng = np.random.default_rng(5)
    points = np.concatenate([10 * rng.random((3000, 3)), *(10 * rng.random(3) + 0.3 * rng.normal(size=(5, 60, 3)))])
    ours = ae.measures.label_clusters(points, np.ones(len(points), bool), Settings(0.45, 10))[0]
    labels, _ = theirs.maximum_separation_clustering(points, d_max=0.45, n_min=10)
    assert ours.max() == labels.max() > 3
    assert {frozenset(np.flatnonzero(ours == one)) for one in range(ours.max() + 1)} == {
        frozenset(np.flatnonzero(labels == one)) for one in range(labels.max() + 1)
    }
