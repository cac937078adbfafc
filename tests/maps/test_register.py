"""Known transforms are found again; what cannot be found is said."""

import json
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rough import ROUGH
from scipy import ndimage

import apt_evap as ae
from apt_evap import plot
from apt_evap._common.codec import for_json, from_plain
from apt_evap.maps.registration import correlation_search
from apt_evap.maps.registration.register import register, register_points
from apt_evap.maps.registration.transform import SimilarityTransform
from apt_evap.warnings import RegistrationWarning

NICKEL = Path(__file__).parents[3] / "shared" / "data" / "ni111_map.npz"
ROLLED = ae.RollUp(ae.TruncatedNormal(0.155, 0.155))
FASTER = ae.RollUp(ae.TruncatedNormal(0.3, 0.1))


@pytest.fixture(scope="session")
def low(made_once):
    """Ni[124], an axis without any symmetry: 16,000 ions."""
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, apex_radius=16 * nickel.a, axis=(1, 2, 4), shank_length=16 * nickel.a)
    return made_once(tip, 16_000, voltage=1000.0, seed=1, **ROUGH)


@pytest.fixture(scope="session")
def simulated(low):
    """What `low` shows, 48,000 hits."""
    return together(low.hits(ROLLED), replace(low, seed=2).hits(ROLLED), replace(low, seed=3).hits(ROLLED))


def together(*parts):
    return ae.Hits(**{name: np.concatenate([getattr(p, name)[p.detected] for p in parts]) for name in "xy"})


def measured(draws, true, radius, seed, ions=100_000):
    """As an instrument sees the hits of some draws: moved, within a circle off the centre, thinner to one side.

    The density falls by a factor of 15 across the field of view.
    """
    rng = np.random.default_rng(seed)
    x, y = [], []
    for hits in draws:
        moved = true.hits(hits[hits.detected])
        u, v = (moved.x - 0.05 * radius) / radius, moved.y / radius
        thinned = np.exp(1.2 * u + 0.6 * v - 0.5 * (u * u + v * v)) / 4
        kept = (u * u + v * v < 1) & (rng.random(len(u)) < thinned)
        x.append(moved.x[kept])
        y.append(moved.y[kept])
        if sum(map(len, x)) >= ions:
            break
    x, y = np.concatenate(x)[:ions], np.concatenate(y)[:ions]
    return ae.Hits(x=x, y=y).map()


def draws(run, perturbation, seed, part=slice(None)):
    """Hits of one run again and again, each time with other random numbers."""
    for number in range(60):
        yield replace(run, seed=1000 * seed + number).hits(perturbation)[part]


@pytest.fixture(scope="session")
def map_of(low):
    """`measured` of draws of `low`, made once for each registration, radius and seed."""
    return cache(lambda true, radius, seed: measured(draws(low, FASTER, seed), true, radius, seed))


def off(found, true, radius):
    """By how many degrees, what share of the scale and, at the middle of the map, of the radius a transform is off."""
    middle = true.inverse.points(0.05 * radius, 0.0)
    distance = np.hypot(*np.subtract(found.points(*middle), (0.05 * radius, 0.0))) / radius
    return abs((found.rotation - true.rotation + 180) % 360 - 180), abs(found.scale / true.scale - 1), distance


# ---- from maps -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "scale, mirror, radius, shift, seed, scales",
    [
        (0.45, True, 30, (8.0, 3.0), 2, (0.3, 0.7)),
        pytest.param(0.2, False, 15, (6.0, -3.0), 1, None, marks=pytest.mark.slow),
        pytest.param(0.45, True, 30, (8.0, 3.0), 2, None, marks=pytest.mark.slow),
        pytest.param(1.5, False, 110, (20.0, -30.0), 3, None, marks=pytest.mark.slow),
    ],
)
def test_a_known_transform(map_of, simulated, scale, mirror, radius, shift, seed, scales):
    """Other energies, a gradient, an off-centre circle, 1e5 ions: within 1 degree and 1 %, as asked for."""
    true = ae.Registration(17.0, scale, shift, mirror)
    map = map_of(true, radius, seed)
    assert map.ions > 85_000  # of 100,000 some are too thinly spread to be in the mask
    found = register(simulated, map, scales=scales)
    assert found.mirror == mirror and found.method == "search"
    rotation, stretch, distance = off(found, true, radius)
    assert rotation < 1 and stretch < 0.01 and distance < 0.01
    assert found.score > 0.75 and found.overlap > 0.98


@pytest.mark.slow
def test_layers_of_their_own(low):
    """The maps share no atom: 8,000 of the early layers, 8,000 of the late ones, when the tip is blunter by 2 %."""
    early = together(*(replace(low, seed=seed).hits(ROLLED)[:8000] for seed in range(1, 7)))
    true = ae.Registration(17.0, 0.45, (8.0, 3.0), True)
    map = measured(draws(low, FASTER, 2, slice(8000, None)), true, 30, 2)
    found = register(early, map, scales=(0.4, 0.5))
    rotation, stretch, distance = off(found, true, 30)
    assert found.mirror and rotation < 1 and stretch < 0.03 and distance < 0.02


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the registration is doubtful")
def test_what_is_known_is_kept(map_of, simulated):
    true = ae.Registration(17.0, 0.45, (8.0, 3.0), True)
    map = map_of(true, 30, 2)
    start = ae.Registration(8.0, 0.5, (11.0, 1.0), True)
    found = register(simulated, map, start=start)
    rotation, stretch, distance = off(found, true, 30)
    assert found.method == "start" and found.mirror  # and no warning: nothing is at a bound
    assert rotation < 1 and stretch < 0.01 and distance < 0.01
    fixed = register(simulated, map, start=start, scales=0.44, rotations=15.0)
    assert (fixed.scale, fixed.rotation) == pytest.approx((0.44, 15.0), rel=1e-12)
    assert fixed.score < found.score
    with pytest.warns(RegistrationWarning, match="rotation 18 .* scale 0.46"):
        bound = register(simulated, map, start=start, scales=(0.46, 0.5), rotations=(18.0, 25.0))
    assert 0.46 <= bound.scale <= 0.5 and 18 <= bound.rotation <= 25
    wrong = ((0.0, 0.0), (8.5, 3.0))
    with pytest.warns(RegistrationWarning, match=r"shift .*\(tolerance\)"):
        held = register(simulated, map, pole=wrong, tolerance=0.2, scales=(0.43, 0.47))
    assert held.method == "pole" and held.mirror
    assert np.abs(np.subtract(held.points(0.0, 0.0), wrong[1])).max() <= 0.2 + 1e-9
    with pytest.warns(RegistrationWarning, match="bound"):
        plain = register(simulated, map, start=start, mirrors=(False,), tolerance=30.0)
    assert not plain.mirror and plain.score < found.score - 0.1


@pytest.mark.slow
def test_the_score_surface_has_its_maximum_at_the_registration(map_of, simulated):
    map = map_of(ae.Registration(17.0, 0.45, (8.0, 3.0)), 30, 2)
    surface = ae.maps.score_surface(simulated, map, scales=(0.36, 0.55), rotations=(-30.0, 80.0))
    assert surface.scores.shape == (len(surface.scales), len(surface.rotations)) and not surface.mirror
    row, column = np.unravel_index(np.nanargmax(surface.scores), surface.scores.shape)
    assert abs(surface.rotations[column] - 17.0) <= 3.0  # one step of the grid
    assert abs(np.log(surface.scales[row] / 0.45)) <= 0.05
    assert surface.scores[row, column] > np.nanmedian(surface.scores) + 0.3  # 0.8 and 0.2
    ax = ae.plot.score_surface(surface)
    assert f"{surface.scores[row, column]:.2f}" in ax.get_title()
    with pytest.raises(ValueError, match="surface"):
        ae.plot.score_surface(surface._replace(scores=surface.scores[:1]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the registration is doubtful")
def test_a_threefold_pole_with_mirrors_has_ties(tip20):
    """fcc [111]: turned by 120 degrees it is the same, and mirrored and turned by 60; unmirrored is preferred."""
    # flights as exact as by default: how many of the five others are ties depends on the details of the map
    run = ae.Simulation(tip20, voltage=1000.0, seed=1).run(15_000, (ROLLED,), responses=False, progress=False)
    rolled = run.hits(ROLLED)
    true = ae.Registration(17.0, 0.5, (3.0, -2.0))
    early, late = rolled[:7500], true.hits(rolled[7500:])
    found = register(early, late, scales=(0.4, 0.6))
    assert not found.mirror and any(tie.mirror for tie in found.ties) and len(found.ties) >= 2
    for one in (found, *found.ties):
        equal = (one.rotation - (77 if one.mirror else 17) + 60) % 120 - 60
        assert abs(equal) < 1 and abs(one.scale / 0.5 - 1) < 0.04  # the tip gets blunter
    second = register(early, late, start=ae.Registration(140.0, 0.48, (3.0, -2.0)))
    assert abs(second.rotation - 137) < 1  # a start chooses


@pytest.mark.slow
def test_maps_that_have_nothing_in_common(simulated):
    rng = np.random.default_rng(5)
    z = 20 * np.sqrt(rng.random(100_000)) * np.exp(2j * np.pi * rng.random(100_000))
    with pytest.warns(RegistrationWarning, match="correlation of the maps is only 0.[0-3]"):
        found = register(simulated, ae.Hits(x=z.real, y=z.imag), scales=(0.28, 0.33), mirrors=(False,))
    assert found.score < 0.35
    with pytest.raises(ValueError, match="must cover at least 50% of the measured field of view"):
        register(simulated, ae.Hits(x=z.real, y=z.imag), scales=0.01)


@pytest.mark.slow
def test_a_registration_by_few_hits_is_not_tried(rng):
    """A magnified rim of a map, of which some hits are on the measured one, fits anything by chance."""
    few, many = (20 * np.sqrt(rng.random(n)) * np.exp(2j * np.pi * rng.random(n)) for n in (4_000, 20_000))
    with pytest.warns(RegistrationWarning):
        found = register(*(ae.Hits(x=z.real, y=z.imag) for z in (few, many)), rotations=(0, 12), mirrors=[False])
    x, y = found.points(few.real, few.imag)
    assert np.count_nonzero(np.hypot(x, y) < 20) >= 900  # within the rim of the map


@pytest.mark.slow
@pytest.mark.skipif(not NICKEL.exists(), reason="the measured map of nickel is not there")
@pytest.mark.filterwarnings("ignore:the registration is doubtful")
def test_measured_nickel(run20):
    """Its six bright lines, about 60 degrees apart, from 28 degrees on; those simulated with roll-up begin at 30."""
    data = np.load(NICKEL)
    map = ae.DetectorMap.from_array(*(data[name] for name in ("relative_density", "x_edges_mm", "y_edges_mm")))
    found = register(run20.hits(ROLLED), map, pole=((0, 0), (-9.6, -0.4)), scales=(0.15, 0.5))
    assert abs((found.rotation + 30) % 60 - 30) < 4
    assert np.hypot(found.shift[0] + 9.6, found.shift[1] + 0.4) < 1


# ---- from points ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mirror", [False, True])
def test_points_that_fit_exactly(mirror, rng):
    true = ae.Registration(-112.0, 0.37, (4.0, -9.0), mirror)
    points = rng.normal(size=(5, 2)) * 30
    moved = np.column_stack(true.points(*points.T))
    found = register_points(points, moved)
    assert (found.rotation, found.scale, *found.shift) == pytest.approx((-112.0, 0.37, 4.0, -9.0), rel=1e-9)
    assert found.mirror == mirror and found.residual < 1e-9 and found.method == "points"
    two = register_points(points[:2], moved[:2], mirror=mirror)
    assert (two.rotation, two.scale, *two.shift) == pytest.approx((-112.0, 0.37, 4.0, -9.0), rel=1e-9)
    assert not register_points(points[:2], moved[:2]).mirror  # two points do not tell


def test_points_by_least_squares(rng):
    points = rng.normal(size=(6, 2)) * 30
    target = np.column_stack(ae.Registration(20.0, 0.5, (1.0, 2.0)).points(*points.T)) + rng.normal(size=(6, 2))
    found = register_points(points, target)

    def rms(one):
        return np.sqrt(((np.column_stack(one.points(*points.T)) - target) ** 2).sum(1).mean())

    assert rms(found) == pytest.approx(found.residual, rel=1e-12)
    for change in ({"rotation": 0.1}, {"scale": 1e-3}, {"shift": (0.05, 0)}, {"shift": (0, 0.05)}):
        for sign in (1, -1):
            moved = {name: np.add(getattr(found, name), sign * np.array(step)) for name, step in change.items()}
            moved = {name: tuple(v) if np.ndim(v) else float(v) for name, v in moved.items()}
            assert rms(replace(found, **moved)) > rms(found)


# ---- the transform -------------------------------------------------------------------------------------------------

transforms = st.builds(
    ae.Registration,
    st.floats(-720, 720),
    st.floats(0.01, 100),
    st.tuples(st.floats(-100, 100), st.floats(-100, 100)),
    st.booleans(),
)


def test_order_of_the_steps():
    """The point (1, 2): mirrored (1, -2), turned by 90 degrees (2, 1), scaled (6, 3), shifted (6.5, 2)."""
    assert ae.Registration(90.0, 3.0, (0.5, -1.0), True).points(1.0, 2.0) == pytest.approx((6.5, 2.0))


@given(transforms, st.complex_numbers(max_magnitude=100), st.complex_numbers(max_magnitude=100))
def test_an_anchor_changes_no_transform(registration, place, point):
    anchored = registration.transform.anchored(place)
    assert anchored.place == place
    assert anchored.apply(anchored.anchor) == place
    assert anchored.apply(point) == pytest.approx(registration.transform.apply(point), abs=1e-6)
    assert anchored.apply_inverse(anchored.apply(point)) == pytest.approx(point, abs=1e-6)
    assert anchored.inverse.apply(place) == anchored.anchor
    assert anchored.inverse.apply(point) == pytest.approx(anchored.apply_inverse(point), abs=1e-6)


@given(transforms, st.floats(-180, 180), st.floats(0.1, 10))
def test_turning_and_stretching_leaves_the_anchor_where_it_is(registration, rotation, scale):
    anchored = registration.transform.anchored(3 - 4j)
    turned = replace(anchored, rotation=anchored.rotation + rotation, scale=anchored.scale * scale)
    assert turned.apply(turned.anchor) == 3 - 4j
    distance = abs(anchored.apply(anchored.anchor + 1) - (3 - 4j))
    assert abs(turned.apply(turned.anchor + 1) - (3 - 4j)) == pytest.approx(scale * distance)


def test_a_registration_moves_points_as_its_formula_says():
    """With z = x + iy, z' = scale exp(i rotation) conj(z) + shift, to the last bit."""
    registration = ae.Registration(33.0, 0.7, (4.0, -9.0), True)
    x, y = np.random.default_rng(1).normal(size=(2, 1000)) * 30
    moved = 0.7 * np.exp(1j * np.radians(33.0)) * np.conj(x + 1j * y) + (4.0 - 9.0j)
    assert np.array_equal(registration.points(x, y), [moved.real, moved.imag])
    assert registration.transform == SimilarityTransform(33.0, 0.7, True, place=4.0 - 9.0j)


@given(transforms, st.floats(-100, 100), st.floats(-100, 100))
def test_there_and_back(transform, x, y):
    assert transform.inverse.points(*transform.points(x, y)) == pytest.approx((x, y), abs=1e-6)
    assert transform.points(*transform.inverse.points(x, y)) == pytest.approx((x, y), abs=1e-6)
    assert -180 <= transform.rotation < 180


@given(transforms)
def test_plain_types(transform):
    transform = replace(transform, score=0.5, ties=(transform, transform.inverse))
    plain = for_json(transform)
    again = from_plain(json.loads(json.dumps(plain, allow_nan=False)), ae.Registration)
    assert for_json(again) == plain
    assert again.ties[0].points(1, 2) == transform.ties[0].points(1, 2)


def test_hits_keep_their_columns():
    hits = ae.Hits(x=[1.0, np.nan], y=[0.0, 1.0], ion=[3, 4], outcome=[0, 1], source="f")
    moved = ae.Registration(90.0, 2.0, (1.0, 0.0)).hits(hits)
    np.testing.assert_allclose([moved.x, moved.y], [[1.0, np.nan], [2.0, np.nan]], atol=1e-12)
    assert moved.ion.tolist() == [3, 4] and moved.source == "f" and moved.detected.tolist() == [True, False]


def test_bad_input():
    map = ae.Hits(x=np.linspace(0, 1, 500) ** 2, y=np.linspace(1, 0, 500)).map(bins=16)
    cases = [
        (lambda: ae.Registration(0.0, 0.0, (0, 0)), "scale must be a finite number > 0, got 0"),
        (lambda: ae.Registration(0.0, 1.0, (0, 0, 0)), r"shift must have shape \(2,\)"),
        (lambda: register(map.values, map), "simulated must be a DetectorMap or Hits"),
        (lambda: register(map, map, start=3), "start must be a Registration, got 3"),
        (lambda: register(map, map, scales=(2, 1)), "scales must be a finite number >= 2, got 1"),
        (lambda: register(map, map, scales=0.0), "scales must be a finite number > 0"),
        (lambda: register(map, map, overlap=1.5), "overlap must be"),
        (lambda: register(map, map, mirrors=()), "mirrors must contain"),
        (lambda: register(map, map, pole=(0, 0)), r"pole must have shape \(2, 2\)"),
        (lambda: register(map, map, tolerance=1.0), "tolerance needs a pole or a start"),
        (lambda: register_points([[0, 0]], [[0, 0]]), "at least two points, got 1"),
        (lambda: register_points([[0, 0], [1, 1]], [[0, 0]]), r"measured_points must have shape \(2, 2\)"),
        (lambda: register_points([[1, 1], [1, 1]], [[0, 0], [1, 0]]), "simulated_points must contain different points"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()


# ---- correlation ---------------------------------------------------------------------------------------------------


def test_masked_correlation_against_sums(rng):
    """Every shift, by NumPy's correlation coefficient of the shared pixels; float32 leaves 1e-4."""
    images = [rng.normal(size=shape) for shape in ((9, 7), (8, 10))]
    masks = [rng.random(image.shape) < 0.8 for image in images]
    size = 18
    spectra = [correlation_search.spectra(np.where(m, i, 0), m, size) for i, m in zip(images, masks, strict=True)]
    coefficients, shared = correlation_search.correlate(*spectra, size)
    padded = [np.full((3 * size, 3 * size), np.nan) for _ in images]
    padded[1][size : size + 8, size : size + 10] = np.where(masks[1], images[1], np.nan)
    checked = 0
    for dy in range(-8, 8):
        for dx in range(-6, 10):
            padded[0][:] = np.nan
            padded[0][size + dy : size + dy + 9, size + dx : size + dx + 7] = np.where(masks[0], images[0], np.nan)
            common = np.isfinite(padded[0] + padded[1])
            assert shared[dy, dx] == common.sum()
            if common.sum() > 5:
                expected = np.corrcoef(padded[0][common], padded[1][common])[0, 1]
                assert coefficients[dy, dx] == pytest.approx(expected, abs=1e-4)
                checked += 1
    assert checked > 100


# ---- picture -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_overlay(low, simulated, tmp_path):
    true = ae.Registration(17.0, 0.45, (8.0, 3.0), True, score=0.9, overlap=1.0)
    map = measured(draws(low, FASTER, 2), true, 30, 2, ions=30_000)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a contour that is nowhere warns
        ax = plot.overlay(simulated, map, true, title="Ni[124]")
    ax.figure.savefig(tmp_path / "a.png")
    (caption,) = (above.get_xlabel() for above in ax.child_axes)
    assert caption == "mirrored, rotated by 17.00°, scaled by 0.45, shifted by (8.00, 3.00) mm\n" + (
        "correlation 0.90, common area 100% of the field of view"
    )
    labels = [text.get_text() for text in ax.figure.legends[0].get_texts()]
    assert labels == ["simulated, bright", "simulated, dark"]
    # what is bright lies where hits are, once moved
    density = map.density[map.mask]
    x, y = np.meshgrid(*map.centres)
    inside = ax.collections[0].get_paths()[0].contains_points(np.column_stack([x[map.mask], y[map.mask]]))
    assert density[inside].mean() > 1.3 * density[~inside].mean()
    beside = ax.figure.axes[1]  # the simulated map, with the same contours
    for own, other in zip(ax.collections, beside.collections, strict=True):
        np.testing.assert_array_equal(own.get_paths()[0].vertices, other.get_paths()[0].vertices)
    # contours are drawn only where the measured map is
    x, y = np.concatenate([line.get_paths()[0].vertices for line in ax.collections]).T
    columns, rows = (np.searchsorted(edges[1:-1], at) for edges, at in ((map.x_edges, x), (map.y_edges, y)))
    assert ndimage.binary_dilation(map.mask)[rows, columns].all() and not map.mask.all()
    partial = plot.overlay(
        simulated.within_circle(40.0),
        map,
        replace(true, score=np.nan, residual=0.25),
        plot.new_figure((5, 5)).subplots(),
    )
    assert partial.get_legend().get_texts()[-1].get_text() == "simulated field of view"
    assert "from points, residual 0.25 mm (RMS)" in partial.child_axes[0].get_xlabel()
