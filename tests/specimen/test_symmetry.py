"""Point groups, and the symmetry of a crystal about the axis of a specimen."""

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

import apt_evap as ae
from apt_evap.maps.crystallography.directions import plane_normals, poles
from apt_evap.specimen.lattice import rotation_to_axis
from apt_evap.specimen.symmetry import point_group, pole_symmetry, symmetry_about_axis


@pytest.mark.parametrize(("structure", "order"), [("fcc", 48), ("bcc", 48), ("sc", 48), ("diamond", 48), ("hcp", 24)])
def test_point_groups(structure, order):
    members = point_group(structure)
    assert len(members) == order
    assert members @ members.transpose(0, 2, 1) == pytest.approx(np.broadcast_to(np.eye(3), (order, 3, 3)))
    products = np.einsum("aij,bjk->abik", members, members).reshape(-1, 9)
    distances, which = scipy.spatial.cKDTree(members.reshape(-1, 9)).query(products)
    assert distances.max() < 1e-12  # a group is closed
    assert len(set(which[:order].tolist())) == order  # and its members differ


@pytest.mark.parametrize(
    ("name", "axis", "order"),
    [
        ("Ni", (1, 1, 1), 6),
        ("Ni", (0, 0, 1), 8),
        ("Ni", (0, 1, 1), 4),
        ("Ni", (0, 1, 2), 2),
        ("Ni", (1, 2, 3), 1),
        ("W", (0, 1, 1), 4),
        ("Ti", (0, 0, 0, 1), 12),
        ("Ti", (1, 0, -1, 0), 4),
    ],
)
def test_the_symmetry_about_an_axis_is_that_of_the_lattice(name, axis, order):
    material = ae.material(name)
    tip = ae.Tip(material, apex_radius=1.6, axis=axis, rotation=17.0, shank_length=1.6, shank_angle=0.5)
    turns = symmetry_about_axis(material, rotation_to_axis(material, axis, 17.0))
    assert len(turns) == order
    # a lattice point is at the centre of the cap; hcp keeps its planes with a shift only
    if material.structure != "hcp":
        tree = scipy.spatial.cKDTree(tip.positions)
        near = tip.positions[np.linalg.norm(tip.positions, axis=1) < 1.5]
        for turn in turns:
            moved = np.column_stack([near[:, :2] @ turn.T, near[:, 2]])
            assert tree.query(moved)[0].max() < 1e-9


@pytest.mark.parametrize(
    ("name", "plane", "symmetry", "order"),
    [
        ("Ni", (1, 1, 1), "3m", 3),
        ("Ni", (0, 0, 2), "4mm", 4),
        ("W", (0, 1, 1), "2mm", 2),
        ("Si", (1, 1, 3), "m", 1),
        ("Fe", (1, 2, 3), "1", 1),
        ("Ti", (0, 0, 0, 2), "6mm", 6),
        ("Ti", (1, 0, -1, 0), "2mm", 2),
        ("Ti", (1, 0, -1, 1), "m", 1),
    ],
)
def test_the_symmetry_about_a_direction_is_that_of_the_poles(name, plane, symmetry, order):
    material = ae.material(name)
    direction = plane_normals(material, np.array([plane]))[0]
    found = pole_symmetry(material, direction)
    assert (found.name, found.order) == (symmetry, order) == pole_symmetry(material, -7.0 * direction)[:2]
    assert found.toward @ direction == pytest.approx(0, abs=1e-12) and np.linalg.norm(found.toward) == pytest.approx(1)
    normals = poles(material).normals
    if "m" in symmetry:
        mirror = np.cross(direction / np.linalg.norm(direction), found.toward)
        mirrored = normals - 2 * np.outer(normals @ mirror, mirror)
        assert (mirrored @ normals.T).max(axis=1).min() > 1 - 1e-9
    for fold in range(1, 13):
        turned = Rotation.from_rotvec(2 * np.pi / fold * direction / np.linalg.norm(direction)).apply(normals)
        onto_itself = (turned @ normals.T).max(axis=1).min() > 1 - 1e-9
        assert onto_itself == (order % fold == 0)


@pytest.mark.parametrize(
    ("name", "plane"), [("Ni", (1, 1, 1)), ("W", (0, 1, 1)), ("W", (1, 1, 2)), ("Ti", (1, 0, -1, 1))]
)
def test_symmetric_poles_have_symmetric_azimuths(name, plane):
    """Maps can be folded about different poles of a family: the same lines are at the same places."""
    material = ae.material(name)
    direction = plane_normals(material, np.array([plane]))[0]
    group = point_group(material.structure)
    first = pole_symmetry(material, direction)
    for member in group @ direction:
        found = pole_symmetry(material, member)
        moved = np.linalg.norm(group @ direction - member, axis=1) + np.linalg.norm(
            group @ first.toward - found.toward, axis=1
        )
        assert moved.min() < 1e-9
