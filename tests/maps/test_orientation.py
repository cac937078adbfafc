import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from apt_evap import DetectorMap, Orientation, Tip, material
from apt_evap.detection import Projection
from apt_evap.maps.crystallography.directions import plane_normals
from apt_evap.maps.crystallography.orientation import fit_orientation

MEASURED = Path(__file__).parents[3] / "shared" / "data"
PLANES = {
    "Ni": [(1, 1, 1), (0, 0, 2), (0, 2, 2), (1, 1, 3), (1, 3, 3), (1, 1, -1)],
    "W": [(0, 1, 1), (0, 0, 2), (1, 1, 2), (1, 2, 3), (1, 0, 1), (-1, 1, 2)],
    "Ti": [(0, 0, 0, 2), (1, 0, -1, 1), (0, 1, -1, 1), (1, 0, -1, 2), (1, 1, -2, 2), (2, -1, -1, 2)],
}
seeds = st.integers(0, 10**6)
few = settings(max_examples=max(2, settings.default.max_examples // 12))  # a fit with a free scale takes a second


def specimen(name, seed):
    """An orientation whose first plane is within some 25 degrees of the axis, and its poles within 75 degrees."""
    rng = np.random.default_rng(seed)
    normals = plane_normals(material(name), PLANES[name])
    near = Rotation.align_vectors([[0, 0, 1]], normals[:1])[0]
    tilt = Rotation.from_rotvec([*rng.uniform(-0.3, 0.3, 2), 0]) * Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)])
    matrix = (tilt * near).as_matrix()
    ahead = (normals @ matrix.T)[:, 2] > math.cos(math.radians(75))
    return matrix, np.array(PLANES[name])[ahead], rng


def between(one, other):
    """Angle of the rotation between two orientations [degrees]."""
    return math.degrees(Rotation.from_matrix(one @ other.T).magnitude())


@pytest.mark.parametrize("name", PLANES)
@given(seed=seeds)
def test_a_matrix_and_back(name, seed):
    matrix = Rotation.random(random_state=seed).as_matrix()
    orientation = Orientation.from_matrix(name, matrix)
    np.testing.assert_allclose(orientation.matrix, matrix, atol=1e-13)
    plain = json.loads(json.dumps([orientation.axis, orientation.rotation]))
    np.testing.assert_array_equal(Orientation(name, *plain).matrix, orientation.matrix)


@pytest.mark.parametrize("name", PLANES)
@given(seed=seeds)
def test_euler_angles(name, seed):
    rotation = Rotation.random(random_state=seed)
    angles = Orientation.from_matrix(name, rotation.as_matrix()).euler()
    # intrinsic rotations about z, x and z, as those of Bunge
    back = Rotation.from_euler("ZXZ", angles, degrees=True)
    assert between(back.as_matrix(), rotation.as_matrix()) < 1e-6
    assert all(0 <= angle < 360 for angle in angles) and angles[1] <= 180


@pytest.mark.parametrize("tilt", [0.0, 180.0])
@pytest.mark.parametrize("about", [0.0, 30.0, -1e-15])
def test_euler_angles_of_a_crystal_with_its_axis_along_z(tilt, about):
    rotation = Rotation.from_euler("ZX", [about, tilt], degrees=True)
    angles = Orientation.from_matrix("Ni", rotation.as_matrix()).euler()
    assert angles[2] == 0 and 0 <= angles[0] < 360 and angles[1] == pytest.approx(tilt, abs=1e-6)
    assert between(Rotation.from_euler("ZXZ", angles, degrees=True).as_matrix(), rotation.as_matrix()) < 1e-6


def test_euler_angles_of_named_orientations():
    # [001] along z and [100] along x: nothing is rotated; by 20 degrees about z: phi1
    assert Orientation("Ni").euler() == (0.0, 0.0, 0.0)
    assert Orientation("Ni", rotation=20.0).euler() == pytest.approx((20.0, 0.0, 0.0))
    assert Orientation("Ni", axis=(1, 1, 1)).euler()[1] == pytest.approx(math.degrees(math.acos(1 / math.sqrt(3))))


@pytest.mark.parametrize("name", PLANES)
def test_orix_has_the_same_directions_and_angles(name):
    vectors = pytest.importorskip("orix.vector")
    orientation = Orientation.from_matrix(name, Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix())
    other = orientation.to_orix()
    np.testing.assert_allclose(other.to_matrix()[0], orientation.matrix.T, atol=1e-12)
    vector = np.array([[0.2, -0.5, 0.8]])
    in_specimen = ~other * vectors.Vector3d(vector)
    np.testing.assert_allclose(in_specimen.data, orientation.directions(vector), atol=1e-12)
    np.testing.assert_allclose(np.degrees(other.to_euler()[0]), orientation.euler(), atol=1e-6)
    assert other.symmetry.size == (24 if name == "Ti" else 48)


def test_orix_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "orix", None)
    monkeypatch.setitem(sys.modules, "orix.quaternion", None)
    with pytest.raises(ImportError, match="to_orix needs orix, which is not installed: pip install orix"):
        Orientation("Ni").to_orix()


def test_an_orientation_goes_straight_into_a_tip():
    orientation = Orientation.from_matrix("Ni", Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix())
    tip = Tip("Ni", 2.0, axis=orientation.axis, rotation=orientation.rotation)
    assert Orientation.from_settings(json.loads(json.dumps(tip.settings))) == orientation
    assert Orientation.known(tip.settings) == orientation and Orientation.known({"atoms": 3}) is None
    # atoms of one row of nearest neighbours in the crystal are so in the tip
    step = orientation.matrix @ [0, 0.176, 0.176]
    origin = np.argmin(np.linalg.norm(tip.positions, axis=1))
    assert np.linalg.norm(tip.positions - tip.positions[origin] - step, axis=1).min() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANES)
@pytest.mark.parametrize("mirror", [False, True])
@given(seed=seeds)
@few
def test_orientation_and_scale_come_back_from_poles(name, mirror, seed):
    matrix, planes, rng = specimen(name, seed)
    true = Projection(rng.uniform(10, 80), tuple(rng.normal(0, 4, 2)), mirror)
    places = true.places(plane_normals(material(name), planes) @ matrix.T)
    fit = fit_orientation(name, planes, places, centre=true.centre, mirror=mirror)
    # exact data: what is left is the end of the iteration
    assert between(fit.orientation.matrix, matrix) < 1e-5
    assert fit.projection.scale == pytest.approx(true.scale, rel=1e-7)
    assert fit.residuals.max() < 1e-5 and fit.rms < 1e-5


@given(seed=seeds)
@few
def test_two_poles_are_enough(seed):
    matrix, planes, _ = specimen("Ni", seed)
    true = Projection(30.0)
    places = true.places(plane_normals(material("Ni"), planes[:2]) @ matrix.T)
    fit = fit_orientation("Ni", planes[:2], places, scale=30.0)
    assert between(fit.orientation.matrix, matrix) < 1e-5 and math.isnan(fit.scale_error)
    fit = fit_orientation("Ni", planes[:2], places)
    if fit.projection.scale == pytest.approx(30.0, rel=1e-6):
        assert between(fit.orientation.matrix, matrix) < 1e-4
    else:  # a second projection that shows the same: as exact, with smaller angles
        assert fit.projection.scale > 30.0 and fit.rms < 1e-6


@given(seed=seeds)
@few
def test_a_pole_and_a_zone_line_are_enough(seed):
    matrix, *_ = specimen("Ni", seed)
    true = Projection(30.0, (2.0, -1.0))
    first, other = plane_normals(material("Ni"), [(1, 1, 1), (0, 0, 2)])
    on_line = [(1 - share) * first + share * other for share in (0.2, 0.35, 0.5)]
    place, *points = true.places(np.array([first, *on_line]) @ matrix.T)
    options = {"lines": [((0, 0, 2), points)], "centre": true.centre}
    fit = fit_orientation("Ni", [(1, 1, 1)], [place], scale=30.0, **options)
    assert between(fit.orientation.matrix, matrix) < 1e-5
    # one point is enough, on the other side it is the line away from 002
    fit = fit_orientation("Ni", [(1, 1, 1)], [place], scale=30.0, **options | {"lines": [((0, 0, 2), points[:1])]})
    assert between(fit.orientation.matrix, matrix) < 1e-5
    with pytest.raises(ValueError, match=r"scale \[mm/rad\] must be given"):
        fit_orientation("Ni", [(1, 1, 1)], [place], **options)


@pytest.mark.parametrize("scale", [27.0, pytest.param(None, marks=pytest.mark.slow)])
def test_errors_are_what_noise_does(scale):
    """The spread over 30 maps with places read to 0.5 mm is the standard error that each of them states."""
    matrix, planes, rng = specimen("Ni", 3)
    true = Projection(27.0)
    exact = true.places(plane_normals(material("Ni"), planes) @ matrix.T)
    assert len(exact) >= 5
    fits = [fit_orientation("Ni", planes, exact + rng.normal(0, 0.5, exact.shape), scale=scale) for _ in range(30)]
    turned = np.sqrt(np.mean([between(fit.orientation.matrix, matrix) ** 2 for fit in fits]))
    # 30 fits of three degrees of freedom each: the roots of the means are known to 7 %, so 4 sigma
    assert turned == pytest.approx(np.sqrt(np.mean([fit.angle_error**2 for fit in fits])), rel=0.3)
    if scale is not None:
        assert np.isnan([fit.scale_error for fit in fits]).all()
        return
    spread = np.std([fit.projection.scale for fit in fits])
    assert spread == pytest.approx(np.sqrt(np.mean([fit.scale_error**2 for fit in fits])), rel=0.3)


def test_given_indices_tell_the_handedness_and_the_lattice_does_not():
    matrix, planes, _ = specimen("Ni", 5)
    places = Projection(27.0, mirror=True).places(plane_normals(material("Ni"), planes) @ matrix.T)
    fit = fit_orientation("Ni", planes, places, mirror=None)
    assert fit.projection.mirror and fit.mirrored_rms > 1
    # the same places with the members of the families that a mirror plane of the lattice makes of them
    other = fit_orientation("Ni", planes[:, [1, 0, 2]], places, mirror=None)
    assert not other.projection.mirror and other.rms < 1e-6
    assert fit_orientation("Ni", planes, places).rms == pytest.approx(fit.mirrored_rms)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"planes": [(1, 1, 1), (2, 2, 2)]}, "needs two poles in different directions, or a pole and a zone line"),
        ({"planes": [(1, 1, 1)], "places": [(0, 0)]}, "needs two poles"),
        ({"places": [(1, 0), (1, 0)]}, "places of the poles must be different"),
        ({"places": [(1, 0)]}, r"places must have shape \(2, 2\)"),
        ({"planes": [(1, 1, 1), (0, 0, 0)]}, "planes must not have indices that are all zero"),
        ({"lines": [(1, 1, 1)]}, "lines must be pairs of Miller indices and points"),
        ({"lines": [((2, 2, 2), [(3, 3)])]}, "must differ from that of the first pole"),
        ({"mirror": "yes"}, "mirror must be True or False, got"),
        ({"scale": -1}, "scale must be a finite number"),
        ({"material": 3}, "material must be a Material or its name"),
    ],
)
def test_what_is_refused(changes, message):
    given = {"material": "Ni", "planes": [(1, 1, 1), (0, 0, 2)], "places": [(0, 0), (20, 0)]} | changes
    with pytest.raises(ValueError, match=message):
        fit_orientation(given.pop("material"), given.pop("planes"), given.pop("places"), **given)


def test_a_matrix_that_is_no_rotation_and_settings_without_a_crystal():
    with pytest.raises(ValueError, match="matrix"):
        Orientation.from_matrix("Ni", np.diag([1, 1, -1]))
    with pytest.raises(ValueError, match="settings"):
        Orientation.from_settings({"atoms": 3})


def test_the_measured_map_of_nickel():
    """Three poles read off the map put bright zone lines and five poles that were not used where they are."""
    path = MEASURED / "ni111_map.npz"
    if not path.exists():
        pytest.skip(f"no measured map of nickel in {MEASURED}")
    with np.load(path) as data:
        map = DetectorMap.from_array(data["relative_density"], data["x_edges_mm"], data["y_edges_mm"])
    fit = fit_orientation("Ni", [(1, 1, 1), (1, 1, 3), (1, 3, 1)], [(-9.6, -0.4), (2.4, 6.2), (-7.5, -13.5)])
    assert fit.rms < 0.6  # mm, a bin and a half
    # gaps in the bright lines, read off the map to about 0.5 mm: 1 mm is half the distance to any other pole
    seen = {(1, 1, 2): (-1.2, 4.3), (1, 2, 1): (-8.5, -9.7), (1, 3, 3): (0, -5.1), (3, 1, 3): (-9, 9.6)}
    places = fit.projection.places(fit.orientation.directions(plane_normals(material("Ni"), list(seen))))
    assert np.linalg.norm(places - list(seen.values()), axis=1).max() < 1.0
    # along the six lines the map is brighter than half way between them
    centre, *around = fit.orientation.directions(
        plane_normals(material("Ni"), [(1, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1)])
    )
    tangents = [np.cross(np.cross(centre, other), centre) for other in around]
    tangents = np.array([tangent / np.linalg.norm(tangent) for tangent in tangents])
    halfway = tangents + np.roll(tangents, -1, axis=0)
    halfway /= np.linalg.norm(halfway, axis=1)[:, None]

    def brightness(directions):
        angles = np.radians(np.arange(7, 15))[:, None, None]
        x, y = fit.projection.places((np.cos(angles) * centre + np.sin(angles) * directions).reshape(-1, 3)).T
        return map.density[np.searchsorted(map.y_edges, y) - 1, np.searchsorted(map.x_edges, x) - 1].mean()

    # measured 2.18 along the lines, 1.57 between them
    assert brightness(tangents) > 1.2 * brightness(halfway)
