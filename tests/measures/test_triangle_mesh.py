"""Signed distances from surfaces of triangles and convex hulls, against boxes, spheres and all triangles."""

import itertools

import numpy as np
import pytest
from skimage.measure import marching_cubes

import apt_evap as ae

BOX = ae.specimen.Box((-1.0, -0.5, 0.0), (2.0, 1.5, 1.0))
CORNERS = np.array([[x, y, z] for x in (-1.0, 2.0) for y in (-0.5, 1.5) for z in (0.0, 1.0)])
# two triangles a side, anticlockwise as seen from outside
FACES = [
    [0, 1, 3],
    [0, 3, 2],
    [4, 6, 7],
    [4, 7, 5],
    [0, 4, 5],
    [0, 5, 1],
    [2, 3, 7],
    [2, 7, 6],
    [0, 2, 6],
    [0, 6, 4],
    [1, 5, 7],
    [1, 7, 3],
]
POINTS = 6 * np.random.default_rng(1).random((2000, 3)) - 2.5


def sphere_mesh(radius=2.0, step=0.25):
    grid = np.stack(np.meshgrid(*[np.arange(-3, 3 + step / 2, step)] * 3, indexing="ij"), axis=-1)
    inside = radius - np.linalg.norm(grid, axis=-1)
    corners, faces, *_ = marching_cubes(inside, 0.0, spacing=(step,) * 3, gradient_direction="ascent")
    return ae.measures.TriangleMesh(corners - 3.0, faces)


def test_a_box_of_triangles_has_the_distance_of_a_box():
    """Its points outside are nearest to sides, edges and corners, and the sign is right at all of them."""
    mesh = ae.measures.TriangleMesh(CORNERS, FACES)
    assert mesh.is_closed and mesh.volume == pytest.approx(6.0) and mesh.area == pytest.approx(22.0)
    np.testing.assert_allclose(mesh.distance(POINTS), BOX.distance(POINTS), atol=1e-12)  # rounding of some nm
    assert np.array_equal(ae.specimen.regions.contains(mesh, POINTS), ae.specimen.regions.contains(BOX, POINTS))


def test_a_sphere_of_marching_cubes_has_the_distance_of_a_sphere():
    mesh = sphere_mesh()
    exact = np.linalg.norm(POINTS, axis=1) - 2.0
    # a chord over the diagonal of a cube of h = 0.25 nm lies 3 h^2 / (8 R) = 0.012 nm inside
    np.testing.assert_allclose(mesh.distance(POINTS), exact, atol=0.012)
    near, on_rim = mesh.nearest(POINTS, reach=0.5)
    assert np.array_equal(np.isfinite(near), np.abs(mesh.distance(POINTS)) <= 0.5) and not on_rim.any()
    assert np.array_equal(near[np.isfinite(near)], mesh.distance(POINTS)[np.isfinite(near)])


def test_beyond_a_sharp_corner_is_outside_however_its_sides_are_divided():
    """The sign at a vertex is that of the angles of its triangles, not of their number."""
    apex, base = np.array([0.0, 0.0, 3.0]), np.array([[1.0, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0]])
    along = base[0] + np.linspace(0, 1, 31)[:, None] * (base[1] - base[0])  # one side in 30 thin triangles
    corners = np.concatenate([[apex], base, along[1:-1]])
    edge = [1, *range(4, 33), 2]
    faces = [[0, i, j] for i, j in itertools.pairwise(edge)] + [[0, 2, 3], [0, 3, 1]]
    faces += [[3, j, i] for i, j in itertools.pairwise(edge)]
    mesh = ae.measures.TriangleMesh(corners, faces)
    assert mesh.is_closed and mesh.volume > 0
    normals = [np.cross(base[i] - apex, base[j] - apex) for i, j in ((0, 1), (1, 2), (2, 0))]
    normals = [normal / np.linalg.norm(normal) for normal in normals]
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], 200)  # all directions from the apex that are nearest to it
    points = apex + 0.3 * weights @ np.array(normals)
    np.testing.assert_allclose(mesh.distance(points), np.linalg.norm(points - apex, axis=1), atol=1e-12)


def test_no_other_triangle_is_nearer():
    mesh = sphere_mesh(step=0.5)
    points = POINTS[:100]
    every = mesh.vertices[mesh.faces]
    # barycentric samples of all triangles: none is nearer, the nearest is as near as their spacing
    weights = np.array([[i, j, 12 - i - j] for i in range(13) for j in range(13 - i)]) / 12
    samples = np.einsum("sk,nkd->nsd", weights, every).reshape(-1, 3)
    nearest = np.array([np.linalg.norm(samples - point, axis=1).min() for point in points])
    distance = np.abs(mesh.distance(points))
    assert (distance <= nearest + 1e-9).all()
    assert (nearest**2 - distance**2 <= (0.5 * np.sqrt(3) / 12) ** 2 + 1e-9).all()  # a sample within a cell of 1/12


def test_an_open_surface_ends_at_its_rim():
    square = ae.measures.TriangleMesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    distance, on_rim = square.nearest([[0.5, 0.5, 0.3], [0.2, 0.7, -0.3], [1.5, 0.5, 0.0], [0.5, 0.5, 0.0]])
    np.testing.assert_allclose(distance, [0.3, -0.3, 0.5, 0.0], atol=1e-15)
    assert on_rim.tolist() == [False, False, True, False]
    assert not square.is_closed


def test_parts_are_in_the_order_of_their_area():
    small, large = sphere_mesh(1.0), sphere_mesh(2.0)
    corners = np.concatenate([small.vertices, large.vertices + 9.0])
    both = ae.measures.TriangleMesh(corners, np.concatenate([small.faces, large.faces + len(small.vertices)]))
    assert [part.area for part in both.parts()] == pytest.approx([large.area, small.area])


def test_the_convex_hull_of_a_box_is_the_box():
    hull = ae.measures.ConvexHull(np.concatenate([CORNERS, [[0.0, 0.0, 0.5]]]))
    inside = BOX.distance(POINTS) <= 0
    np.testing.assert_allclose(hull.distance(POINTS)[inside], BOX.distance(POINTS)[inside], atol=1e-12)
    assert np.array_equal(hull.distance(POINTS) <= 0, inside)
    assert (hull.distance(POINTS) <= BOX.distance(POINTS) + 1e-12).all()
    assert hull.volume == pytest.approx(6.0)


@pytest.mark.parametrize("extents", [(9.0, 9.0, 9.0), (30.0, 4.0, 5.0), (20.0, 20.0, 0.01)])
@pytest.mark.parametrize("depth", [-1.0, 0.0, 0.5, 2.0, 50.0])
def test_cells_of_points_decide_as_the_points(extents, depth):
    places = np.random.default_rng(1).random((20_000, 3)) * extents
    hull = ae.measures.ConvexHull(places[:200])
    assert np.array_equal(hull.deeper(places, depth), hull.distance(places) <= -depth)
    assert hull.deeper(places[:1], depth)[0] == (hull.distance(places[:1])[0] <= -depth)
    assert len(hull.deeper(places[:0], depth)) == 0


@pytest.mark.parametrize(
    ("corners", "faces", "message"),
    [
        (CORNERS, [[0, 1, 8]], "faces must be indices from 0 to 7, got 0 to 8"),
        (CORNERS, [[0, 0, 1]], "faces must contain a triangle with an area, got 1 without"),
        (CORNERS, np.empty((0, 3), int), "faces must contain a triangle with an area, got 0 without"),
    ],
)
def test_wrong_triangles_are_named(corners, faces, message):
    with pytest.raises(ValueError, match=message):
        ae.measures.TriangleMesh(corners, faces)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.eye(3), np.repeat(CORNERS[:3], 5, axis=0)])
def test_a_hull_needs_an_extent(points):
    with pytest.raises(ValueError, match=f"needs at least four ions that are not in a plane, got {len(points)}"):
        ae.measures.ConvexHull(points)
