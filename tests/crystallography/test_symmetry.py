"""Point groups, and the symmetry of a crystal about the axis of a specimen."""

import numpy as np
import pytest
import scipy

import apt_evap as ae
from apt_evap.crystallography.symmetry import point_group, symmetry_about_axis
from apt_evap.specimen.lattice import rotation_to_axis


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
