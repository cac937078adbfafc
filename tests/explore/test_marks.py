"""Poles and zone lines that are marked on a map, and the orientations that fit them."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.explore.marks import Marks, overlay, plain
from apt_evap.maps.crystallography.directions import poles, zones

PROJECTION = ae.detection.Projection(95.0, (2.0, -3.0))
REACH = 60.0  # mm


def marked(orientation, number, noise=0.0):
    """Marks at the poles of largest spacing on a map of an orientation."""
    marks = Marks(orientation.material)
    crystal = poles(orientation.material, 10)
    places = PROJECTION.places(orientation.directions(crystal.normals))
    visible = np.flatnonzero(np.hypot(*places.T) < REACH)[:number]
    rng = np.random.default_rng(1)
    for each in visible:
        indices = sorted(map(abs, crystal.planes[each].tolist()), reverse=True)
        if len(indices) == 4:  # hcp
            family = next(k for k, members in enumerate(marks._members) if each in members)
        else:
            family = marks.families.index(plain("".join(map(str, indices))))
        marks.poles.append((family, tuple(places[each] + rng.normal(0, noise, 2))))
    assert len(marks.poles) == number
    return marks


def misorientation(first, second):
    """Angle between two orientations without regard to the symmetry [degrees], from the poles of four families."""
    crystal = poles(first.material, 4)
    normals = [each.directions(crystal.normals) for each in (first, second)]
    return np.degrees(np.arccos(np.clip((normals[0] @ normals[1].T).max(axis=1).min(), -1, 1)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("metal", "axis"),
    [
        ("Al", (0.2, 0.3, 1.0)),
        pytest.param("W", (0.1, 1.0, 0.9), marks=pytest.mark.slow),
        pytest.param("Ti", (1, 0, -1, 3), marks=pytest.mark.slow),
    ],
)
def test_families_of_poles_are_enough(metal, axis):
    """A fit that knows no member finds the orientation, to the noise of the clicks, and says how good it is."""
    orientation = ae.Orientation(metal, axis=axis, rotation=33.0)
    exact = marked(orientation, 5).fits(centre=PROJECTION.centre)
    assert misorientation(exact[0].orientation, orientation) < 0.01
    assert exact[0].projection.scale == pytest.approx(PROJECTION.scale, rel=1e-6) and exact[0].rms < 1e-6
    noisy = marked(orientation, 5, 0.5).fits(centre=PROJECTION.centre)  # mm
    assert misorientation(noisy[0].orientation, orientation) < 2 and 0.05 < noisy[0].rms < 1.5
    assert all(each.rms >= exact[0].rms for each in exact)


def test_two_poles_have_several_candidates():
    orientation = ae.Orientation("W", axis=(0.1, 1.0, 0.9), rotation=33.0)
    found = marked(orientation, 2).fits(centre=PROJECTION.centre)
    assert len(found) > 2 and all(each.rms < 1e-6 for each in found)
    assert any(misorientation(each.orientation, orientation) < 0.01 for each in found)
    known = marked(orientation, 2).fits(centre=PROJECTION.centre, scale=PROJECTION.scale)
    assert misorientation(known[0].orientation, orientation) < 0.01 and known[0].rms < 1e-6
    assert all(each.rms > 1.0 for each in known[1:])  # mm


@pytest.mark.slow
def test_of_equal_fits_the_usual_field_of_view_comes_first():
    """Three poles {200} about [111] fit at 54.7 degrees as they do at 125.3, where no instrument sees them."""
    orientation = ae.Orientation("Ni", axis=(1, 1, 1), rotation=20.0)
    normals = orientation.directions([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
    for noise in (0.0, 0.02):  # mm
        places = ae.detection.Projection(60.0).places(normals)
        places += np.random.default_rng(2).normal(0, noise, places.shape)
        marks = Marks("Ni")
        family = [marks.families.index(each) for each in ("111", "200")]
        marks.poles = [(family[0], (0.0, 0.0)), *((family[1], tuple(each)) for each in places.tolist())]
        for number in (3, 4):
            found = Marks("Ni", marks.poles[:number]).fits()
            scales = [each.projection.scale for each in found]
            assert scales == pytest.approx([60.0, 60.0 * 54.7356 / 125.2644], rel=1e-3)


def test_a_pole_and_a_zone_line_with_a_scale():
    orientation = ae.Orientation("Ni", axis=(0.2, 0.3, 1.0), rotation=-70.0)
    marks = marked(orientation, 1)
    crystal = poles(orientation.material, 10)
    first = PROJECTION.directions(np.array([marks.poles[0][1]]))[0]
    rotated = orientation.directions(crystal.normals)
    angles = np.arccos(rotated[marks._members[2]] @ first)
    second = rotated[marks._members[2]][np.where(angles > 0.1, angles, 9).argmin()]  # the nearest other one
    points = PROJECTION.places(np.array([0.8 * first + 0.2 * second, 0.4 * first + 0.6 * second]))
    marks.lines.append((2, [tuple(each) for each in points]))
    found = marks.fits(centre=PROJECTION.centre, scale=PROJECTION.scale)
    assert any(misorientation(each.orientation, orientation) < 0.01 for each in found) and found[0].rms < 1e-6
    with pytest.raises(ValueError, match="scale"):
        marks.fits(centre=PROJECTION.centre)


def test_marks_that_do_not_suffice():
    marks = Marks("W")
    with pytest.raises(ValueError, match="poles"):
        marks.fits(scale=90.0)
    marks.poles = [(0, (1.0, 1.0)), (0, (1.0, 1.0))]
    with pytest.raises(ValueError, match="places"):
        marks.fits()


def test_the_overlay_is_on_the_map():
    orientation = ae.Orientation("Ni", axis=(1, 1, 1))
    like = ae.Detector(width=80.0).grid(20)
    drawn = overlay(orientation, PROJECTION, like)
    assert "111" in drawn.labels and len(drawn.places) == len(drawn.labels)
    centre = drawn.places[drawn.labels.index("111")]
    assert np.allclose(centre, PROJECTION.centre)
    assert (np.abs(drawn.places) <= 40).all()
    # all points of a line are perpendicular to one zone axis
    axes = orientation.directions(zones("Ni").directions)
    assert len(drawn.lines) >= 3
    for line in drawn.lines:
        points = PROJECTION.directions(line[np.isfinite(line[:, 0])])
        assert np.abs(points @ axes.T).max(axis=0).min() < 1e-9


def test_negative_indices_have_bars():
    assert plain(r"$\bar{1}1\bar{3}$") == "1\u030513\u0305" and plain(r"$\bar{10}\,11$") == "1\u03050\u0305 11"


def test_labels_do_not_cover_each_other():
    pytest.importorskip("bokeh")
    from apt_evap.explore.pole_panel import sparse_labels

    orientation = ae.Orientation("Ni", axis=(0.3, 0.5, 0.8))
    pattern = ae.maps.master_patterns("fcc")[0]
    like = pattern.map(orientation, ae.detection.Projection(30.0), width=60.0, ions=20_000)
    drawn = overlay(orientation, ae.detection.Projection(30.0), like)
    labels = sparse_labels(drawn, like)
    kept = drawn.places[[label != "" for label in labels]]
    assert 5 < len(kept) < len(drawn.labels) and labels[0] == drawn.labels[0]
    gaps = [np.abs(kept[i] - kept[j]) for i in range(len(kept)) for j in range(i)]
    assert all(x >= 0.08 * 60.0 - 1e-9 or y >= 0.04 * 60.0 - 1e-9 for x, y in gaps)
