"""Profiles about a pole: known widths and heights of lines are found, in degrees of crystal angle, with errors."""

import numpy as np
import pytest

import apt_evap as ae

PLANE = ae.detection.Projection(100.0, compression=1.0)
POLE = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
TOWARD = np.array([[1.0, 0.3, 0.4], [-0.5, 1.0, 0.2], [-0.4, -1.0, 0.3]])
FWHM, HEIGHT = 3.0, -0.7  # of the lines [degrees], and over the background


def across(directions, toward):
    left = np.cross(POLE, toward)
    return np.degrees(np.arcsin(directions @ (left / np.linalg.norm(left))))


def map_of(rng, n=400_000, height=HEIGHT):
    """Three Gaussian lines of one width from the pole, on an even ground within 40 degrees of the axis."""
    angle, azimuth = np.arccos(rng.uniform(np.cos(np.radians(40)), 1, n)), rng.uniform(0, 2 * np.pi, n)
    directions = np.column_stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    density = np.ones(n)
    for toward in TOWARD:
        ahead = directions @ (toward - POLE * (toward @ POLE)) > 0
        density += height * ahead * 0.5 ** ((2 * across(directions, toward) / FWHM) ** 2)
    directions = directions[rng.uniform(0, max(1.0, 1 + height), n) < density]
    half = 90.0
    hits = ae.Hits(**dict(zip("xy", PLANE.places(directions).T, strict=True)))
    return hits.map(360, extent=(-half, half, -half, half), position_step=None, mask=np.ones((360, 360), bool))


@pytest.mark.parametrize("height", [-0.7, 0.8])
def test_width_and_height_of_a_line(rng, height):
    profile = ae.maps.pole_line_profile(map_of(rng, height=height), PLANE, POLE, TOWARD, inner=8, outer=20)
    line = ae.maps.fit_zone_line(profile)
    assert profile.unit == line.unit == "degrees" and "degrees wide" in str(line)
    assert line.kind == ("enhanced" if height > 0 else "depleted")
    # three errors, and half a bin of the map (0.5 mm, 0.29 degrees) added in squares to 3 degrees: 0.03
    assert line.width == pytest.approx(FWHM, abs=3 * line.width_error + 0.05)
    assert line.height / line.background == pytest.approx(height, abs=4 * line.height_error + 0.02)
    assert abs(line.centre) < 4 * line.centre_error + 0.02
    assert 0 < line.width_error < 0.2


@pytest.mark.slow
def test_errors_of_a_line_are_those_of_new_maps(rng):
    lines = [
        ae.maps.fit_zone_line(ae.maps.pole_line_profile(map_of(rng, 60_000), PLANE, POLE, TOWARD)) for _ in range(30)
    ]
    scatter = np.std([line.width for line in lines], ddof=1)
    assert np.mean([line.width_error for line in lines]) == pytest.approx(scatter, rel=0.4)  # 30 values: 13 %


def test_positions_are_positive_to_the_left(rng):
    along = TOWARD[0] - POLE * (TOWARD[0] @ POLE)
    along /= np.linalg.norm(along)
    left, turn = np.cross(POLE, along), np.radians(10.0)
    right_of_it = POLE + np.cos(turn) * along - np.sin(turn) * left
    line = ae.maps.fit_zone_line(ae.maps.pole_line_profile(map_of(rng), PLANE, POLE, right_of_it, inner=13, outer=15))
    expected = np.degrees(np.arcsin(np.sin(np.radians(14.0)) * np.sin(turn)))
    # half a bin of the map, 0.29 degrees, and the curvature of 1 % over the range
    assert line.centre == pytest.approx(expected, abs=4 * line.centre_error + 0.1)


def test_a_line_to_the_other_side_is_none(rng):
    """Lines are half circles: they end at the pole."""
    opposite = 2 * POLE * (TOWARD @ POLE)[:, None] - TOWARD
    profile = ae.maps.pole_line_profile(map_of(rng), PLANE, POLE, opposite[:1], inner=8, outer=20)
    assert np.abs((profile.density - 1) / profile.error).max() < 4.5  # of 24 normal numbers


def test_lines_of_densities_have_errors_by_their_noise(rng):
    counts = map_of(rng, 100_000)
    densities = ae.DetectorMap.from_array(counts.values / 7.0, counts.x_edges, counts.y_edges)
    one, two = (ae.maps.pole_line_profile(each, PLANE, POLE, TOWARD) for each in (counts, densities))
    none = ae.maps.pole_line_profile(densities, PLANE, POLE, TOWARD, ions=np.inf)
    assert two.density == pytest.approx(one.density, rel=1e-12)
    # one hit per bin: the median of squares is that of small integers, not of normal numbers
    assert two.error == pytest.approx(one.error, rel=0.5)
    assert np.isnan(none.error).all()


@pytest.mark.slow
def test_a_dark_pole_with_errors(rng):
    """Radial densities with Poisson errors: 30 maps scatter by them."""
    radii = (0.0, 2.0, 4.0, 8.0)
    profiles = [ae.maps.pole_profile(map_of(rng, 40_000, 0.0), PLANE, POLE, radii) for _ in range(30)]
    scatter = np.std([each.density for each in profiles], axis=0, ddof=1)
    assert np.mean([each.error for each in profiles], axis=0) == pytest.approx(scatter, rel=0.45)  # 13 % each
    assert profiles[0].position.tolist() == [1.0, 3.0, 6.0]


def test_lines_that_cannot_be(rng):
    map = map_of(rng, 1000)
    for arguments, words in (
        ({"toward": POLE}, "toward must be another direction than the pole"),
        ({"toward": (0, 0, 0)}, "toward must not be zero"),
        ({"inner": 5, "outer": 5}, r"outer must be a finite number \[degrees\] > 5 and <= 90, got 5"),
        ({"inner": 80, "outer": 90}, "has no hits within 12 degrees of the lines, 80 to 90 degrees out"),
    ):
        with pytest.raises(ValueError, match=words.replace("> 5 and <= 90", ".*")):
            ae.maps.pole_line_profile(map, PLANE, POLE, **{"toward": TOWARD} | arguments)
