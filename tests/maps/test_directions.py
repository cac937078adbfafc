import math

import numpy as np
import pytest

from apt_evap import Material, Orientation, material
from apt_evap.maps.crystallography.directions import direction_normals, label, plane_normals, poles, zones
from apt_evap.specimen.lattice import Lattice, lattice_sites_in

OF_STRUCTURE = {
    "fcc": material("Ni"),
    "bcc": material("W"),
    "sc": Material("X", "sc", 0.3, 30.0, 1, 50.0),
    "diamond": material("Si"),
    "hcp": material("Ti"),
}


def families(crystal, count):
    """Sorted absolute indices (the first three of four) of each family, in order."""
    found = []
    for plane in poles(crystal, count).planes.tolist():
        *first, last = plane
        name = "".join(map(str, sorted(map(abs, plane)))) if len(plane) == 3 else (sorted(map(abs, first)), abs(last))
        if name not in found:
            found.append(name)
    return found


def test_order_of_visibility():
    # as the poles of field ion images are named: on paper, a over the root of h2 + k2 + l2 of the planes that diffract
    assert families(OF_STRUCTURE["fcc"], 8) == ["111", "002", "022", "113", "133", "024", "224", "115"]
    assert families(OF_STRUCTURE["bcc"], 6) == ["011", "002", "112", "013", "222", "123"]
    assert families(OF_STRUCTURE["sc"], 4) == ["001", "011", "111", "012"]
    assert families(OF_STRUCTURE["hcp"], 3) == [([0, 0, 0], 2), ([0, 1, 1], 1), ([0, 1, 1], 0)]


@pytest.mark.parametrize("structure", OF_STRUCTURE)
def test_spacings_are_those_of_the_atoms(structure):
    """Twin: the largest gap between the heights of all atoms of a ball, along each pole."""
    crystal = OF_STRUCTURE[structure]
    radius = 5 * crystal.a

    def ball(points):
        return np.linalg.norm(points, axis=1) - radius

    atoms, _ = lattice_sites_in(
        Lattice(structure, crystal.a, crystal.c, np.eye(3), (0, 0, 0)), ball, [[-radius] * 3, [radius] * 3]
    )
    found = poles(crystal, 6)
    assert len(found.planes) > 20
    for normal, spacing in zip(found.normals, found.spacings, strict=True):
        heights = np.sort(atoms @ normal)
        middle = heights[np.abs(heights) < 1.2 * crystal.a]  # near the rim of the ball layers are missing
        assert np.diff(middle).max() == pytest.approx(spacing, rel=1e-6)


def test_members_of_families():
    found = poles(OF_STRUCTURE["fcc"], 4)
    counts = np.bincount(np.unique(found.spacings.round(9), return_inverse=True)[1])[::-1]
    assert counts.tolist() == [8, 6, 12, 24]
    assert len(poles(OF_STRUCTURE["hcp"], 3).planes) == 2 + 12 + 6
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1)


def test_normals_of_hcp():
    titanium = OF_STRUCTURE["hcp"]
    normals = plane_normals(titanium, [(0, 0, 0, 2), (1, 0, -1, 0), (1, 0, -1, 1)])
    ratio = titanium.c / titanium.a
    tilt = math.atan(2 * ratio / math.sqrt(3))  # between (0001) and (10-11), any textbook
    np.testing.assert_allclose(normals @ normals[0], [1, 0, math.cos(tilt)], atol=1e-14)
    # a plane contains the directions whose indices give 0 with its own
    for plane, direction in [((1, 0, -1, 1), (1, -2, 1, 0)), ((1, 1, -2, 3), (1, 1, -2, -2))]:
        dot = plane_normals(titanium, [plane]) @ direction_normals(titanium, [direction])[0]
        assert sum(i * j for i, j in zip(plane, direction, strict=True)) == 0 and abs(dot[0]) < 1e-14
    np.testing.assert_allclose(plane_normals(titanium, [(1, 0, 1)]), normals[2:])


@pytest.mark.parametrize("structure", OF_STRUCTURE)
def test_every_zone_line_has_poles_on_it(structure):
    crystal = OF_STRUCTURE[structure]
    found, normals = zones(crystal), poles(crystal, 8).normals
    on_line = np.abs(normals @ found.directions.T) < 1e-12
    assert (on_line.sum(axis=0) >= 6).all()
    assert (np.abs(found.directions @ found.directions.T) > 1 - 1e-12).sum() == len(found.axes)  # no two opposite
    assert found.families.tolist() == sorted(found.families.tolist())


def test_labels_have_bars():
    assert label((-1, 1, 3)) == r"$\bar{1}13$"
    assert label((0, -12, 2)) == r"$0\,\bar{12}\,2$"
    assert poles(OF_STRUCTURE["hcp"], 1).labels == ("$0002$", r"$000\bar{2}$")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: poles(OF_STRUCTURE["fcc"], 0), "families must be an integer >= 1, got 0"),
        (lambda: poles(OF_STRUCTURE["fcc"], 51), "families must be <= 50"),
        (lambda: plane_normals(OF_STRUCTURE["fcc"], [(0, 0, 0)]), "planes must not have indices that are all zero"),
        (lambda: plane_normals(OF_STRUCTURE["fcc"], [(1, 0, -1, 0)]), r"planes must have shape \(n, 3\)"),
        (lambda: plane_normals(OF_STRUCTURE["hcp"], [(1, 0, 0, 0)]), "sum of 0"),
        (lambda: zones(OF_STRUCTURE["hcp"], [(1, 1, 0)]), r"a zone axis must have shape \(4,\)"),
        (lambda: zones(OF_STRUCTURE["fcc"], []), "at least one zone axis, got none"),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_an_orientation_stands_for_its_crystal(nickel):
    orientation = Orientation(nickel, (1, 1, 1), 20.0)
    for find in (poles, zones):
        expected = find(nickel)
        for crystal in (orientation, "Ni"):
            assert all(np.array_equal(a, b) for a, b in zip(find(crystal), expected, strict=True))
    with pytest.raises(ValueError, match="material"):
        poles(3)
