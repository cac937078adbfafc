"""Indexing: known orientations are found, the map decides or not, marks of a user count."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import apt_evap as ae
from apt_evap.maps.crystallography.directions import plane_normals
from apt_evap.maps.indexing import index_map, joint_search, two_criteria
from apt_evap.maps.indexing import orientation_search as polar_pictures
from apt_evap.maps.indexing.contrast_search import picture_of, terms_of
from apt_evap.maps.indexing.deciding_marks import deciding_marks
from apt_evap.maps.indexing.index_map import DECIDED, LEAST_IONS, Candidate, Indexing
from apt_evap.maps.indexing.joint_search import AXIS_STEP, COUNTED, COUNTS, JointSearch
from apt_evap.maps.indexing.marked_poles import marks_of
from apt_evap.maps.indexing.master_pattern import master_patterns, mixture
from apt_evap.maps.indexing.orientation_search import (
    Start,
    about_axis,
    axes_of,
    disc_of,
    flattened,
    flattened_by_rings,
    misorientation,
)
from apt_evap.maps.indexing.refine import _Likelihood, _State, bins_of, deviance, refine, rotation_of
from apt_evap.maps.indexing.two_criteria import angle_between
from apt_evap.specimen.symmetry import point_group

SCALE, WIDTH = 60.0, 70.0
ELEMENTS = {"fcc": "Ni", "bcc": "W", "diamond": "Si", "hcp": "Ti"}


def proper(structure):
    group = point_group(structure)
    return group[np.linalg.det(group) > 0]


def made(structure, axis, rotation=0.0, *, ions=20_000, rolled=0.5, seed=1, projection=None, pattern=0):
    orientation = ae.Orientation(ELEMENTS[structure], axis=axis, rotation=rotation)
    projection = ae.detection.Projection(SCALE) if projection is None else projection
    source = master_patterns(structure)[pattern]
    return orientation, source.map(orientation, projection, WIDTH, ions=ions, rolled=rolled, seed=seed)


def quickly(map, material, **options):
    """Index with one pattern and a scale that is known within 10 %, for speed."""
    patterns = master_patterns(ae.material(material).structure)[:1]
    return ae.index(map, material, patterns=patterns, **{"scales": (54.0, 66.0), **options})


def off(candidate, orientation, projection=None):
    """Largest angle between true and found directions at three places [degrees], for the best of the equal crystals.

    The axis of a candidate is at the centre of its disc, which need not be that of the true projection.
    """
    places = np.array([[0.0, 0.0], [15.0, 0.0], [-10.0, 12.0]])
    truth = (projection or ae.detection.Projection(SCALE)).directions(places) @ orientation.matrix
    answer = candidate.projection.directions(places) @ candidate.orientation.matrix
    members = proper(orientation.material.structure)
    return min(np.degrees(np.arccos(np.clip((answer @ each * truth).sum(axis=1), -1, 1))).max() for each in members)


@pytest.mark.parametrize(
    ("structure", "axis", "rotation", "rolled"),
    [
        pytest.param(*("fcc", (0.30, 0.54, 0.79), 20.0, 1.0), marks=pytest.mark.slow),  # fast: `indexed_nickel`
        pytest.param(*("bcc", (0.10, 0.60, 0.80), 110.0, 0.0), marks=pytest.mark.slow),
        pytest.param(*("diamond", (0.35, 0.35, 0.87), -70.0, 0.6), marks=pytest.mark.slow),
        pytest.param(*("hcp", (2, 1, 2), 200.0, 0.3), marks=pytest.mark.slow),
    ],
)
def test_the_orientation_of_a_map_is_found(structure, axis, rotation, rolled):
    orientation, map = made(structure, axis, rotation, rolled=rolled)
    found = quickly(map, ELEMENTS[structure])
    assert found.decided and found.verdict == "indexed"
    best = found.best
    # several errors by the noise of 20,000 ions, see `angle_error`
    assert off(best, orientation) < 0.8
    assert best.projection.scale == pytest.approx(SCALE, rel=0.02)
    assert best.rolled == pytest.approx(rolled, abs=0.15)
    assert 0 < best.angle_error < 0.5 and best.score > 0.7  # the pattern is smoothed, its own noise is in the map


@pytest.mark.slow
def test_a_rotated_map_has_a_rotated_orientation():
    """Rotation of the map by 90 degrees, to the noise of equal counts: nothing depends on x and y."""
    _, map = made("fcc", (0.2, 0.5, 0.84), 10.0)
    turned = ae.DetectorMap.from_array(
        np.rot90(map.values, -1), map.x_edges, map.y_edges, np.rot90(map.mask, -1), is_counts=True
    )  # rows are y: anticlockwise on the detector
    answers = [quickly(each, "Ni") for each in (map, turned)]
    first, second = (each.best for each in answers)
    # folded about the pole, both are the same map
    folds = [each.folded((1, 1, 1)) for each in answers]
    assert folds[0].symmetry == "3m" and folds[0].correlation(folds[1]) > 0.95
    assert quickly(map, "Ni").best._plain() == first._plain()  # and the same every time
    about = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    expected = about @ first.orientation.matrix
    # the search grid is the same, so the results differ by the polynomial's rounding and the end of the iteration
    assert misorientation(second.orientation.matrix, expected, proper("fcc")) < 0.1


@pytest.mark.slow
def test_a_compressed_and_shifted_map_is_found():
    projection = ae.detection.Projection(SCALE, (2.0, -1.0), compression=1.5)
    orientation, map = made("bcc", (0.1, 0.3, 0.95), 30.0, projection=projection, ions=60_000)
    found = quickly(map, "W")
    assert found.decided
    assert off(found.best, orientation, projection) < 1.0


@pytest.mark.slow
def test_maps_without_structure_and_of_another_crystal_are_undecided():
    _, map = made("bcc", (0.1, 0.60, 0.80), 110.0, rolled=0.0)
    assert not quickly(map, "Ti").decided
    flat = ae.DetectorMap.from_array(
        np.random.default_rng(4).poisson(3.0, map.values.shape), map.x_edges, map.y_edges, map.mask, is_counts=True
    )
    found = quickly(flat, "W")
    assert found.verdict == "undecided" and len(found.candidates) > 1
    assert sum(each.confidence for each in found.candidates) <= 1.0 + 1e-9
    assert "undecided" in str(found) and found.to_dict()["verdict"] == "undecided"


@pytest.mark.slow
def test_marks_decide_what_a_noisy_map_does_not():
    orientation, map = made("fcc", (0.30, 0.54, 0.79), 20.0, ions=1_500, rolled=0.0)
    alone = quickly(map, "Ni")
    projection = ae.detection.Projection(SCALE)
    places = projection.places(orientation.directions(np.array([[1.0, 1, 1], [1, 1, 3], [0, 1, 1], [1, 3, 3]])))
    names = [(1, 1, 1), (1, 1, 3), (0, 2, 2), (1, 3, 3)]
    poles = [(*place, name) for place, name in zip(places, names, strict=True) if np.hypot(*place) < WIDTH / 2]
    assert len(poles) >= 3
    named = quickly(map, "Ni", poles=poles)
    assert off(named.best, orientation) < 1.5
    assert not alone.decided or off(alone.best, orientation) < 3
    pointed = quickly(map, "Ni", poles=[each[:2] for each in poles])
    assert off(pointed.best, orientation) < 1.5


@pytest.mark.slow
def test_lines_decide_without_a_pole():
    """Two zone lines of tungsten that are parallel to their zones, and miss the pole in which these meet."""
    orientation, map = made("bcc", (0.02, 0.69, 0.72), 40.0, ions=1_500, rolled=0.0)
    projection = ae.detection.Projection(SCALE)
    lines = []
    for zone in ((1.0, 1.0, -1.0), (1.0, -1.0, 1.0)):
        normal = orientation.directions(np.array([zone]))[0]
        normal /= np.linalg.norm(normal)
        first = np.cross(normal, [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        angles = np.radians(np.arange(0, 360, 1.0))
        circle = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
        places = projection.places(circle)
        places = places[np.isfinite(places).all(axis=1)]
        places = places[np.hypot(*places.T) < 30]
        ends = places[[0, -1]] if np.hypot(*(places[0] - places[-1])) > 5 else places[[0, len(places) // 2]]
        along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
        lines.append((*(ends + 1.0 * np.array([-along[1], along[0]])).ravel(), (1, 1, 1)))
    found = quickly(map, "W", lines=lines)
    assert off(found.best, orientation) < 3.0  # lines and offsets: 2.5 degrees


def test_an_axis_of_each_equal_set_is_searched():
    for structure in ("fcc", "hcp"):
        axes = axes_of(structure, AXIS_STEP)
        group = point_group(structure)
        # the area of the sphere over that of the triangle is the order of the group
        assert len(axes) * len(group) == pytest.approx(4 * np.pi / np.radians(AXIS_STEP) ** 2, rel=0.15)
        rng = np.random.default_rng(1)
        for vector in rng.normal(size=(50, 3)):
            equal = group @ (vector / np.linalg.norm(vector))
            nearest = np.degrees(np.arccos(np.clip((axes @ equal.T).max(), -1, 1)))
            assert nearest < AXIS_STEP


def test_the_search_is_the_direct_correlation():
    """Its best score against the correlation of the same pictures, computed without Fourier transforms."""
    module = polar_pictures
    _, map = made("fcc", (0.30, 0.54, 0.79), 0.0, rolled=0.0)
    disc = flattened_by_rings(disc_of(map))
    pattern = master_patterns("fcc")[0]
    search = JointSearch(disc, picture_of(disc), terms_of(ae.material("Ni")), (pattern,), (58.0, 58.0))
    start = search.starts(COUNTED, 1)[0]
    radii, azimuths = module.polar_grid(module.RINGS, module.AZIMUTHS)
    slow, weights = module.slow_changes(radii, azimuths)
    ring, phi = (each.ravel() for each in np.meshgrid(radii, azimuths, indexing="ij"))
    theta = ring * disc.radius / 58.0
    directions = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    densities = np.minimum(pattern.at(directions @ start.matrix, sigma=module.SMOOTHED), 2.5) * np.sqrt(weights)
    densities -= (densities @ slow) @ slow.T
    picture = flattened(disc, np.radians(module.SMOOTHED) * 58.0).ravel()
    fit = np.linalg.lstsq(densities.T, picture, rcond=None)[0]
    direct = np.linalg.norm(densities.T @ fit) / np.linalg.norm(picture)
    # the search takes the nearest pixel of the pattern, here it is interpolated
    correlation = np.sqrt(1 - np.exp(-start.score / COUNTS))
    assert correlation == pytest.approx(direct, abs=0.03) and start.scale == pytest.approx(58.0)


def test_spectra_of_both_hands():
    random = np.random.default_rng(7)
    spectra, picture = (random.normal(size=(*shape, 2)) @ (1, 1j) for shape in ((4, 3, 20, 49), (20, 49)))
    as_it_is, mirrored = joint_search._products(spectra, picture).swapaxes(0, 1)
    assert as_it_is == pytest.approx((spectra * picture.conj()).sum(axis=2).conj())
    assert mirrored == pytest.approx((spectra * picture).sum(axis=2))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 2.0])
def test_the_matrix_of_a_rotation_vector(size):
    vector = size * np.array([0.48, -0.6, 0.64])
    assert rotation_of(vector) == pytest.approx(Rotation.from_rotvec(vector).as_matrix(), abs=1e-15)


def test_the_error_at_the_centre_is_that_of_the_rim_and_of_the_stretch():
    """Against draws of both with their covariance."""
    _, map = made("fcc", (0.30, 0.54, 0.79), ions=2_000)
    disc = disc_of(map)
    fit = refine(bins_of(disc), disc, master_patterns("fcc")[0].smoothed(0.7), np.eye(3), SCALE, steps=1)
    covariance = np.zeros((5, 5))
    covariance[3:, 3:] = 1e-6 * np.array([[9.0, -20.0], [-20.0, 100.0]])
    fit = replace(fit, scale=48.0, stretch=0.2, covariance=covariance, dispersion=2.0)
    rim, stretch = np.random.default_rng(8).multivariate_normal((np.log(48.0), 0.2), 2 * covariance[3:, 3:], 100_000).T
    assert fit.scale_error == pytest.approx(np.std(np.exp(rim) / (1 - stretch)), rel=0.01)


@pytest.mark.slow
def test_the_error_of_the_scale_by_noise_is_its_scatter():
    """The pattern is right: scales of 24 draws, with a lens, have the scatter that one of them predicts."""
    lens = ae.detection.Projection(SCALE, barrel=0.3)  # 10 % at the rim
    densities = master_patterns("fcc")[0].smoothed(0.7)
    scales, errors = [], []
    for seed in range(24):
        orientation, map = made("fcc", (0.30, 0.54, 0.79), 20.0, projection=lens, seed=seed)
        disc = disc_of(map)
        fit = refine(bins_of(disc), disc, densities, orientation.matrix, SCALE, prior=0.1)
        scales.append(fit.scale_at_centre)
        errors.append(fit.scale_error)
    # the error of a standard deviation of 24 is 15 %
    assert np.std(scales, ddof=1) == pytest.approx(np.median(errors), rel=0.45)
    assert np.mean(scales) == pytest.approx(SCALE, abs=3 * np.median(errors) / np.sqrt(24))


def test_the_error_of_the_scale_is_what_patterns_of_other_radii_leave_open(monkeypatch):
    """In a narrow view of one pole its size sets the scale, which a pattern of the right radius alone knows."""
    monkeypatch.setattr(index_map, "terms_of", lambda material: None)
    monkeypatch.setattr(index_map, "Terms", lambda material, patterns: None)
    orientation, bounds = ae.Orientation("W", axis=(0, 1, 1.02), rotation=20.0), (SCALE / 2, 2 * SCALE)
    patterns, width = master_patterns("bcc"), 2 * SCALE * np.radians(23)
    map = patterns[1].map(orientation, ae.detection.Projection(SCALE), width, ions=20_000, rolled=0.5, seed=1)
    disc = disc_of(map)
    view = two_criteria.View(disc, bins_of(disc), np.zeros(0))
    errors = []
    for used in (patterns, patterns[1:2]):
        crystal = index_map._Crystal(view, orientation.material, used, bounds, bounds)
        fit, error = crystal.with_lens(refine(view.bins, disc, crystal.densities, orientation.matrix, SCALE))
        assert fit.scale_at_centre == pytest.approx(SCALE, abs=2 * error)
        errors.append((error, np.hypot(fit.scale_error, index_map.COMMON * fit.scale_at_centre)))
    (by_all, noise), (by_one, noise_of_one) = errors
    assert by_one == pytest.approx(noise_of_one) and by_all > 5 * by_one and noise < 2 * by_one


def test_refinement_never_lowers_the_likelihood():
    orientation, map = made("fcc", (0.30, 0.54, 0.79), 20.0)
    disc = disc_of(map)
    bins = bins_of(disc)
    # the slow polynomials alone are at their maximum: no derivative is left of counts of this scatter
    assert np.abs(bins.slow.T @ (bins.counts - bins.mu)).max() < 1e-6 * np.sqrt(bins.counts.sum() * len(bins.counts))
    densities = master_patterns("fcc")[0].smoothed(0.7)
    start = Start(Rotation.from_rotvec((1, 1, 0), degrees=True).as_matrix() @ orientation.matrix, 58.0, 0.0)
    gains = [refine(bins, disc, densities, start.matrix, start.scale, steps=n).gain for n in (4, 8, 20)]
    assert gains[0] <= gains[1] + 1e-6 <= gains[2] + 2e-6
    last = refine(bins, disc, densities, start.matrix, start.scale)
    # the model of these counts is right: their deviations are Poisson's, and not correlated
    assert last.dispersion == pytest.approx(1.0, abs=0.25) and last.explained == pytest.approx(1.0, abs=0.1)
    assert deviance(bins.counts, bins.counts + 1e-12) == pytest.approx(0, abs=1e-6)


def test_the_normal_equations_are_the_derivatives_of_the_likelihood():
    orientation, map = made("fcc", (0.30, 0.54, 0.79), 20.0)
    disc = disc_of(map)
    bins, densities = bins_of(disc), master_patterns("fcc")[0].smoothed(1.5)
    geometry = np.array([0.03, 0.0, -0.02, np.log(SCALE), 0.02])
    likelihood = _Likelihood(bins, disc, densities, orientation.matrix, (), None, geometry, 0.05)
    state = _State(bins.fit, np.array([0.3, 0.4]), geometry, likelihood.contrasts(geometry))
    normal, right = likelihood.normal_equations(state, moving=True)

    def moved(k, by):
        numbers = np.concatenate(state[:3])
        numbers[k] += by
        fit, amplitudes, geometry = np.split(numbers, np.cumsum([len(part) for part in state[:2]]))
        return _State(fit, amplitudes, geometry, likelihood.contrasts(geometry))

    for k in range(len(right)):
        states = [moved(k, by) for by in (-2e-3, 2e-3)]
        low, high = (likelihood.value(state) for state in states)
        scale = np.sqrt(normal[k, k])
        assert (low - high) / 8e-3 / scale == pytest.approx(right[k] / scale, abs=1.0), k
        low, high = (likelihood.expected(state)[0] for state in states)
        by_counts = ((high - low) ** 2 / 16e-6 / likelihood.expected(state)[0]).sum()
        assert normal[k, k] == pytest.approx(by_counts + (400.0 if k == len(right) - 1 else 0), rel=0.1), k


@pytest.mark.parametrize("mirror", [False, True])
def test_a_given_orientation_is_refined(mirror):
    """A start that is some degrees off, about another centre, goes to the orientation of the map."""
    truth, measured = made("fcc", (0.30, 0.54, 0.79), 20.0)
    away = ae.detection.Projection(58.0, (2.0, -1.0), mirror=mirror)
    # the orientation whose directions are at the same places of this projection
    places = np.array([[0.0, 0.0], [15.0, 0.0], [0.0, 15.0]])
    turn = away.directions(places).T @ np.linalg.inv(ae.detection.Projection(SCALE).directions(places).T)
    matrix = turn @ truth.matrix
    left, _, right = np.linalg.svd(-matrix if mirror else matrix)
    start = ae.Orientation.from_matrix("Ni", left @ right)
    found = ae.index(measured, "Ni", start=(start, away))
    assert off(found.best, truth) < 1.0  # noise alone: 0.1
    assert found.best.projection.scale == pytest.approx(SCALE, rel=0.02) and not found.decided
    assert len(found.candidates) == 1


@pytest.mark.slow
def test_densities_are_indexed_as_counts_are():
    orientation, map = made("fcc", (0.30, 0.54, 0.79), 20.0, ions=60_000)
    density = ae.DetectorMap.from_array(np.where(map.mask, map.density, np.nan), map.x_edges, map.y_edges)
    found = ae.index(density, "Ni", distance=90.0)  # all patterns, half angles of 27 to 50 degrees
    assert found.decided and off(found.best, orientation) < 0.5
    assert "flight length" not in found.reason  # which was given


def test_marks_of_a_wrong_form_are_refused():
    nickel = ae.material("Ni")
    for name, marks in (("poles", ([(1.0,)], [])), ("lines", ([], [(1.0, 2.0)])), ("lines", ([], [(1.0, 2, 1, 2)]))):
        with pytest.raises(ValueError, match=name.rstrip("s")):
            marks_of(nickel, *marks)
    _, map = made("fcc", (0.30, 0.54, 0.79), ions=2_000)
    with pytest.raises(ValueError, match=r"the second of scales must be .* >= 50, got 40"):
        quickly(map, "Ni", scales=(50.0, 40.0))
    with pytest.raises(ValueError, match="distance"):
        ae.index(map, "Ni", scales=(50.0, 60.0), distance=90.0)
    with pytest.raises(ValueError, match="patterns"):
        ae.index(map, "Ni", patterns=master_patterns("bcc"))


@pytest.mark.slow
def test_few_ions_do_not_decide(monkeypatch):
    _, map = made("fcc", (0.30, 0.54, 0.79), 20.0, ions=20_000)
    assert quickly(map, "Ni").decided and map.ions > LEAST_IONS
    monkeypatch.setattr("apt_evap.maps.indexing.index_map.LEAST_IONS", 30_000)
    found = quickly(map, "Ni")
    assert not found.decided and f"{map.ions:,}" in found.reason


@pytest.mark.slow
def test_the_picture_of_an_answer_shows_its_candidates():
    _, map = made("fcc", (0.30, 0.54, 0.79), ions=20_000)
    found = quickly(map, "Ni")
    assert found.decided and len(ae.plot.indexing(found)) == 3
    axes = ae.plot.indexing(found, candidates=2)
    assert len(axes) == 5 and f"{found.best}" in axes[1].get_title().replace("\n", " ")
    # lines, poles and colours are explained
    figure = axes[0].figure
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "poles" in names and "zone lines of ⟨$110$⟩" in names and len(set(names)) == len(names)
    bars = [ax.get_ylabel() for ax in figure.axes if ax not in set(axes)]
    assert bars == ["hits per area / mean", "predicted hits per area / mean"]
    assert len({image.get_clim() for ax in axes[2::2] for image in ax.images}) == 1
    # the pattern beside it is that of the map
    predicted = found.best.predicted(map)
    inside = map.mask
    smooth = map.smoothed(1.0).values[inside]
    assert np.corrcoef(predicted.values[inside], smooth)[0, 1] > 0.7
    assert DECIDED > 0


@pytest.mark.slow
def test_bounds_of_the_scale_hold_for_all_candidates():
    _, map = made("fcc", (0.30, 0.54, 0.79), 20.0)  # its scale is outside of all of these
    for scales in ((48.0, 54.0), (66.0, 72.0), (50.0, 50.0)):
        for each in quickly(map, "Ni", scales=scales).candidates:
            assert scales[0] <= each.projection.scale <= scales[1]
    for each in ae.index(map, "Ni", patterns=master_patterns("fcc")[:1], distance=60.0).candidates:
        assert 60 / 2.2 <= each.projection.scale <= 60 / 1.2


@pytest.mark.parametrize("options", [
    {"distance": 1e-9}, {"distance": 0.1}, {"distance": 1e12}, {"scales": (1e-9, 1e-8)}, {"scales": (22.0, 30.0)},
    {"scales": (1e5, 1e6)},
])  # fmt: skip
def test_half_angles_that_no_instrument_has_are_refused(options):
    _, map = made("fcc", (0.30, 0.54, 0.79), ions=2_000)
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be .* for this map"):
        ae.index(map, "Ni", **options)


@pytest.mark.slow
@pytest.mark.parametrize("mean", [0.5, 3.0])
@pytest.mark.parametrize("shape", ["flat", "gradient", "half", "hot bins"])
def test_noise_has_no_score(mean, shape):
    _, map = made("bcc", (0.1, 0.60, 0.80), ions=2_000)
    x = map.centres[0][None, :] / 35
    expected = {"flat": 1 + 0 * x, "gradient": 1 + 0.6 * x, "half": 1.0 * (x > 0)}.get(shape, 1 + 0 * x) * mean
    counts = np.random.default_rng(4).poisson(np.broadcast_to(expected, map.values.shape))
    if shape == "hot bins":
        counts[45, 70], counts[80, 30:32] = 5_000, 300
    found = quickly(ae.DetectorMap.from_array(counts, map.x_edges, map.y_edges, map.mask, is_counts=True), "W")
    assert not found.decided and "no structure" in found.reason
    assert [each.score for each in found.candidates] == [0.0] * len(found.candidates)


def test_dark_lines_do_not_divide_the_disc():
    """Lines without hits that reach the rim are inside: what they cut off was left out, and a wrong result decided."""
    _, map = made("fcc", (0.30, 0.54, 0.79), ions=60_000)
    x, y = np.meshgrid(*map.centres)
    whole = disc_of(map)
    for dark in (np.abs(y + 8) < 1.5, np.abs(x - 0.4 * y - 5) < 1.5, (np.abs(y + 8) < 1.5) | (np.abs(x - 12) < 1.5)):
        cut = disc_of(replace(map, values=np.where(dark, 0, map.values)))
        assert cut.radius == pytest.approx(whole.radius, rel=0.03)
        assert cut.centre == pytest.approx(whole.centre, abs=0.03 * whole.radius)
        assert np.count_nonzero(cut.map.mask) > 0.97 * np.count_nonzero(whole.map.mask)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("zeros", "hits"),
        ("one hot bin", "field of view"),
        ("row", "field of view"),
        ("thin", "field of view"),
        ("few bins", "bins"),
        ("three bins", "bins"),
        ("not numbers", "bins"),
    ],
)
def test_maps_that_can_show_nothing_are_undecided(kind, why):
    counts = np.random.default_rng(1).poisson(3.0, (128, 128)).astype(float)
    if kind == "zeros":
        counts *= 0
    elif kind == "one hot bin":
        counts = np.where(np.arange(128 * 128).reshape(128, 128) == 8000, 5000, 0)
    elif kind == "row":
        counts[:62], counts[66:] = 0, 0
    elif kind == "thin":
        counts = counts[:4]
    elif kind == "few bins":
        counts = counts[:5, :5]
    elif kind == "three bins":
        counts = counts[:1, :3]
    else:
        counts[:] = np.nan
        counts[60:64, 60:64] = 3.0
    edges = [np.arange(size + 1.0) - size / 2 for size in counts.shape]
    found = ae.index(ae.DetectorMap.from_array(counts, edges[1], edges[0], is_counts=True), "W")
    assert found.verdict == "undecided" and found.candidates == () and why in found.reason
    assert found.reason in str(found) and found.to_dict()["candidates"] == [] and found.deciding_marks == ()
    assert "0 candidates" in repr(found)
    with pytest.raises(ValueError, match="candidate to draw.*" + why):
        ae.plot.indexing(found)
    with pytest.raises(ValueError, match="no orientation: .*" + why):
        _ = found.best


def test_marks_outside_the_map_and_of_no_pole_are_refused():
    _, map = made("fcc", (0.30, 0.54, 0.79), ions=2_000)
    for poles in (
        [(1e9, 1e9)],
        [(34.0, 34.0)],
        [(1.0, 1.0, (99999, 1, 1))],
        [(1.0, 1.0, (1.5, 1, 1))],
        [(1.0, 1.0, 7)],
    ):
        with pytest.raises(ValueError, match="poles"):
            quickly(map, "Ni", poles=poles)
    with pytest.raises(ValueError, match="lines"):
        quickly(map, "Ni", lines=[(0.0, 0.0, 0.0, 90.0)])


@pytest.mark.slow
def test_marks_that_contradict_each_other_or_the_map_are_named():
    orientation, map = made("fcc", (0.42, 0.50, 0.76), 20.0)
    projection = ae.detection.Projection(SCALE)
    first, second, third = projection.places(orientation.directions(np.array([[1.0, 0, 1], [0, -1, -1], [1, 1, 1]])) * [
        [1], [-1], [1]]).tolist()  # fmt: skip
    good = quickly(map, "Ni", poles=[(*first, (0, 2, 2)), (*second, (0, 2, 2)), (*third, (1, 1, 1))])
    assert good.decided
    # 60 degrees apart, as 311 and another 311 are within 3 degrees, but 311 is not there
    wrong = quickly(map, "Ni", poles=[(*first, (3, 1, 1)), (*second, (3, 1, 1))])
    assert not wrong.decided and wrong.reason.count("called 311") == 2
    assert off(wrong.best, orientation) < 1.0
    # no scale makes two poles 111 as near as these
    near = quickly(map, "Ni", poles=[(*third, (1, 1, 1)), (third[0] + 15.0, third[1], (1, 1, 1))])
    assert not near.decided and "contradict each other" in near.reason and near.reason.count("called 111") == 2


@pytest.mark.slow
def test_marks_that_would_decide_are_named():
    """The named spot is a pole of its candidate, of a family that no other candidate has there."""
    _, map = made("fcc", (0.30, 0.54, 0.79), 20.0, ions=30_000, rolled=0.5)
    found = quickly(map, "Ni")
    assert found.decided and found.deciding_marks == ()
    undecided = replace(found, decided=False)
    sentences = undecided.deciding_marks
    assert len(undecided.candidates) > 1 and sentences and all(sentence in str(undecided) for sentence in sentences)
    assert undecided.to_dict()["deciding_marks"] == list(sentences)
    for sentence in sentences:
        x, y, family, number = re.fullmatch(
            r"if the spot at \((-?\d+), (-?\d+)\) mm is \{(\d+)\}: candidate (\d)", sentence
        ).groups()
        marked = (float(x), float(y)), tuple(int(index) for index in family)
        distances = [nearest_of_family(candidate, *marked) for candidate in undecided.candidates[:3]]
        first = distances.pop(int(number) - 1)
        # rounded to 1 mm; 4.5 degrees are 4.7 mm
        assert first < 0.8 and min(distances) > 3.5


def test_marks_of_a_hexagonal_crystal():
    """Families are those by spacing and indices in any order, named with their signs."""
    map = ae.DetectorMap.from_array(np.ones((64, 64)), *[np.linspace(-40, 40, 65)] * 2)
    projection = ae.detection.Projection(60.0)
    candidates = [(ae.Orientation("Ti", axis=axis), projection) for axis in ((0, 0, 0, 1), (1, 0, -1, 1))]
    first, second = deciding_marks(map, candidates)
    assert first == "if the spot at (0, 0) mm is {0002}: candidate 1"
    x, y = re.fullmatch(r"if the spot at \((-?\d+), (-?\d+)\) mm is \{1 0 -1 1\}: candidate 2", second).groups()
    normals = plane_normals(
        ae.material("Ti"), [(1, 0, -1, 1), (0, 1, -1, 1), (-1, 1, 0, 1), (-1, 0, 1, 1), (0, -1, 1, 1)]
    )
    places = projection.places(candidates[1][0].directions(np.vstack([normals, -normals])))
    assert np.nanmin(np.hypot(*(places - (float(x), float(y))).T)) < 0.8  # rounded to 1 mm


def nearest_of_family(candidate, place, plane):
    """Distance of the nearest pole of a family [mm]."""
    normal = np.array(plane) / np.linalg.norm(plane)
    directions = candidate.orientation.directions(point_group("fcc") @ normal)
    places = candidate.projection.places(directions)
    return float(np.nanmin(np.hypot(*(places - place).T)))


@pytest.mark.slow
def test_the_same_axis_at_another_scale_is_a_rival():
    """A map of two halves with one orientation and scales of 50 and 72 mm/rad: no other orientation explains it."""
    halves = [
        made("fcc", (0.30, 0.54, 0.79), 20.0, projection=ae.detection.Projection(scale), seed=seed)
        for seed, scale in enumerate((50.0, 72.0))
    ]
    (orientation, map), (_, other) = halves
    sums = ae.DetectorMap.from_array(map.values + other.values, map.x_edges, map.y_edges, map.mask, is_counts=True)
    found = quickly(sums, "Ni", scales=(44.0, 80.0))
    assert sorted(candidate.projection.scale for candidate in found.candidates[:2]) == pytest.approx(
        [50.0, 72.0], rel=0.04
    )  # each is refined on the sum
    for candidate in found.candidates[:2]:
        assert misorientation(candidate.orientation.matrix, orientation.matrix, proper("fcc")) < 1.0
    # 26 in the sum, of the order of what is needed; hundreds in one of the halves
    alone = quickly(map, "Ni", scales=(44.0, 80.0))
    assert over_the_next(found) < 2 * DECIDED < over_the_next(alone) and alone.decided


def over_the_next(found):
    """Evidence over the next best orientation or scale, from the confidences."""
    first, second = (candidate.confidence for candidate in found.candidates[:2])
    return 2 * np.log(first / max(second, 1e-300))


@pytest.mark.slow
def test_a_mixture_of_patterns_is_fitted_as_such():
    """A map of two patterns in equal parts: their amplitudes, and no others; the model is right for its counts."""
    patterns = master_patterns("fcc")
    orientation, first = made("fcc", (0.30, 0.54, 0.79), 20.0, ions=100_000, rolled=0.0, pattern=0)
    _, last = made("fcc", (0.30, 0.54, 0.79), 20.0, ions=100_000, rolled=1.0, pattern=2, seed=2)
    counts = first.values + last.values
    both = ae.DetectorMap.from_array(counts, first.x_edges, first.y_edges, first.mask, is_counts=True)
    disc = disc_of(both)
    densities = np.concatenate([pattern.smoothed(0.5) for pattern in patterns])
    fit = refine(bins_of(disc), disc, densities, orientation.matrix, SCALE, steps=20)
    assert fit.amplitudes[[0, 5]] == pytest.approx([0.5, 0.5], abs=0.1)
    assert fit.amplitudes.min() >= 0 and fit.amplitudes[[1, 2, 3, 4]].max() < 0.1
    assert fit.explained > 0.9  # the smoothing of the densities is not in the map
    single = refine(bins_of(disc), disc, densities[:2], orientation.matrix, SCALE, steps=20)
    assert fit.gain > single.gain + 1000
    mean = mixture(patterns, fit.amplitudes)
    assert 20 < mean.apex_radius < 80 and mean.densities.shape == patterns[0].densities.shape
    assert mixture(patterns[:1], np.zeros(2)).densities == pytest.approx(patterns[0].densities)


def test_the_angle_between_two_results():
    """Turned about the centre, and at another scale, by their formulas; equal crystals are the same."""
    _, map = made("fcc", (0.30, 0.54, 0.79), ions=2_000)
    disc, group = disc_of(map), point_group("fcc")
    densities = master_patterns("fcc")[0].smoothed(0.7)
    fit = refine(bins_of(disc), disc, densities, np.eye(3), SCALE, steps=1)
    half_angle = disc.radius / SCALE
    for turn in (2.0, 8.0):
        tilted = replace(fit, matrix=Rotation.from_euler("z", turn, degrees=True).as_matrix() @ group[5])
        # directions theta off the axis turn by theta' = 2 asin(sin(theta) sin(turn / 2)), here averaged over the disc
        theta = np.linspace(0, half_angle, 2001)
        angles = np.degrees(2 * np.arcsin(np.sin(theta) * np.sin(np.radians(turn / 2))))
        expected = np.sqrt((angles**2 * theta).sum() / theta.sum())
        assert angle_between(fit, tilted, group, disc.radius) == pytest.approx(expected, rel=0.02)
    other = replace(fit, scale=1.2 * SCALE)
    rim = np.degrees(half_angle * (1 - 1 / 1.2))
    assert angle_between(fit, other, group, disc.radius) == pytest.approx(rim / np.sqrt(2), rel=0.02)


def test_marks_that_would_decide_are_in_the_field_of_view():
    """A map without a mask, as of recorded ions: no spot in its empty corners."""
    orientation, map = made("fcc", (0.30, 0.54, 0.79), 20.0, ions=30_000)
    bare = ae.DetectorMap.from_array(np.where(map.mask, map.values, 0), map.x_edges, map.y_edges, is_counts=True)
    projection = ae.detection.Projection(SCALE)
    corner = projection.directions(np.array([[29.0, 29.0]]))[0]
    turned = about_axis(corner).T  # a {111} pole in a corner
    pattern = master_patterns("fcc")[0]
    candidates = [
        Candidate(ae.Orientation.from_matrix("Ni", matrix), projection, 0.5, 0.5, 0.5, 1.0, 0.1, pattern)
        for matrix in (turned @ about_axis(np.ones(3) / np.sqrt(3)), orientation.matrix)
    ]
    for sentence in Indexing(bare, tuple(candidates), False, "two").deciding_marks:
        place = re.search(r"\((-?\d+), (-?\d+)\)", sentence).groups()
        assert np.hypot(*np.array(place, float)) < WIDTH / 2
