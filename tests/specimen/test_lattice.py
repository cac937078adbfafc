import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from apt_evap.specimen.lattice import (
    BASES,
    COORDINATION,
    Lattice,
    atom_density,
    cell_lengths,
    direction_vectors,
    lattice_sites_in,
    nearest_neighbour_distance,
    rotation_to_axis,
)
from apt_evap.specimen.materials import material

# number of neighbours and squared distance [a^2] of the first shells: Kittel ch. 1, and counting on paper
SHELLS = {
    "fcc": [(12, 1 / 2), (6, 1), (24, 3 / 2), (12, 2)],
    "bcc": [(8, 3 / 4), (6, 1), (12, 2), (24, 11 / 4), (8, 3)],
    "sc": [(6, 1), (12, 2), (8, 3), (6, 4)],
    "diamond": [(4, 3 / 16), (12, 1 / 2), (12, 11 / 16), (6, 1)],
    "hcp": [(12, 1), (6, 2), (2, 8 / 3), (18, 3), (12, 11 / 3)],
}
A = 0.36
axes = st.tuples(*[st.integers(-6, 6)] * 3).filter(any)


def ball(radius, centre=(0.0, 0.0, 0.0)):
    def signed_distance(points):
        return np.linalg.norm(points - np.array(centre), axis=1) - radius

    return signed_distance, np.add([centre, centre], [[-radius] * 3, [radius] * 3])


def uniform(depth):
    return lambda points: np.full(len(points), depth)


def points_in_ball(structure, radius, axis=(0, 0, 1), origin=(0, 0, 0), **options):
    return lattice_sites_in(
        Lattice(structure, A, None, rotation_to_axis(structure, axis), origin), *ball(radius), **options
    )[0]


@pytest.mark.parametrize("structure", BASES)
@given(axis=axes, site=st.integers(0, 7), shift=st.tuples(*[st.floats(-1, 1)] * 3))
def test_shells_of_neighbours_of_every_site(structure, axis, site, shift):
    shells = SHELLS[structure]
    reach = A * (math.sqrt(shells[-1][1]) + 0.01)
    orientation = rotation_to_axis(structure, axis)
    basis = np.array(BASES[structure])
    centre = orientation @ (basis[site % len(basis)] * cell_lengths(structure, A)) + shift
    points = lattice_sites_in(Lattice(structure, A, None, orientation, shift), *ball(reach, centre))[0]
    distances = np.sort(np.linalg.norm(points - centre, axis=1)) / A
    expected = [0.0] + [math.sqrt(square) for count, square in shells for _ in range(count)]
    np.testing.assert_allclose(distances, expected, atol=1e-12)  # rounding at coordinates of a few a


@pytest.mark.parametrize("structure", BASES)
def test_nearest_neighbour_distance_and_coordination_agree_with_the_shells(structure):
    (count, square), (second, _) = SHELLS[structure][:2]
    assert nearest_neighbour_distance(structure, A) == pytest.approx(A * math.sqrt(square), rel=1e-14)
    assert COORDINATION[structure] == (count, second)


def test_real_hcp_has_two_shells_of_six():
    titanium = material("Ti")
    orientation = rotation_to_axis(titanium, (0, 0, 1))
    points = lattice_sites_in(Lattice("hcp", titanium.a, titanium.c, orientation, (0, 0, 0)), *ball(1.02 * titanium.a))[
        0
    ]
    distances = np.sort(np.linalg.norm(points, axis=1))[1:]
    between = math.sqrt(titanium.a**2 / 3 + titanium.c**2 / 4)
    np.testing.assert_allclose(distances, [between] * 6 + [titanium.a] * 6, rtol=1e-12)
    assert titanium.nearest_neighbour_distance == pytest.approx(between, rel=1e-14)


@pytest.mark.parametrize("structure", BASES)
def test_density_times_volume_is_the_number_of_points(structure):
    radius = 12 * A
    expected = 4 / 3 * math.pi * radius**3 * atom_density(structure, A)
    surface = 4 * math.pi * (radius / A) ** 2
    # around a generic centre the count strays from the volume by a few roots of the sites on the surface
    found = len(points_in_ball(structure, radius, (1, 2, 3), origin=(0.011, 0.023, 0.037)))
    assert abs(found - expected) < 8 * math.sqrt(surface)


@given(axis=axes, rotation=st.floats(-400, 400), structure=st.sampled_from([*BASES]))
def test_rotation_brings_the_axis_onto_z(axis, rotation, structure):
    matrix = rotation_to_axis(structure, axis, rotation)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-14)
    vectors = np.eye(3)
    if structure == "hcp":
        vectors = np.array([[1, 0, 0], [-1 / 2, math.sqrt(3) / 2, 0], [0, 0, math.sqrt(8 / 3)]])
    direction = np.array(axis) @ vectors
    np.testing.assert_allclose(matrix @ direction, [0, 0, np.linalg.norm(direction)], atol=1e-13)
    turned = rotation_to_axis(structure, axis, 0.0)
    cos, sin = math.cos(math.radians(rotation)), math.sin(math.radians(rotation))
    np.testing.assert_allclose(matrix, np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ turned, atol=1e-13)


@pytest.mark.parametrize(
    ("axis", "across"),
    [
        ((0, 0, 1), (1, 0, 0)),
        ((0, 1, 2), (1, 0, 0)),
        ((1, 1, 1), (1, 0, -1)),
        ((0, 1, 1), (1, 0, 0)),
        ((1, 1, 2), (1, -1, 0)),
    ],
)
def test_documented_direction_along_x(axis, across):
    across = np.array(across) / np.linalg.norm(across)
    np.testing.assert_allclose(rotation_to_axis("fcc", axis) @ across, [1, 0, 0], atol=1e-15)


@given(
    axis=st.tuples(*[st.floats(-3, 3)] * 3).filter(lambda axis: max(map(abs, axis)) > 0.01),
    length=st.floats(0.01, 100),
    structure=st.sampled_from([*BASES]),
)
def test_any_axis_comes_onto_z_whatever_its_length(axis, length, structure):
    matrix = rotation_to_axis(structure, axis)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-14)
    direction = np.array(axis) @ direction_vectors(structure, A)
    np.testing.assert_allclose(matrix @ direction, [0, 0, np.linalg.norm(direction)], atol=1e-13)
    longer = [length * number for number in axis]
    if all(number == round(number) for number in axis) or all(number == round(number) for number in longer):
        return  # whole numbers have a lattice direction along x
    edge = np.argmin(np.round(np.abs(matrix[2]), 6))
    if np.sort(np.abs(matrix[2]))[1] > np.abs(matrix[2]).min() + 1e-5:  # one edge is the most nearly perpendicular
        # that edge has no part along y, and a positive one along x
        assert abs(matrix[1, edge]) < 1e-14 and matrix[0, edge] > 0
        np.testing.assert_allclose(rotation_to_axis(structure, longer), matrix, atol=1e-12)


def test_the_bits_of_lattice_directions():
    # the rule of whole numbers, and its very rounding, stay as they are: runs of before are made again from them
    assert rotation_to_axis("fcc", (1, 1, 1))[0].tolist() == [0.7071067811865475, 0.0, -0.7071067811865475]
    np.testing.assert_array_equal(rotation_to_axis("fcc", (1.0, 1.0, 1.0)), rotation_to_axis("fcc", (1, 1, 1)))


def test_large_indices_have_a_perpendicular_lattice_direction():
    matrix = rotation_to_axis("fcc", (41, 73, 101))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)


def test_common_factors_do_not_matter():
    np.testing.assert_array_equal(rotation_to_axis("fcc", (2, 2, 2)), rotation_to_axis("fcc", (1, 1, 1)))


def test_four_indices_are_the_same_directions_as_three():
    titanium = material("Ti")
    for four, three in [((2, -1, -1, 0), (1, 0, 0)), ((0, 0, 0, 1), (0, 0, 1)), ((1, 0, -1, 1), (2, 1, 1))]:
        np.testing.assert_array_equal(rotation_to_axis(titanium, four), rotation_to_axis(titanium, three))


@pytest.mark.parametrize(
    ("structure", "axis", "message"),
    [
        ("fcc", (0, 0, 0), "axis must not be zero"),
        ("hcp", (0, 0, 0, 0), "axis must not be zero"),
        ("hcp", (1, 1, 1, 0), r"u \+ v \+ t = 0"),
        ("fcc", (1, 1, -2, 0), r"axis must be three numbers such as \[0, 1, 2\], got \(1, 1, -2, 0\)"),
        ("hcp", (0.5, 0.1, 0.3, 1.0), r"u \+ v \+ t = 0"),
        ("fcc", (0.5, math.nan, 0), "axis must be finite"),
        ("fcc", (1e9, 1, 0), "axis must have its largest number between"),
        ("fcc", "111", "axis"),
        ("cubic", (0, 0, 1), "structure must be one of"),
    ],
)
def test_bad_directions_are_refused(structure, axis, message):
    with pytest.raises(ValueError, match=message):
        rotation_to_axis(structure, axis)


@given(
    structure=st.sampled_from([*BASES]),
    axis=axes,
    blocks=st.tuples(st.integers(1, 5), st.integers(6, 12)),
    depth=st.one_of(st.none(), st.floats(0.3, 2.0)),
)
def test_points_and_their_order_do_not_depend_on_the_blocks(structure, axis, blocks, depth):
    small, large = (
        points_in_ball(structure, 5 * A, axis, depth=depth and uniform(depth), block=block) for block in blocks
    )
    np.testing.assert_array_equal(small, large)


def test_points_do_not_depend_on_the_chunks(monkeypatch):
    whole = points_in_ball("fcc", 10 * A, (1, 1, 1))
    monkeypatch.setattr("apt_evap.specimen.lattice._CHUNK", 1)
    np.testing.assert_array_equal(points_in_ball("fcc", 10 * A, (1, 1, 1)), whole)


def test_shell_is_the_outer_part_of_the_whole():
    whole = points_in_ball("bcc", 9 * A, (1, 1, 0))
    shell = points_in_ball("bcc", 9 * A, (1, 1, 0), depth=uniform(2 * A))
    np.testing.assert_array_equal(shell, whole[np.linalg.norm(whole, axis=1) - 9 * A >= -2 * A])
    assert 0 < len(shell) < len(whole)


def test_brute_force_gives_the_same_points():
    orientation = rotation_to_axis("diamond", (1, 2, 3), 17.0)
    origin = np.array([0.1, -0.2, 0.05])
    cells = np.indices((17, 17, 17)).reshape(3, -1).T - 8
    everything = np.concatenate([(cells + site) * A for site in BASES["diamond"]]) @ orientation.T + origin
    expected = everything[np.linalg.norm(everything, axis=1) <= 4 * A]
    found = lattice_sites_in(Lattice("diamond", A, None, orientation, origin), *ball(4 * A))[0]
    assert len(found) == len(expected)
    assert cKDTree(expected).query(found)[0].max() < 1e-12  # rounding only
