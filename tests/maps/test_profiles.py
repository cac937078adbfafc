import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.maps.profiles import Rectangle, azimuthal_profile, compare_profiles, radial_profile, zone_line_profile


def disc(n, radius=10.0, seed=0):
    random = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(random.random(n)), 2 * np.pi * random.random(n)
    return r * np.cos(angle), r * np.sin(angle)


@pytest.mark.parametrize("of_map", [False, True])
def test_azimuthal_profile_finds_six_lines(of_map):
    random = np.random.default_rng(8)
    x, y = disc(200_000, 12.0)
    angle = np.radians(10 + 60 * random.integers(0, 6, 20_000))
    r, across = random.uniform(0, 12, 20_000), random.normal(0, 0.2, 20_000)
    x = np.concatenate([x, r * np.cos(angle) - across * np.sin(angle)]) + 2
    y = np.concatenate([y, r * np.sin(angle) + across * np.cos(angle)]) - 1
    hits = Hits(x=x, y=y)
    profile = azimuthal_profile(hits.map() if of_map else hits, (2, -1), inner=3, outer=10, bins=90)
    assert profile.position[:2].tolist() == [2, 6]
    bright = profile.position[profile.density > 1 + 8 * profile.error]
    assert {round((azimuth - 10) / 60) for azimuth in bright} == set(range(6))
    assert np.abs((bright - 10 + 30) % 60 - 30).max() <= 6


def test_profiles_of_a_uniform_disc_scatter_as_poisson():
    x, y = disc(300_000)
    hits = Hits(x=x, y=y)
    for source in (hits, hits.map()):
        for profile in (
            azimuthal_profile(source, inner=2, outer=9, bins=60),
            radial_profile(source, outer=9, bins=60),
        ):
            pull = (profile.density - 1) / profile.error
            # chi-square of 60 bins: 60 +- 11; errors that are twice too large give 15
            assert 20 < (pull**2).sum() < 115
    # all hits inside 9 mm: the total density does not depend on how it is cut
    areas = np.pi * np.diff(np.linspace(0, 9, 61) ** 2)
    assert (radial_profile(hits, outer=9, bins=60).density * areas).sum() == pytest.approx(areas.sum())


def test_two_profiles_of_one_density_differ_by_both_errors():
    discs = (disc(40_000, seed=seed) for seed in (1, 2))
    both = [azimuthal_profile(Hits(x=x, y=y), inner=2, outer=9, bins=200) for x, y in discs]
    compared = compare_profiles(*both)
    # chi-square of 200 bins: 10 %, three times
    assert compared.chi_square / compared.degrees_of_freedom == pytest.approx(1, abs=0.3)
    assert compared.relative < 0.05


def test_profiles_of_densities_have_no_error():
    map = DetectorMap.from_array(np.ones((40, 40)), np.linspace(-5, 5, 41), np.linspace(-5, 5, 41))
    profile = radial_profile(map, outer=4, bins=4)
    np.testing.assert_allclose(profile.density, 1)
    assert np.isnan(profile.error).all()


# ---- across a line -------------------------------------------------------------------------------------------------

AROUND = Rectangle((2.0, -1.0), 30.0, 8.0, 5.0)


@given(st.floats(-400, 400), st.floats(-20, 20), st.floats(-20, 20))
def test_a_rectangle_is_where_it_says(angle, x, y):
    rectangle = Rectangle((x, y), angle, 6.0, 4.0)
    corners = rectangle.corners
    along, across = rectangle.along_and_across(*corners.T)
    # rounding of numbers up to 30
    np.testing.assert_allclose(along, [-3, 3, 3, -3], atol=1e-12)
    np.testing.assert_allclose(across, [-2, -2, 2, 2], atol=1e-12)
    area = 0.5 * np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - corners[:, 1] * np.roll(corners[:, 0], -1))
    assert area == pytest.approx(24)  # counterclockwise
    turned = rectangle.turned(90).corners
    np.testing.assert_allclose(turned, np.column_stack([-corners[:, 1], corners[:, 0]]), atol=1e-12)


def test_distances_grow_to_the_left():
    hits = Hits(x=[1.2], y=[0.1])
    for angle, expected in ((-90, 1.0), (90, -1.0), (0, 0.0)):
        profile = zone_line_profile(hits, Rectangle((0, 0), angle, 4, 5), bins=5)
        assert profile.position[np.argmax(profile.density)] == pytest.approx(expected)


@given(st.floats(-180, 180), st.booleans())
def test_a_uniform_disc_is_flat_across_any_line(angle, of_map):
    x, y = disc(40_000, seed=3)
    hits = Hits(x=x, y=y)
    rectangle = Rectangle((1.0, 2.0), angle, 8.0, 5.0)
    profile = zone_line_profile(hits.map(bins=100) if of_map else hits, rectangle, bins=25)
    pull = (profile.density - 1) / profile.error
    # chi-square of 25 bins: 24 +- 7; 6 standard deviations, since angles are tried by the hundred
    assert (pull**2).sum() < 66
    np.testing.assert_allclose(profile.position, np.linspace(-2.4, 2.4, 25), atol=1e-12)


def test_profiles_count_what_a_histogram_counts():
    x, y = disc(20_000)
    profile = zone_line_profile(Hits(x=x, y=y), Rectangle((1, 2), -90, 6, 4), bins=8)
    inside = np.abs(y - 2) < 3
    counts = np.histogram(x[inside], np.linspace(-1, 3, 9))[0]
    np.testing.assert_allclose(profile.density, counts / counts.mean(), rtol=1e-12)
    np.testing.assert_allclose(profile.error, np.sqrt(counts) / counts.mean(), rtol=1e-12)


def test_lines_alike_are_laid_over_each_other():
    x, y = disc(3000)
    keep = y > 0.3 * x**2 - 2  # nothing symmetric
    x, y = x[keep], y[keep]
    rectangle = Rectangle((4.0, 1.0), 20.0, 5.0, 3.0)
    one = zone_line_profile(Hits(x=x, y=y), rectangle, bins=10)
    angle = np.radians([0, 120, 240])[:, None]
    x, y = (x * np.cos(angle) - y * np.sin(angle)).ravel(), (x * np.sin(angle) + y * np.cos(angle)).ravel()
    three = zone_line_profile(Hits(x=x, y=y), [rectangle.turned(turn) for turn in (0, 120, 240)], bins=10)
    alone = zone_line_profile(Hits(x=x, y=y), rectangle.turned(120), bins=10)
    # each turned rectangle sees the three turned discs, one of them as `one` saw it; all three see the same
    np.testing.assert_allclose(three.density, alone.density, rtol=1e-12)
    np.testing.assert_allclose(three.error, alone.error / np.sqrt(3), rtol=1e-12)
    assert not np.allclose(three.density, one.density)


def test_a_map_counts_only_inside_its_mask():
    edges = np.linspace(-10, 10, 81)
    values = np.full((80, 80), 4)
    mask = np.ones((80, 80), bool)
    mask[:, :44] = False  # x < 1
    map = DetectorMap.from_array(values, edges, edges, mask, is_counts=True)
    profile = zone_line_profile(map, Rectangle((0, 0), -90, 10, 8), bins=8)
    assert np.isnan(profile.density[:5]).all()
    np.testing.assert_allclose(profile.density[5:], 1)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda hits: azimuthal_profile(hits, inner=3, outer=2), "outer must be"),
        (lambda hits: radial_profile(hits, (99, 99), outer=1), "got none between inner and outer"),
        (lambda hits: zone_line_profile(hits, Rectangle((99, 99), 0, 1, 1)), r"got none in Rectangle\(centre="),
        (
            lambda hits: zone_line_profile(hits, AROUND, bins=0),
            "bins must be an integer from 1 to 16,384, got 0",
        ),
        (
            lambda hits: zone_line_profile(hits, []),
            r"rectangles must contain at least one, all of equal width, got widths \[\]",
        ),
        (
            lambda hits: zone_line_profile(hits, [AROUND, Rectangle((0, 0), 0, 3, 2)]),
            r"all of equal width, got widths \[2.0, 5.0\] mm",
        ),
        (lambda hits: zone_line_profile(Hits(voltage=[1.0]), AROUND), "no column 'x'"),
        (lambda hits: Rectangle((0, 0), 0, 0, 1), r"length must be a finite number \[mm\] > 0, got 0"),
        (lambda hits: Rectangle((0, 0, 0), 0, 1, 1), r"centre must have shape \(2,\)"),
        (lambda hits: Rectangle((0, 0), np.nan, 1, 1), "angle must be a finite number"),
    ],
)
def test_bad_arguments_are_named(call, message):
    x, y = disc(1000)
    with pytest.raises(ValueError, match=message):
        call(Hits(x=x, y=y))
