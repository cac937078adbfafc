"""Regions: what is inside, and how far the boundary is."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import apt_evap as ae
from apt_evap._common.codec import to_plain
from apt_evap.specimen.regions import boundary_distance, contains, region_of

CORE = ae.specimen.Sphere((0.5, -0.2, 1.0), 2.0)
REGIONS = [
    CORE,
    ae.specimen.Ellipsoid((0.3, 0.1, -0.4), (3.0, 2.0, 0.7)),
    ae.specimen.Ellipsoid((0.3, 0.1, -0.4), (2.0, 2.0, 0.5), axis=(1, -2, 0.5)),
    ae.specimen.Cylinder((0, 1, 0), 1.5),
    ae.specimen.Cylinder((0, 1, 0), 1.5, length=2.0, axis=(1, 1, 0)),
    ae.specimen.HalfSpace((0.2, 0, 0), (1, 2, -1)),
    ae.specimen.Layer(-0.7, 0.9),
    ae.specimen.Layer(-0.7, 0.9, normal=(1, 0, 1)),
    ae.specimen.CoreShell(CORE, 0.8),
]


@pytest.fixture(scope="session")
def points():
    return np.random.default_rng(1).uniform(-4, 4, (20_000, 3))


@pytest.mark.parametrize("region", [*REGIONS, ae.specimen.Union(REGIONS[:4])], ids=lambda region: type(region).__name__)
def test_the_sign_of_the_distance_tells_what_is_inside(region, points):
    distance = boundary_distance(region, points)
    clear = np.abs(distance) > 1e-6  # points on the boundary belong to the region, up to 1e-7 nm
    np.testing.assert_array_equal(contains(region, points)[clear], distance[clear] < 0)
    assert 0.005 < contains(region, points).mean() < 0.995


@pytest.mark.parametrize("region", REGIONS, ids=lambda region: type(region).__name__)
def test_the_distance_is_that_of_the_nearest_point_outside_or_inside(region, points):
    # the gradient of a distance has length 1, except where two parts of the boundary are equally near
    step = 1e-5
    gradient = np.stack(
        [
            (boundary_distance(region, points + move) - boundary_distance(region, points - move)) / (2 * step)
            for move in step * np.eye(3)
        ],
        axis=1,
    )
    length = np.linalg.norm(gradient, axis=1)
    # one in 20,000 points per edge of this step lies on such a ridge
    assert np.quantile(np.abs(length - 1), 0.998) < 1e-4
    # moving back along the gradient by the distance leads onto the boundary
    near = np.abs(boundary_distance(region, points)) < 0.2
    foot = points[near] - gradient[near] * boundary_distance(region, points[near])[:, None]
    # edges of a cylinder: inside them the nearest side is not at the end of the gradient of the other one
    assert np.quantile(np.abs(boundary_distance(region, foot)), 0.99) < 1e-3


def test_the_ellipsoid_with_equal_axes_is_the_sphere(points):
    ball = ae.specimen.Ellipsoid(CORE.centre, (2.0, 2.0, 2.0))
    # bisection to the rounding of float64, over an interval of about 30 nm^2
    np.testing.assert_allclose(ball.distance(points), CORE.distance(points), rtol=0, atol=1e-9)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 3))
def test_points_on_the_boundary_are_inside_in_spite_of_rounding(x, z, radius):
    direction = np.array([x, 0.3, z]) / np.linalg.norm([x, 0.3, z])
    assert contains(ae.specimen.Sphere((1, 2, 3), radius), np.array([[1, 2, 3]]) + radius * direction[None]).all()
    assert contains(ae.specimen.HalfSpace(direction, direction), direction[None]).all()


def test_a_shell_is_all_around_its_core(points):
    core, shell = contains(CORE, points), contains(ae.specimen.CoreShell(CORE, 0.8), points)
    assert not (core & shell).any()
    np.testing.assert_array_equal(core | shell, contains(ae.specimen.Sphere(CORE.centre, 2.8), points))


def test_a_function_is_a_region_without_a_distance(points):
    def octant(points):
        return (points > 0).all(axis=1)

    assert contains(octant, points).mean() == pytest.approx(1 / 8, abs=0.01)  # 4 standard deviations of 20,000 points
    assert contains(ae.specimen.Union((octant, CORE)), points).sum() > contains(octant, points).sum()
    with pytest.raises(ValueError, match="needs a region with a method distance"):
        boundary_distance(octant, points)
    with pytest.raises(ValueError, match="result of the function"):
        contains(lambda points: points, points)


@pytest.mark.parametrize("region", [*REGIONS, ae.specimen.Union(REGIONS)], ids=lambda region: type(region).__name__)
def test_a_region_is_rebuilt_from_its_description(region):
    assert region_of(json.loads(json.dumps(to_plain(region)))) == region


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"name": "Ball"}, "region .*Sphere"),
        ({"name": "Sphere", "centre": [0, 0, 0]}, "region .*radius"),
        ({"name": "Sphere", "center": [0, 0, 0]}, "'centre'"),
        ({"name": "Union", "regions": 3}, "regions"),
        ({"name": "CoreShell", "core": 3, "thickness": 1}, "core"),
        (3, "region"),
    ],
)
def test_a_wrong_description_is_refused(table, message):
    with pytest.raises(ValueError, match=message):
        region_of(table)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ae.specimen.Sphere((0, 0), 1), r"centre must have shape \(3,\)"),
        (lambda: ae.specimen.Sphere((0, 0, 0), 0), "radius must be a finite number .* > 0, got 0"),
        (lambda: ae.specimen.Ellipsoid((0, 0, 0), (1, 2, -1)), "semi_axes must be"),
        (lambda: ae.specimen.Layer(2, 1), "upper must be .* > 2, got 1"),
        (lambda: ae.specimen.HalfSpace((0, 0, 0), (0, 0, 0)), "normal must be a direction"),
        (lambda: ae.specimen.CoreShell(3, 1), "core"),
        (lambda: ae.specimen.Union(()), "at least one region"),
        (lambda: ae.specimen.Union((CORE, 3)), "regions must be a region"),
    ],
)
def test_wrong_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
