"""Maps folded about a pole: known densities are found, noise is halved, and what the crystal lacks is averaged out."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.maps.crystallography.orientation import Orientation

PLANE = ae.detection.Projection(100.0, compression=1.0)
POLE = np.array([0.1, -0.05, 1.0])
DETECTOR = ae.Detector(width=160.0)


def expected_map(orientation, density, bins=400, projection=PLANE):
    """Map whose density per solid angle is a function of the directions in the crystal."""
    map = DETECTOR.grid(bins)
    x, y = np.meshgrid(*map.centres)
    directions = projection.directions(np.column_stack([x.ravel(), y.ravel()]))
    solid = directions[:, 2] ** 3  # of a bin on a plane, in units of that on the axis
    values = density(directions @ orientation.matrix) * solid
    return ae.DetectorMap.from_array(values.reshape(x.shape), map.x_edges, map.y_edges, mask=map.mask)


def lines(directions):
    """A density with the symmetry m-3m: bright in its mirror planes."""
    a, b, c = np.sort(np.abs(directions), axis=1).T
    return (
        1
        + 0.8 * np.exp(-(((c - b) / 0.03) ** 2))
        + 0.5 * np.exp(-(((b - a) / 0.05) ** 2))
        + 0.3 * np.exp(-((a / 0.05) ** 2))
    )


def tilted(material="W", axis=(0.1, 1.0, 1.05), rotation=25.0):
    return Orientation(material, axis, rotation)


@pytest.mark.parametrize("plane", [(0, 1, 1), (1, 1, 1), (0, 0, 1), (1, 1, 2)])
def test_the_density_of_a_crystal_is_found(plane):
    orientation = tilted(axis=np.add(plane, (0.1, 0.02, 0.05)))
    pole = orientation.nearest_pole(plane)
    found = ae.maps.folded(expected_map(orientation, lines), PLANE, *pole, reach=12.0, smoothing=0.25)
    u, v = np.radians(found.angles), np.radians(found.angles[:, None])
    angle, azimuth = np.hypot(u, v), np.arctan2(v, u)
    across = np.cross(pole.direction, pole.toward)
    directions = np.cos(angle)[..., None] * pole.direction + np.sin(angle)[..., None] * (
        np.cos(azimuth)[..., None] * pole.toward + np.sin(azimuth)[..., None] * across
    )
    known = np.isfinite(found.density)
    wanted = lines(directions[known] @ orientation.matrix)
    assert known.sum() > 0.7 * known.size  # the circle in its square
    assert np.corrcoef(found.density[known], wanted)[0, 1] > 0.99
    assert np.abs(found.density[known] - wanted / wanted.mean()).mean() < 0.03


def test_two_orientations_and_projections_of_a_crystal_are_alike_and_dark_lines_are_not():
    first, second = tilted(), tilted(axis=(1.1, -0.03, 1.0), rotation=-140.0)
    other = ae.detection.Projection(140.0, centre=(3.0, -2.0))
    maps = [
        ae.maps.folded(
            expected_map(each, lines, projection=projection), projection, *each.nearest_pole((0, 1, 1)), reach=10
        )
        for each, projection in ((first, PLANE), (second, other))
    ]
    assert maps[0].symmetry == maps[1].symmetry == "2mm"
    assert maps[0].correlation(maps[1]) > 0.98
    dark = ae.maps.folded(
        expected_map(first, lambda each: 3 - lines(each)), PLANE, *first.nearest_pole((0, 1, 1)), reach=10
    )
    assert dark.correlation(maps[0]) < -0.9


def test_folding_averages_a_gradient_and_noise(rng):
    """With a gradient over the detector and 400,000 ions: the fold is nearer to the truth than one map."""
    orientation = tilted(axis=(0, 1, 1))
    pole = orientation.nearest_pole((0, 1, 1))
    truth = expected_map(orientation, lines)
    x = truth.centres[0]
    expected = truth.values * (1 + 0.6 * x / 80.0) * truth.mask
    counts = rng.poisson(expected / expected.sum() * 400_000)
    noisy = ae.DetectorMap.from_array(counts, truth.x_edges, truth.y_edges, is_counts=True, mask=truth.mask)
    perfect, folds, single = (
        ae.maps.folded(map, PLANE, pole.direction, symmetry, pole.toward)
        for map, symmetry in ((truth, "2mm"), (noisy, "2mm"), (noisy, "1"))
    )
    ring = np.hypot(perfect.angles, perfect.angles[:, None]) < 15
    error, worse = (np.std((each.density / perfect.density)[ring]) for each in (folds, single))
    # half of the noise remains, and no gradient
    assert error < 0.55 * worse
    assert folds.halves > single.halves
    assert folds.correlation(perfect) == pytest.approx(folds.ceiling, abs=0.02)
    assert 0.5 < folds.ceiling < 0.999


def test_bad_input_gets_a_sentence():
    map = expected_map(tilted(), lines, bins=100)
    with pytest.raises(ValueError, match="toward must be a direction in a mirror plane for the symmetry 2mm, got None"):
        ae.maps.folded(map, PLANE, POLE, "2mm")
    with pytest.raises(ValueError, match="toward must be another direction than the pole"):
        ae.maps.folded(map, PLANE, POLE, "2mm", POLE)
    with pytest.raises(ValueError, match="symmetry must be"):
        ae.maps.folded(map, PLANE, POLE, "5")
    with pytest.raises(ValueError, match="has no hits within 16 degrees"):
        ae.maps.folded(map, PLANE, (1.0, 0.0, 0.05), "1")
    first, second = (ae.maps.folded(map, PLANE, POLE, "2", reach=reach) for reach in (10, 12))
    with pytest.raises(ValueError, match="other must have the symmetry and the reach"):
        first.correlation(second)


def test_the_picture_names_the_correlation_with_the_first_map():
    orientation = tilted()
    pole = orientation.nearest_pole((0, 1, 1))
    first, second = (
        ae.maps.folded(expected_map(orientation, density), PLANE, *pole, reach=10)
        for density in (lines, lambda each: 3 - lines(each))
    )
    axes = ae.plot.folded_maps({"measured": first, "simulated": second})
    assert [ax.get_title() for ax in axes] == ["measured", f"simulated: correlation {second.correlation(first):.2f}"]
    with pytest.raises(ValueError, match="folded_maps needs at least one map, got none"):
        ae.plot.folded_maps({})
